"""Claim: what a triangular root gives without an inverse is what the inverse holds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from qu_bench import still

from pse_analysis.estimation.bad_data.robust import InnovationStats
from pse_analysis.estimation.core.cholesky import (
    Columns,
    Root,
    cholesky,
    factor,
    solve,
    squared_inverse,
)
from pse_analysis.estimation.core.run_arrays import EPOCH
from pse_analysis.estimation.filters.conditioning import Moments, Prior
from pse_analysis.measurement import VA, VM

SEED = 3


def covariance(m: int) -> np.ndarray:
    half = np.random.default_rng(SEED).standard_normal((m, m))
    return half @ half.T + np.eye(m)


@pytest.mark.parametrize("m", [1, 7, 128, 129, 300])
def test_squares_of_the_inverse_root_are_the_diagonal_of_the_inverse(m: int) -> None:
    S = covariance(m)
    chol = np.linalg.cholesky(S)
    # What stands above the diagonal does not count.
    full = np.asfortranarray(chol + np.triu(np.ones((m, m)), 1))
    expected = np.diagonal(np.linalg.inv(S))
    np.testing.assert_allclose(squared_inverse(full), expected, rtol=1e-9)
    known = Root(full, lambda: expected[: m // 2])
    np.testing.assert_allclose(known.precision(), expected, rtol=1e-9)


@pytest.mark.parametrize("rows", [[4], [4, 0, 11]], ids=str)
def test_columns_are_those_of_the_inverses(rows: list[int]) -> None:
    S = covariance(12)
    chol = np.asfortranarray(np.linalg.cholesky(S))
    root = Root(chol)
    asked = np.array(rows)
    for _ in range(2):  # made, then remembered
        np.testing.assert_allclose(root.columns(asked), np.linalg.inv(chol)[:, asked], atol=1e-12)
        np.testing.assert_allclose(root.precision_columns(asked), np.linalg.inv(S)[:, asked])


def test_columns_are_made_once() -> None:
    made: list[int] = []

    def make(rows: np.ndarray) -> np.ndarray:
        made.extend(rows)
        return np.eye(5)[:, rows] * (rows + 1.0)

    columns = Columns(5, make)
    for asked in ([3], [1, 3], [3, 1, 0], []):
        np.testing.assert_array_equal(
            columns(np.array(asked, dtype=int)), np.diag(np.arange(1.0, 6.0))[:, asked]
        )
    assert made == [3, 1, 0]


def test_measurements_of_the_state_itself_need_no_inverse() -> None:
    """The diagonal of S⁻¹ for two rows that read an entry of s, from its posterior variance."""
    P = covariance(4)
    H = np.vstack([np.eye(4)[[2, 0]], np.random.default_rng(SEED).standard_normal((5, 4))])
    noise = np.linspace(0.1, 0.7, 7)
    prior = Prior(np.zeros(4), P, np.zeros(4), np.arange(4))
    own, cross = np.asfortranarray(H @ P @ H.T), np.asfortranarray(P @ H.T)
    seen: list[np.ndarray] = []

    def verdict(found: InnovationStats) -> np.ndarray:
        seen.append(found.root.precision())
        return np.zeros(7)

    Moments(np.zeros(7), own, cross, entry=np.array([2, 0])).condition(
        prior, np.ones(7), noise, verdict
    )
    np.testing.assert_allclose(seen[0], np.diagonal(np.linalg.inv(own + np.diag(noise))))


def test_what_is_certain_does_not_stop_a_factorisation() -> None:
    """A row of zeros, a little below them by rounding, as that of an angle nothing moves."""
    S = covariance(5)
    S[2] = S[:, 2] = 0.0
    S[2, 2] = -1e-25
    root = cholesky(S)
    np.testing.assert_allclose(root @ root.T, S, atol=1e-10)
    S[2, 2] = -1e-3
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        cholesky(S)


def test_nothing_is_written_to_the_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    """LAPACK complains there of matrices without rows; a layout of voltages alone leads to one."""
    none = np.zeros((0, 0))
    assert len(squared_inverse(none)) == len(cholesky(none)) == 0
    assert len(solve(none, np.zeros(0))) == len(factor(none, np.zeros(0))) == 0
    b = still("ieee14")
    few = np.flatnonzero(np.isin(b.layout.quantity, (VM, VA)))
    layout = dataclasses.replace(b, layout=b.layout.take(few), exact=b.exact[:, few])
    made = layout.filter(robustness="per_channel")
    z = layout.exact[0].copy()
    z[3] += 1.0
    state = made.begin(b.truth[0], b.start, EPOCH)
    _, info = made.step(state, layout.snapshot(z))
    assert info.inflation[3] > 0
    out, err = capfd.readouterr()
    assert out == err == ""
