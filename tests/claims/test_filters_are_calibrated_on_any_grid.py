"""Claim: whatever grid, meters, losses and moving reference are drawn, σ is what the errors are.

Loads and held voltages walk as the filters believe, so that nothing but a filter's own faults can
make it too sure or too modest. What is drawn at random: which buses have meters of |V|, P and Q and
which phasor units, their σ (0.2 … 2 %), how the angle that phasors count from moves (it stands,
walks, turns by degrees per second, jumps), and the share of samples that is lost (up to 60 %), from
the first one on.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from pse_analysis.estimation.core.interface import Estimator, Snapshot
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.filters import composition
from pse_analysis.estimation.filters.angle_reference import AngleReference
from pse_analysis.estimation.filters.composition import Composition
from pse_analysis.estimation.filters.kalman import kalman_filter
from pse_analysis.estimation.filters.restart import guarded
from pse_analysis.estimation.process.load_noise import LoadStatistics, Sensitivity, load_noise
from pse_analysis.estimation.process.sage_husa import of_grid
from pse_analysis.estimation.static.start_prior import start_prior
from pse_analysis.estimation.static.wls import state_columns
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, MeasurementModel, P, Q, SensorLayout, wrap
from pse_analysis.vocabulary import Status

SEED = 1208
STEPS = 40
SHARE, HELD = 0.01, 3e-4
"""σ of the change per step of a load in its size, and of a held voltage. [p.u.]"""
FIRST = 0.2
"""How far loads are from their usual size when the first snapshot comes."""
START, MINUTE = np.datetime64("2024-05-14T00:00:00", "us"), np.timedelta64(60, "s")
GRIDS = {"ieee14": 6, "ieee30": 5, "ieee33": 6, "ieee57": 4, "ieee118": 3}
"""Scenes that are drawn of each grid: on a small one all errors of a scene hang together."""


class Scene(NamedTuple):
    """A grid with meters, its true states (2N, T), and what is reported (T, m)."""

    network: Network
    layout: SensorLayout
    statistics: LoadStatistics
    truth: np.ndarray
    z: np.ndarray
    on: np.ndarray


def moved(rng: np.random.Generator) -> np.ndarray:
    """How the angle that phasor units count from moves. (T,) [rad]"""
    walk = np.deg2rad(10.0 ** rng.uniform(-3, 0)) * np.cumsum(rng.standard_normal(STEPS))
    turns = np.deg2rad(rng.uniform(-180, 180)) * np.arange(STEPS)
    jumps = np.deg2rad(rng.uniform(-180, 180)) * (np.arange(STEPS) >= rng.integers(5, STEPS))
    return (np.zeros(STEPS), walk, turns, jumps)[rng.integers(4)]


def metered(network: Network, rng: np.random.Generator) -> SensorLayout:
    """|V|, P and Q at most buses, and phasor units at a quarter of them or nowhere."""
    bus, n = np.arange(network.n_bus), network.n_bus
    phasor = bus[rng.random(n) < 0.25] if rng.random() < 0.6 else bus[:0]
    blocks = [(q, bus[rng.random(n) < rng.uniform(0.7, 1.0)], BUS) for q in (VM, P, Q)]
    layout = SensorLayout.of(network, *blocks, (VA, phasor, BUS))
    size = 0.5 * np.mean(np.abs(network.p_nominal_pu[network.p_nominal_pu != 0]))
    scale = np.select([layout.quantity == VM, layout.quantity == VA], [0.3, 0.1], size)
    return dataclasses.replace(layout, sigma=rng.uniform(0.002, 0.02) * scale)


@cache
def scene(grid: str, number: int) -> Scene:
    network = library.load(grid)
    n, rng = network.n_bus, np.random.default_rng([SEED, list(GRIDS).index(grid), number])
    layout = metered(network, rng)
    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    step = SHARE * np.abs(nominal) + 1e-6
    power = (nominal * (1 + FIRST * rng.standard_normal(2 * n)))[:, None]
    power = power + np.cumsum(step[:, None] * rng.standard_normal((2 * n, STEPS)), axis=1)
    held = Sensitivity(network).held
    level = np.repeat(network.buses.vm_set_pu[:, None], STEPS, axis=1)
    level[held] += np.cumsum(HELD * rng.standard_normal((len(held), STEPS)), axis=1)
    truth = solve(network, power[:n], power[n:], level, tolerance=1e-9).x.copy()
    if layout.has_angle:
        truth[:n] += moved(rng)
    z = MeasurementModel(network, layout).h(truth).T
    z = z + layout.sigma * rng.standard_normal(z.shape)
    z = np.where(layout.angular, wrap(z), z)
    on = rng.random(z.shape) >= rng.choice([0.0, 0.1, 0.3, 0.6])
    return Scene(
        network, layout, LoadStatistics(step[None], np.eye(2 * n), HELD, 86400.0), truth, z, on
    )


def estimator(kind: str, s: Scene) -> Estimator:
    network, layout = s.network, s.layout
    noise = load_noise(network, s.statistics)
    reference = AngleReference(layout) if layout.has_angle else None
    none = np.zeros((0, len(layout)))
    past = Record(np.zeros(0, "datetime64[us]"), none, none, none, none > 0, none > 0, none)
    prior = start_prior(network, layout, past)
    if kind == "kalman":
        made = kalman_filter(
            kind, network, layout, noise, step_s=60.0, reference=reference, prior=prior
        )
    else:
        polar = of_grid(network, noise, state_columns(network, layout))
        choice = Composition(robustness="per_channel" if kind == "ukf per channel" else "none")
        made = composition.build(
            kind, "ekf" if kind == "ekf" else "ukf", choice, network, layout, polar,
            reference=reference, prior=prior,
        )  # fmt: skip
    return guarded(made, layout)


def scaled_errors(kind: str, s: Scene) -> tuple[np.ndarray, np.ndarray]:
    """(T, 2N) errors over σ, NaN where σ is 0; and which steps are called right."""
    zero = np.zeros(len(s.layout))
    snapshots = (
        Snapshot(START + t * MINUTE, np.where(on, z, 0.0), s.layout.sigma, zero, on, on, zero)
        for t, (z, on) in enumerate(zip(s.z, s.on, strict=True))
    )
    done = run(estimator(kind, s), snapshots, s.network, s.layout)
    n = s.network.n_bus
    value, sigma = (
        done.estimated[column].to_numpy().reshape(STEPS, 2 * n).copy()
        for column in ("value", "sigma")
    )
    value[:, :n], sigma[:, :n] = np.deg2rad(value[:, :n]), np.deg2rad(sigma[:, :n])
    error = value - s.truth.T
    error[:, :n] = wrap(error[:, :n])
    ratio = np.full(error.shape, np.nan)
    np.divide(error, sigma, out=ratio, where=sigma > 1e-12)
    return ratio, (done.steps["status"] == Status.OK).to_numpy()


@pytest.mark.parametrize("kind", ["kalman", "ekf", "ukf", "ukf per channel"])
@pytest.mark.parametrize("grid", GRIDS)
def test_errors_are_as_large_as_sigma_says(grid: str, kind: str) -> None:
    """Root mean square of error/σ over all scenes 0.8 … 1.25, 98 % of all states inside 3σ."""
    found = [scaled_errors(kind, scene(grid, number)) for number in range(GRIDS[grid])]
    ratio = np.concatenate([each[np.isfinite(each)] for each, _ in found])
    assert (np.abs(ratio) < 3).mean() >= 0.98
    assert 0.8 <= np.sqrt(np.mean(ratio**2)) <= 1.25
    assert np.mean([ok.mean() for _, ok in found]) > 0.9
