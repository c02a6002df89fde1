"""A step of the unscented filter beside filterpy's, and beside the products that define it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.linalg import blas

from benchmarks.timing import Row, alternate
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.composition import Composition, compose, scalar
from pse_analysis.estimation.filters.recursion import GaussianFilter
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, P, Q, SensorLayout

SEED = 118
VARIANCE = 1e-4
NOW = np.datetime64("2016-06-09T12:00:00", "us")
REPEATS = 15
PEER_REPEATS = 4
LARGE = 3_500_000
GRIDS = ("ieee14", "ieee30", "ieee57", "ieee118", "ieee300")
PEER_UP_TO = 118
"""Buses up to which filterpy is run by `cost`: beyond, one step takes seconds."""


class Step:
    """One grid with the paper's measurements, and one snapshot of them with and without errors."""

    def __init__(self, grid: str) -> None:
        self.network = network = library.load(grid)
        bus, phasor = np.arange(network.n_bus), np.arange(0, network.n_bus, 4)
        layout = SensorLayout.of(
            network, (P, bus, BUS), (Q, bus, BUS), (VM, bus, BUS), (VA, phasor, BUS)
        )
        sigma = np.where(layout.quantity == VA, 0.002, 0.02)
        self.layout = dataclasses.replace(layout, sigma=sigma)
        self.x = solve(network).x
        self.clean = self.filter()
        rng = np.random.default_rng(SEED)
        self.z = self.clean.model.h(self.x) + sigma * rng.standard_normal(len(sigma))
        wrong = rng.random(len(sigma)) < 0.05
        self.wrong = np.where(wrong, 10.0 * self.z, self.z)

    def filter(self, kind: str = "ukf", **choice: object) -> GaussianFilter:
        """A filter of the given composition."""
        variance = scalar(self.network, self.layout, VARIANCE)
        made = Composition(**choice)  # type: ignore[arg-type]
        return compose(kind, made, self.network, self.layout, variance)  # type: ignore[arg-type]

    def snapshot(self, z: np.ndarray) -> Snapshot:
        """Everything reports."""
        on, zero = np.ones(len(z), dtype=bool), np.zeros(len(z))
        return Snapshot(NOW, z, self.layout.sigma, zero, on, on, zero)

    def work(self, made: GaussianFilter, z: np.ndarray) -> Callable[[], object]:
        """The step of a filter after one snapshot without errors."""
        start = made.begin(self.x, VARIANCE * np.eye(len(self.x)), NOW)
        state, _ = made.step(start, self.snapshot(self.z))
        assert state is not None
        snapshot = self.snapshot(z)
        return lambda: made.step(state, snapshot)

    def least_squares(self) -> Callable[[], object]:
        """One snapshot by weighted least squares from a flat start, with its covariance."""
        made = WeightedLeastSquares(self.network, self.layout)
        return lambda: made.solve(self.z, self.layout.sigma).covariance()

    def peer(self) -> Callable[[], object]:
        """filterpy's predict, points drawn again, and update, with our h."""  # noqa: D403
        n, m = len(self.x), len(self.z)
        points = MerweScaledSigmaPoints(n, 1.0, 2.0, 0.0)
        peer = UnscentedKalmanFilter(n, m, 1.0, self.clean.model.h, lambda x, dt: x, points)
        peer.Q, peer.R = VARIANCE * np.eye(n), np.diag(self.layout.sigma**2)
        start = VARIANCE * np.eye(n)

        def step() -> None:
            peer.x, peer.P = self.x.copy(), start
            peer.predict()
            peer.sigmas_f = points.sigma_points(peer.x, peer.P)
            peer.update(self.z)

        return step

    def products(self) -> Callable[[], object]:
        """S and P - K S Kᵀ as symmetric products and C as a dense one, of the sums' own sizes."""
        n, m = len(self.x), len(self.z)
        rng = np.random.default_rng(SEED)
        apart = np.asfortranarray(rng.standard_normal((m, 2 * n + 1)))
        points = np.asfortranarray(rng.standard_normal((n, 2 * n + 1)))
        gain = np.asfortranarray(rng.standard_normal((n, m)))

        def multiply() -> None:
            blas.dsyrk(1.0, apart, lower=1)
            blas.dgemm(1.0, points, apart, trans_b=1)
            blas.dsyrk(1.0, gain, lower=1)

        return multiply


