"""How the mean moves between two instants: random walk, Holt's smoothing, local linear trend.

All are affine, s⁺ = F s + g + w, so that no sigma points are needed to predict mean and covariance.
A state s holds the estimated voltages x and, for the local trend, their slopes behind them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError


@dataclass(frozen=True)
class HoltParams:
    """Weights of the newest estimate in the level and of the newest slope in the trend.

    The defaults of the weights are those of [qu2018].

    Attributes
    ----------
    alpha, beta : float
    as_printed : bool
        Whether `holt` has the covariance F P Fᵀ of [qu2018] with F = α(1+β) I, which claims to know
        more after every step without a measurement. Without it the level is as uncertain as the
        estimate that it follows, F = I.
    """

    alpha: float = 0.85
    beta: float = 0.05
    as_printed: bool = False

    def __post_init__(self) -> None:
        if not (0 < self.alpha <= 1 and 0 <= self.beta <= 1):
            raise ParameterError(
                "holt: expected 0 < alpha ≤ 1 and 0 ≤ beta ≤ 1, received "
                f"alpha = {self.alpha}, beta = {self.beta}"
            )


class Process(NamedTuple):
    """An affine process on s, of size ``order``·n for n voltages.

    Attributes
    ----------
    order : int
    begin : (x, P, Q) -> (s, P, memory)
        State from a first estimate of the voltages.
    forecast : (s, P, memory) -> (F s + g, F P Fᵀ, memory)
    noise : Q -> covariance of w
        From the covariance Q of the voltages' own noise, (n, n).
    transition : (order, order) ndarray
        F = transition ⊗ I.
    """

    order: int
    begin: Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, Any]]
    forecast: Callable[[FloatArray, FloatArray, Any], tuple[FloatArray, FloatArray, Any]]
    noise: Callable[[FloatArray], FloatArray]
    transition: FloatArray


def random_walk() -> Process:
    """F = I, g = 0."""
    return Process(
        1,
        lambda x, covariance, _noise: (x, covariance, None),
        lambda s, covariance, _memory: (s, covariance, None),
        lambda noise: noise,
        np.ones((1, 1)),
    )


class _Smoothing(NamedTuple):
    """Holt's last forecast x̃, level a and slope b."""

    forecast: FloatArray
    level: FloatArray
    slope: FloatArray


def holt(params: HoltParams | None = None) -> Process:
    """Holt's two-parameter smoothing.

    Returns
    -------
    Process

    Notes
    -----
    Eq. (3) of [qu2018]: a = α x̂ + (1-α) x̃, b = β (a - a₋₁) + (1-β) b₋₁, x̃⁺ = a + b. Its
    covariance F P Fᵀ + Q with F = α(1+β) I takes g for exogenous, although it holds earlier
    estimates: P is optimistic, see ``as_printed``. The error of the level has the covariance
    (1-α)² P⁻ + (1 - (1-α)²) P, hardly more than P, which counts otherwise; that of the slope is
    left out. `local_trend` makes the same forecasts with the covariance that belongs to them.
    """
    params = params or HoltParams()
    alpha, beta = params.alpha, params.beta
    factor = alpha * (1.0 + beta) if params.as_printed else 1.0

    def begin(
        x: FloatArray, covariance: FloatArray, _noise: FloatArray
    ) -> tuple[FloatArray, FloatArray, _Smoothing]:
        return x, covariance, _Smoothing(x, x, np.zeros_like(x))

    def forecast(
        x: FloatArray, covariance: FloatArray, memory: _Smoothing
    ) -> tuple[FloatArray, FloatArray, _Smoothing]:
        level = alpha * x + (1.0 - alpha) * memory.forecast
        slope = beta * (level - memory.level) + (1.0 - beta) * memory.slope
        ahead = level + slope
        return ahead, factor**2 * covariance, _Smoothing(ahead, level, slope)

    return Process(1, begin, forecast, lambda noise: noise, np.full((1, 1), factor))


def local_trend(params: HoltParams | None = None) -> Process:
    """State-space model [x; b] whose steady-state filter is Holt's smoothing.

    Returns
    -------
    Process

    Raises
    ------
    ParameterError
        If α, β are no filter's gains: it takes β (2-α) < α.

    Notes
    -----
    x⁺ = x + b + w, b⁺ = b + v. In steady state the gains are α for x and αβ for b if
    Var w = α S (α - (2-α)β) and Var v = (αβ)² S, where S is the variance of an innovation; so
    Var v = Var w · αβ²/(α - (2-α)β), and the slope is known to Var w · αβ/(α - (2-α)β).
    """
    params = params or HoltParams()
    alpha, beta = params.alpha, params.beta
    margin = alpha - (2.0 - alpha) * beta
    if margin <= 0:
        raise ParameterError(
            f"local_trend: alpha = {alpha}, beta = {beta} are no steady-state gains: expected "
            f"beta < alpha/(2 - alpha) = {alpha / (2.0 - alpha):.3g}"
        )

    def begin(
        x: FloatArray, covariance: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray, None]:
        known = noise * (alpha * beta / margin)
        return np.concatenate([x, np.zeros_like(x)]), _block_diagonal(covariance, known), None

    def forecast(
        s: FloatArray, covariance: FloatArray, _memory: None
    ) -> tuple[FloatArray, FloatArray, None]:
        n = len(s) // 2
        ahead = s.copy()
        ahead[:n] += s[n:]
        # F P Fᵀ with F = [[I, I], [0, I]], added so that it is exactly symmetric if P is.
        moved = covariance.copy()
        cross, slope = covariance[:n, n:], covariance[n:, n:]
        moved[:n, :n] += slope
        moved[:n, :n] += cross + cross.T
        moved[:n, n:] += slope
        moved[n:, :n] = moved[:n, n:].T
        return ahead, moved, None

    return Process(
        2,
        begin,
        forecast,
        lambda noise: _block_diagonal(noise, noise * (alpha * beta**2 / margin)),
        np.array([[1.0, 1.0], [0.0, 1.0]]),
    )


def _block_diagonal(first: FloatArray, second: FloatArray) -> FloatArray:
    n = len(first)
    out = np.zeros((2 * n, 2 * n))
    out[:n, :n], out[n:, n:] = first, second
    return out
