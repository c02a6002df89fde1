"""The stage keeps every sample, says what is wrong with each, and never looks ahead."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pytest

from pse_analysis import vocabulary
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.grid import library
from pse_analysis.validation import Rule, ValidateParams, validate
from pse_analysis.vocabulary import Flag, Reason

START = pd.Timestamp("2016-06-06", tz="UTC")
HISTORY_END = datetime(2016, 6, 7, tzinfo=UTC)
NAME = "scada:bus/1:p_mw"


def channels(**changes: object) -> pd.DataFrame:
    row = {
        "channel": NAME, "source": "scada", "quantity": "p_mw", "element": "bus/1", "side": "",
        "unit": "mw", "sigma": 0.01, "sigma_kind": "absolute", "lower": -100.0, "upper": 100.0,
        "period_s": 300.0, "sign": np.int8(1), "aggregation": "instant",
    }  # fmt: skip
    return pd.DataFrame([row | changes])


def telemetry(value: np.ndarray, seconds: np.ndarray | None = None, **more: object) -> pd.DataFrame:
    n = len(value)
    offset = np.arange(n) * 300.0 if seconds is None else seconds
    time = pd.Series(START + pd.to_timedelta(offset, unit="s")).dt.as_unit("us")
    frame = pd.DataFrame(
        {
            "trial": np.zeros(n, dtype=np.int32),
            "channel": NAME,
            "seq": np.arange(n),
            "time_utc": time,
            "arrival_utc": (time + pd.Timedelta("2s")).dt.as_unit("us"),
            "value": np.asarray(value, dtype=float),
            "quality": pd.array([pd.NA] * n, dtype="Int16"),
        }
    )
    return frame.assign(**more)


def walk(n: int, seed: int = 11) -> np.ndarray:
    return 20.0 + np.cumsum(np.random.default_rng(seed).normal(0.0, 0.1, n))


GIVEN = ValidateParams((Rule(increment=1.0),))


def reasons(frame: pd.DataFrame, params: ValidateParams = GIVEN) -> list[int]:
    return validate(frame, channels(), params)["reasons"].tolist()


def test_a_spike_costs_one_sample_and_its_value_is_kept() -> None:
    value = walk(50)
    value[20] += 30.0
    out = validate(telemetry(value), channels(), GIVEN)
    assert np.flatnonzero(out["flag"] == Flag.BAD).tolist() == [20]
    assert out["reasons"].iloc[20] == Reason.INCREMENT
    assert out["value"].iloc[20] == value[20]
    assert np.isnan(out["corrected"].iloc[20])
    assert out["statistic"].iloc[20] == pytest.approx(value[20] - value[19])
    assert out["threshold"].iloc[20] == pytest.approx(1.0)
    np.testing.assert_array_equal(out["corrected"].drop(20), np.delete(value, 20))


def test_a_step_is_accepted_after_the_confirming_samples() -> None:
    for confirm in (1, 2, 4):
        value = walk(40)
        value[20:] += 30.0
        found = reasons(telemetry(value), ValidateParams((Rule(increment=1.0, confirm=confirm),)))
        assert found[20 : 20 + confirm] == [Reason.INCREMENT] * confirm
        assert found[20 + confirm] == Reason.STEP_ACCEPTED
        assert not any(found[21 + confirm :])


def test_a_source_that_dies_at_one_value_never_confirms_a_step() -> None:
    value = walk(600)
    value[400:] = -99.0
    out = validate(telemetry(value), channels(), history_end=HISTORY_END)
    assert (out["flag"].iloc[400:] == Flag.BAD).all()
    assert (out["reasons"].iloc[404:] == Reason.STUCK).all()
    coarse = np.repeat(np.rint(walk(100)), 6)
    coarse[400:] += 30.0
    out = validate(telemetry(coarse), channels(), history_end=HISTORY_END)
    assert (out["flag"].iloc[400:] == Flag.BAD).sum() == 2


@pytest.mark.parametrize("limits", [{"lower": np.nan}, {"lower": -1.0}, {"lower": 0.5}])
def test_a_voltage_of_zero_is_never_good(limits: dict[str, float]) -> None:
    voltage = channels(quantity="vm_pu", unit="pu", upper=np.nan, **limits)
    value = walk(600) / 20.0
    value[400:] = 0.0
    value[300] = -9999.0
    out = validate(telemetry(value), voltage, history_end=HISTORY_END)
    assert np.flatnonzero(out["reasons"] & int(Reason.LIMIT)).tolist() == [300, *range(400, 600)]
    without = ValidateParams((Rule(checks=("extrapolation", "stuck")),))
    dead = validate(telemetry(value), voltage, without, history_end=HISTORY_END).iloc[400:]
    assert (dead["flag"] == Flag.BAD).all()
    assert (dead["reasons"].iloc[4:] == Reason.STUCK).all()


def test_sample_faults_get_their_reason() -> None:
    value = walk(40)
    value[5], value[6], value[7] = np.nan, np.inf, 5000.0
    seconds = np.arange(40) * 300.0
    seconds[12] = seconds[11]
    seconds[15] = seconds[13] + 50.0
    seconds[30:] += 900.0
    frame = telemetry(value, seconds)
    frame.loc[25, "arrival_utc"] = frame.loc[25, "time_utc"] + pd.Timedelta("1h")
    frame["quality"] = pd.array([0] * 34 + [7] * 6, dtype="Int16")
    params = ValidateParams((Rule(increment=1.0, bad_quality=(7, 9)),))
    found = reasons(frame, params)
    expected = {
        5: Reason.NOT_FINITE,
        6: Reason.NOT_FINITE,
        7: Reason.LIMIT,
        12: Reason.DUPLICATE,
        13: Reason.GAP,
        15: Reason.BACKWARD,
        16: Reason.GAP,
        25: Reason.LATE,
        30: Reason.GAP,
        **dict.fromkeys(range(34, 40), Reason.QUALITY),
    }
    assert {i: r for i, r in enumerate(found) if r} == expected


def test_a_stamp_from_the_future_costs_itself_and_nothing_after_it() -> None:
    hour = 3600.0
    for known, at in ((True, [20]), (False, [20]), (False, [0]), (False, [20, 21]), (False, [39])):
        value, seconds = walk(40), np.arange(40) * 300.0
        value[25] += 30.0
        frame = telemetry(value, seconds)
        seconds[at] += 6.0 * 365.0 * 24.0 * hour
        frame["time_utc"] = telemetry(value, seconds)["time_utc"]
        listed = channels()
        if not known:
            frame["arrival_utc"] = pd.Series(pd.NaT, frame.index, frame["arrival_utc"].dtype)
            other = telemetry(walk(40)).assign(channel="other", arrival_utc=frame["arrival_utc"])
            listed = pd.concat([listed, channels(channel="other")], ignore_index=True)
            frame = pd.concat([frame, other], ignore_index=True)
        found = validate(frame, listed, GIVEN)["reasons"].tolist()
        after = {at[-1] + 1: Reason.GAP} if 0 < at[-1] < 39 else {}
        expected = {**dict.fromkeys(at, Reason.AHEAD), **after, 25: Reason.INCREMENT}
        assert {i: r for i, r in enumerate(found) if r} == expected


def test_a_clock_less_than_a_period_ahead_and_a_backfill_after_an_outage_are_no_such_stamps() -> (
    None
):
    frame = telemetry(walk(40))
    frame["arrival_utc"] = frame["time_utc"] - pd.Timedelta("200s").as_unit("us")
    assert not any(reasons(frame))
    seconds = np.r_[0:10, 30:40, 10:30] * 300.0
    frame = telemetry(walk(40), seconds)
    frame["arrival_utc"] = pd.Series(pd.NaT, frame.index, frame["arrival_utc"].dtype)
    params = ValidateParams((Rule(increment=100.0),))
    assert reasons(frame, params) == [0] * 10 + [Reason.GAP] + [0] * 9 + [Reason.BACKWARD] * 20


def test_a_telegram_delivered_twice_is_a_duplicate_even_with_two_stamps() -> None:
    value, seconds = walk(40), np.arange(40) * 300.0
    value[21], seconds[21] = value[20], seconds[20] + 40.0
    value[31] = value[30]
    found = reasons(telemetry(value, seconds))
    assert found[21] == Reason.DUPLICATE
    assert found[31] == 0


@pytest.mark.parametrize("k", ["optimal", "scan", 0.5])
def test_the_coefficient_is_optimal_scanned_or_given(k: str | float) -> None:
    rng = np.random.default_rng(15)
    change = np.zeros(3_000)
    for i in range(1, 3_000):
        change[i] = 0.5 * change[i - 1] + 0.1 * rng.standard_normal()
    value = 20.0 + np.cumsum(change)
    value[2_500] += 5.0
    end = HISTORY_END + pd.Timedelta("6D")
    rules = ValidateParams((Rule(k=k, criterion="fixed", quantile=4.0),))
    out = validate(telemetry(value), channels(), rules, history_end=end)
    assert out["reasons"].iloc[2_500] == Reason.EXTRAPOLATION
    assert out["threshold"].iloc[2_400] == pytest.approx(0.4, rel=0.06)
    naive = ValidateParams((Rule(k=0.0, criterion="fixed", quantile=4.0),))
    wide = validate(telemetry(value), channels(), naive, history_end=end)
    assert wide["reasons"].iloc[2_500] == Reason.INCREMENT
    assert wide["threshold"].iloc[2_400] > 1.1 * out["threshold"].iloc[2_400]


def test_criteria_set_the_threshold() -> None:
    value = walk(900)
    quantile = {}
    for name, rule in {
        "bayes": Rule(q=0.05),
        "minimax": Rule(criterion="minimax", q_max=0.05),
        "loose": Rule(criterion="minimax"),
        "fixed": Rule(criterion="fixed", quantile=3.0),
    }.items():
        out = validate(
            telemetry(value), channels(), ValidateParams((rule,)), history_end=HISTORY_END
        )
        quantile[name] = out["threshold"].iloc[300:].median()
    assert quantile["bayes"] / quantile["fixed"] == pytest.approx(3.004 / 3.0, rel=1e-3)
    assert quantile["minimax"] == pytest.approx(quantile["bayes"], rel=1e-9)
    assert quantile["loose"] / quantile["fixed"] == pytest.approx(1.256 / 3.0, rel=2e-3)


def test_the_default_count_of_a_stuck_source_comes_from_its_history() -> None:
    restless, coarse = walk(900), np.round(walk(900), 0)
    restless[500:510] = restless[500]
    found = np.array(validate(telemetry(restless), channels(), history_end=HISTORY_END)["reasons"])
    assert np.flatnonzero(found & Reason.STUCK).tolist() == list(range(504, 510))
    found = np.array(validate(telemetry(coarse), channels(), history_end=HISTORY_END)["reasons"])
    assert not (found[:100] & Reason.STUCK).any()
    asleep = restless.copy()
    asleep[700:] = 0.0
    found = np.array(validate(telemetry(asleep), channels(), history_end=HISTORY_END)["reasons"])
    assert not (found[700:] & Reason.STUCK).any()


def test_no_row_is_lost_and_the_rows_keep_their_order_and_index() -> None:
    frame = pd.concat([telemetry(walk(30)), telemetry(walk(30, 12)).assign(trial=np.int32(1))])
    shuffled = frame.sample(frac=1.0, random_state=5)
    shuffled.index = pd.RangeIndex(100, 160)
    out = validate(shuffled, channels(), GIVEN)
    assert out.index.equals(shuffled.index)
    pd.testing.assert_frame_equal(
        out[list(vocabulary.KEYS["telemetry"])], shuffled[list(vocabulary.KEYS["telemetry"])]
    )
    straight = validate(frame.reset_index(drop=True), channels(), GIVEN)
    key = list(vocabulary.KEYS["telemetry"])
    pd.testing.assert_frame_equal(
        out.sort_values(key, ignore_index=True), straight.sort_values(key, ignore_index=True)
    )


def test_changing_the_future_changes_no_flag_of_the_past() -> None:
    rng = np.random.default_rng(3)
    value = walk(900)
    hit = rng.random(900) < 0.05
    value[hit] += rng.uniform(-2.0, 2.0, hit.sum())
    frame = telemetry(value)
    base = validate(frame, channels(), history_end=HISTORY_END)
    cut = 500
    future = frame.copy()
    future.loc[cut:, "value"] = rng.permutation(value[cut:])
    changed = validate(future, channels(), history_end=HISTORY_END)
    columns = ["flag", "reasons", "statistic", "threshold", "corrected"]
    pd.testing.assert_frame_equal(base.loc[: cut - 1, columns], changed.loc[: cut - 1, columns])
    assert base["flag"].iloc[288:cut].gt(0).any()
    assert not base.loc[cut:, "reasons"].equals(changed.loc[cut:, "reasons"])


def test_thresholds_are_learnt_from_the_history() -> None:
    value = walk(900)
    out = validate(telemetry(value), channels(), history_end=HISTORY_END)
    gamma = out["threshold"].iloc[300:]
    spread = np.std(np.diff(value[:288]))
    assert gamma.median() == pytest.approx(3.512 * spread, rel=0.05)
    unlearnt = validate(telemetry(value), channels())
    assert unlearnt["threshold"].isna().all()


def test_later_rules_override_field_by_field() -> None:
    value = walk(40)
    value[10] += 5.0
    rules = (
        Rule(increment=1.0, upper=50.0),
        Rule(source="scada", increment=8.0),
        Rule(channel="*bus/1:*", unit="kw", upper=18_000.0),
    )
    found = np.array(reasons(telemetry(value), ValidateParams(rules)))
    np.testing.assert_array_equal((found & Reason.LIMIT) != 0, value > 18.0)
    assert not (found & Reason.INCREMENT).any()


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"source": "pmu"}, "matches no channel"),
        ({"unit": "kv", "lower": 1.0}, "does not convert to 'mw'"),
        (
            {"unit": "pu", "lower": 1.0},
            "does not convert to 'mw', .* without the grid.*pass model=",
        ),
        ({"lower": 200.0}, "swap them"),
        ({"k": -3.0}, "expected -1 … 2, received -3.0"),
        ({"amplitude": np.inf}, "amplitude must be finite and > 0, received inf"),
    ],
)
def test_rules_that_cannot_hold_say_so(rule: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        validate(telemetry(walk(5)), channels(), ValidateParams((Rule(**rule),)))


@pytest.mark.parametrize("unit", ["kv", "kV", " KV "])
def test_limits_may_be_stated_in_the_unit_of_the_plant(unit: str) -> None:
    network = library.load("ieee33")
    voltage = channels(quantity="vm_pu", element="bus/6", unit="pu", lower=np.nan, upper=np.nan)
    value = 1.0 + 0.001 * walk(40)
    value[10], value[20] = 0.9, 1.1
    params = ValidateParams((Rule(unit=unit, lower=0.95 * 12.66, upper=1.05 * 12.66),))
    found = np.array(validate(telemetry(value), voltage, params, model=network)["reasons"])
    assert np.flatnonzero(found & Reason.LIMIT).tolist() == [10, 20]


def test_a_channel_that_limits_reject_as_a_whole_is_shown_and_stops_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    both = pd.concat([channels(), channels(channel="other")], ignore_index=True)
    frame = pd.concat([telemetry(walk(40)), telemetry(walk(40)).assign(channel="other")])
    params = ValidateParams((Rule(channel="other", lower=20_000.0, upper=23_000.0),))
    validate(frame, both)
    assert not caplog.records
    out = validate(frame.reset_index(drop=True), both, params)
    assert (out["flag"] == Flag.BAD).sum() == 40
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "other: all 40 samples lie outside the limits 20000.0 … 23000.0 mw, e.g. 19" in (
        caplog.text.replace("e.g. 20", "e.g. 19")
    )


def test_a_prior_that_rejects_everything_is_reported() -> None:
    rules = ValidateParams((Rule(q=0.5, cost_miss=5.0),))
    with pytest.raises(ParameterError, match="rejecting every sample is the cheapest"):
        validate(telemetry(walk(400)), channels(), rules, history_end=HISTORY_END)


def test_a_sample_of_an_unknown_channel_is_refused() -> None:
    frame = telemetry(walk(5)).assign(channel="scada:bus/2:p_mw")
    with pytest.raises(TableError, match="'scada:bus/2:p_mw' is not in the table of channels"):
        validate(frame, channels(), GIVEN)


def test_naive_history_end_is_refused() -> None:
    with pytest.raises(ParameterError, match="no time zone"):
        validate(telemetry(walk(5)), channels(), history_end=datetime(2016, 6, 7))


@pytest.mark.parametrize("n", [0, 1, 2])
def test_tiny_tables_pass_through(n: int) -> None:
    out = validate(telemetry(walk(n)), channels(), history_end=HISTORY_END)
    assert len(out) == n
    assert not out["flag"].any()


@pytest.mark.parametrize(("unit", "turn"), [("degree", 360.0), ("rad", 2.0 * np.pi)])
def test_the_end_of_a_turn_is_no_jump_of_an_angle(unit: str, turn: float) -> None:
    degrees = np.random.default_rng(14).normal(0.0, 0.1, 900) + 3.0 * np.sin(np.arange(900) / 40.0)
    angle = (180.0 + degrees) / 360.0 * turn
    angle[600] += 0.2 * turn
    wrapped = np.mod(angle + 0.5 * turn, turn) - 0.5 * turn
    assert (np.abs(np.diff(wrapped[:288])) > 0.5 * turn).any()
    assert (np.abs(np.diff(wrapped[300:])) > 0.5 * turn).any()
    own = channels(quantity="va_degree", unit=unit, lower=np.nan, upper=np.nan)
    found, straight = (
        validate(telemetry(x), own, history_end=HISTORY_END) for x in (wrapped, angle)
    )
    assert found["flag"].iloc[600] == Flag.BAD
    pd.testing.assert_series_equal(found["reasons"], straight["reasons"])
    np.testing.assert_allclose(found["threshold"], straight["threshold"], rtol=1e-9)