def cost(grids: Sequence[str] = GRIDS, repeats: int = REPEATS) -> pd.DataFrame:
    """Time of one step against the size of the grid.

    Parameters
    ----------
    grids : sequence of str
    repeats : int
        Of which the median is taken.

    Returns
    -------
    DataFrame
        A row by grid, indexed by its number of buses; columns are methods. [ms]
    """
    _keep_memory()
    found = {}
    for grid in grids:
        step = Step(grid)
        plain = step.work(step.clean, step.z)
        sides: dict[str, Callable[[], object]] = {
            "its dense products": step.products(),
            "ukf, square root": step.work(step.filter(form="square_root"), step.z),
            "rukf, gate closed": step.work(step.filter(robustness="per_channel"), step.z),
            "rukf, gate open": step.work(step.filter(robustness="per_channel"), step.wrong),
            "ekf": step.work(step.filter("ekf"), step.z),
            "wls, flat start": step.least_squares(),
        }
        if step.network.n_bus <= PEER_UP_TO:
            sides["filterpy"] = step.peer()
        spent = {}
        for name, other in sides.items():
            few = PEER_REPEATS if name == "filterpy" else repeats
            spent["ukf"], spent[name] = alternate(plain, other, few)
        found[step.network.n_bus] = {name: 1e3 * seconds for name, seconds in spent.items()}
    return pd.DataFrame.from_dict(found, orient="index").rename_axis("buses")


def run() -> list[Row]:
    """Steps on ieee118 with the paper's measurements, and those of every grid."""
    _keep_memory()
    large = Step("ieee118")
    what = "UKF step, ieee118"
    plain = large.work(large.clean, large.z)
    rows = [_row(what, plain, large.peer(), "filterpy", "at least 10 ×", PEER_REPEATS)]
    rows.append(_row(what, plain, large.products(), "its dense products", "at least 0.5 ×"))
    robust = large.filter(robustness="per_channel")
    for name, made, z, note in (
        ("square-root form", large.filter(form="square_root"), large.z, _agreement(large)),
        ("per channel, gate closed", robust, large.z, "expected: at least 0.91 ×"),
        ("per channel, gate open", robust, large.wrong, "expected: at least 0.71 ×"),
        ("trace, gate open", large.filter(robustness="trace"), large.wrong, ""),
        ("Sage–Husa", large.filter(learning="sage_husa"), large.z, "expected: at least 0.77 ×"),
        ("adaptive scaling", large.filter(scaling="moments"), large.z, ""),
    ):
        spent = alternate(large.work(made, z), plain, REPEATS)
        rows.append(Row(f"{what}, {name}", *spent, "plain UKF", note))
    table = cost()
    for buses, times in table.iterrows():
        others = (f"{name} {value:.3g} ms" for name, value in times.items() if value == value)
        note = "; ".join(text for text in others if not text.startswith(("ukf ", "filterpy")))
        ours, peer = 1e-3 * times["ukf"], 1e-3 * times["filterpy"]
        rows.append(Row(f"UKF step, {buses} buses", ours, peer, "filterpy", note))
    return rows


def _agreement(step: Step) -> str:
    """How far the two forms are apart after 100 steps, relative to the largest entry of P."""
    rng = np.random.default_rng(SEED)
    made = [step.filter(form=form) for form in ("covariance", "square_root")]
    states = [each.begin(step.x, VARIANCE * np.eye(len(step.x)), NOW) for each in made]
    exact = made[0].model.h(step.x)
    for _ in range(100):
        z = exact + step.layout.sigma * rng.standard_normal(len(exact))
        for i, each in enumerate(made):
            after, _ = each.step(states[i], step.snapshot(z))
            assert after is not None
            states[i] = after
    one, other = states
    apart = np.abs(one.P - other.P).max() / np.abs(one.P).max()
    return f"P differs by {apart:.0e} after 100 steps"


def _keep_memory() -> None:
    # Once a large block was freed, as after reading tables, glibc keeps what both sides free and
    # allocate at every step; before that the page faults are half of the time.
    np.empty(LARGE)


def _row(
    what: str,
    ours: Callable[[], object],
    peer: Callable[[], object],
    name: str,
    note: str,
    repeats: int = REPEATS,
) -> Row:
    return Row(what, *alternate(ours, peer, repeats), name, note and f"expected: {note}")


if __name__ == "__main__":
    for each in run():
        ratio = each.peer_s / each.ours_s if each.ours_s else math.nan
        print(
            f"{each.what:45s} {1e3 * each.ours_s:9.3f} ms  {ratio:6.2f} × {each.peer}  {each.note}"
        )
