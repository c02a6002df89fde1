"""Claim: a run gives every instant its row, says what went wrong at it, and goes on."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pandas as pd
import pytest
from reference import channels_table

from pse_analysis.errors import NotConverged, TableError
from pse_analysis.estimation import Method, estimate
from pse_analysis.estimation.core.interface import Estimator, Info, Snapshot, Voltages
from pse_analysis.estimation.core.run import ConsistencyParams, biased, run
from pse_analysis.estimation.core.snapshots import Record, record
from pse_analysis.estimation.filters.kalman import KalmanState, kalman_filter
from pse_analysis.estimation.process import learn_from_history
from pse_analysis.estimation.process.load_noise import scalar_noise
from pse_analysis.estimation.static.tracking import tracking_wls
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VM, MeasurementModel, P, Q, SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.vocabulary import Status, check

SEED = 6
NETWORK = library.load("ieee14")
START = datetime(2016, 6, 9, tzinfo=UTC)
STEP_S = 300
CHANNELS = channels_table(
    NETWORK,
    [
        {"quantity": q, "element": f"bus/{name}", "unit": u, "sigma": s, "period_s": 300.0}
        for name in NETWORK.buses.name
        for q, u, s in (
            ("vm_pu", "pu", 0.002),
            ("va_degree", "degree", 0.1),
            ("p_mw", "mw", 1.0),
            ("q_mvar", "mvar", 1.0),
        )
    ],
)
LAYOUT = SensorLayout.from_channels(CHANNELS, NETWORK)
TRUTH = solve(NETWORK).x
METHODS = [Method.of("wls", "wls"), Method.of("kf", "kalman", noise="scalar", variance=1e-7)]


def study(instants: int, history_s: float = 0.0) -> Study:
    return Study(START, START + timedelta(seconds=STEP_S * instants), STEP_S, history_s)


def telemetry(instants: int, first: int = 0) -> pd.DataFrame:
    """Table ``aligned``: every channel is read at every instant."""
    rng = np.random.default_rng(SEED)
    sigma = LAYOUT.sigma
    exact = MeasurementModel(NETWORK, LAYOUT).h(TRUTH)
    z = exact + sigma * rng.normal(size=(instants, len(sigma)))
    step = pd.Timedelta(seconds=STEP_S)
    time = pd.date_range(START + first * step, periods=instants, freq=step, unit="us")
    table = pd.DataFrame(
        {
            "variant": "last",
            "trial": np.int32(0),
            "time_utc": time.repeat(len(sigma)),
            "channel": np.tile(np.array(LAYOUT.channel, dtype=object), instants),
            "value_pu": z.ravel(),
            "sigma_pu": np.tile(sigma, instants),
            "sigma_age_pu": 0.0,
            "origin": "measured",
            "sample_utc": time.repeat(len(sigma)),
            "time_confidence": 1.0,
            "age_s": 0.0,
            "flag": np.int8(0),
            "reasons": np.int32(0),
        }
    )
    return check("aligned", table)


def truth_table(instants: int) -> pd.DataFrame:
    time = pd.date_range(START, periods=instants, freq=pd.Timedelta(seconds=STEP_S), unit="us")
    names = [f"bus/{name}" for name in NETWORK.buses.name]
    value = np.concatenate([np.rad2deg(TRUTH[:14]), TRUTH[14:]])
    table = pd.DataFrame(
        {
            "trial": np.int32(0),
            "time_utc": time.repeat(28),
            "element": np.tile(np.array(names * 2, dtype=object), instants),
            "quantity": np.tile(["va_degree"] * 14 + ["vm_pu"] * 14, instants),
            "value": np.tile(value, instants),
        }
    )
    return check("truth", table.sample(frac=1.0, random_state=1))


def instant(k: int) -> pd.Timestamp:
    return pd.Timestamp(START) + pd.Timedelta(seconds=STEP_S * k)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_tables_obey_their_schemas_and_cover_every_instant(method: Method) -> None:
    got = estimate(telemetry(6), CHANNELS, NETWORK, study(6), method, truth=truth_table(6))
    assert len(got.steps) == 6
    assert len(got.estimated) == 6 * 28
    assert got.steps["status"].tolist() == ["ok"] * 6
    assert set(got.estimated["method"]) == {method.name}
    vm = got.estimated[got.estimated["quantity"] == "vm_pu"]["value"].to_numpy().reshape(6, 14)
    va = got.estimated[got.estimated["quantity"] == "va_degree"]["value"].to_numpy().reshape(6, 14)
    np.testing.assert_allclose(vm, np.tile(TRUTH[14:], (6, 1)), atol=0.01)
    np.testing.assert_allclose(va, np.tile(np.rad2deg(TRUTH[:14]), (6, 1)), atol=0.5)
    # Constant truth: NEES of 28 states is about 28 under the estimate's own covariance.
    assert 5 < got.steps["nees"].mean() < 90


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_instant_without_any_sample_has_its_row_too(method: Method) -> None:
    """And the filter's walk goes on through it: σ grows by one more Q."""
    table = telemetry(6)
    holed = table[table["time_utc"] != instant(3)]
    got = estimate(holed, CHANNELS, NETWORK, study(6), method)
    assert got.steps["time_utc"].tolist() == [instant(k) for k in range(6)]
    expected = "unobservable" if method.filter == "wls" else "predicted"
    assert got.steps["status"].tolist() == ["ok"] * 3 + [expected] + ["ok"] * 2
    assert got.steps["dof"].iloc[3] == 0
    assert np.isnan(got.steps["nis"].iloc[3])
    at = got.estimated[got.estimated["time_utc"] == instant(3)]
    assert at["value"].isna().all() == (method.filter == "wls")
    if method.filter == "kalman":
        before = got.estimated[got.estimated["time_utc"] == instant(2)]
        grown = at["sigma"].to_numpy() > before["sigma"].to_numpy()
        assert grown.all()


