"""Claim: every measurement is held against all others, and the wrong ones are left out together."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.estimation.deletion import Deletion

SEED = 7
PRICE = 20.0


def correlated(m: int = 12, share: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A covariance, and a deviation drawn from it."""
    rng = np.random.default_rng(SEED)
    half = rng.standard_normal((m, share))
    S = half @ half.T + np.diag(rng.uniform(0.5, 1.5, m))
    return S, np.linalg.cholesky(S) @ rng.standard_normal(m)


def deletion(S: np.ndarray, eta: np.ndarray) -> Deletion:
    M = np.linalg.inv(S)
    return Deletion(M @ eta, np.diagonal(M), lambda rows: M[:, rows], float(eta @ M @ eta))


def chosen(m: int, *rows: int) -> np.ndarray:
    return np.isin(np.arange(m), rows)


@pytest.mark.parametrize("out", [(), (3,), (3, 7, 8)], ids=str)
def test_standing_is_the_conditional_given_the_kept_ones(out: tuple[int, ...]) -> None:
    S, eta = correlated()
    found = deletion(S, eta).without(chosen(12, *out))
    kept = np.delete(np.arange(12), out)
    for i in range(12):
        rest = kept[kept != i]
        gain = np.linalg.solve(S[np.ix_(rest, rest)], S[rest, i])
        assert found.error[i] == pytest.approx(eta[i] - gain @ eta[rest])
        assert found.variance[i] == pytest.approx(S[i, i] - gain @ S[rest, i])
    expected = eta[kept] @ np.linalg.solve(S[np.ix_(kept, kept)], eta[kept])
    assert found.rest == pytest.approx(expected)


def test_ratio_is_what_a_move_changes() -> None:
    S, eta = correlated()
    d = deletion(S, eta)
    now = d.without(chosen(12, 3, 7))
    assert d.without(chosen(12, 3, 7, 5)).rest == pytest.approx(now.rest - now.ratio[5])
    assert d.without(chosen(12, 3)).rest == pytest.approx(now.rest + now.ratio[7])


def test_search_finds_the_cheapest_of_all_choices() -> None:
    """All choices of up to three of twelve are tried."""
    S, eta = correlated()
    eta[[1, 6]] += 25.0, -40.0
    d = deletion(S, eta)
    named, _ = d.search(np.zeros(12, dtype=bool), PRICE)
    cost = {
        out: d.without(chosen(12, *out)).rest + PRICE * len(set(out))
        for out in [(i, j, k) for i in range(12) for j in range(i + 1) for k in range(j + 1)]
    }
    best = min(cost, key=lambda out: cost[out])
    assert set(np.flatnonzero(named)) == set(best) == {1, 6}


@pytest.mark.parametrize("start", [(), (0, 2, 4, 9)], ids=str)
def test_search_tells_the_standing_of_what_it_chose(start: tuple[int, ...]) -> None:
    S, eta = correlated()
    eta[[1, 6, 7]] += 25.0, -40.0, 30.0
    d = deletion(S, eta)
    named, found = d.search(chosen(12, *start), PRICE)
    expected = deletion(S, eta).without(named)
    assert set(np.flatnonzero(named)) == {1, 6, 7}
    np.testing.assert_allclose(found.error, expected.error)
    np.testing.assert_allclose(found.variance, expected.variance)
    assert found.rest == pytest.approx(expected.rest)


def test_what_was_left_out_without_need_is_taken_back() -> None:
    S, eta = correlated()
    eta[4] += 40.0
    named, _ = deletion(S, eta).search(chosen(12, 0, 2, 4, 9), PRICE)
    assert tuple(np.flatnonzero(named)) == (4,)


def test_critical_measurement_is_never_left_out() -> None:
    """Residuals of a level seen by three, and of another one seen by one alone."""
    H = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    z = np.array([0.0, 0.1, 50.0, 900.0])
    M = np.eye(4) - H @ np.linalg.solve(H.T @ H, H.T)
    d = Deletion(M @ z, np.diagonal(M), lambda rows: M[:, rows], float(z @ M @ z), np.full(4, 1e-9))
    named, found = d.search(np.zeros(4, dtype=bool), PRICE)
    assert tuple(np.flatnonzero(named)) == (2,)
    assert found.variance[3] == np.inf
    assert found.ratio[3] == 0.0


def test_search_leaves_half_at_most() -> None:
    S = np.eye(6)
    eta = np.array([90.0, 80.0, 70.0, 60.0, 50.0, 0.0])
    named, _ = deletion(S, eta).search(np.ones(6, dtype=bool), PRICE)
    assert tuple(np.flatnonzero(named)) == (0, 1, 2)
