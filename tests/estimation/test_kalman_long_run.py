"""Claim: whatever the scales of the meters, P stays symmetric and positive definite."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pse_analysis.estimation.bad_data import innovation_test
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.kalman import kalman_filter
from pse_analysis.estimation.process.dynamics import Process, holt, local_trend, random_walk
from pse_analysis.estimation.process.load_noise import scalar_noise
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, MeasurementModel, P, Q, SensorLayout
from pse_analysis.vocabulary import Status

SEED = 33
STEP_S = 300.0


def metered(network: Network) -> SensorLayout:
    """Voltage phasors at every third bus and all injections."""
    bus = np.arange(network.n_bus)
    return SensorLayout.of(
        network, (VM, bus[::3], BUS), (VA, bus[::3], BUS), (P, bus, BUS), (Q, bus, BUS)
    )


@pytest.mark.parametrize(
    ("process", "refuse", "steps"),
    [
        (random_walk(), None, 3000),
        (holt(), None, 500),
        (local_trend(), None, 500),
        (random_walk(), innovation_test.refuse(), 500),
    ],
    ids=["walk", "holt", "trend", "screened"],
)
def test_covariance_stays_symmetric_and_positive_over_a_long_run(
    process: Process, refuse: innovation_test.Refuse | None, steps: int
) -> None:
    """σ from 1e-8 (injections that are exactly zero) to 1, meters that come and go, old samples."""
    network = library.load("ieee14")
    layout = metered(network)
    rng = np.random.default_rng(SEED)
    power = np.isin(layout.quantity, (P, Q))
    sigma = np.where(
        power, 10.0 ** rng.uniform(-8, 0, len(layout)), 10.0 ** rng.uniform(-5, -1, len(layout))
    )
    layout = dataclasses.replace(layout, sigma=sigma, window_s=np.where(power, STEP_S, 0.0))
    noise = scalar_noise(network, 1e-10)
    made = kalman_filter(
        "kf", network, layout, noise,
        step_s=STEP_S, reach_s=2 * STEP_S, process=process, refuse=refuse,
    )  # fmt: skip
    z = MeasurementModel(network, layout).h(solve(network).x)
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    start = np.datetime64("2016-06-09T00:00:00", "us")
    state, _ = made.init(Snapshot(start, z, np.full(len(z), 1e-3), zero, on, on, zero))
    for k in range(1, steps):
        now = Snapshot(
            start + k * np.timedelta64(300, "s"),
            z + sigma * rng.normal(size=len(z)),
            sigma, zero, rng.random(len(z)) < 0.7, on, rng.uniform(0, STEP_S, len(z)),
        )  # fmt: skip
        state, info = made.step(state, now)
        assert info.status is Status.OK
        if k % 250 == 0:
            np.testing.assert_array_equal(state.P, state.P.T)
            scale = np.sqrt(np.diagonal(state.P))
            assert np.linalg.eigvalsh(state.P / np.outer(scale, scale)).min() > 0
    assert np.abs(made.read(state).x - solve(network).x).max() < 1e-2
