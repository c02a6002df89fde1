"""Claim: a sample reads the past as its interval covers it, and shares what it cannot resolve."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pse_analysis.estimation.filters.intervals import bridge_covariance, covered, kinds, weights

SEED = 17
STEP_S = 300.0
LAGS = 6


def reader(age: float, window: float, fine: int) -> np.ndarray:
    """Share of each of the cells of 1/fine steps, counted back from the present, in a sample."""
    ago = (np.arange(LAGS * fine) + 0.5) / fine
    if window == 0:
        reads = np.zeros(len(ago))
        reads[min(int(age * fine + 1e-9), len(ago) - 1)] = 1.0
    else:
        reads = ((ago > age) & (ago < age + window)).astype(float)
    return reads / reads.sum()


ages = st.integers(0, 300).map(lambda k: k / 100)
windows = st.one_of(st.just(0.0), st.integers(1, 300).map(lambda k: k / 100))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(age=ages, window=windows)
def test_weights_equal_numerical_integration(age: float, window: float) -> None:
    fine = 200
    got = weights(np.array([age * STEP_S]), np.array([window * STEP_S]), STEP_S, LAGS)[0]
    ago = (np.arange(LAGS * fine) + 0.5) / fine
    hat = np.maximum(0.0, 1.0 - np.abs(ago[:, None] - np.arange(LAGS + 1)))
    np.testing.assert_allclose(got, reader(age, window, fine) @ hat, atol=0.5 / fine + 1e-9)
    assert got.sum() == pytest.approx(1.0)
    assert (got >= 0).all()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(samples=st.lists(st.tuples(ages, windows), min_size=1, max_size=4))
def test_bridge_covariance_equals_numerical_integration(
    samples: list[tuple[float, float]],
) -> None:
    fine = 200
    age, window = np.array(samples).T
    got = bridge_covariance(age * STEP_S, window * STEP_S, STEP_S, LAGS)
    reads = np.stack([reader(a, w, fine) for a, w in samples])
    fraction = (np.arange(fine) + 0.5) / fine
    bridge = np.minimum.outer(fraction, fraction) - np.outer(fraction, fraction)
    by_step = reads.reshape(len(samples), LAGS, fine)
    expected = np.einsum("isu,uv,jsv->ij", by_step, bridge, by_step)
    np.testing.assert_allclose(got, expected, atol=4e-3)
    assert np.linalg.eigvalsh(got).min() > -1e-9


@pytest.mark.parametrize(
    ("age", "window", "expected"),
    [
        (0, 0, 0.0),
        (150, 0, 0.25),
        (60, 0, 0.16),
        (0, 300, 1 / 12),
        (300, 600, 1 / 24),
        (0, 900, 1 / 36),
    ],
)
def test_variance_is_that_of_the_textbook_bridge(age: int, window: int, expected: float) -> None:
    got = bridge_covariance(np.array([age]), np.array([window]), STEP_S, LAGS)
    assert got[0, 0] == pytest.approx(expected, abs=1e-3)


def test_samples_of_different_steps_share_nothing() -> None:
    got = bridge_covariance(np.array([60.0, 400.0]), np.array([0.0, 100.0]), STEP_S, LAGS)
    assert got[0, 1] == got[1, 0] == 0.0


def test_sample_is_covered_up_to_the_oldest_state() -> None:
    age = np.array([0.0, 300.0, 300.0, 1800.0, 1801.0])
    window = np.array([900.0, 1500.0, 1501.0, 0.0, 0.0])
    assert covered(age, window, STEP_S, LAGS).tolist() == [True, True, False, True, False]
    assert covered(np.array([0.0, 1.0]), np.zeros(2), STEP_S, 0).tolist() == [True, False]


def test_weights_and_bridge_give_the_statistics_of_brownian_paths() -> None:
    """Sample minus interpolated states, over 20 000 paths."""
    rng = np.random.default_rng(SEED)
    fine, lags, paths = 60, 4, 20_000
    path = np.cumsum(rng.normal(0, 1 / np.sqrt(fine), (paths, lags * fine + 1)), axis=1)
    ago = path[:, ::-1]  # column j is the state j/fine steps ago
    states = ago[:, ::fine]
    age = np.array([0.2, 0.5, 1.4, 0.0, 0.3, 0.25, 1.1])
    window = np.array([0.0, 0.0, 0.0, 3.0, 3.0, 0.5, 0.4])
    samples = []
    for a, w in zip(age, window, strict=True):
        part = ago[:, round(a * fine) : round((a + w) * fine) + 1]
        samples.append(part[:, 0] if w == 0 else np.trapezoid(part, axis=1) / (w * fine))
    left = np.stack(samples, 1) - states @ weights(age * STEP_S, window * STEP_S, STEP_S, lags).T
    expected = bridge_covariance(age * STEP_S, window * STEP_S, STEP_S, lags)
    size = np.diagonal(expected)
    error = np.sqrt((np.outer(size, size) + expected**2) / paths)
    assert (np.abs(np.cov(left.T) - expected) < 4.5 * error + 1e-3).all()
    across = left.T @ states / paths  # what is left out is independent of the states themselves
    error = np.sqrt(np.outer(size, states.var(axis=0)) / paths)
    assert (np.abs(across) < 4.5 * error).all()


def test_kinds_give_every_sample_its_own_interval_back() -> None:
    rng = np.random.default_rng(SEED)
    age, window = rng.choice([0.0, 7.5, 60.0], 40), rng.choice([0.0, 900.0], 40)
    ages, windows, kind = kinds(age, window)
    assert len(ages) == len(windows) == len(set(zip(age, window, strict=True)))
    np.testing.assert_array_equal(ages[kind], age)
    np.testing.assert_array_equal(windows[kind], window)
