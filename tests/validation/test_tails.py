"""Claim: the scale of residuals is σ for a normal law and keeps what is heavier-tailed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pse_analysis.validation import tails

SEED = 31
FACTOR = 4.0
BEYOND = 2 * stats.norm.sf(FACTOR)
"""How rarely a normal law exceeds 4σ."""


def scaled(residuals: np.ndarray) -> np.ndarray:
    count = np.isfinite(residuals).sum(axis=1)
    return tails.scale(np.abs(residuals), count, FACTOR)


def test_scale_of_a_normal_law_is_its_sigma_within_a_tenth():
    rng = np.random.default_rng(SEED)
    found = scaled(rng.normal(0, 0.3, (400, 288)))
    assert 0.3 <= np.median(found) < 0.33


@pytest.mark.parametrize(
    "law", [stats.laplace(), stats.expon(), stats.dweibull(1.5)], ids=["laplace", "expon", "1.5"]
)
def test_a_threshold_of_four_scales_is_as_rare_as_four_sigma_of_a_normal_law(law):
    rng = np.random.default_rng(SEED)
    found = FACTOR * np.median(scaled(law.rvs((400, 288), random_state=rng)))
    exact = law.isf(BEYOND / 2) if law.cdf(0) > 0 else law.isf(BEYOND)
    assert found == pytest.approx(exact, rel=0.15)


def test_errors_in_one_of_two_hundred_hardly_move_it():
    rng = np.random.default_rng(SEED)
    clean = rng.normal(0, 1, (400, 288))
    spoilt = np.where(rng.random(clean.shape) < 0.005, 10.0, clean)
    assert np.median(scaled(spoilt)) < 1.1 * np.median(scaled(clean))


def test_few_residuals_tell_a_median_but_no_tail():
    residuals = np.full((1, 288), np.inf)
    residuals[0, :9] = np.arange(1.0, 10.0)
    assert scaled(residuals)[0] == pytest.approx(tails.MAD * 5.0)


def test_a_channel_that_stands_still_has_no_scale():
    np.testing.assert_array_equal(scaled(np.zeros((2, 288))), 0.0)
