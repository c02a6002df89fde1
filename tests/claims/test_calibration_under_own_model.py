"""Claim: where truth moves as the filter believes, NIS, NEES and coverage are what they should be.

30 seeds; 99.9 % bounds. In the first test phasors read the state, which is exactly linear; in the
second one meters read the nonlinear grid.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.filters.kalman import KalmanState, kalman_filter
from pse_analysis.estimation.process.load_noise import LoadStatistics, load_noise
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import (
    BUS,
    VA,
    VM,
    MeasurementModel,
    P,
    Q,
    SensorLayout,
)
from pse_analysis.scoring.consistency import bounds

SEED = 1000
SEEDS = 30
STEP_S = 300.0
CONFIDENCE = 0.999


def metered(network: Network) -> tuple[SensorLayout, np.ndarray]:
    """Phasors at three buses and every load, with their σ."""
    load = np.arange(1, network.n_bus)
    bus = np.array([1, 5, 17])
    layout = SensorLayout.of(
        network, (VM, bus, BUS), (VA, bus, BUS), (P, load, BUS), (Q, load, BUS)
    )
    names = tuple(f"d{p}:{q}" for p, q in zip(layout.position, layout.quantity, strict=True))
    layout = dataclasses.replace(layout, channel=names)
    return layout, np.where(
        layout.quantity == VM, 5e-4, np.where(layout.quantity == VA, 5e-4, 2e-4)
    )


def statistics(network: Network) -> LoadStatistics:
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    correlation = 0.7 * np.eye(2 * network.n_bus) + 0.3
    return LoadStatistics(0.05 * nominal[None, :], correlation, 1e-3, 86400.0)


def square_root(covariance: np.ndarray) -> np.ndarray:
    """A factor of a covariance that may have null directions."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def assert_consistent(total: float, dof: int) -> None:
    low, high = bounds(dof, CONFIDENCE)
    assert low < total / dof < high


def linear_run(belief: float) -> tuple[float, int, float, float]:
    """NIS and its degrees, NEES and coverage of |x| if meters are believed to have belief·σ."""
    network = library.load("ieee33")
    bus, sigma = np.arange(0, 33, 2), 5e-4
    layout = SensorLayout.of(network, (VM, bus, BUS), (VA, bus, BUS))
    flow = solve(network)
    voltage = flow.vm * np.exp(1j * flow.theta)
    noise = load_noise(network, statistics(network))(voltage, np.datetime64("2016-06-09", "us"))
    assert np.linalg.matrix_rank(noise) < 66
    made = kalman_filter("kf", network, layout, lambda _voltage, _time: noise, step_s=STEP_S)
    mean = np.concatenate([voltage.real, voltage.imag])
    start, root = 1e-6 * np.eye(66), square_root(noise)
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    steps, settled = 25, 5
    nis = nees = 0.0
    inside = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([SEED, seed])
        truth = mean + 1e-3 * rng.normal(size=66)
        state = KalmanState(mean.copy(), start.copy())
        for k in range(steps):
            truth = truth + root @ rng.normal(size=66)
            along, across = sigma * rng.normal(size=(2, len(bus)))
            phasor = truth[bus] + along + 1j * (truth[33 + bus] + across)
            size = np.abs(phasor)
            z = np.concatenate([size, np.angle(phasor)])
            # σ is the same along and across, so that its frame does not matter.
            own = belief * sigma * np.concatenate([np.ones(len(bus)), 1.0 / size])
            time = np.datetime64("2016-06-09", "us") + k * np.timedelta64(300, "s")
            state, info = made.step(state, Snapshot(time, z, own, zero, on, on, zero))
            nis += info.nis
            if k >= settled:
                inside.append(np.abs(state.x - truth) <= 2 * np.sqrt(np.diagonal(state.P)))
        error = state.x - truth
        nees += float(error @ np.linalg.solve(state.P, error))
    return nis, SEEDS * steps * len(layout), nees, float(np.mean(inside))


def test_linear_filter_is_consistent() -> None:
    """Q has null directions: P keeps what the start left there, so NEES has all 2N degrees."""
    nis, dof, nees, inside = linear_run(1.0)
    assert_consistent(nis, dof)
    assert_consistent(nees, SEEDS * 66)
    assert 0.94 < inside < 0.97


