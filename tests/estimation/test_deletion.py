"""Claim: every measurement is held against all others, and the wrong ones are left out together."""

from __future__ import annotations

import numpy as np
import pytest
from qu_bench import still

from pse_analysis.estimation.bad_data.identification import Deletion, of_snapshot

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
    named = d.search(np.zeros(12, dtype=bool), PRICE)
    cost = {
        out: d.without(chosen(12, *out)).rest + PRICE * len(set(out))
        for out in [(i, j, k) for i in range(12) for j in range(i + 1) for k in range(j + 1)]
    }
    best = min(cost, key=lambda out: cost[out])
    assert set(np.flatnonzero(named)) == set(best) == {1, 6}


@pytest.mark.parametrize("start", [(), (0, 2, 4, 9)], ids=str)
def test_search_ends_alike_wherever_it_starts(start: tuple[int, ...]) -> None:
    S, eta = correlated()
    eta[[1, 6, 7]] += 25.0, -40.0, 30.0
    d = deletion(S, eta)
    named = d.search(chosen(12, *start), PRICE)
    assert set(np.flatnonzero(named)) == {1, 6, 7}


def test_accusation_is_the_standing_of_the_left_out_ones() -> None:
    S, eta = correlated()
    d = deletion(S, eta)
    out = np.array([3, 7, 8])
    error, variance = d.error_estimate(out)
    expected = d.without(chosen(12, *out))
    np.testing.assert_allclose(error, expected.error[out])
    np.testing.assert_allclose(variance, expected.variance[out])


def test_wrongly_accused_is_exchanged_for_the_wrong_one() -> None:
    """A loose level is read by three; 0 is off by 30, but 1 is left out. No single move helps."""
    S = np.full((3, 3), 400.0) + np.diag([1.0, 1.0, 26.0])
    d, price = deletion(S, np.array([30.0, 0.0, 0.0])), 2.0 * PRICE
    cost = [d.without(chosen(3, *out)).rest + price * len(out) for out in ((1,), (), (0, 1), (0,))]
    assert cost[3] < cost[0] < min(cost[1:3])
    assert tuple(np.flatnonzero(d.search(chosen(3, 1), price))) == (0,)


def test_what_the_snapshot_says_is_least_squares_without_the_others() -> None:
    """Each of three rows of ieee14, beside least squares on the rest with a weak prior."""
    b = still("ieee14")
    model = b.filter().model
    x, rows = b.truth[0], np.arange(0, len(b.layout), 1)[3:]
    rng = np.random.default_rng(SEED)
    off = b.layout.sigma[rows] * rng.standard_normal(len(rows))
    noise, among = b.layout.sigma[rows] ** 2, np.array([2, 11, 30])
    found = of_snapshot(model, x, rows, off, noise, among).without(chosen(3, 0, 1, 2))
    H = model.jacobian(x).toarray()[rows]
    kept = np.delete(np.arange(len(rows)), among)
    gain = H[kept].T @ (H[kept] / noise[kept, None]) + np.eye(H.shape[1])
    moved = np.linalg.solve(gain, H[kept].T @ (off[kept] / noise[kept]))
    for i, row in enumerate(among):
        assert found.error[i] == pytest.approx(off[row] - H[row] @ moved, rel=1e-6)
        alone = H[row] @ np.linalg.solve(gain, H[row])
        assert found.variance[i] == pytest.approx(noise[row] + alone, rel=1e-6)


def test_what_was_left_out_without_need_is_taken_back() -> None:
    S, eta = correlated()
    eta[4] += 40.0
    named = deletion(S, eta).search(chosen(12, 0, 2, 4, 9), PRICE)
    assert tuple(np.flatnonzero(named)) == (4,)


def test_critical_measurement_is_never_left_out() -> None:
    """Residuals of a level seen by three, and of another one seen by one alone."""
    H = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    z = np.array([0.0, 0.1, 50.0, 900.0])
    M = np.eye(4) - H @ np.linalg.solve(H.T @ H, H.T)
    d = Deletion(M @ z, np.diagonal(M), lambda rows: M[:, rows], float(z @ M @ z), np.full(4, 1e-9))
    named = d.search(np.zeros(4, dtype=bool), PRICE)
    found = d.without(named)
    assert tuple(np.flatnonzero(named)) == (2,)
    assert found.variance[3] == np.inf
    assert found.ratio[3] == 0.0


def test_search_leaves_half_at_most() -> None:
    S = np.eye(6)
    eta = np.array([90.0, 80.0, 70.0, 60.0, 50.0, 0.0])
    named = deletion(S, eta).search(np.ones(6, dtype=bool), PRICE)
    assert tuple(np.flatnonzero(named)) == (0, 1, 2)


def test_a_search_that_rounding_sends_to_and_fro_comes_to_an_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of two channels that see next to the same, each seems the better one to blame."""
    M = np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) + 1e-9 * np.eye(3)
    eta = np.array([20.0, 0.0, 0.1])
    deletion = Deletion(M @ eta, np.diagonal(M), lambda asked: M[:, asked], float(eta @ M @ eta))
    swaps = []

    def swapped(_self: Deletion, out: np.ndarray, *_rest: object) -> np.ndarray:
        swaps.append(out)
        return np.array([1 - out[0]])

    monkeypatch.setattr(Deletion, "_exchanged", swapped)
    found = deletion.search(np.zeros(3, dtype=bool), 9.0)
    assert found.sum() == 1
    assert not found[2]
    assert len(swaps) <= 3
