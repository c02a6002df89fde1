"""Claim: powers and magnitudes say nothing of the angle that all buses share, in any filter."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pse_analysis.estimation.core.interface import Estimator, Snapshot
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.filters import composition
from pse_analysis.estimation.filters.composition import Composition
from pse_analysis.estimation.filters.kalman import kalman_filter
from pse_analysis.estimation.process.load_noise import LoadStatistics, load_noise
from pse_analysis.estimation.process.sage_husa import of_grid
from pse_analysis.estimation.static.wls import state_columns
from pse_analysis.grid import library
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, MeasurementModel, P, Q, SensorLayout

SEED = 118
STEP = np.timedelta64(60, "s")
START = np.datetime64("2016-06-09T00:00:00", "us")
MOVE, SOURCE = 0.001, 1e-4
"""σ of a step of every load, as a share of it, and of the held voltages in p.u."""


def metered(network: Network, phasors: int = 0) -> SensorLayout:
    """Magnitudes of 0.3 % and 1 % powers at every bus, and some angles."""
    bus = np.arange(network.n_bus)
    blocks = [(VM, bus, BUS), (P, bus, BUS), (Q, bus, BUS)]
    if phasors:
        blocks.append((VA, bus[:phasors], BUS))
    layout = SensorLayout.of(network, *blocks)
    usual = np.abs(MeasurementModel(network, layout).h(solve(network).x))
    power = np.isin(layout.quantity, (P, Q))
    sigma = np.where(power, np.maximum(0.01 * usual, 2e-3), 3e-3)
    return dataclasses.replace(layout, sigma=np.where(layout.quantity == VA, 0.02, sigma))


def statistics(network: Network) -> LoadStatistics:
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    deviation = MOVE * nominal + 1e-5
    return LoadStatistics(deviation[None], np.eye(2 * network.n_bus), SOURCE, 86400.0)


def truth(network: Network, steps: int, rng: np.random.Generator) -> np.ndarray:
    """States of loads and held voltages that walk as the filters believe. (2N, steps)"""
    n, deviation = network.n_bus, statistics(network).deviation[0]
    power = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])[:, None] + np.cumsum(
        deviation[:, None] * rng.normal(size=(2 * n, steps)), axis=1
    )
    held = network.buses.kind != BusKind.PQ
    level = network.buses.vm_set_pu[:, None] + np.where(
        held[:, None], np.cumsum(SOURCE * rng.normal(size=(n, steps)), axis=1), 0.0
    )
    return solve(network, power[:n], power[n:], level, tolerance=1e-9).x


def filters(network: Network, layout: SensorLayout) -> dict[str, Estimator]:
    noise = load_noise(network, statistics(network))
    polar = of_grid(network, noise, state_columns(network, layout))
    return {
        "kalman": kalman_filter("kalman", network, layout, noise, step_s=60.0),
        "ekf": composition.build("ekf", "ekf", Composition(), network, layout, polar),
        "transform": kalman_filter(
            "transform", network, layout, noise, step_s=60.0, linearisation="transform"
        ),
    }


def errors(
    name: str, network: Network, layout: SensorLayout, steps: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the angles and their σ, slack left out, at all steps but the first. (T, N-1)"""
    rng = np.random.default_rng([SEED, seed])
    x = truth(network, steps, rng)
    z = MeasurementModel(network, layout).h(x)
    z = z + layout.sigma[:, None] * rng.normal(size=z.shape)
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    taken = (
        Snapshot(START + k * STEP, z[:, k], layout.sigma, zero, on, on, zero) for k in range(steps)
    )
    made = filters(network, layout)[name]
    table = run(made, taken, network, layout).estimated
    n, free = network.n_bus, np.arange(network.n_bus) != network.slack
    value, sigma = (table[c].to_numpy().reshape(steps, 2 * n)[1:, :n] for c in ("value", "sigma"))
    return (np.deg2rad(value) - x[:n, 1:].T)[:, free], np.deg2rad(sigma)[:, free]


@pytest.mark.parametrize(("grid", "steps", "seeds"), [("ieee14", 60, 4), ("ieee118", 40, 1)])
def test_filter_knows_how_well_it_knows_the_angles(grid: str, steps: int, seeds: int) -> None:
    network = library.load(grid)
    layout = metered(network)
    found = {}
    for name in ("kalman", "ekf", "transform"):
        parts = [errors(name, network, layout, steps, seed) for seed in range(seeds)]
        error, sigma = (np.concatenate(part) for part in zip(*parts, strict=True))
        found[name] = (error, sigma)
    for name in ("kalman", "ekf"):
        error, sigma = found[name]
        assert np.mean(np.abs(error) < 3 * sigma) >= 0.98
        assert 0.8 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.25
    # Both linearise the same function, and differ by what is of second order only.
    (one, its), (other, others) = found["kalman"], found["ekf"]
    assert np.sqrt(np.mean((one - other) ** 2)) < 0.1 * np.sqrt(np.mean(other**2))
    np.testing.assert_allclose(its, others, rtol=0.03)
    if grid == "ieee118":  # where injections are large beside the σ of their meters
        error, sigma = found["transform"]
        assert np.sqrt(np.mean((error / sigma) ** 2)) > 1.25


def test_common_angle_is_known_as_well_as_the_phasors_tell() -> None:
    """A hundred readings of one angle that stands still: σ/10, whatever the powers are."""
    network = library.load("ieee14")
    layout = metered(network, phasors=1)
    x = truth(network, 100, np.random.default_rng(SEED))
    rng = np.random.default_rng([SEED, 1])
    z = MeasurementModel(network, layout).h(x)
    z = z + layout.sigma[:, None] * rng.normal(size=z.shape)
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    bound = 0.02 / np.sqrt(100)
    known = {}
    for name, made in filters(network, layout).items():
        state = None
        for k in range(100):
            now = Snapshot(START + k * STEP, z[:, k], layout.sigma, zero, on, on, zero)
            state, _ = made.init(now) if state is None else made.step(state, now)
        known[name] = np.sqrt(made.read(state).covariance[network.slack, network.slack])
    assert 0.97 * bound < known["kalman"] < 1.1 * bound
    assert 0.97 * bound < known["ekf"] < 1.1 * bound
    assert known["transform"] < 0.8 * bound
