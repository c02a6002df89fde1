"""Claim: gross errors of the first snapshot do not spoil the start of a filter, and are named."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from qu_bench import Bench, gross_errors, still

from pse_analysis.errors import Unobservable
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.filters.composition import Composition, build, scalar
from pse_analysis.estimation.filters.kalman import kalman_filter
from pse_analysis.estimation.process.load_noise import scalar_noise
from pse_analysis.estimation.static.robust_wls import begin, robust_wls
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.measurement import VM, P, Q
from pse_analysis.vocabulary import Reason, Status

SEED = 21


@cache
def least_squares(grid: str = "ieee30") -> tuple[Bench, WeightedLeastSquares]:
    b = still(grid)
    return b, WeightedLeastSquares(b.network, b.layout)


def row(b: Bench, quantity: int, bus: str) -> int:
    at = (b.layout.quantity == quantity) & (b.layout.position == b.network.bus(bus))
    return int(np.flatnonzero(at)[0])


def test_without_gross_errors_it_is_plain_least_squares() -> None:
    b, wls = least_squares()
    rng = np.random.default_rng(SEED)
    on = np.ones(len(b.layout), dtype=bool)
    named = 0
    for z in b.measure(rng):
        solution, out = robust_wls(wls, z, b.layout.sigma, on)
        named += int(out.sum())
        if not out.any():
            np.testing.assert_array_equal(solution.x, wls.solve(z, b.layout.sigma).x)
    assert named <= 1


def test_gross_errors_are_found_and_cost_little() -> None:
    """2 % of all samples times 10: those beyond 20σ, and what is left of the error."""
    b, wls = least_squares()
    rng = np.random.default_rng(SEED)
    on, n = np.ones(len(b.layout), dtype=bool), b.network.n_bus
    far = hit = false = 0
    plain, robust = [], []
    for good, exact, truth in zip(b.measure(rng), b.exact, b.truth, strict=True):
        z, wrong = gross_errors(good, 0.02, rng)
        solution, out = robust_wls(wls, z, b.layout.sigma, on)
        large = wrong & (np.abs(z - exact) > 20.0 * b.layout.sigma)
        far, hit = far + int(large.sum()), hit + int((large & out).sum())
        false += int((out & ~wrong).sum())
        robust.append(np.abs(solution.x - truth)[:n].max())
        plain.append(np.abs(wls.solve(good, b.layout.sigma).x - truth)[:n].max())
    assert hit / far >= 0.9
    assert false <= 8
    assert np.median(robust) < 2.0 * np.median(plain)


def test_needed_measurement_is_kept_whatever_it_says() -> None:
    """Bus 26 ends a line; only its own P and Q are left to see it."""
    b, wls = least_squares()
    near = [b.network.bus(name) for name in ("25", "26")]
    on = ~(np.isin(b.layout.position, near) & np.isin(b.layout.quantity, (P, Q)))
    on[[row(b, P, "26"), row(b, Q, "26")]] = True
    on[row(b, VM, "26")] = False
    z = b.exact[0].copy()
    needed, spare = row(b, P, "26"), row(b, VM, "12")
    with pytest.raises(Unobservable):
        wls.solve(z, b.layout.sigma, on & (np.arange(len(z)) != needed))
    z[needed] += 1.0
    z[spare] *= 10.0
    _, out = robust_wls(wls, z, b.layout.sigma, on)
    assert tuple(np.flatnonzero(out)) == (spare,)


def test_start_names_what_it_left_out() -> None:
    b, wls = least_squares()
    z = b.measure(np.random.default_rng(SEED))[0]
    wrong = row(b, VM, "10")
    z[wrong] *= 100.0
    solution, info = begin(wls, b.snapshot(z))
    assert solution is not None
    assert info.status is Status.OK
    assert tuple(np.flatnonzero(info.reasons)) == (wrong,)
    assert not info.used[wrong]
    own = solution.x[b.network.n_bus + b.network.bus("10")]
    assert info.innovation[wrong] == pytest.approx(z[wrong] - own)
    assert b.layout.channel[wrong] in info.detail


@pytest.mark.parametrize("kind", ["ukf", "kalman"])
def test_spoilt_first_snapshot_does_not_spoil_the_filter(kind: str) -> None:
    b, _ = least_squares()
    z = b.measure(np.random.default_rng(SEED))[:4]
    wrong = [row(b, VM, "10"), row(b, VM, "2")]
    z[0, wrong] *= 10.0
    if kind == "ukf":
        noise = scalar(b.network, b.layout, 1e-4)
        made = build(kind, "ukf", Composition(), b.network, b.layout, noise)
    else:
        walk = scalar_noise(b.network, 1e-4)
        made = kalman_filter(kind, b.network, b.layout, walk, step_s=600.0, reach_s=0.0)
    tables = run(made, (b.snapshot(each) for each in z), b.network, b.layout, truth=b.truth[:4])
    vm = tables.estimated[tables.estimated["quantity"] == "vm_pu"]
    off = np.abs(vm["value"].to_numpy().reshape(4, -1) - b.truth[:4, b.network.n_bus :])
    assert off.max() < 0.05
    first = tables.residuals[~tables.residuals["used"]]
    assert set(first["channel"]) == {b.layout.channel[i] for i in wrong}
    assert (first["reasons"] == Reason.INNOVATION).all()
    assert tables.steps["rejected"].iloc[0] == 2


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), decades=st.integers(2, 9))
def test_sigma_of_many_decades_and_huge_errors_end_in_an_estimate_or_none(
    seed: int, decades: int
) -> None:
    b, wls = least_squares("ieee14")
    rng, m = np.random.default_rng(seed), len(b.layout)
    sigma = 10.0 ** rng.uniform(-decades, 0.0, m)
    z = b.exact[0] + sigma * rng.normal(size=m)
    wrong = rng.choice(m, 3, replace=False)
    z[wrong] += 10.0 ** rng.uniform(0.0, 6.0, 3)
    solution, left_out = robust_wls(wls, z, sigma, np.ones(m, dtype=bool))
    assert left_out.shape == (m,)
    if solution.converged:
        assert np.isfinite(solution.x).all()
        assert (np.diagonal(solution.covariance()) >= 0.0).all()
