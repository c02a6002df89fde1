"""Claim: gross errors among innovations are refused one by one, movements of the grid are not."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.bad_data import innovation_test
from pse_analysis.estimation.bad_data.innovation_test import InnovationTest

SEED = 12
M = 30


def innovations(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Innovations of a common movement under independent noise, their covariance, and σ of that."""
    common = rng.normal(0, 1, (M, 3))
    variance = rng.uniform(0.5, 2.0, M)
    S = 4.0 * common @ common.T + np.diag(variance)
    return np.linalg.cholesky(S) @ rng.standard_normal(M), S, np.sqrt(variance)


def found(
    eta: np.ndarray, S: np.ndarray, sigma: np.ndarray, params: InnovationTest | None = None
) -> np.ndarray:
    return innovation_test.refuse(params)(eta, np.linalg.cholesky(S), sigma)


def naive(eta: np.ndarray, S: np.ndarray, sigma: np.ndarray, params: InnovationTest) -> list[int]:
    """The same by inverting what is left, over and over."""
    bound = np.where(
        np.abs(eta) <= params.alone * np.sqrt(np.diagonal(S)), params.certain, params.factor
    )
    inverse = np.linalg.inv(S)
    if (np.abs(inverse @ eta) / np.sqrt(np.diagonal(inverse)) <= bound).all():
        return []
    S = np.diag(sigma**2) + params.forecast_inflation**2 * (S - np.diag(sigma**2))
    left = np.arange(len(eta))
    while len(left) > len(eta) - int(params.largest_share * len(eta)):
        inverse = np.linalg.inv(S[np.ix_(left, left)])
        off = np.abs(inverse @ eta[left]) / np.sqrt(np.diagonal(inverse)) / bound[left]
        if off.max() <= 1.0:
            break
        left = np.delete(left, off.argmax())
    return sorted(set(range(len(eta))) - set(left.tolist()))


def test_gross_errors_are_refused_one_by_one_and_nothing_else():
    rng = np.random.default_rng(SEED)
    missed = false = 0
    for _ in range(200):
        eta, S, sigma = innovations(rng)
        bad = rng.choice(M, 3, replace=False)
        eta[bad] += 20.0 * rng.choice((-1.0, 1.0), 3)
        refused = found(eta, S, sigma)
        missed += 3 - refused[bad].sum()
        false += refused.sum() - refused[bad].sum()
    assert missed <= 0.02 * 600
    assert false <= 0.001 * 200 * 27


@pytest.mark.parametrize(
    "params",
    [InnovationTest(), InnovationTest(factor=2.0, forecast_inflation=1.0, alone=1.0, certain=5.0)],
)
def test_refusing_by_ranks_equals_inverting_what_is_left(params: InnovationTest):
    rng = np.random.default_rng(SEED)
    refused = 0
    for _ in range(50):
        eta, S, sigma = innovations(rng)
        eta[rng.choice(M, 4, replace=False)] += rng.normal(0, 10, 4)
        expected = naive(eta, S, sigma, params)
        np.testing.assert_array_equal(np.flatnonzero(found(eta, S, sigma, params)), expected)
        refused += len(expected)
    assert refused > 50


def test_a_common_movement_is_not_refused():
    eta, S, sigma = innovations(np.random.default_rng(SEED))
    values, vectors = np.linalg.eigh(S)
    moved = eta + 3.5 * np.sqrt(values[-1]) * vectors[:, -1]
    assert (np.abs(moved) > 4).any()
    assert not found(moved, S, sigma).any()


def test_the_one_channel_that_sees_a_step_of_its_load_is_not_refused():
    """Eight σ of what only this channel reads is a step; 8 σ of its own noise is an error."""
    common = np.random.default_rng(SEED).normal(0, 1, (M, 3))
    sigma = np.full(M, 0.5)
    S = 4.0 * common @ common.T + np.diag(sigma**2)
    own = np.zeros(M)
    own[7] = 2.0
    with_load = S + np.outer(own, own)
    moved = 8.0 * own
    for covariance, refused in ((with_load, False), (S, True)):
        assert found(moved, covariance, sigma)[7] == refused
    assert found(moved, with_load, sigma, InnovationTest(forecast_inflation=1.0))[7]


def test_what_only_the_others_speak_against_is_refused_where_it_is_certain():
    common = np.random.default_rng(SEED).normal(0, 1, (M, 3))
    sigma = np.full(M, 0.1)
    S = 4.0 * common @ common.T + np.diag(sigma**2)
    own = np.sqrt(S[7, 7])
    inverse = np.linalg.inv(S)
    for far, certain, refused in ((2.0, 40.0, False), (3.0, 40.0, True), (2.0, 15.0, True)):
        moved = np.zeros(M)
        moved[7] = far * own
        assert 20 < np.abs((inverse @ moved)[7]) / np.sqrt(inverse[7, 7]) < 40
        assert found(moved, S, sigma, InnovationTest(certain=certain))[7] == refused


def test_first_refusal_is_the_largest_normalised_residual():
    eta, S, sigma = innovations(np.random.default_rng(SEED))
    eta[7] += 30.0
    inverse = np.linalg.inv(S)
    largest = np.argmax(np.abs(inverse @ eta) / np.sqrt(np.diagonal(inverse)))
    assert largest == 7
    one = InnovationTest(forecast_inflation=1.0, largest_share=0.04)
    np.testing.assert_array_equal(np.flatnonzero(found(eta, S, sigma, one)), [7])


def test_more_than_a_share_is_never_refused():
    eta, S, sigma = innovations(np.random.default_rng(SEED))
    assert found(1e3 * eta, S, sigma, InnovationTest(largest_share=0.2)).sum() <= 6


@pytest.mark.parametrize(
    "wrong",
    [{"factor": 0.0}, {"certain": 3.0}, {"forecast_inflation": 0.5}, {"largest_share": 1.0}],
)
def test_impossible_parameters_are_refused(wrong: dict[str, float]):
    with pytest.raises(ParameterError, match="factor ≤ certain"):
        InnovationTest(**wrong)