def test_least_squares_estimate_what_few_measurements_tell_and_leave_the_rest_open() -> None:
    table = telemetry(6)
    few = (table["time_utc"] < instant(2)) & ~table["channel"].str.endswith("vm_pu")
    got = estimate(table[~few], CHANNELS, NETWORK, study(6), METHODS[0])
    assert got.steps["status"].tolist() == ["partly_observable"] * 2 + ["ok"] * 4
    late = got.estimated["time_utc"] >= instant(2)
    angle = got.estimated["quantity"] == "va_degree"
    slack = got.estimated["element"] == f"bus/{NETWORK.buses.name[NETWORK.slack]}"
    for column in ("value", "sigma"):
        assert got.estimated[column].notna().equals(late | ~angle | slack)


def test_filter_whose_first_snapshots_leave_states_open_says_how_little_it_knows() -> None:
    """It starts from usual loads, and is as sure as a filter can be once all meters report."""
    table = telemetry(6)
    few = (table["time_utc"] < instant(2)) & ~table["channel"].str.endswith("vm_pu")
    got = estimate(table[~few], CHANNELS, NETWORK, study(6), METHODS[1])
    assert got.steps["status"].tolist() == ["ok"] * 6
    early = got.estimated["time_utc"] < instant(2)
    sigma = got.estimated["sigma"].groupby(early).median()
    assert sigma[True] > 2.0 * sigma[False]


def test_bad_rows_and_rows_of_other_trials_and_variants_are_passed_over() -> None:
    table = telemetry(3)
    spoilt = table.assign(value_pu=99.0)
    bad = table.assign(
        value_pu=np.where(table["channel"] == LAYOUT.channel[2], 99.0, table["value_pu"]),
        flag=np.where(table["channel"] == LAYOUT.channel[2], 2, 0).astype("int8"),
    )
    other = pd.concat(
        [bad, spoilt.assign(trial=np.int32(1)), spoilt.assign(variant="dtw")], ignore_index=True
    )
    got = estimate(other, CHANNELS, NETWORK, study(3), METHODS[0])
    plain = estimate(
        table[table["channel"] != LAYOUT.channel[2]], CHANNELS, NETWORK, study(3), METHODS[0]
    )
    pd.testing.assert_frame_equal(got.estimated, plain.estimated)
    assert LAYOUT.channel[2] not in set(got.residuals["channel"])


def test_missing_trial_and_variant_are_named_with_what_there_is() -> None:
    with pytest.raises(TableError, match=r"reads variant 'last' of trial 7.*\['last'\].*\[0\]"):
        estimate(telemetry(2), CHANNELS, NETWORK, study(2), METHODS[0], trial=7)
    method = dataclasses.replace(METHODS[0], variant="dtw")
    with pytest.raises(TableError, match=r"reads variant 'dtw' of trial 0"):
        estimate(telemetry(2), CHANNELS, NETWORK, study(2), method)


def test_channel_that_is_not_in_the_layout_is_named() -> None:
    strange = telemetry(2).replace({"channel": {LAYOUT.channel[0]: "pmu:bus/99:vm_pu"}})
    with pytest.raises(TableError, match="'pmu:bus/99:vm_pu' is not in the channels table"):
        record(strange, LAYOUT)


def test_channel_twice_at_one_instant_is_refused() -> None:
    table = telemetry(2)
    with pytest.raises(TableError, match="a channel stands twice at one instant"):
        record(pd.concat([table, table.head(1)]), LAYOUT)


