"""Claim: gross errors among innovations are refused one by one, movements of the grid are not."""

from __future__ import annotations

import numpy as np

from pse_analysis.estimation import refusal
from pse_analysis.estimation.refusal import InnovationParams

SEED = 12


def innovations(rng: np.random.Generator, m: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Innovations of a common movement under independent noise, with their covariance."""
    common = rng.normal(0, 1, (m, 3))
    S = 4.0 * common @ common.T + np.diag(rng.uniform(0.5, 2.0, m))
    return np.linalg.cholesky(S) @ rng.standard_normal(m), S


def test_gross_errors_are_refused_one_by_one_and_nothing_else():
    rng = np.random.default_rng(SEED)
    refuse = refusal.refuse()
    missed = false = 0
    for _ in range(200):
        eta, S = innovations(rng)
        bad = rng.choice(30, 3, replace=False)
        eta[bad] += 20.0 * rng.choice((-1.0, 1.0), 3)
        found = refuse(eta, np.linalg.cholesky(S))
        missed += 3 - found[bad].sum()
        false += found.sum() - found[bad].sum()
    assert missed <= 0.02 * 600
    assert false <= 0.001 * 200 * 27


def test_a_common_movement_is_not_refused():
    rng = np.random.default_rng(SEED)
    eta, S = innovations(rng)
    values, vectors = np.linalg.eigh(S)
    moved = eta + 3.5 * np.sqrt(values[-1]) * vectors[:, -1]
    assert (np.abs(moved) > 4).any()
    assert not refusal.refuse()(moved, np.linalg.cholesky(S)).any()


def test_what_only_the_others_speak_against_is_not_refused():
    common = np.random.default_rng(SEED).normal(0, 1, (30, 3))
    S = 4.0 * common @ common.T + 0.1 * np.eye(30)
    own = np.sqrt(S[7, 7])
    inverse = np.linalg.inv(S)
    for far, refused in ((2.0, False), (3.0, True)):
        moved = np.zeros(30)
        moved[7] = far * own
        assert np.abs((inverse @ moved)[7]) / np.sqrt(inverse[7, 7]) > 6
        assert refusal.refuse()(moved, np.linalg.cholesky(S))[7] == refused


def test_first_refusal_is_the_largest_normalised_residual():
    rng = np.random.default_rng(SEED)
    eta, S = innovations(rng)
    eta[7] += 30.0
    inverse = np.linalg.inv(S)
    largest = np.argmax(np.abs(inverse @ eta) / np.sqrt(np.diagonal(inverse)))
    assert largest == 7
    found = refusal.refuse(InnovationParams(factor=4.0, largest_share=0.04))(
        eta, np.linalg.cholesky(S)
    )
    np.testing.assert_array_equal(np.flatnonzero(found), [7])


def test_more_than_a_share_is_never_refused():
    rng = np.random.default_rng(SEED)
    eta, S = innovations(rng)
    assert (
        refusal.refuse(InnovationParams(largest_share=0.2))(1e3 * eta, np.linalg.cholesky(S)).sum()
        <= 6
    )