@pytest.mark.parametrize("belief", [0.8, 1.25])
def test_filter_that_believes_in_other_meters_is_found_out(belief: float) -> None:
    nis, dof, _, _ = linear_run(belief)
    low, high = bounds(dof, CONFIDENCE)
    assert not low < nis / dof < high


@pytest.mark.parametrize("window_s", [0.0, 900.0])
def test_whole_filter_is_consistent_on_the_grid(window_s: float) -> None:
    """Loads and source walk, meters read h(x): instantaneous, or as quarter-hour means."""
    network = library.load("ieee33")
    layout, sigma = metered(network)
    power = np.isin(layout.quantity, (P, Q))
    layout = dataclasses.replace(layout, window_s=np.where(power, window_s, 0.0))
    model = MeasurementModel(network, layout)
    learnt = statistics(network)
    estimator = kalman_filter(
        "kf", network, layout, load_noise(network, learnt), step_s=STEP_S, reach_s=window_s
    )
    steps, fine, settled = (40, 1, 8) if window_s == 0 else (40, 6, 12)
    count = (steps + 3) * fine
    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    root = np.linalg.cholesky(
        learnt.correlation * np.outer(learnt.deviation[0], learnt.deviation[0]) + 1e-20 * np.eye(66)
    )
    nis = dof = nees = 0.0
    inside = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([SEED, seed])
        move = root @ rng.normal(size=(66, count)) / np.sqrt(fine)
        injection = nominal[:, None] + np.cumsum(move, axis=1)
        level = 1 + np.cumsum(learnt.held / np.sqrt(fine) * rng.normal(size=count))
        vm = np.where((np.arange(33) == network.slack)[:, None], level, 1.0)
        flow = solve(network, injection[:33], injection[33:], vm, tolerance=1e-9)
        seen = model.h(flow.x)
        at = np.arange(3, steps + 3) * fine + fine - 1
        z = seen[:, at]
        if window_s:
            width = 3 * fine
            total = np.cumsum(np.pad(seen[power], ((0, 0), (1, 0))), axis=1)
            # A trapezoid over the window, of which the samples at both ends count half.
            whole = total[:, at + 1] - total[:, at + 1 - width]
            z[power] = (whole + 0.5 * seen[power][:, at - width] - 0.5 * seen[power][:, at]) / width
        z = z + sigma[:, None] * rng.normal(size=z.shape)
        zero, on = np.zeros(len(sigma)), np.ones(len(sigma), dtype=bool)
        snapshots = []
        for k in range(steps):
            time = np.datetime64("2016-06-09", "us") + k * np.timedelta64(300, "s")
            fresh = on if window_s == 0 else ~power | (k % 3 == 0)
            # At the start a mean stands for the present: its σ says by how much it may differ.
            grown = np.where(layout.window_s > 0, learnt_spread(model, learnt, nominal, power), 0.0)
            snapshots.append(
                Snapshot(time, z[:, k], np.hypot(sigma, grown), grown, on, fresh, zero)
            )
        truth = flow.x[:, at].T
        result = run(estimator, iter(snapshots), network, layout, truth=truth)
        assert set(result.steps["status"]) <= {"ok", "inconsistent"}
        late = result.steps.iloc[settled:]
        nis += late["nis"].sum()
        dof += late["dof"].sum()
        nees += float(late["nees"].iloc[-1])
        vm = result.estimated[result.estimated["quantity"] == "vm_pu"]
        error = vm["value"].to_numpy().reshape(steps, 33) - truth[:, 33:]
        spread = vm["sigma"].to_numpy().reshape(steps, 33)
        inside.append((np.abs(error) <= 2 * spread)[settled:])
    assert_consistent(nis, int(dof))
    assert_consistent(nees, SEEDS * 66)
    assert 0.94 < np.mean(inside) < 0.97


def learnt_spread(
    model: MeasurementModel, learnt: LoadStatistics, nominal: np.ndarray, power: np.ndarray
) -> np.ndarray:
    """σ by which a mean over three steps may differ from the value at its end."""
    place = model.layout.position + 33 * (model.layout.quantity == Q)
    return np.where(power, learnt.deviation[0][place % 66], 0.0)