def test_record_scatters_rows_by_time_and_channel() -> None:
    table = telemetry(3).sample(frac=1.0, random_state=2)
    held = (table["channel"] == LAYOUT.channel[5]) & (table["time_utc"] == instant(1))
    table["origin"] = np.where(held, "held", "measured")
    gone = (table["channel"] == LAYOUT.channel[0]) & (table["time_utc"] == instant(2))
    got = record(table[~gone], LAYOUT)
    assert got.z.shape == (3, len(LAYOUT))
    assert not got.fresh[1, 5]
    assert got.available[1, 5]
    assert not got.available[2, 0]
    assert got.z[2, 0] == 0.0
    assert got.fresh.sum() == got.available.sum() - 1
    part = got.between(got.time[1], got.time[2])
    np.testing.assert_array_equal(part.z, got.z[1:2])
    snapshots = list(got.snapshots())
    np.testing.assert_array_equal(snapshots[1].z, got.z[1])
    assert snapshots[2].time == got.time[2]


# --- the driver -----------------------------------------------------------------------------------


def snapshots(count: int) -> list[Snapshot]:
    table: Record = record(telemetry(count), LAYOUT)
    return list(table.snapshots())


def spoiling(estimator: Estimator, at: int, spoil: Any) -> Estimator:
    """The estimator whose state is spoilt after one of its steps."""
    count = {"steps": 0}

    def step(state: Any, snapshot: Snapshot) -> tuple[Any, Info]:
        count["steps"] += 1
        state, info = estimator.step(state, snapshot)
        return (spoil(state) if count["steps"] == at else state), info

    return estimator._replace(step=step)


def filter_of(q: float = 1e-7) -> Estimator:
    return kalman_filter("kf", NETWORK, LAYOUT, scalar_noise(NETWORK, q), step_s=STEP_S)


def test_state_that_is_not_finite_restarts() -> None:
    broken = spoiling(filter_of(), 2, lambda s: KalmanState(np.full_like(s.x, np.nan), s.P))
    got = run(broken, iter(snapshots(6)), NETWORK, LAYOUT)
    assert got.steps["status"].tolist() == ["ok", "ok", "diverged", "ok", "ok", "ok"]
    value = got.estimated["value"].to_numpy().reshape(6, 28)
    assert np.isnan(value[2]).all()
    assert np.isfinite(np.delete(value, 2, axis=0)).all()


def test_covariance_that_is_not_finite_restarts() -> None:
    broken = spoiling(filter_of(), 2, lambda s: KalmanState(s.x, np.full_like(s.P, np.nan)))
    got = run(broken, iter(snapshots(6)), NETWORK, LAYOUT)
    assert got.steps["status"].iloc[2] == "diverged"
    assert got.steps["status"].iloc[3:].tolist() == ["ok"] * 3
    sigma = got.estimated["sigma"].to_numpy().reshape(6, 28)
    assert np.isfinite(np.delete(sigma, 2, axis=0)).all()


def test_filter_that_is_far_too_sure_is_called_inconsistent() -> None:
    """Meters eight times worse than they claim: NIS is 64 times its expectation."""
    worse = [
        dataclasses.replace(s, z=s.z + 7 * (s.z - MeasurementModel(NETWORK, LAYOUT).h(TRUTH)))
        for s in snapshots(30)
    ]
    got = run(filter_of(), iter(worse), NETWORK, LAYOUT)
    assert set(got.steps["status"].iloc[15:]) == {"inconsistent"}
    plain = run(filter_of(), iter(snapshots(30)), NETWORK, LAYOUT)
    assert set(plain.steps["status"]) == {"ok"}


def test_meter_that_is_always_off_to_the_same_side_is_told() -> None:
    """3 σ eight times in a row are 24/√8 = 8.5; the same to and fro are nothing, 40 σ once count 4.

    A row that is not believed says nothing of the filter.
    """
    on, sigma = np.ones(2, dtype=bool), np.ones(2)

    def told(off: list[float], phi: float = 0.0) -> list[int]:
        info = [
            Info(Status.OK, 1, 1.0, 1, on, np.array([0.1, one]), sigma, np.array([0.0, phi]))
            for one in off
        ]
        return np.flatnonzero(biased(info, ConsistencyParams(), on)).tolist()

    assert told([3.0] * 9) == [7, 8]
    assert told([-3.0] * 9, phi=1.0) == []
    assert told([3.0, -3.0] * 5) == []
    assert told([40.0] + [0.0] * 20) == []
    assert told([]) == []


def test_nees_folds_angles_and_leaves_out_what_is_fixed() -> None:
    covariance = np.diag([0.0, *[1e-4] * 27])
    x = TRUTH.copy()
    x[1] = TRUTH[1] + 2 * np.pi + 0.01
    x[20] += 0.02
    m = len(LAYOUT)
    one = Estimator(
        "fixed",
        lambda s: (0, Info.nothing(m, Status.OK)),
        lambda state, s: (state, Info.nothing(m, Status.OK)),
        lambda state: Voltages(x, covariance),
    )
    got = run(one, iter(snapshots(1)), NETWORK, LAYOUT, truth=TRUTH[None, :])
    assert got.steps["nees"].iloc[0] == pytest.approx(1.0 + 4.0)


