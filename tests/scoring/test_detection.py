"""Claim: found, missed and false alarms are counted as they are, by kind and by channel."""

from __future__ import annotations

import pandas as pd
import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.scoring import ScoreParams, score
from pse_analysis.scoring.detection import of_faults
from pse_analysis.vocabulary import Reason, severity

A, B = "scada:bus/1:p_mw", "scada:bus/2:p_mw"


def validated() -> pd.DataFrame:
    reasons = {
        A: [0, Reason.EXTRAPOLATION, 0, Reason.INCREMENT, Reason.NOT_FINITE, 0],
        B: [Reason.DUPLICATE, Reason.DUPLICATE | Reason.INCREMENT, Reason.STEP_ACCEPTED, 0, 0, 0],
    }
    frame = pd.DataFrame(
        [(0, c, i, int(r)) for c, all_ in reasons.items() for i, r in enumerate(all_)],
        columns=["trial", "channel", "seq", "reasons"],
    ).astype({"trial": "int32", "reasons": "int32"})
    return frame.assign(flag=severity(frame["reasons"].to_numpy()))


def faults() -> pd.DataFrame:
    rows = [(A, 1, "spike"), (A, 2, "spike"), (A, 4, "empty"), (B, 0, "duplicated"), (B, None, "lost")]  # fmt: skip # noqa: E501
    frame = pd.DataFrame(rows, columns=["channel", "seq", "kind"])
    return frame.assign(trial=0, seq=frame["seq"].astype("Int64"), size=1.0)


def values(scored: pd.DataFrame, element: str) -> dict[str, float]:
    own = scored[scored.element == element]
    return dict(zip(own.metric, own.value, strict=True))


def test_whole_case_counts_faults_that_arrived_and_alarms_on_good_samples() -> None:
    found = values(of_faults(validated(), faults()), "")
    assert (found["found"], found["missed"], found["false_alarms"]) == (3, 1, 2)
    assert found["recall"] == pytest.approx(3 / 4)
    assert found["precision"] == pytest.approx(3 / 5)
    assert found["false_alarm_rate"] == pytest.approx(2 / 8)


def test_false_alarm_counts_for_the_kind_that_its_reasons_speak_of() -> None:
    scored = of_faults(validated(), faults())
    assert values(scored, "spike")["false_alarms"] == 1
    assert values(scored, "spike")["precision"] == pytest.approx(1 / 2)
    assert values(scored, "duplicated")["false_alarms"] == 1
    assert values(scored, "empty")["precision"] == 1.0
    assert "lost" not in set(scored.element)


def test_by_channel_adds_up_to_the_whole() -> None:
    scored = of_faults(validated(), faults(), by_channel=True)
    for metric in ("found", "missed", "false_alarms"):
        parts = sum(values(scored, c)[metric] for c in (A, B))
        assert parts == values(scored, "")[metric]
    assert not set(of_faults(validated(), faults()).element) & {A, B}


def test_case_without_methods_is_scored_on_its_faults() -> None:
    none = pd.DataFrame(columns=["method"])
    scored = score(none, none, validated(), None, faults(), ScoreParams(by_channel=True))
    assert set(scored.method) == {"validate"}
    with pytest.raises(ParameterError, match="nothing to score"):
        score(none, none, validated())
