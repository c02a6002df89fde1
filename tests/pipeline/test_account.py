"""Claim: the account of a run names what was flagged, what did not work and what stands out."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pandas as pd
import pytest

from pse_analysis.parameters import Study
from pse_analysis.pipeline import account
from pse_analysis.validation import Rule, ValidateParams, validate
from pse_analysis.vocabulary import Flag, Reason

CHANNELS = ["a", "b", "c", "dead"]
TIMES = pd.date_range("2024-05-14T12:00Z", periods=10, freq="5min", unit="us")
START = TIMES[0].to_pydatetime()
STUDY = Study(START, START + timedelta(minutes=50), 300.0, history_s=3600.0)


def channels(*names: str, **changes: object) -> pd.DataFrame:
    row = {
        "source": "scada", "quantity": "p_mw", "element": "bus/1", "side": "", "unit": "mw",
        "sigma": 0.01, "sigma_kind": "absolute", "lower": np.nan, "upper": np.nan,
        "period_s": 300.0, "sign": np.int8(1), "aggregation": "instant",
    }  # fmt: skip
    return pd.DataFrame([{"channel": name, **row, **changes} for name in names or CHANNELS])


def validated() -> pd.DataFrame:
    """Ten samples of three channels: most of c are bad, one of a is, the fourth is silent."""
    frame = pd.DataFrame({"channel": np.repeat(CHANNELS[:3], 10), "flag": 0, "reasons": 0})
    frame["trial"], frame["value"], frame["time_utc"] = 0, 5e3, np.tile(TIMES, 3)
    frame["threshold"] = np.where(frame["channel"] == "b", np.nan, 0.1)
    frame.loc[[3, *range(20, 29)], ["flag", "reasons"]] = int(Flag.BAD), int(Reason.INCREMENT)
    frame.loc[5, ["flag", "reasons"]] = int(Flag.SUSPECT), int(Reason.LATE)
    return frame


def steps(status: list[str], detail: str = "") -> pd.DataFrame:
    """Steps of one method."""
    return pd.DataFrame(
        {"method": "wls", "time_utc": TIMES[: len(status)], "status": status, "detail": detail}
    )


def residuals(**size: float) -> pd.DataFrame:
    """Innovations of two methods, in units of their σ; the second is ten times as far off."""
    parts = [
        pd.DataFrame(
            {"method": m, "channel": c, "innovation": k * s, "sigma_innovation": 1.0, "used": True},
            index=range(5),
        )
        for k, m in ((1.0, "wls"), (10.0, "kf"))
        for c, s in size.items()
    ]
    return pd.concat(parts, ignore_index=True)


def of_run(
    found: pd.DataFrame | None = None,
    status: pd.DataFrame | None = None,
    listed: pd.DataFrame | None = None,
    *rules: Rule,
    study: Study = STUDY,
    **size: float,
) -> account.Account:
    return account.of_run(
        channels() if listed is None else listed,
        validated() if found is None else found,
        steps(["ok"] * 10) if status is None else status,
        residuals(**(size or {"a": 1.0})),
        study=study,
        params=ValidateParams(rules),
    )


def measured(n_before: int, **changes: object) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Table ``validated`` of one channel with that many samples of history, and its channels."""
    n = n_before + 10
    period = float(changes.pop("spacing", 300.0))
    time = pd.Series(START + pd.to_timedelta((np.arange(n) - n_before) * period, unit="s"))
    rng = np.random.default_rng(4)
    frame = pd.DataFrame(
        {
            "trial": np.zeros(n, dtype=np.int32),
            "channel": "a",
            "seq": np.arange(n),
            "time_utc": time.dt.as_unit("us"),
            "arrival_utc": time.dt.as_unit("us"),
            "value": 5.0 + rng.normal(0.0, 0.1, n).cumsum(),
            "quality": pd.array([pd.NA] * n, dtype="Int16"),
        }
    )
    spike = changes.pop("spike", None)
    if spike is not None:
        frame.loc[n_before + 3, "value"] = spike
    listed = channels("a", **changes)
    rules = changes.pop("rules", ())
    return validate(frame, listed, ValidateParams(rules), history_end=START), listed


