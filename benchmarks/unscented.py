"""A step of the unscented filter beside filterpy's, and beside the products that define it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.linalg import blas

from benchmarks.timing import Row, alternate
from pse_analysis.estimation.composition import Composition, compose, scalar
from pse_analysis.estimation.estimator import Snapshot
from pse_analysis.estimation.gaussian import GaussianFilter
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, P, Q, SensorLayout

SEED = 118
VARIANCE = 1e-4
NOW = np.datetime64("2016-06-09T12:00:00", "us")
REPEATS = 15
PEER_REPEATS = 4
LARGE = 3_500_000
GRIDS = ("ieee14", "ieee30", "ieee33", "ieee118")


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

    def filter(self, **choice: object) -> GaussianFilter:
        """A filter of the given composition."""
        variance = scalar(self.network, self.layout, VARIANCE)
        made = Composition(**choice)  # type: ignore[arg-type]
        return compose("ukf", made, self.network, self.layout, variance)

    def work(self, made: GaussianFilter, z: np.ndarray) -> Callable[[], object]:
        """The step of a filter after one snapshot without errors."""
        on, zero = np.ones(len(z), dtype=bool), np.zeros(len(z))
        start = made.begin(self.x, VARIANCE * np.eye(len(self.x)), NOW)
        sigma = self.layout.sigma
        state, _ = made.step(start, Snapshot(NOW, self.z, sigma, zero, on, on, zero))
        assert state is not None
        snapshot = Snapshot(NOW, z, sigma, zero, on, on, zero)
        return lambda: made.step(state, snapshot)

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


def run() -> list[Row]:
    """Steps on ieee118 with the paper's measurements, and the plain one on every grid."""
    # Once a large block was freed, as after reading tables, glibc keeps what both sides free and
    # allocate at every step; before that the page faults are half of the time.
    np.empty(LARGE)
    large = Step("ieee118")
    what = "UKF step, ieee118"
    plain = large.work(large.clean, large.z)
    rows = [_row(what, plain, large.peer(), "filterpy", "at least 10 ×", PEER_REPEATS)]
    rows.append(_row(what, plain, large.products(), "its dense products", "at least 0.5 ×"))
    robust = large.filter(robustness="per_channel")
    for name, made, z, note in (
        ("per channel, gate closed", robust, large.z, "at least 0.9 ×"),
        ("per channel, gate open", robust, large.wrong, "at least 0.7 ×"),
        ("trace, gate open", large.filter(robustness="trace"), large.wrong, "at least 0.7 ×"),
        ("Sage–Husa", large.filter(learning="sage_husa"), large.z, "at least 0.77 ×"),
        ("adaptive scaling", large.filter(scaling="moments"), large.z, ""),
    ):
        rows.append(_row(f"{what}, {name}", large.work(made, z), plain, "plain UKF", note))
    for grid in GRIDS[:-1]:
        small = Step(grid)
        work = small.work(small.clean, small.z)
        rows.append(_row(f"UKF step, {grid}", work, small.peer(), "filterpy", "", PEER_REPEATS))
    return rows


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
        print(f"{each.what:45s} {1e3 * each.ours_s:9.3f} ms  {ratio:6.2f} × {each.peer}")
