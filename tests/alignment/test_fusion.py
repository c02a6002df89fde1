"""Claim: an instant sees the last sample that had arrived by then, and how old it is."""

from __future__ import annotations

import dataclasses
from datetime import timedelta
from typing import Any

import numpy as np
import pandas as pd
import pytest
from reference import channels_table

from pse_analysis.alignment import AlignParams, Variant, align
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.grid import library
from pse_analysis.parameters import Study
from pse_analysis.vocabulary import Reason, check, severity

SEED = 12
NETWORK = dataclasses.replace(library.load("ieee33"), base_mva=37.0)
ZERO = pd.Timestamp("2016-06-09T00:00:00Z")
VM, POWER = "pmu:bus/6:vm_pu", "ami:bus/7:p_mw"
CHANNELS = channels_table(
    NETWORK,
    [
        {"quantity": "vm_pu", "element": "bus/6", "unit": "pu", "sigma": 0.002},
        {"quantity": "p_mw", "element": "bus/7", "unit": "kw", "sigma": 0.02, "source": "ami",
         "sigma_kind": "relative", "sign": -1, "period_s": 900.0, "aggregation": "mean"},
    ],
)  # fmt: skip
STEP = 300


def study(minutes: int = 20, history_s: float = 0.0) -> Study:
    start = ZERO.to_pydatetime()
    return Study(start, start + timedelta(minutes=minutes), STEP, history_s)


def samples(rows: list[tuple[Any, ...]], trial: int = 0) -> pd.DataFrame:
    """Table ``validated`` of (channel, stamp, arrival or None, value[, reasons]); times in s."""
    frame = pd.DataFrame(
        [(*row, 0)[:5] for row in rows],
        columns=["channel", "stamp", "arrival", "value", "reasons"],
    )
    second = pd.to_timedelta(frame["stamp"].astype(float), unit="s")
    late = pd.to_timedelta(frame["arrival"].astype(float), unit="s")
    reasons = frame["reasons"].astype("int32")
    flag = severity(reasons)
    out = pd.DataFrame(
        {
            "trial": np.int32(trial),
            "channel": frame["channel"],
            "seq": np.arange(len(frame), dtype=np.int64),
            "time_utc": (ZERO + second).astype("datetime64[us, UTC]"),
            "arrival_utc": (ZERO + late).astype("datetime64[us, UTC]"),
            "value": frame["value"].astype(float),
            "quality": pd.array([pd.NA] * len(frame), dtype="Int16"),
            "flag": flag,
            "reasons": reasons,
            "statistic": np.nan,
            "threshold": np.nan,
            "corrected": np.where(flag < 2, frame["value"].astype(float), np.nan),
        }
    )
    return check("validated", out)


def aligned(
    rows: list[tuple[Any, ...]], params: AlignParams | None = None, **of_study: Any
) -> pd.DataFrame:
    params = params or AlignParams(growth="none")
    return align(samples(rows), CHANNELS, NETWORK, study(**of_study), params)


def brief(table: pd.DataFrame) -> list[tuple[int, float, float, str]]:
    """Minute of the instant, value, age and origin of each row."""
    minute = (table["time_utc"] - ZERO) // pd.Timedelta(minutes=1)
    columns = (minute, table["value_pu"].round(9), table["age_s"], table["origin"])
    return [(int(m), float(v), float(a), o) for m, v, a, o in zip(*columns, strict=True)]


def test_ages_and_origins_of_a_table_that_fits_on_a_hand() -> None:
    rows = [
        (VM, -20, -10, 1.01),
        (VM, 250, 260, 1.02),
        (VM, 290, 310, 1.03),  # taken before minute 5, arrives after it
        (VM, 900, 900, 1.04),  # arrives at the very instant
    ]
    assert brief(aligned(rows)) == [
        (0, 1.01, 20.0, "measured"),
        (5, 1.02, 50.0, "measured"),
        (10, 1.03, 310.0, "measured"),
        (15, 1.04, 0.0, "measured"),
    ]
    assert brief(aligned(rows[:1])) == [
        (minute, 1.01, 20.0 + 60 * minute, "measured" if minute == 0 else "held")
        for minute in (0, 5, 10, 15)
    ]


def test_sample_without_an_arrival_arrives_when_it_is_taken() -> None:
    assert brief(aligned([(VM, 299, None, 1.0)]))[0] == (5, 1.0, 1.0, "measured")


def test_late_sample_does_not_push_out_a_newer_one() -> None:
    rows = [(VM, 200, 210, 1.02), (VM, 100, 220, 1.01), (VM, 50, 400, 1.03)]
    assert [row[:2] for row in brief(aligned(rows))] == [(5, 1.02), (10, 1.02), (15, 1.02)]