def test_samples_are_counted_by_reason_and_silent_channels_are_named() -> None:
    told = of_run().findings
    assert told == (
        "telemetry: 30 samples of 4 channels, 11 flagged, reasons: increment 10, late 1",
        "channels without a usable sample: dead",
        "channels of which most samples are flagged: c (90%)",
    )


def test_steps_that_did_not_work_are_told_with_their_first_reason() -> None:
    wrong = steps(["ok", "unobservable", "unobservable", "diverged"], "add a flow")
    told = of_run(status=wrong).findings
    assert "wls: 2 × unobservable, 1 × diverged; first at 2024-05-14 12:05: add a flow" in told


def test_a_channel_that_no_method_agrees_with_is_named_and_one_that_a_method_lost_is_not() -> None:
    told = of_run(status=steps(["ok"]), a=1.0, b=8.0).findings
    assert told[-1].startswith("channels that no method can agree with: b (12 σ): look at")


def test_channels_without_a_learnt_threshold_are_counted_first_with_the_reason_and_a_remedy() -> (
    None
):
    assert of_run().notices == (
        "no threshold for changes was learnt for 1 of 4 channels (b): their history of 3600 s "
        "holds 0 usable samples, and 20 increments over one period_s are needed. A wrong value of "
        "theirs inside the limits enters the estimates. Lengthen [study] history_s to 9000 or "
        "more, with telemetry to fill it, or state increment = … for them in [[validate.rules]]",
    )
    none = of_run(study=Study(STUDY.start, STUDY.end, 300.0)).notices
    assert "(b): there is no history (history_s = 0). A wrong value" in none[0]


@pytest.mark.parametrize(("n_before", "told"), [(0, 1), (20, 1), (21, 0), (60, 0)])
def test_the_notice_follows_what_the_stage_did(n_before: int, told: int) -> None:
    found, listed = measured(n_before)
    assert found["threshold"].isna().all() == bool(told)
    notices = of_run(found, listed=listed).notices
    assert len(notices) == told
    if told:
        assert f"holds {n_before} usable samples" in notices[0]


def test_thresholds_that_are_stated_or_not_asked_for_are_no_reason_for_a_notice() -> None:
    found, listed = measured(5, rules=(Rule(increment=1.0),))
    assert of_run(found, None, listed, Rule(increment=1.0)).notices == ()
    found, listed = measured(5, rules=(Rule(checks=("limits", "time")),))
    told = of_run(found, None, listed, Rule(checks=("limits", "time")))
    assert told.notices == ()
    assert "changes were not checked: no rule asks for it" in told.findings
    told = of_run(None, None, None, Rule(channel="b", checks=("time",)))
    assert told.notices == ()
    assert "changes were not checked, because no rule asks for it, of b" in told.findings


def test_a_sample_out_of_limits_does_not_pass_for_a_threshold_of_changes() -> None:
    found, listed = measured(5, spike=1e9, upper=100.0)
    assert found["threshold"].notna().sum() == 1
    assert len(of_run(found, listed=listed).notices) == 1


def test_samples_out_of_default_limits_are_counted_with_what_the_limits_follow_from() -> None:
    angle = {"quantity": "va_degree", "unit": "degree"}
    found, listed = measured(5, spike=1e6, **angle)
    told = [t for t in of_run(found, listed=listed).findings if "default limits" in t]
    assert told == [
        "samples outside the default limits, which no plant exceeds: a (1, e.g. 1e+06; 2 turns): "
        "look at the unit, or state lower and upper"
    ]
    found, listed = measured(5, spike=1e6, upper=180.0, **angle)
    assert found["reasons"].tolist().count(int(Reason.LIMIT)) == 1
    assert not [t for t in of_run(found, listed=listed).findings if "default limits" in t]


def test_a_wrong_period_is_told_before_the_thresholds_that_it_cost() -> None:
    found, listed = measured(60, spacing=60.0)
    notices = of_run(found, listed=listed).notices
    assert notices[0].startswith("period_s = 300 is stated, but samples come every 60 s: a: write")
    assert len(notices) == 2
    assert notices[1].startswith("no threshold for changes was learnt for 1 of 1 channels (a)")
    assert notices[1].endswith("; mend period_s first where it is wrong")
    found, listed = measured(60, spacing=60.0, period_s=60.0)
    assert of_run(found, listed=listed).notices == ()
