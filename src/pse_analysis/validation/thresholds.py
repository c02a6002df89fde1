"""Decision thresholds for the increment and extrapolation checks: Bayes, minimax, q-bounded.

The good increment is N(0, σ²). A gross error n ~ U(−a, a) adds to it. With A = a/σ and k = γ/σ
the densities, both error probabilities and both optimal thresholds are functions of k and A alone.

Notes
-----
Eqs. (4)–(11) of [anishchenko2018]. Departures from print: (5) prints 1/(12σ), i.e. a = 6σ, while
(6) uses 3σ in its arguments, so its mass is ½; here one A serves both (default 6). (6) takes x,
not γ, as its argument. (9) stops at 3σ; here it runs to infinity unless ``truncate_at`` says
otherwise.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import log_ndtr, ndtr

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError

DEFAULT_AMPLITUDE = 6.0
"""A = a/σ as (5) prints it; 3 is the reading 'after rejection by three sigma'."""

_LOG_SQRT_2PI = 0.5 * np.log(2.0 * np.pi)
_BISECTIONS = 80


class Verdict(enum.IntEnum):
    """Whether the optimal threshold is an interior optimum."""

    INTERIOR = 0
    ALWAYS_REJECT = 1
    NEVER_REJECT = 2


@dataclass(frozen=True, eq=False)
class Threshold:
    """Thresholds with the error probabilities they imply; all arrays have the broadcast shape.

    Attributes
    ----------
    k : ndarray
        γ/σ.
    verdict : ndarray of int8
        `Verdict`: `ALWAYS_REJECT` is k = 0, `NEVER_REJECT` is k = ∞; neither is a check.
    false_alarm, miss : ndarray
        Their probabilities at k, given a good and an erroneous sample respectively.
    risk : ndarray
        Mean cost (1−q)·F_FA + q·r·F_M in units of the cost of a false alarm; for minimax the
        equalised risk.
    q : ndarray
        Prior probability of a gross error; for minimax the least favourable one.
    """

    k: FloatArray
    verdict: npt.NDArray[np.int8]
    false_alarm: FloatArray
    miss: FloatArray
    risk: FloatArray
    q: FloatArray


def good_density(x: npt.ArrayLike) -> FloatArray:
    """Density of the good increment in units of σ; eq. (4)."""
    u = np.asarray(x, dtype=float)
    return np.asarray(np.exp(-0.5 * u * u - _LOG_SQRT_2PI))


def error_density(x: npt.ArrayLike, amplitude: npt.ArrayLike = DEFAULT_AMPLITUDE) -> FloatArray:
    """Density of the increment with a gross error, in units of σ; eq. (6) with its mass restored.

    Parameters
    ----------
    x : array_like
        Increment over σ.
    amplitude : array_like
        A = a/σ, the largest gross error over σ.
    """
    u, a = _floats(x, amplitude)
    _positive("amplitude", a)
    return np.asarray((ndtr(a - np.abs(u)) - ndtr(-a - np.abs(u))) / (2.0 * a))


def false_alarm(k: npt.ArrayLike, *, truncate_at: float = np.inf) -> FloatArray:
    """Probability that a good increment exceeds k·σ; eq. (9), to infinity unless truncated.

    Parameters
    ----------
    k : array_like
        γ/σ; negative values count as 0.
    truncate_at : float
        Upper end of the integral over σ. The paper prints 3.
    """
    u = np.maximum(np.asarray(k, dtype=float), 0.0)
    return np.asarray(np.maximum(2.0 * (ndtr(-u) - ndtr(-truncate_at)), 0.0))


def miss(k: npt.ArrayLike, amplitude: npt.ArrayLike = DEFAULT_AMPLITUDE) -> FloatArray:
    """Probability that an increment with a gross error stays within k·σ; eq. (10).

    Parameters
    ----------
    k : array_like
        γ/σ; negative values count as 0.
    amplitude : array_like
        A = a/σ.

    Notes
    -----
    F_M = [G(A+k) − G(A−k) − G(k−A) + G(−A−k)]/(2A), G(u) = uΦ(u) + φ(u).
    """
    u, a = _floats(k, amplitude)
    _positive("amplitude", a)
    u = np.maximum(u, 0.0)
    # G(u) − G(−u) = u turns the four terms into two decaying ones and stays finite at k = ∞.
    far = np.minimum(u, 1e8)
    # F_M = 1 − [tail(k−A) − tail(k+A)]/A with tail(u) = ∫_u^∞ Q(s) ds = φ(u) − u·Q(u).
    value = 1.0 - (_tail(far - a) - _tail(far + a)) / a
    return np.asarray(np.clip(value, 0.0, 1.0))


def risk(
    k: npt.ArrayLike,
    q: npt.ArrayLike,
    cost_ratio: npt.ArrayLike = 1.0,
    amplitude: npt.ArrayLike = DEFAULT_AMPLITUDE,
) -> FloatArray:
    """Mean cost (1−q)·F_FA(k) + q·r·F_M(k), in units of the cost of a false alarm; eq. (8)."""
    p, r = _floats(q, cost_ratio)
    return np.asarray((1.0 - p) * false_alarm(k) + p * r * miss(k, amplitude))


def likelihood_ratio(k: npt.ArrayLike, amplitude: npt.ArrayLike = DEFAULT_AMPLITUDE) -> FloatArray:
    """f₁(k)/f₂(k): decreases in k ≥ 0, from ``degenerate_odds`` to 0."""
    return np.asarray(np.exp(_log_ratio(*_floats(k, amplitude))))


def degenerate_odds(amplitude: npt.ArrayLike = DEFAULT_AMPLITUDE) -> FloatArray:
    """Λ = q·r/(1−q) from which rejecting every sample is the cheapest: 4.787 at A = 6."""
    return likelihood_ratio(0.0, amplitude)


def bayes(
    q: npt.ArrayLike,
    cost_ratio: npt.ArrayLike = 1.0,
    amplitude: npt.ArrayLike = DEFAULT_AMPLITUDE,
) -> Threshold:
    """Thresholds of least mean cost; eq. (8).

    Parameters
    ----------
    q : array_like
        Prior probability of a gross error, 0 … 1.
    cost_ratio : array_like
        r = cost of a miss over cost of a false alarm, > 0.
    amplitude : array_like
        A = a/σ, > 0. The three broadcast.

    Raises
    ------
    ParameterError
        If a parameter lies outside its range.
    """
    p, r, a = _floats(q, cost_ratio, amplitude)
    _probability("q", p)
    _positive("cost_ratio", r)
    _positive("amplitude", a)
    with np.errstate(divide="ignore"):
        log_odds = np.log(p) + np.log(r) - np.log1p(-p)
    always = log_odds >= _log_ratio(np.zeros_like(a), a)
    never = p == 0.0
    inner = ~(always | never)
    k = np.where(never, np.inf, 0.0)
    if inner.any():
        a_in, target = a[inner], log_odds[inner]
        k[inner] = _bisect(lambda u: _log_ratio(u, a_in) - target, np.ones_like(a_in))
    verdict = np.where(
        never, Verdict.NEVER_REJECT, np.where(always, Verdict.ALWAYS_REJECT, Verdict.INTERIOR)
    )
    return Threshold(
        k=k,
        verdict=verdict.astype(np.int8),
        false_alarm=false_alarm(k),
        miss=miss(k, a),
        risk=risk(k, p, r, a),
        q=p,
    )


def minimax(
    cost_ratio: npt.ArrayLike = 1.0,
    amplitude: npt.ArrayLike = DEFAULT_AMPLITUDE,
    *,
    q_max: npt.ArrayLike = 1.0,
) -> Threshold:
    """Thresholds whose largest mean cost over q ∈ [0, q_max] is least; eq. (11).

    Parameters
    ----------
    cost_ratio : array_like
        r = cost of a miss over cost of a false alarm, > 0.
    amplitude : array_like
        A = a/σ, > 0.
    q_max : array_like
        Largest credible prior. Below the least favourable prior q₀ the answer is Bayes at q_max.

    Notes
    -----
    Unbounded, the risk is equal for all q: F_FA(k) = r·F_M(k), and q₀ = Λ₀/(Λ₀ + r) with
    Λ₀ = f₁/f₂ at k.
    """
    r, a, bound = _floats(cost_ratio, amplitude, q_max)
    _positive("cost_ratio", r)
    _positive("amplitude", a)
    _probability("q_max", bound)
    k = _bisect(lambda u: false_alarm(u) - r * miss(u, a), np.ones_like(a))
    odds = np.exp(_log_ratio(k, a))
    q_worst = odds / (odds + r)
    bounded = bound < q_worst
    if bounded.any():
        at_bound = bayes(bound, r, a)
        k = np.where(bounded, at_bound.k, k)
        verdict = np.where(bounded, at_bound.verdict, np.int8(Verdict.INTERIOR))
        q_worst = np.where(bounded, bound, q_worst)
    else:
        verdict = np.zeros(k.shape, dtype=np.int8)
    return Threshold(
        k=k,
        verdict=verdict.astype(np.int8),
        false_alarm=false_alarm(k),
        miss=miss(k, a),
        risk=risk(k, q_worst, r, a),
        q=q_worst,
    )


def _log_ratio(k: FloatArray, a: FloatArray) -> FloatArray:
    """Log f₁(k)/f₂(k), exact far into both tails."""
    near, far = log_ndtr(a - k), log_ndtr(-a - k)
    log_f2 = near + np.log1p(-np.exp(far - near)) - np.log(2.0 * a)
    return np.asarray(-0.5 * k * k - _LOG_SQRT_2PI - log_f2)


def _tail(u: FloatArray) -> FloatArray:
    """∫_u^∞ [1 − Φ(s)] ds = φ(u) − u·[1 − Φ(u)]."""
    return np.asarray(np.exp(-0.5 * u * u - _LOG_SQRT_2PI) - u * ndtr(-u))


def _bisect(decreasing: object, upper: FloatArray) -> FloatArray:
    """Root on [0, ∞) of a function that decreases through zero, elementwise."""
    assert callable(decreasing)
    low = np.zeros_like(upper)
    high = upper.copy()
    for _ in range(60):
        short = decreasing(high) > 0.0
        if not np.any(short):
            break
        low = np.where(short, high, low)
        high = np.where(short, 2.0 * high, high)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        above = decreasing(middle) > 0.0
        low = np.where(above, middle, low)
        high = np.where(above, high, middle)
    return np.asarray(0.5 * (low + high))


def _floats(*values: npt.ArrayLike) -> tuple[FloatArray, ...]:
    arrays = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in values))
    return tuple(np.array(v, dtype=float) for v in arrays)


def _positive(name: str, value: FloatArray) -> None:
    if not np.all((value > 0.0) & np.isfinite(value)):
        worst = value[~((value > 0.0) & np.isfinite(value))].ravel()[0]
        raise ParameterError(f"{name} must be positive and finite, received {worst}")


def _probability(name: str, value: FloatArray) -> None:
    if not np.all((value >= 0.0) & (value <= 1.0)):
        worst = value[~((value >= 0.0) & (value <= 1.0))].ravel()[0]
        raise ParameterError(f"{name} is a probability: expected 0 … 1, received {worst}")
