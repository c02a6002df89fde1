"""Claim: every score equals what one computes by hand on a table of a few rows."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pse_analysis.errors import ParameterError, TableError
from pse_analysis.scoring import Published, ScoreParams, consistency, detection, errors, score
from pse_analysis.vocabulary import check

START = pd.Timestamp("2016-06-09T06:00:00Z")


def at(minutes: object) -> pd.Series:
    offset = pd.to_timedelta(pd.Series(minutes), unit="min")
    return (START + offset).astype("datetime64[us, UTC]")


def estimates(rows: list[tuple[str, int, str, str, float, float]]) -> pd.DataFrame:
    """Table ``estimated`` of (method, minute, element, quantity, value, σ)."""
    frame = pd.DataFrame(
        rows, columns=["method", "minute", "element", "quantity", "value", "sigma"]
    )
    frame["time_utc"] = at(frame["minute"])
    return check(
        "estimated", frame.assign(trial=np.int32(0), relative=np.nan, sigma_relative=np.nan)
    )


def truths(rows: list[tuple[int, str, str, float]]) -> pd.DataFrame:
    frame = pd.DataFrame(rows, columns=["minute", "element", "quantity", "value"])
    frame["time_utc"] = at(frame["minute"])
    return check("truth", frame.assign(trial=np.int32(0), relative=np.nan, sigma_relative=np.nan))


def steps(rows: list[tuple[int, str, float, int, float]]) -> pd.DataFrame:
    """Table ``steps`` of (minute, status, nis, dof, nees)."""
    frame = pd.DataFrame(rows, columns=["minute", "status", "nis", "dof", "nees"])
    frame["time_utc"] = at(frame["minute"])
    return check(
        "steps",
        frame.assign(
            method="kf", trial=np.int32(0), iterations=np.int32(1), rejected=np.int32(0),
            seconds=0.25, detail="", dof=frame["dof"].astype("int32"),
        ),
    )  # fmt: skip


def flagged(flags: list[int]) -> pd.DataFrame:
    """Table ``validated`` of one channel."""
    n = len(flags)
    return check(
        "validated",
        pd.DataFrame(
            {
                "trial": np.int32(0),
                "channel": "a",
                "seq": np.arange(n, dtype=np.int64),
                "time_utc": at(range(n)),
                "arrival_utc": at(range(n)),
                "value": 1.0,
                "quality": pd.array([pd.NA] * n, dtype="Int16"),
                "flag": np.array(flags, dtype="int8"),
                "reasons": np.int32(0),
                "statistic": np.nan,
                "threshold": np.nan,
                "corrected": 1.0,
            }
        ),
    )


def injected(rows: list[tuple[int | None, str]]) -> pd.DataFrame:
    """Table ``faults`` of (seq, kind)."""
    frame = pd.DataFrame(rows, columns=["seq", "kind"]).astype({"seq": "Int64"})
    return check(
        "faults",
        frame.assign(trial=np.int32(0), channel="a", time_utc=at([0] * len(frame)), size=1.0),
    )


def value(scored: pd.DataFrame, metric: str, element: str = "", method: str | None = None) -> float:
    rows = scored[(scored["metric"] == metric) & (scored["element"] == element)]
    if method is not None:
        rows = rows[rows["method"] == method]
    assert len(rows) == 1
    return float(rows["value"].iloc[0])


TRUTH = truths(
    [(m, e, q, v) for m in (0, 60) for e, q, v in (
        ("bus/1", "vm_pu", 1.0), ("bus/2", "vm_pu", 0.9),
        ("bus/1", "va_degree", 0.0), ("bus/2", "va_degree", 179.0))]
)  # fmt: skip
ESTIMATED = estimates(
    [
        ("kf", 0, "bus/1", "vm_pu", 1.01, 0.01),
        ("kf", 0, "bus/2", "vm_pu", 0.87, 0.01),
        ("kf", 60, "bus/1", "vm_pu", 1.00, 0.01),
        ("kf", 60, "bus/2", "vm_pu", np.nan, np.nan),
        ("kf", 0, "bus/1", "va_degree", 0.0, 0.0),
        ("kf", 0, "bus/2", "va_degree", -179.0, 1.5),
        ("kf", 60, "bus/2", "va_degree", 178.0, 0.4),
    ]
)


def test_errors_by_hand() -> None:
    scored = errors.of_states(errors.against_truth(ESTIMATED, TRUTH))
    assert value(scored, "vm_error_mean") == pytest.approx((0.01 + 0.03 + 0.0) / 3)
    assert value(scored, "vm_error_max") == pytest.approx(0.03)
    assert value(scored, "vm_rmse") == pytest.approx(np.sqrt((1e-4 + 9e-4) / 3))
    assert value(scored, "vm_error_mean", "bus/1") == pytest.approx(0.005)
    # From 179° to -179° it is 2°, not 358.
    assert value(scored, "va_error_max") == pytest.approx(np.deg2rad(2.0))
    assert value(scored, "va_error_mean", "bus/2") == pytest.approx(np.deg2rad(1.5))
    units = dict(zip(scored["metric"], scored["unit"], strict=True))
    assert (units["vm_rmse"], units["va_rmse"]) == ("pu", "rad")


def test_coverage_by_hand() -> None:
    scored = consistency.coverage(errors.against_truth(ESTIMATED, TRUTH))
    assert value(scored, "coverage_vm") == pytest.approx(2 / 3)
    assert value(scored, "coverage_vm", "hour/06") == pytest.approx(1 / 2)
    assert value(scored, "coverage_vm", "hour/07") == 1.0
    # The reference angle has no σ and does not count: one of two is inside.
    assert value(scored, "coverage_va") == pytest.approx(1 / 2)


def test_truth_that_matches_no_estimate_is_refused() -> None:
    later = TRUTH.assign(time_utc=TRUTH["time_utc"] + pd.Timedelta(seconds=1))
    with pytest.raises(TableError, match="no row matches an estimate by trial, time_utc"):
        errors.against_truth(ESTIMATED, later)


def test_consistency_by_hand() -> None:
    """Three states have a σ at minutes 0 and 5, two at 10 and 60; the angle of bus 1 is fixed."""
    scored = consistency.of_steps(
        steps(
            [
                (0, "ok", np.nan, 0, np.nan),
                (5, "ok", 12.0, 10, 4.0),
                (10, "predicted", np.nan, 0, 6.0),
                (60, "inconsistent", 8.0, 30, 8.0),
            ]
        ),
        estimates(
            [
                ("kf", minute, bus, quantity, 1.0, sigma)
                for minute in (0, 5, 10, 60)
                for bus, quantity, sigma in (
                    ("bus/1", "vm_pu", 0.01 if minute < 10 else np.nan),
                    ("bus/1", "va_degree", 0.0),
                    ("bus/2", "vm_pu", 0.01),
                    ("bus/2", "va_degree", 0.1),
                )
            ]
        ),
    )
    assert value(scored, "nis_ratio") == pytest.approx(20 / 40)
    assert value(scored, "nis_ratio", "hour/06") == pytest.approx(1.2)
    assert value(scored, "nis_ratio", "hour/07") == pytest.approx(8 / 30)
    assert value(scored, "nees_ratio") == pytest.approx((4 + 6 + 8) / (3 + 2 + 2))
    assert value(scored, "steps_not_ok") == 2
    assert value(scored, "seconds") == 1.0


@pytest.mark.parametrize(("dof", "confidence"), [(10, 0.99), (2000, 0.999)])
def test_bounds_hold_their_share_of_chi_square(dof: int, confidence: float) -> None:
    low, high = consistency.bounds(dof, confidence)
    inside = stats.chi2.cdf(high * dof, dof) - stats.chi2.cdf(low * dof, dof)
    assert inside == pytest.approx(confidence)
    assert low < 1 < high


def test_nominal_coverage_is_that_of_two_sigma() -> None:
    assert pytest.approx(0.9545, abs=1e-4) == consistency.NOMINAL_COVERAGE


def test_detection_by_hand() -> None:
    """Seven samples: spikes at 0 (found) and 1 (missed), stale at 2 (found), alarm at 4."""
    scored = detection.of_faults(
        flagged([2, 0, 1, 0, 2, 0, 0]),
        injected([(0, "spike"), (1, "spike"), (2, "stale"), (None, "lost")]),
    )
    assert value(scored, "found") == 2
    assert value(scored, "missed") == 1
    assert value(scored, "recall") == pytest.approx(2 / 3)
    assert value(scored, "false_alarms") == 1
    assert value(scored, "precision") == pytest.approx(2 / 3)
    assert value(scored, "false_alarm_rate") == pytest.approx(1 / 4)
    assert value(scored, "recall", "spike") == pytest.approx(1 / 2)
    assert value(scored, "recall", "stale") == 1.0
    assert "lost" not in set(scored["element"])


def test_sample_with_two_faults_counts_once_among_all_and_once_of_each_kind() -> None:
    scored = detection.of_faults(
        flagged([2, 2, 0]), injected([(0, "spike"), (0, "delayed"), (2, "spike")])
    )
    assert value(scored, "found") == 1
    assert value(scored, "missed") == 1
    assert value(scored, "precision") == pytest.approx(1 / 2)
    assert value(scored, "recall", "delayed") == 1.0
    assert value(scored, "recall", "spike") == pytest.approx(1 / 2)


def test_no_fault_and_no_flag_have_no_rate() -> None:
    scored = detection.of_faults(flagged([0, 0]), injected([]))
    assert np.isnan(value(scored, "precision"))
    assert np.isnan(value(scored, "recall"))
    assert value(scored, "false_alarm_rate") == 0.0


def test_score_brings_them_together_and_leaves_out_what_nothing_is_known_of() -> None:
    some = steps([(0, "ok", 9.0, 10, 4.0)])
    seen = flagged([2, 0])
    whole = score(ESTIMATED, some, seen, TRUTH, injected([(0, "spike")]))
    assert value(whole, "vm_error_max", method="kf") == pytest.approx(0.03)
    assert value(whole, "nis_ratio", method="kf") == pytest.approx(0.9)
    assert value(whole, "recall", method="validate") == 1.0
    real = score(ESTIMATED, some, seen)
    assert set(real["method"]) == {"kf"}
    assert not real["metric"].str.contains("error|coverage|recall").any()
    short = score(ESTIMATED, some, seen, TRUTH, None, ScoreParams(by_hour=False, by_element=False))
    assert set(short["element"]) == {""}


def test_printed_numbers_stand_beside_the_scores_and_change_none() -> None:
    some, seen = steps([(0, "ok", 9.0, 10, 4.0)]), flagged([0])
    printed = Published(method="kf", metric="vm_error_max", value=0.5, source="[x], Table 1")
    with_print = score(ESTIMATED, some, seen, TRUTH, None, ScoreParams(published=(printed,)))
    plain = score(ESTIMATED, some, seen, TRUTH)
    np.testing.assert_array_equal(with_print["value"], plain["value"])
    row = with_print[with_print["published"].notna()]
    assert row[["metric", "published", "source"]].to_numpy().tolist() == [
        ["vm_error_max", 0.5, "[x], Table 1"]
    ]
    wrong = Published(method="kf", metric="vm_eror_max", value=0.5, source="[x]")
    with pytest.raises(ParameterError, match="no score 'vm_eror_max' of method 'kf': expected"):
        score(ESTIMATED, some, seen, TRUTH, None, ScoreParams(published=(wrong,)))