def test_late_sample_that_is_the_newest_is_used_from_its_arrival() -> None:
    rows = [(VM, 0, 0, 1.00), (VM, 100, 500, 1.01)]
    assert [row[:3] for row in brief(aligned(rows))[1:3]] == [(5, 1.00, 300.0), (10, 1.01, 500.0)]


def test_of_two_samples_with_one_stamp_the_first_counts() -> None:
    rows = [(VM, 100, 110, 1.0), (VM, 100, 120, 2.0)]
    assert brief(aligned(rows))[0][1] == 1.0


def test_stamp_of_the_future_waits_for_its_time_and_blocks_nothing() -> None:
    rows = [(VM, 0, 1, 1.00), (VM, 900, 100, 1.09), (VM, 299, 299, 1.01), (VM, 599, 599, 1.02)]
    assert [row[:3] for row in brief(aligned(rows))] == [
        (5, 1.01, 1.0),
        (10, 1.02, 1.0),
        (15, 1.09, 0.0),
    ]


def test_bad_and_missing_samples_are_passed_over_and_suspect_ones_are_not() -> None:
    rows = [
        (VM, 0, 0, 1.00),
        (VM, 100, 100, 1.01, int(Reason.LATE)),
        (VM, 200, 200, 9.99, int(Reason.LIMIT)),
        (VM, 250, 250, np.nan, int(Reason.NOT_FINITE)),
    ]
    table = aligned(rows)
    assert brief(table)[1][:2] == (5, 1.01)
    assert table["reasons"].iloc[1] == int(Reason.LATE)


def test_old_samples_are_left_out_by_source() -> None:
    rows = [(VM, 0, 0, 1.0), (POWER, 0, 0, 50.0)]
    params = AlignParams(growth="none", max_age_s={"pmu": 300.0}, default_max_age_s=600.0)
    table = aligned(rows, params)
    by_channel = table.groupby("channel")["time_utc"].count()
    assert by_channel.to_dict() == {VM: 2, POWER: 3}


@pytest.mark.parametrize("age", [np.inf, 1e12])
def test_without_a_largest_age_the_last_sample_holds_for_ever(age: float) -> None:
    params = AlignParams(growth="none", max_age_s={"pmu": age}, default_max_age_s=age)
    assert len(aligned([(VM, 0, 0, 1.0)], params)) == 4


def test_values_and_sigmas_come_out_in_per_unit_with_the_sign_turned() -> None:
    table = aligned([(POWER, 0, 0, 740.0)])
    assert table["value_pu"].iloc[0] == pytest.approx(-0.74 / 37.0)
    assert table["sigma_pu"].iloc[0] == pytest.approx(0.02 * 0.74 / 37.0)
    assert (table["sigma_age_pu"] == 0).all()


def test_unknown_channel_is_named() -> None:
    with pytest.raises(TableError, match="'pmu:bus/9:vm_pu' is not in the channels table: add it"):
        aligned([("pmu:bus/9:vm_pu", 0, 0, 1.0)])


def test_a_study_beside_the_telemetry_says_what_each_covers() -> None:
    with pytest.raises(TableError, match=r"reaches from 2016-06-11 .* asks for 2016-06-09"):
        aligned([(VM, 2 * 86400, None, 1.0)])


def test_a_clock_that_was_reset_costs_neither_memory_nor_the_forecasts_of_the_rest() -> None:
    rows = [(POWER, 900 * k, None, -1.0) for k in range(-8, 2)]
    reset = pd.Timestamp("1970-01-01T00:00:00Z") - ZERO
    forecast = AlignParams(growth="none", variants=(Variant("x", pseudo="holt"),))
    plain = aligned(rows, forecast, minutes=60, history_s=7200.0)
    odd = aligned([(POWER, reset.total_seconds(), None, -9.0), *rows], forecast, minutes=60,
                  history_s=7200.0)  # fmt: skip
    assert (plain["origin"] == "pseudo").any()
    pd.testing.assert_frame_equal(odd, plain)


@pytest.mark.parametrize(
    "params",
    [
        AlignParams(interpolate=("scadda",)),
        AlignParams(max_age_s={"scadda": 60.0}),
        AlignParams(variants=(Variant("x", face_value=("scadda",)),)),
        AlignParams(variants=(Variant("x", time="dtw"),)),
    ],
)
def test_a_source_that_is_not_there_is_refused(params: AlignParams) -> None:
    with pytest.raises(ParameterError, match=r"\[align.*scad.*ami, pmu"):
        aligned([(VM, 0, None, 1.0)], params)


