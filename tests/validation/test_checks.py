"""A check flags and never raises: booleans of the same index, True for what is wrong."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pse_analysis.errors import ParameterError
from pse_analysis.validation import Rule, check_series, checks
from pse_analysis.vocabulary import Flag, Reason, severity

NUMBERS = st.floats(allow_nan=True, allow_infinity=True, width=64)
SERIES = st.lists(
    st.one_of(NUMBERS, st.sampled_from([0.0, 1.0, 1e308, -1e308, 5e-324])), max_size=40
)
MINUTES = st.lists(st.integers(-500, 500), min_size=40, max_size=40)

EVERY_CHECK = {
    "not_finite": checks.not_finite,
    "limits": lambda s: checks.limits(s, -1.0, 1.0),
    "increment": lambda s: checks.increment(s, 0.5),
    "extrapolation": lambda s: checks.extrapolation(s, 0.5, 0.5),
    "stuck": lambda s: checks.stuck(s, 3),
    "duplicate": checks.duplicate,
    "backward": checks.backward,
    "gap": checks.gap,
    "late": lambda s: checks.late(s, np.arange(len(s)) * 60.0, 60.0),
}


def timed(values: list[float], minutes: list[int]) -> pd.Series:
    base = pd.Timestamp("2020-01-01", tz="UTC")
    index = pd.DatetimeIndex(
        [base + pd.Timedelta(m, unit="min") for m in minutes[: len(values)]], tz="UTC"
    )
    return pd.Series(values, index=index, dtype=float, name="load")


@pytest.mark.parametrize("name", EVERY_CHECK)
@settings(max_examples=40, deadline=None, derandomize=True)
@given(values=SERIES, minutes=MINUTES)
def test_no_input_raises_and_the_index_is_kept(
    name: str, values: list[float], minutes: list[int]
) -> None:
    check = EVERY_CHECK[name]
    for series in (timed(values, minutes), pd.Series(values, dtype=float)):
        flags = check(series)
        assert flags.dtype == bool
        assert flags.index.equals(series.index)
        assert flags.name == series.name
    frame = pd.DataFrame({"a": values, "b": values[::-1]}, dtype=float)
    flags = check(frame)
    assert flags.shape == frame.shape
    assert flags.to_numpy().dtype == bool
    block = frame.to_numpy()
    np.testing.assert_array_equal(check(block), flags.to_numpy())


@settings(max_examples=20, deadline=None, derandomize=True)
@given(values=SERIES, minutes=MINUTES, constant=st.booleans())
def test_check_series_flags_whatever_it_gets(
    values: list[float], minutes: list[int], constant: bool
) -> None:
    values = [1.0] * len(values) if constant else values
    series = timed(values, minutes)
    for each in (series, pd.Series(values, dtype=float)):
        found = check_series(each, lower=-1e6, upper=1e6)
        assert found.index.equals(each.index)
        np.testing.assert_array_equal(found["flag"], severity(found["reasons"].to_numpy()))
        wrong = ~np.isfinite(each.to_numpy())
        assert (found["flag"].to_numpy()[wrong] == Flag.MISSING).all()
        assert set(found["qartod"]) <= {1, 2, 3, 4, 9}


@pytest.mark.parametrize(
    "series",
    [
        pd.Series([], dtype=float),
        pd.Series([3.0]),
        pd.Series([1, 2, 3]),
        pd.Series(["a", None, "2.5"], dtype=object),
        pd.Series([pd.NA, 1.5], dtype="Float64"),
        pd.Series([True, False]),
        pd.Series([1.0, 2.0], index=pd.DatetimeIndex([pd.NaT, "2020-01-01"])),
        pd.Series([1.0, 2.0], index=pd.DatetimeIndex(["1950-01-01", "1950-01-02"])),
        pd.Series([1.0, 2.0, 3.0], index=["x", "x", "y"]),
    ],
    ids=["empty", "one", "integers", "words", "masked", "booleans", "no time", "early", "labels"],
)
def test_unusual_series_are_answered(series: pd.Series) -> None:
    assert len(check_series(series)) == len(series)
    for check in EVERY_CHECK.values():
        assert check(series).index.equals(series.index)


def test_every_check_finds_what_it_is_for() -> None:
    rng = np.random.default_rng(2)
    value = 20.0 + np.cumsum(rng.normal(0.0, 0.1, 60))
    minutes = np.arange(60) * 2
    value[10] = np.nan
    value[20] += 3.0
    value[30:34] = value[30]
    minutes[40], minutes[45] = minutes[39], minutes[43] - 1
    minutes[50:] += 6
    load = timed(value.tolist(), minutes.tolist())
    where = {name: np.flatnonzero(check(load)).tolist() for name, check in EVERY_CHECK.items()}
    assert where["not_finite"] == [10]
    assert where["increment"] == [20]
    assert where["extrapolation"] == [20]
    assert where["stuck"] == [32, 33]
    assert where["duplicate"] == [40]
    assert where["backward"] == [45]
    assert where["gap"] == [41, 46, 50]
    assert np.flatnonzero(checks.limits(load, upper=value[20] - 0.01)).tolist() == [20]
    arrival = load.index + pd.Timedelta("1s")
    arrival = arrival.where(np.arange(60) != 5, load.index + pd.Timedelta("5min"))
    assert np.flatnonzero(checks.late(load, arrival, 60.0)).tolist() == [5]


def test_limits_may_differ_by_channel() -> None:
    block = np.array([[1.0, 1.0], [5.0, 5.0]])
    np.testing.assert_array_equal(
        checks.limits(block, upper=[2.0, 6.0]), [[False, False], [True, False]]
    )


def test_missing_samples_do_not_hide_the_next_error() -> None:
    value = np.zeros(40) + np.random.default_rng(3).normal(0.0, 0.1, 40)
    value[20:23] = np.nan
    value[23] += 9.0
    assert np.flatnonzero(checks.increment(value, 1.0)).tolist() == [23]


def test_the_threshold_grows_over_a_gap() -> None:
    value = np.arange(40) * 0.9
    gappy = np.delete(value, range(20, 24))
    index = np.delete(np.arange(40.0), range(20, 24))
    assert not checks.increment(value, 1.0).any()
    assert checks.increment(gappy, 1.0, time=index, period=1.0)[20]
    assert not checks.increment(gappy, 2.1, time=index, period=1.0).any()
    assert checks.increment(gappy, 2.1).any()


def test_one_call_on_a_series_learns_and_finds() -> None:
    rng = np.random.default_rng(5)
    load = pd.Series(
        50.0 + np.cumsum(rng.normal(0.0, 0.2, 2_000)),
        index=pd.date_range("2024-03-01", periods=2_000, freq="2min", tz="Europe/Minsk"),
    )
    faulty = load.copy()
    at = np.arange(700, 1_900, 60)
    faulty.iloc[at] += 4.0
    found = check_series(faulty, upper=500.0, history_end=load.index[500])
    assert (found["flag"].iloc[at] == Flag.BAD).all()
    flagged = np.flatnonzero(found["flag"] == Flag.BAD)
    assert len(np.setdiff1d(flagged, at)) <= 4
    assert found["corrected"].iloc[at].isna().all()
    assert found["value"].equals(faulty.rename("value"))
    naive = check_series(
        faulty.tz_localize(None), upper=500.0, history_end=datetime(2024, 3, 1, 16)
    )
    assert (naive["flag"].iloc[at] == Flag.BAD).all()


def test_the_future_of_a_series_changes_no_flag_of_its_past() -> None:
    rng = np.random.default_rng(6)
    load = pd.Series(np.cumsum(rng.standard_normal(1_200)))
    load[rng.random(1_200) < 0.05] += 7.0
    cut = 700
    other = load.copy()
    other[cut:] = rng.permutation(other[cut:])
    one, two = check_series(load), check_series(other)
    pd.testing.assert_frame_equal(one.iloc[:cut], two.iloc[:cut])
    assert (one["reasons"].iloc[cut:] != two["reasons"].iloc[cut:]).any()


def test_stated_rules_reach_the_series() -> None:
    load = pd.Series(np.tile([0.0, 1.0], 50))
    found = check_series(load, rule=Rule(increment=0.5, confirm=1, checks=("increment",)))
    assert set(found["reasons"]) == {0, int(Reason.INCREMENT)}


def test_qartod_codes_follow_the_flags() -> None:
    load = pd.Series(np.cumsum(np.random.default_rng(7).normal(0.0, 0.1, 400)))
    load.iloc[200], load.iloc[300] = np.nan, 90.0
    load.index = pd.date_range("2024-01-01", periods=400, freq="min", tz=UTC)
    late = load.iloc[[*range(350), 340, *range(350, 400)]]
    late.index = late.index.to_series().where(
        np.arange(401) != 350, late.index[340] + pd.Timedelta("5s")
    )
    found = check_series(late)
    assert found["qartod"].iloc[0] == 2
    assert found["qartod"].iloc[150] == 1
    assert found["qartod"].iloc[200] == 9
    assert found["qartod"].iloc[300] == 4
    assert found["qartod"].iloc[350] == 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: checks.increment(s, 0.0), "threshold must be > 0"),
        (lambda s: checks.increment(s, 1.0, confirm=0), "confirm must be ≥ 1"),
        (lambda s: checks.stuck(s, 1), "count must be ≥ 2"),
        (lambda s: checks.gap(s, period=0.0), "period must be positive"),
        (lambda s: checks.gap(s, time=[1.0]), "time has 1 entries, the samples have 2 rows"),
    ],
)
def test_impossible_arguments_are_refused(call: object, message: str) -> None:
    assert callable(call)
    with pytest.raises(ParameterError, match=message):
        call(pd.Series([1.0, 2.0]))
