"""Bench of the unscented tests: the paper's sensors on a day of real load, without telemetry."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.core.run_arrays import EPOCH, ArrayRun, run_arrays
from pse_analysis.estimation.filters.composition import Composition, compose, scalar
from pse_analysis.estimation.filters.recursion import GaussianFilter
from pse_analysis.estimation.static.wls import state_columns
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, MeasurementModel, P, Q, SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.simulation import SimulateParams, profiles, simulate
from pse_analysis.simulation.settings import LoadParams, SensorParams

PMU_BUSES = {
    "ieee14": ("2", "6", "7", "9"),
    "ieee30": ("1", "7", "15", "17", "19", "24", "27", "30"),
}
VARIANCE = 1e-4
START = 1e-4
STEPS = 144


def paper_layout(network: Network, pmu: tuple[str, ...]) -> SensorLayout:
    """P, Q and |V| at every bus, θ at those with a phasor unit, and the paper's σ."""
    bus = np.arange(network.n_bus)
    phasor = np.array([network.bus(name) for name in pmu])
    layout = SensorLayout.of(
        network, (P, bus, BUS), (Q, bus, BUS), (VM, bus, BUS), (VA, phasor, BUS)
    )
    exact = (layout.quantity == VM) & np.isin(layout.position, phasor)
    sigma = np.where(exact, 0.005, np.where(layout.quantity == VA, 0.002, 0.02))
    return dataclasses.replace(layout, sigma=sigma)


@dataclass(frozen=True, eq=False)
class Bench:
    """A grid with its layout and true states, (T, 2N)."""

    network: Network
    layout: SensorLayout
    truth: np.ndarray
    exact: np.ndarray

    def filter(self, kind: str = "ukf", q: float = VARIANCE, **choice: object) -> GaussianFilter:
        """A filter of the given composition with scalar noise."""
        return compose(
            kind,  # type: ignore[arg-type]
            Composition(**choice),  # type: ignore[arg-type]
            self.network,
            self.layout,
            scalar(self.network, self.layout, q),
        )

    @property
    def start(self) -> np.ndarray:
        """Covariance of the start."""
        return np.asarray(START * np.eye(len(state_columns(self.network, self.layout))))

    def measure(self, rng: np.random.Generator) -> np.ndarray:
        """Measurements of every instant, with noise. (T, m)"""
        return np.asarray(self.exact + self.layout.sigma * rng.standard_normal(self.exact.shape))

    def run(self, made: GaussianFilter, z: np.ndarray) -> ArrayRun:
        """The filter's day, from the true state."""
        return run_arrays(made, self.truth[0], self.start, z, self.layout.sigma)

    def snapshot(self, z: np.ndarray, available: np.ndarray | None = None) -> Snapshot:
        """A snapshot of fresh values."""
        zero = np.zeros(len(z))
        on = np.ones(len(z), dtype=bool) if available is None else available
        return Snapshot(EPOCH, z, self.layout.sigma, zero, on, on, zero)


@cache
def still(grid: str, steps: int = 21) -> Bench:
    """Loads that walk a little, from the nominal state."""
    network = library.load(grid)
    layout = paper_layout(network, PMU_BUSES.get(grid, network.buses.name[::4]))
    rng = np.random.default_rng(14)
    scale = 1.0 + 0.01 * np.cumsum(rng.standard_normal((network.n_bus, steps)), axis=1)
    x = solve(network, network.p_nominal_pu[:, None] * scale).x
    return Bench(network, layout, x.T, MeasurementModel(network, layout).h(x).T)


@cache
def real_day(grid: str = "ieee30") -> Bench:
    """144 instants of ten minutes under real load curves."""
    network = library.load(grid)
    start = datetime(2016, 6, 9, tzinfo=UTC)
    study = Study(start, start + timedelta(minutes=10 * STEPS), 600.0)
    group = SensorParams("scada", ("vm_pu",), ("bus/1",), sigma=0.02, period_s=600.0)
    params = SimulateParams(30, (group,), truth_step_s=300.0, load=LoadParams(level=0.8))
    curves = profiles.load(Path(__file__).parents[1] / "data" / "raw" / "load_profiles")
    truth = simulate(network, curves, study, params).truth
    assert truth is not None
    wide = truth.pivot(index="time_utc", columns=["quantity", "element"], values="value")
    names = [f"bus/{name}" for name in network.buses.name]
    x = np.hstack([np.deg2rad(wide["va_degree"][names]), wide["vm_pu"][names]])
    layout = paper_layout(network, PMU_BUSES.get(grid, network.buses.name[::4]))
    return Bench(network, layout, x, MeasurementModel(network, layout).h(x.T).T)


def gross_errors(
    z: np.ndarray, share: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A share of all samples read ten times too high, and which."""
    wrong = rng.random(z.shape) < share
    return np.where(wrong, 10.0 * z, z), wrong
