"""Claim: a stated period that is off by a factor is named, and one that is right never is."""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pse_analysis.validation import periods, validate, wrong_periods

START = pd.Timestamp("2024-05-14", tz="UTC")
NAME = "scada:bus/1:p_mw"


def channels(period_s: float, *names: str, aggregation: str = "instant") -> pd.DataFrame:
    names = names or (NAME,)
    return pd.DataFrame(
        {
            "channel": list(names), "source": "scada", "quantity": "p_mw", "element": "bus/1",
            "side": "", "unit": "mw", "sigma": 0.01, "sigma_kind": "absolute", "lower": np.nan,
            "upper": np.nan, "period_s": float(period_s), "sign": np.int8(1),
            "aggregation": aggregation,
        }
    )  # fmt: skip


def telemetry(seconds: np.ndarray, name: str = NAME, trial: int = 0) -> pd.DataFrame:
    time = pd.Series(START + pd.to_timedelta(np.asarray(seconds), unit="s")).dt.as_unit("us")
    n = len(time)
    return pd.DataFrame(
        {
            "trial": np.full(n, trial, dtype=np.int32),
            "channel": name,
            "seq": np.arange(n),
            "time_utc": time,
            "arrival_utc": time,
            "value": 20.0 + np.sin(np.arange(n)),
            "quality": pd.array([pd.NA] * n, dtype="Int16"),
        }
    )


def seen(seconds: np.ndarray, stated_s: float) -> float | None:
    """Period that is found instead of the stated one, or None."""
    found = wrong_periods(telemetry(seconds), channels(stated_s))
    return float(found["seen_s"].iloc[0]) if len(found) else None


def worn(
    period_s: float, n: int, rng: np.random.Generator, loss: float, jitter: float, twice: float
) -> np.ndarray:
    """Stamps of a channel with losses, jitter (of the period) and telegrams that came twice."""
    time = np.arange(n) * period_s
    time = time + jitter * period_s * rng.uniform(-0.5, 0.5, n)
    time = time[rng.random(n) >= loss]
    again = rng.random(len(time)) < twice
    # Some with the same stamp, some with that of their second arrival.
    lag = np.where(rng.random(len(time)) < 0.5, 0.0, 0.1 * period_s * rng.random(len(time)))
    return np.concatenate([time, (time + lag)[again]])


@pytest.mark.parametrize("real", [300.0, 6.0, 30.0, 90.0, 40.0, 86_400.0, 0.02])
def test_the_period_that_is_seen_is_named_exactly_where_stamps_are_regular(real: float) -> None:
    assert seen(np.arange(60) * real, 60.0) == pytest.approx(real, rel=1e-6)
    assert seen(np.arange(60) * real, real) is None


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.02, 1.0, 10.0, 60.0, 300.0, 900.0]),
    st.floats(0.0, 0.9),
    st.floats(0.0, 0.9),
    st.floats(0.0, 0.3),
    st.integers(0, 400),
)
@settings(max_examples=120, deadline=None)
def test_a_right_period_is_never_named_whatever_is_lost_late_or_doubled(
    seed: int, period_s: float, loss: float, jitter: float, twice: float, n: int
) -> None:
    stamps = worn(period_s, n, np.random.default_rng(seed), loss, jitter, twice)
    assert seen(np.random.default_rng(seed).permutation(stamps), period_s) is None


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([6.0, 20.0, 180.0, 300.0, 900.0]),
    st.floats(0.0, 0.4),
    st.floats(0.0, 0.2),
    st.floats(0.0, 0.1),
)
@settings(max_examples=80, deadline=None)
def test_a_wrong_period_is_named_with_forty_percent_lost_and_a_tenth_doubled(
    seed: int, real: float, loss: float, jitter: float, twice: float
) -> None:
    stamps = worn(real, 400, np.random.default_rng(seed), loss, jitter, twice)
    assert seen(stamps, 60.0) == pytest.approx(real, rel=0.06)