@pytest.mark.parametrize(("variance", "status"), [(-1e-6, "diverged"), (-1e-18, "ok")])
def test_negative_variance_is_no_estimate_but_for_the_rounding_of_a_fixed_state(
    variance: float, status: str
) -> None:
    m, covariance = len(LAYOUT), 1e-4 * np.eye(28)
    covariance[3, 3] = variance
    one = Estimator(
        "wrong",
        lambda s: (0, Info.nothing(m, Status.OK)),
        lambda state, s: (state, Info.nothing(m, Status.OK)),
        lambda state: Voltages(TRUTH, covariance),
    )
    got = run(one, iter(snapshots(2)), NETWORK, LAYOUT, truth=np.tile(TRUTH, (2, 1)))
    assert got.steps["status"].tolist() == [status] * 2
    assert got.estimated["value"].notna().all() == (status == "ok")
    if status == "ok":
        assert got.estimated["sigma"].min() == 0.0
        assert got.steps["nees"].tolist() == [0.0] * 2


def test_open_states_are_missing_in_the_table_and_do_not_count_as_errors() -> None:
    m, covariance = len(LAYOUT), 1e-4 * np.eye(28)
    x, open_ = TRUTH.copy(), np.zeros(28, dtype=bool)
    x[5] += 0.02
    open_[[4, 18]] = True
    x[open_] = np.nan
    covariance[open_], covariance[:, open_] = np.nan, np.nan
    one = Estimator(
        "partial",
        lambda s: (0, Info.nothing(m, Status.PARTLY_OBSERVABLE)),
        lambda state, s: (state, Info.nothing(m, Status.PARTLY_OBSERVABLE)),
        lambda state: Voltages(x, covariance, open_),
    )
    got = run(one, iter(snapshots(1)), NETWORK, LAYOUT, truth=TRUTH[None, :])
    for column in ("value", "sigma"):
        np.testing.assert_array_equal(got.estimated[column].isna(), open_)
    assert got.steps["nees"].iloc[0] == pytest.approx(4.0)


def test_no_snapshot_gives_empty_tables() -> None:
    wls = tracking_wls("wls", NETWORK, LAYOUT)
    got = run(wls, iter([]), NETWORK, LAYOUT)
    assert [len(t) for t in (got.estimated, got.residuals, got.steps)] == [0, 0, 0]


def test_residuals_are_those_of_the_rows_that_were_used() -> None:
    got = estimate(telemetry(2), CHANNELS, NETWORK, study(2), METHODS[0])
    assert len(got.residuals) == 2 * len(LAYOUT)
    white = got.residuals["innovation"] / got.residuals["sigma_innovation"]
    assert white.std() == pytest.approx(1.0, abs=0.35)
    assert got.residuals["used"].all()


def test_dead_reckoning_holds_for_the_power_rows_too() -> None:
    """A filter that gets voltages only once keeps its loads through the model."""
    layout = SensorLayout.of(
        NETWORK, (VM, np.arange(14), BUS), (P, np.arange(14), BUS), (Q, np.arange(14), BUS)
    )
    layout = dataclasses.replace(layout, sigma=np.full(len(layout), 1e-3))
    made = kalman_filter("kf", NETWORK, layout, scalar_noise(NETWORK, 1e-8), step_s=STEP_S)
    z = MeasurementModel(NETWORK, layout).h(TRUTH)
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    begin = Snapshot(np.datetime64("2016-06-09", "us"), z, layout.sigma, zero, on, on, zero)
    powers = np.isin(layout.quantity, (P, Q))
    state, _ = made.init(begin)
    for k in range(1, 6):
        time = begin.time + k * np.timedelta64(300, "s")
        state, info = made.step(state, dataclasses.replace(begin, time=time, available=powers))
        assert info.used.sum() == powers.sum()
    np.testing.assert_allclose(made.read(state).x, TRUTH, atol=1e-6)


def test_a_method_that_history_teaches_nothing_says_so_and_does_not_stop_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def lost(*_args: object, **_options: object) -> None:
        raise NotConverged("no power flow at the usual loads")

    monkeypatch.setattr(learn_from_history, "learn_load", lost)
    got = estimate(
        telemetry(3), CHANNELS, NETWORK, study(3), Method.of("kf", "kalman", noise="load")
    )
    assert set(got.steps["status"]) == {"not_converged"}
    assert got.steps["detail"].str.contains("no power flow at the usual loads").all()
    assert got.estimated["value"].isna().all()
    assert got.residuals.empty
