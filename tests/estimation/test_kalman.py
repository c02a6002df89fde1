"""Claim: the filter reads a sample where and when it was taken, once, and says what it did."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pytest

from pse_analysis import parameters
from pse_analysis.estimation import Method, Setting
from pse_analysis.estimation.core.interface import Estimator, Info, Snapshot
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.filters.kalman import KalmanState, kalman_filter
from pse_analysis.estimation.process.load_noise import scalar_noise
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, MeasurementModel, P, Q, SensorLayout
from pse_analysis.vocabulary import Status

SEED = 33
STEP_S = 300.0


def metered(network: Network) -> SensorLayout:
    """Voltage phasors at every third bus and all injections, with devices that pair them."""
    bus = np.arange(network.n_bus)
    layout = SensorLayout.of(
        network, (VM, bus[::3], BUS), (VA, bus[::3], BUS), (P, bus, BUS), (Q, bus, BUS)
    )
    names = tuple(f"d{p}:{q}" for p, q in zip(layout.position, layout.quantity, strict=True))
    return dataclasses.replace(layout, channel=names, sigma=np.full(len(layout), 2e-3))


@dataclasses.dataclass
class Bench:
    network: Network
    layout: SensorLayout
    filter: Estimator
    truth: np.ndarray

    def snapshot(self, step: int, **change: object) -> Snapshot:
        m = len(self.layout)
        rng = np.random.default_rng([SEED, step])
        z = MeasurementModel(self.network, self.layout).h(self.truth)
        z = z + self.layout.sigma * rng.normal(size=m)
        on, zero = np.ones(m, dtype=bool), np.zeros(m)
        time = np.datetime64("2016-06-09T00:00:00", "us") + step * np.timedelta64(300, "s")
        usual = Snapshot(time, z, self.layout.sigma, zero, on, on, zero)
        return dataclasses.replace(usual, **change)


def bench(grid: str = "ieee14", q: float = 1e-8, **options: float) -> Bench:
    network = library.load(grid)
    layout = metered(network)
    made = kalman_filter("kf", network, layout, scalar_noise(network, q), step_s=STEP_S, **options)
    return Bench(network, layout, made, solve(network).x)


def test_estimate_settles_on_the_truth() -> None:
    b = bench()
    state, _ = b.filter.init(b.snapshot(0))
    first = np.abs(b.filter.read(state).x - b.truth).max()
    for k in range(1, 100):
        state, info = b.filter.step(state, b.snapshot(k))
        assert info.status is Status.OK
    voltages = b.filter.read(state)
    error = voltages.x - b.truth
    assert np.abs(error).max() < 0.4 * first
    assert np.abs(error / np.sqrt(np.diagonal(voltages.covariance))).max() < 4.5


def test_held_sample_is_not_used_again() -> None:
    b = bench()
    state, _ = b.filter.init(b.snapshot(0))
    held = np.zeros(len(b.layout), dtype=bool)
    after, info = b.filter.step(state, b.snapshot(0, fresh=held))
    assert info.status is Status.PREDICTED
    assert not info.used.any()
    np.testing.assert_array_equal(after.x, state.x)
    np.testing.assert_allclose(np.diagonal(after.P) - np.diagonal(state.P), 1e-8)


def test_row_that_is_not_available_changes_nothing() -> None:
    b = bench()
    state, _ = b.filter.init(b.snapshot(0))
    rows = np.ones(len(b.layout), dtype=bool)
    rows[[2, 7, 20]] = False
    usual = b.snapshot(1)
    one = b.filter.step(state, dataclasses.replace(usual, available=rows))
    spoilt = np.where(rows, usual.z, 0.0)
    other = b.filter.step(state, dataclasses.replace(usual, available=rows, z=spoilt))
    np.testing.assert_array_equal(one[0].x, other[0].x)
    assert not one[1].used[[2, 7, 20]].any()
    assert np.isnan(one[1].innovation[[2, 7, 20]]).all()


def test_growth_of_sigma_by_age_is_left_to_the_model() -> None:
    b = bench()
    state, _ = b.filter.init(b.snapshot(0))
    plain = b.filter.step(state, b.snapshot(1))[0]
    grown = np.full(len(b.layout), 0.05)
    aged = b.snapshot(1, sigma=np.hypot(b.layout.sigma, grown), sigma_age=grown)
    np.testing.assert_allclose(b.filter.step(state, aged)[0].x, plain.x, atol=1e-12)


def test_sample_of_some_seconds_ago_is_used() -> None:
    b = bench(reach_s=60.0)
    state, _ = b.filter.init(b.snapshot(0))
    old = np.full(len(b.layout), 60.0)
    _, info = b.filter.step(state, b.snapshot(1, age_s=old))
    assert info.used.all()
    assert info.status is Status.OK


def test_sample_that_is_older_than_what_is_kept_is_left_out() -> None:
    b = bench(reach_s=300.0)
    state, _ = b.filter.init(b.snapshot(0))
    age = np.zeros(len(b.layout))
    age[4] = 900.0
    _, info = b.filter.step(state, b.snapshot(1, age_s=age))
    assert not info.used[4]
    assert info.used.sum() == len(age) - 1


def test_older_states_spread_by_the_walk_at_the_start() -> None:
    b = bench(reach_s=900.0, q=1e-6)
    state, _ = b.filter.init(b.snapshot(0))
    n = 2 * b.network.n_bus
    assert state.P.shape == (3 * n, 3 * n)
    now, before, oldest = (np.diagonal(state.P)[k * n : (k + 1) * n] for k in range(3))
    np.testing.assert_allclose(before - now, 1e-6, atol=1e-15)
    np.testing.assert_allclose(oldest - now, 2e-6, atol=1e-15)
    np.testing.assert_allclose(state.P[:n, n : 2 * n], state.P[:n, :n])


def test_without_any_angle_the_sources_angle_is_the_reference() -> None:
    network = library.load("ieee33")
    bus = np.arange(33)
    layout = SensorLayout.of(network, (VM, bus[::4], BUS), (P, bus, BUS), (Q, bus, BUS))
    layout = dataclasses.replace(layout, sigma=np.full(len(layout), 1e-3))
    made = kalman_filter("kf", network, layout, scalar_noise(network, 1e-7), step_s=STEP_S)
    b = Bench(network, layout, made, solve(network).x)
    state, _ = made.init(b.snapshot(0))
    for k in range(1, 30):
        state, info = made.step(state, b.snapshot(k))
        assert info.status is Status.OK
    voltages = made.read(state)
    assert voltages.x[network.slack] == pytest.approx(0.0, abs=1e-12)
    assert voltages.covariance[network.slack, network.slack] == pytest.approx(0.0, abs=1e-20)
    assert np.abs(voltages.x - b.truth).max() < 5e-3


def test_start_that_is_not_observable_names_the_buses() -> None:
    b = bench()
    rows = ~np.isin(b.layout.quantity, (P, Q))
    state, info = b.filter.init(b.snapshot(0, available=rows))
    assert state is None
    assert info.status is Status.UNOBSERVABLE
    assert "ieee14 is not observable" in info.detail


def test_state_that_is_not_positive_asks_for_a_new_start() -> None:
    b = bench()
    state, _ = b.filter.init(b.snapshot(0))
    broken = KalmanState(state.x, -state.P)
    after, info = b.filter.step(broken, b.snapshot(1))
    assert after is None
    assert info.status is Status.DIVERGED
    assert "not positive definite" in info.detail


def test_filter_that_diverged_starts_again_from_least_squares() -> None:
    b = bench()

    def step(state: KalmanState, snapshot: Snapshot) -> tuple[KalmanState | None, Info]:
        lost = snapshot.time == b.snapshot(3).time
        return b.filter.step(
            dataclasses.replace(state, P=-1e3 * state.P) if lost else state, snapshot
        )

    spoilt = b.filter._replace(step=step)
    taken = (b.snapshot(k) for k in range(8))
    got = run(spoilt, taken, b.network, b.layout)
    assert got.steps["status"].tolist() == ["ok"] * 3 + ["diverged"] + ["ok"] * 4
    value = got.estimated["value"].to_numpy().reshape(8, -1)
    assert np.isnan(value[3]).all()
    begun = b.filter.read(b.filter.init(b.snapshot(4))[0]).x
    np.testing.assert_allclose(value[4, b.network.n_bus :], begun[b.network.n_bus :])


@pytest.mark.parametrize("process", ["random_walk", "holt", "local_trend"])
@pytest.mark.parametrize("reading", ["interval", "instant"])
def test_filter_of_a_case_file_forecasts_and_estimates_its_noise(
    process: str, reading: str
) -> None:
    b = bench()
    data = {
        "name": "kf", "filter": "kalman", "noise": "innovation", "reading": reading,
        "screening": "innovation", "compose": {"process": process},
    }  # fmt: skip
    method = parameters.build(Method, data, "estimate.methods")
    study = parameters.Study(
        datetime(2016, 6, 9, tzinfo=UTC), datetime(2016, 6, 10, tzinfo=UTC), STEP_S
    )
    m = len(b.layout)
    no, off = np.zeros((0, m)), np.zeros((0, m), dtype=bool)
    history = Record(np.zeros(0, dtype="datetime64[us]"), no, no, no, off, off, no)
    made = method.estimator(Setting(b.network, b.layout, study, history))
    state, _ = made.init(b.snapshot(0))
    assert len(state.inner.x) == 2 * b.network.n_bus * (2 if process == "local_trend" else 1)
    for k in range(1, 12):
        state, info = made.step(state, b.snapshot(k))
        assert info.status is Status.OK
    first = made.init(b.snapshot(0))[0].inner
    assert (state.inner.noise.level != first.noise.level).any()
    assert np.abs(made.read(state).x - b.truth).max() < 5e-3