@pytest.mark.parametrize("lost", [3, 4, 10])
def test_regular_losses_of_every_third_poll_or_fewer_do_not_hide_the_period(lost: int) -> None:
    n = np.arange(600)
    kept = n[n % lost != 0]
    assert seen(60.0 * kept, 60.0) is None
    assert seen(300.0 * kept, 60.0) == 300.0
    assert seen(6.0 * kept, 60.0) == 6.0


def test_two_losses_in_three_are_seen_as_the_longer_period_that_they_are() -> None:
    assert seen(60.0 * np.arange(0, 600, 3), 60.0) == 180.0


@pytest.mark.parametrize("seed", range(5))
def test_sources_that_report_on_change_are_left_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    at_random = np.cumsum(rng.exponential(700.0, 500))
    assert seen(at_random, 10.0) is None
    assert seen(at_random, 3600.0) is None
    # On a grid of polls of 10 s, a value being sent if it has changed.
    polled = 10.0 * np.flatnonzero(rng.random(20_000) < 0.1)
    assert seen(polled, 10.0) is None
    # At the latest after 15 min, sooner on change.
    spacing = np.minimum(np.ceil(rng.exponential(5000.0, 500) / 10.0) * 10.0, 900.0)
    assert np.mean(spacing == 900.0) > 0.7
    assert seen(np.cumsum(spacing), 10.0) is None


def test_too_few_samples_tell_nothing() -> None:
    assert seen(300.0 * np.arange(20), 60.0) is None
    assert seen(300.0 * np.arange(21), 60.0) == 300.0
    for n in (0, 1, 2):
        assert seen(300.0 * np.arange(n), 60.0) is None


@pytest.mark.parametrize("period_s", [0.3, 0.5, 0.7, 1.3, 1.5, 1.7, 2.5])
def test_stamps_cut_to_whole_seconds_are_no_wrong_period(period_s: float) -> None:
    assert seen(np.floor(np.arange(500) * period_s), period_s) is None


def test_spacings_are_taken_within_a_trial_and_put_together_over_trials() -> None:
    trials = [telemetry(300.0 * np.arange(11), trial=k) for k in range(2)]
    assert wrong_periods(pd.concat(trials), channels(60.0))["seen_s"].tolist() == [300.0]
    # The same instants in every trial are no spacing of 0.
    assert wrong_periods(pd.concat(trials), channels(300.0)).empty


def test_each_channel_is_judged_by_itself_in_any_order_of_rows() -> None:
    listed = pd.concat(
        [channels(60.0, "a", "b", "c"), channels(900.0, "d", aggregation="mean")],
        ignore_index=True,
    )
    frames = [
        telemetry(np.arange(50) * step, name)
        for name, step in (("d", 60.0), ("b", 300.0), ("a", 60.0), ("c", 6.0))
    ]
    rows = pd.concat([*frames, telemetry(np.arange(50) * 7.0, "unknown")])
    found = wrong_periods(rows.sample(frac=1.0, random_state=3), listed)
    assert found.to_dict("list") == {
        "channel": ["b", "c", "d"],
        "stated_s": [60.0, 60.0, 900.0],
        "seen_s": [300.0, 6.0, 60.0],
        "mean": [False, False, True],
    }


def test_the_stage_goes_on_with_what_is_stated_and_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    frame = telemetry(np.arange(100) * 300.0)
    with caplog.at_level(logging.WARNING):
        validate(frame, channels(300.0))
        assert not caplog.records
        wrong = validate(frame, channels(60.0, aggregation="mean"))
    assert len(wrong) == 100
    assert (wrong["flag"] == 0).all()
    assert [record.getMessage() for record in caplog.records] == [
        f"period_s = 60 is stated, but samples come every 300 s: {NAME}: write period_s = 300; "
        "all stages went on with 60 s, by which gaps, late samples and thresholds are judged, and "
        "over which each mean is taken to be"
    ]


def test_a_sentence_is_for_all_channels_with_one_wrong_period_and_names_some() -> None:
    names = [f"c{k}" for k in range(8)]
    rows = pd.concat([telemetry(np.arange(50) * 300.0, name) for name in names])
    told = list(periods.sentences(wrong_periods(rows, channels(60.0, *names)), 3))
    assert len(told) == 1
    assert "every 300 s: c0, c1, c2 and 5 more: write period_s = 300;" in told[0]
