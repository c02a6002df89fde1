"""Claim: forecasts are the affine processes they are named after, in mean and covariance."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.process.dynamics import HoltParams, holt, local_trend, random_walk

ALPHA, BETA = 0.85, 0.05
SEED = 5


def covariance(n: int, rng: np.random.Generator) -> np.ndarray:
    half = rng.standard_normal((n, n))
    return np.asarray(half @ half.T + np.eye(n))


def test_random_walk_stays() -> None:
    rng = np.random.default_rng(SEED)
    x, P = rng.standard_normal(3), covariance(3, rng)
    made = random_walk()
    ahead, spread, _ = made.forecast(*made.begin(x, P, np.eye(3)))
    np.testing.assert_array_equal(ahead, x)
    np.testing.assert_array_equal(spread, P)


def test_holts_forecast_is_f_x_plus_g() -> None:
    """With F = α(1+β) I and g = (1+β)(1-α) x̃ - β a₋₁ + (1-β) b₋₁, the paper's form."""
    rng = np.random.default_rng(SEED)
    estimates = rng.standard_normal((6, 3))
    made = holt(HoltParams(ALPHA, BETA, as_printed=True))
    P = covariance(3, rng)
    _, _, memory = made.begin(estimates[0], P, np.eye(3))
    forecast, level, slope = estimates[0], estimates[0], np.zeros(3)
    for x in estimates:
        g = (1 + BETA) * (1 - ALPHA) * forecast - BETA * level + (1 - BETA) * slope
        expected = ALPHA * (1 + BETA) * x + g
        now = ALPHA * x + (1 - ALPHA) * forecast
        slope = BETA * (now - level) + (1 - BETA) * slope
        forecast, level = now + slope, now
        ahead, spread, memory = made.forecast(x, P, memory)
        np.testing.assert_allclose(ahead, expected, atol=1e-12)
        np.testing.assert_allclose(spread, (ALPHA * (1 + BETA)) ** 2 * P)


def test_local_trend_adds_its_slope() -> None:
    rng = np.random.default_rng(SEED)
    made = local_trend()
    P = covariance(6, rng)
    F = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(3))
    s = rng.standard_normal(6)
    ahead, spread, _ = made.forecast(s, P, None)
    np.testing.assert_allclose(ahead, F @ s)
    np.testing.assert_allclose(spread, F @ P @ F.T)


@pytest.mark.parametrize(("alpha", "beta"), [(0.85, 0.05), (0.5, 0.2), (0.3, 0.1)])
def test_steady_state_of_local_trend_is_holts_smoothing(alpha: float, beta: float) -> None:
    """Gains α and αβ where the meter's noise is what those gains are best for."""
    made = local_trend(HoltParams(alpha, beta))
    # Var w = α S (α - (2-α)β) fixes S; the meter has what is left of it, R = (1-α) S.
    S = 1.0 / (alpha * (alpha - (2 - alpha) * beta))
    Q = made.noise(np.eye(1))
    s, P, memory = made.begin(np.zeros(1), np.eye(1), np.eye(1))
    for _ in range(500):
        s, P, memory = made.forecast(s, P, memory)
        P = P + Q
        gain = P[:, 0] / (P[0, 0] + (1 - alpha) * S)
        P = P - np.outer(gain, P[0])
    np.testing.assert_allclose(gain, [alpha, alpha * beta], atol=1e-9)
    start = made.begin(np.zeros(1), np.eye(1), np.eye(1))[1]
    assert start[1, 1] == pytest.approx(P[1, 1], rel=1e-6)


def test_holts_printed_covariance_is_optimistic_and_local_trends_is_right() -> None:
    """Holt's level forgets that it holds earlier errors; all see a local trend of known noise.

    Without the print's factor Holt's covariance lacks the error of the slope alone.
    """
    rng = np.random.default_rng(SEED)
    twin = local_trend(HoltParams(ALPHA, BETA))
    Q = twin.noise(np.eye(1))
    R = 100.0
    trials = 3000
    level, slope = np.zeros(trials), np.zeros(trials)
    inside = {}
    truth = []
    for _ in range(60):
        level = level + slope + np.sqrt(Q[0, 0]) * rng.standard_normal(trials)
        slope = slope + np.sqrt(Q[1, 1]) * rng.standard_normal(trials)
        truth.append(level)
    z = np.array(truth) + np.sqrt(R) * rng.standard_normal((60, trials))
    printed = holt(HoltParams(ALPHA, BETA, as_printed=True))
    plain = holt(HoltParams(ALPHA, BETA))
    for name, made in (("printed", printed), ("holt", plain), ("local_trend", twin)):
        s, P, memory = made.begin(np.zeros(1), np.eye(1), np.eye(1))
        s = np.zeros((made.order, trials))
        noise = made.noise(np.eye(1))
        memory = None if made.order == 2 else type(memory)(s[0], s[0], np.zeros(trials))
        for row in z:
            s, P, memory = made.forecast(s if made.order == 2 else s.reshape(-1), P, memory)
            s = s.reshape(made.order, trials)
            P = P + noise
            gain = P[:, 0] / (P[0, 0] + R)
            s = s + np.outer(gain, row - s[0])
            P = P - np.outer(gain, P[0])
        inside[name] = np.mean(np.abs(s[0] - truth[-1]) <= 2.0 * np.sqrt(P[0, 0]))
    assert 0.93 < inside["local_trend"] < 0.975
    assert inside["printed"] < 0.6
    assert inside["holt"] > 0.85


def test_gains_that_no_filter_has_are_refused() -> None:
    with pytest.raises(ParameterError, match="no steady-state gains"):
        local_trend(HoltParams(0.3, 0.5))
    with pytest.raises(ParameterError, match="0 < alpha ≤ 1"):
        HoltParams(0.0, 0.1)