def test_an_age_below_zero_is_refused() -> None:
    with pytest.raises(ParameterError, match="default_max_age_s > 0, received -5"):
        AlignParams(default_max_age_s=-5)


def test_no_usable_sample_gives_an_empty_table() -> None:
    assert len(aligned([(VM, 0, 0, np.nan, int(Reason.NOT_FINITE))])) == 0
    assert len(align(samples([]), CHANNELS, NETWORK, study())) == 0


def test_variant_is_named_and_trials_stay_apart() -> None:
    both = pd.concat(
        [samples([(VM, 0, 0, 1.0)]), samples([(VM, 100, 100, 1.1)], trial=1)], ignore_index=True
    )
    table = align(both, CHANNELS, NETWORK, study(), AlignParams(variant="x", growth="none"))
    assert set(table["variant"]) == {"x"}
    first = table.groupby("trial").first()
    assert first["value_pu"].tolist() == [1.0, 1.1]
    assert first["origin"].tolist() == ["measured", "measured"]


def test_instants_reach_back_through_the_history() -> None:
    rows = [(VM, -600, -600, 1.0)]
    assert [row[0] for row in brief(aligned(rows, history_s=700.0))] == [-10, -5, 0, 5, 10, 15]


# --- growth of σ ----------------------------------------------------------------------------------


def walk(rate: float, period: int, count: int, seed: int = SEED) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 1.0 + np.cumsum(np.sqrt(rate * period) * rng.normal(size=count))


@pytest.mark.parametrize("wild", [0.0, 0.01])
def test_sigma_grows_by_the_rate_of_the_history_and_wild_values_do_not_matter(wild: float) -> None:
    """√(r a) to 15 %: four standard errors at these 4000 samples of a walk under noise."""
    rate, period, count = 4e-8, 60, 4000
    rng = np.random.default_rng(SEED + 1)
    value = walk(rate, period, count) + 0.002 * rng.normal(size=count)
    spoilt = rng.random(count) < wild
    value[spoilt] *= 1.0 + 0.05 * rng.choice([-1, 1], spoilt.sum())
    stamp = -period * np.arange(count, 0, -1)
    rows = [(VM, t, t, v) for t, v in zip(stamp, value, strict=True)]
    table = aligned(rows, AlignParams(), history_s=float(period * count))
    study_rows = table[table["time_utc"] >= ZERO]
    assert study_rows["age_s"].tolist() == [60.0, 360.0, 660.0, 960.0]
    grown = study_rows["sigma_age_pu"].to_numpy()
    np.testing.assert_allclose(grown / np.sqrt(rate * study_rows["age_s"]), 1.0, atol=0.15)
    np.testing.assert_allclose(study_rows["sigma_pu"], np.hypot(0.002, grown))


