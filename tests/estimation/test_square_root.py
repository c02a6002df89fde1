"""Claim: both forms of the unscented filter agree, and the root holds where P is lost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from qu_bench import VARIANCE, Bench, still

from pse_analysis.estimation.core.run_arrays import EPOCH
from pse_analysis.estimation.filters.conditioning import Moments, Prior
from pse_analysis.estimation.filters.square_root import Halves, carried
from pse_analysis.estimation.filters.unscented import Form, Scaling
from pse_analysis.measurement import VM
from pse_analysis.vocabulary import Status

SEED = 17
FORMS = ("covariance", "square_root")


def definite(P: np.ndarray) -> float:
    """Smallest eigenvalue of the correlations."""
    if np.diagonal(P).min() <= 0.0:
        return -1.0
    size = 1.0 / np.sqrt(np.diagonal(P))
    return float(np.linalg.eigvalsh(P * np.outer(size, size))[0])


@pytest.mark.parametrize("process", ["random_walk", "holt", "local_trend"])
@pytest.mark.parametrize(
    "points",
    [Scaling(), Scaling(0.3, 1.0, 2.0), Scaling(beta=0.0)],
    ids=["paper", "narrow", "cubature"],
)
def test_forms_agree_to_1e_10_over_100_steps(process: str, points: Scaling) -> None:
    b = still("ieee14", 101)
    made = [b.filter(process=process, points=points, form=form) for form in FORMS]
    states = [each.begin(b.truth[0], b.start, EPOCH) for each in made]
    rng = np.random.default_rng(SEED)
    for z in b.measure(rng)[1:]:
        # A tenth of the channels does not report, others than at the instant before.
        snapshot = b.snapshot(z, rng.random(len(z)) < 0.9)
        pairs = [f.step(state, snapshot) for f, state in zip(made, states, strict=True)]
        states = [after for after, _ in pairs]
        (one, info), (other, same) = pairs
        np.testing.assert_allclose(one.s, other.s, atol=1e-10, rtol=0)
        np.testing.assert_allclose(one.P, other.P, atol=1e-10 * np.abs(one.P).max(), rtol=0)
        assert info.nis == pytest.approx(same.nis, rel=1e-10)
    assert states[0].chol_P is None
    np.testing.assert_allclose(states[1].chol_P @ states[1].chol_P.T, states[1].P, atol=1e-15)


@pytest.mark.parametrize("robustness", ["trace", "per_channel"])
def test_forms_name_the_same_wrong_channels(robustness: str) -> None:
    b = still("ieee14")
    rng = np.random.default_rng(SEED)
    z = b.measure(rng)[1]
    z[5] += 3.0
    found = []
    for form in FORMS:
        made = b.filter(form=form, robustness=robustness)
        found.append(made.step(made.begin(b.truth[0], b.start, EPOCH), b.snapshot(z)))
    (one, info), (other, same) = found
    np.testing.assert_allclose(info.inflation, same.inflation, rtol=1e-9)
    assert info.inflation[5] > 0
    np.testing.assert_allclose(one.P, other.P, atol=1e-13)
    np.testing.assert_allclose(one.s, other.s, atol=1e-12)


def exact_meters(b: Bench, sigma: float) -> Bench:
    """Voltmeters of three buses, and no others, are as good as exact."""
    exact = (b.layout.quantity == VM) & np.isin(b.layout.position, (3, 4, 5))
    layout = dataclasses.replace(b.layout, sigma=np.where(exact, sigma, b.layout.sigma))
    return dataclasses.replace(b, layout=layout)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("q", "sigma"), [(VARIANCE, 1e-7), (1e-16, 1e-5), (1e-16, 1e-9)])
def test_covariance_holds_beside_meters_that_are_next_to_exact(
    q: float, sigma: float, form: Form
) -> None:
    """σ² is down to 1e-20 of the 100 p.u.² that the forecast starts from."""
    b = exact_meters(still("ieee14"), sigma)
    made = b.filter(q=q, form=form, points=Scaling(alpha=0.1))
    state = made.begin(b.truth[0], 1e2 * np.eye(len(b.start)), EPOCH)
    rng = np.random.default_rng(SEED)
    for _ in range(40):
        z = b.exact[0] + b.layout.sigma * rng.standard_normal(len(b.layout))
        state, info = made.step(state, b.snapshot(z))
        assert info.status is not Status.DIVERGED
        assert definite(state.P) > 0
    error = state.s - b.truth[0]
    assert np.abs(error / np.sqrt(np.diagonal(state.P))).max() < 5.0


def test_root_of_a_sum_needs_neither_a_regular_noise_nor_a_triangular_root() -> None:
    rng = np.random.default_rng(SEED)
    full = rng.standard_normal((6, 6))
    thin = rng.standard_normal((6, 2))
    for root in (full, np.tril(full)):
        for noise in (thin @ thin.T, np.zeros((6, 6)), np.diag(np.arange(6.0)), np.eye(6)):
            found = carried(np.asfortranarray(root), noise)
            np.testing.assert_array_equal(found, np.tril(found))
            np.testing.assert_allclose(found @ found.T, root @ root.T + noise, atol=1e-13)


def test_both_ways_to_inflate_are_the_textbooks() -> None:
    """S + diag(φR) once by a correction of its factor, once by a new one, once by a root."""
    rng = np.random.default_rng(SEED)
    n, m = 12, 40
    half, H = rng.standard_normal((n, n)), rng.standard_normal((m, n))
    P, R = half @ half.T + np.eye(n), rng.uniform(0.1, 1.0, m)
    prior = Prior(rng.standard_normal(n), P, np.zeros(n), np.arange(n))
    eta = rng.standard_normal(m)
    moments = Moments(eta, np.asfortranarray(H @ P @ H.T), np.asfortranarray(P @ H.T))
    halves = Halves(eta, H @ prior.chol_P, np.zeros(0, dtype=np.int64), np.zeros((0, n)))
    for wrong in (0, 3, 30):
        phi = np.zeros(m)
        phi[:wrong] = 10.0 ** rng.uniform(0, 4, wrong)
        S = H @ P @ H.T + np.diag((1.0 + phi) * R)
        K = np.linalg.solve(S, H @ P).T
        for predicted in (moments, halves):
            found = predicted.condition(prior, eta, R, lambda _, phi=phi: phi)
            np.testing.assert_allclose(found.s, prior.s + K @ eta, atol=1e-10)
            np.testing.assert_allclose(found.P, P - K @ S @ K.T, atol=1e-10)
            np.testing.assert_array_equal(found.P, found.P.T)
            assert found.nis == pytest.approx(eta @ np.linalg.solve(S, eta), rel=1e-9)
            np.testing.assert_allclose(found.variance, np.diagonal(H @ P @ H.T) + R)