def test_rate_of_a_walk_is_recovered_and_means_add_a_third_of_their_window() -> None:
    """r(a + W/3) with r within 4 standard errors of the walk's own."""
    rate, fine, window, count = 2e-9, 60, 900, 1500
    path = walk(rate, fine, count * window // fine) / 37.0 * 1000 * 37.0
    mean = path.reshape(count, -1).mean(axis=1)
    stamp = window * (np.arange(count) - count + 1) - 60
    channels = CHANNELS.assign(sigma_kind="absolute", sigma=1e-6, sign=np.int8(1))
    rows = [(POWER, t, t, v) for t, v in zip(stamp, mean, strict=True)]
    table = align(samples(rows), channels, NETWORK, study(5, float(window * count)), AlignParams())
    last = table.iloc[-1]
    per_unit = rate * (1e-3 / 37.0 * 1000) ** 2
    expected = np.sqrt(per_unit * (last["age_s"] + window / 3))
    assert last["age_s"] == 60.0
    assert last["sigma_age_pu"] == pytest.approx(expected, rel=4 * 0.6 / np.sqrt(count))


def test_channel_without_history_moves_by_its_own_sigma_per_step() -> None:
    table = aligned([(VM, 0, 0, 1.0)], AlignParams())
    expected = 0.002 * np.sqrt(np.array([0.0, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(table["sigma_age_pu"], expected)


# --- waiting and interpolating --------------------------------------------------------------------


def test_an_instant_that_waits_sees_what_arrives_late_but_nothing_taken_after_it() -> None:
    rows = [(VM, 290, 310, 1.0), (VM, 301, 320, 2.0), (VM, 595, 1300, 3.0)]
    at_once = AlignParams(growth="none")
    waiting = AlignParams(growth="none", latency_s=60.0)
    assert brief(aligned(rows, at_once)) == [(10, 2.0, 299.0, "measured"), (15, 2.0, 599.0, "held")]
    assert brief(aligned(rows, waiting))[:2] == [
        (5, 1.0, 10.0, "measured"),
        (10, 2.0, 299.0, "measured"),
    ]


def test_interpolation_needs_the_later_sample_and_says_how_sure_it_is() -> None:
    rows = [(VM, 240, 240, 1.0), (VM, 320, 330, 1.2), (VM, 590, 590, 1.4), (VM, 610, 700, 1.6)]
    params = AlignParams(growth="none", latency_s=30.0, interpolate=("pmu",))
    table = aligned(rows, params, minutes=15)
    assert brief(table) == [
        (5, 1.15, 0.0, "measured"),  # a quarter from 1.2 to 1.0
        (10, 1.4, 10.0, "measured"),  # the sample after it comes too late
    ]
    expected = [0.002 * np.hypot(0.25, 0.75), 0.002]
    np.testing.assert_allclose(table["sigma_pu"], expected)
    moving = dataclasses.replace(params, growth="history")
    rate = 0.002**2 / STEP  # without a history
    bridge = rate * 80 * 0.25 * 0.75
    first = aligned(rows, moving, minutes=15).iloc[0]
    assert first["sigma_pu"] == pytest.approx(np.sqrt(expected[0] ** 2 + bridge))
    assert first["sigma_age_pu"] == 0.0


def test_two_instants_between_the_same_samples_are_news_once() -> None:
    rows = [(VM, 0, 0, 1.0), (VM, 900, 900, 1.9)]
    params = AlignParams(growth="none", latency_s=900.0, interpolate=("pmu",))
    assert brief(aligned(rows, params)) == [
        (0, 1.0, 0.0, "measured"),
        (5, 1.3, 0.0, "held"),
        (10, 1.6, 0.0, "held"),
        (15, 1.9, 0.0, "measured"),
    ]


def test_an_angle_is_interpolated_through_a_full_turn() -> None:
    channels = channels_table(
        NETWORK, [{"quantity": "va_degree", "element": "bus/6", "unit": "degree", "sigma": 0.1}]
    )
    rows = [("pmu:bus/6:va_degree", 270, 270, 179.0), ("pmu:bus/6:va_degree", 330, 330, -177.0)]
    params = AlignParams(growth="none", latency_s=30.0, interpolate=("pmu",))
    table = align(samples(rows), channels, NETWORK, study(), params)
    assert abs(np.degrees(table["value_pu"].iloc[0])) % 360 == pytest.approx(181.0)


def test_face_value_keeps_the_sigma_of_the_meter() -> None:
    params = AlignParams(variants=(Variant("held", face_value=("pmu",)),))
    table = aligned([(VM, 0, 0, 1.0)], params)
    np.testing.assert_allclose(table["sigma_pu"], 0.002)


# --- causality ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cut_s", [300, 600])
def test_permuting_the_future_changes_nothing_before(seed: int, cut_s: int) -> None:
    rng = np.random.default_rng([SEED, seed])
    count = 400
    stamp = np.sort(rng.uniform(-3000, 1200, count)).round(6)
    arrival = (stamp + rng.exponential(60.0, count)).round(6)
    channel = np.where(rng.random(count) < 0.5, VM, POWER)
    order = np.argsort(arrival)
    rows = list(
        zip(channel[order], stamp[order], arrival[order], rng.normal(size=count), strict=True)
    )
    known = [row for row in rows if row[2] <= cut_s]
    future = [row for row in rows if row[2] > cut_s]
    assert len(future) > 5
    mixed = list(rng.permutation(len(future)))
    values = [future[i][3] * 5 for i in mixed]
    changed = [(*row[:3], v) for row, v in zip(future, values, strict=True)]
    instant = ZERO + pd.Timedelta(seconds=cut_s)

    def before(rows: list[tuple[Any, ...]]) -> pd.DataFrame:
        table = aligned(rows, AlignParams(), minutes=20, history_s=3000.0)
        return table[table["time_utc"] <= instant].reset_index(drop=True)

    expected = before(rows)
    pd.testing.assert_frame_equal(before(known + changed), expected)
    pd.testing.assert_frame_equal(before(known), expected)
    later = aligned(rows, AlignParams(), history_s=3000.0)["value_pu"]
    other = aligned(known + changed, AlignParams(), history_s=3000.0)["value_pu"]
    assert not np.array_equal(later, other)
