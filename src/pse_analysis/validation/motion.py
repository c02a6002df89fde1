"""What counts as an ordinary change of a channel, from one period to the next and over gaps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import FloatArray, IntArray

SNAP = 0.25
"""Elapsed times within a quarter period of n periods count as n: jitter is not a change of rate."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What counts as an ordinary change, per channel (arrays of length n_channel).

    Attributes
    ----------
    structure : (n_channel, n_lag + 1)
        v(n), variance of the good increment over n periods, v(0) = 0, n_lag ≥ 2; beyond the last
        lag it grows as between the last two. [unit²]
    k : (n_channel,)
        Coefficient of the last increment in the one-step extrapolation; 0 is "no change".
    increment : (n_channel,)
        Threshold of the first-increment check over its σ = √v(1); inf where it is not made.
    extrapolation : (n_channel,)
        Threshold of the extrapolation check over the σ of its error; inf where it is not made.
    confirm : (n_channel,)
        Samples that must agree with a flagged one before the step is accepted.
    turn : (n_channel,)
        Full turn of an angle, in whose changes whole turns do not count; inf for the rest, and
        where nothing is given. [unit]
    repeats : (n_channel,) array of bool
        Whether a healthy channel mostly repeats its last value. Elsewhere an exact repeat is no
        second opinion, and confirms no step. All do where nothing is given.
    """

    structure: FloatArray
    k: FloatArray
    increment: FloatArray
    extrapolation: FloatArray
    confirm: IntArray
    turn: FloatArray = field(default_factory=lambda: np.empty(0))
    repeats: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))

    def __post_init__(self) -> None:
        if not len(self.turn):
            object.__setattr__(self, "turn", np.full(len(self.k), np.inf))
        if not len(self.repeats):
            object.__setattr__(self, "repeats", np.ones(len(self.k), dtype=bool))
        shape = np.shape(self.structure)
        if len(shape) != 2 or shape[1] < 3:
            raise ValueError(
                f"structure has shape {shape}: expected (n_channel, n_lag + 1) with n_lag ≥ 2"
            )
        for name in ("k", "increment", "extrapolation", "confirm", "turn", "repeats"):
            if getattr(self, name).shape != shape[:1]:
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}: expected {shape[:1]}, "
                    "one entry per channel"
                )

    @property
    def increment_threshold(self) -> FloatArray:
        """γ of the first-increment check over one period, (n_channel,). [unit]"""
        return times_sigma(self.increment, np.sqrt(self.structure[:, 1]))

    @property
    def extrapolation_threshold(self) -> FloatArray:
        """γ of the extrapolation check over one period, (n_channel,). [unit]"""
        return times_sigma(self.extrapolation, np.sqrt(self.one_step_variance))

    @property
    def one_step_variance(self) -> FloatArray:
        """σ²(1 − 2kρ₁ + k²) for the k in use, (n_channel,). [unit²]"""
        v1, v2 = self.structure[:, 1], self.structure[:, 2]
        return np.maximum(v1 * (1.0 + self.k**2) - self.k * (v2 - 2.0 * v1), 0.0)


def given(threshold: npt.ArrayLike, n_channel: int, confirm: int | npt.ArrayLike = 2) -> Motion:
    """Motion of a stated first-increment threshold per period, growing as √m over m periods.

    Parameters
    ----------
    threshold : float or (n_channel,)
        γ of eq. (1). [unit]
    n_channel : int
    confirm : int or (n_channel,)
        Samples that must agree with a flagged one before a step is accepted.
    """
    gamma = np.broadcast_to(np.asarray(threshold, dtype=float), (n_channel,))
    return Motion(
        structure=np.square(gamma)[:, None] * np.arange(3.0)[None, :],
        k=np.zeros(n_channel),
        increment=np.ones(n_channel),
        extrapolation=np.full(n_channel, np.inf),
        confirm=np.broadcast_to(np.asarray(confirm, dtype=np.int64), (n_channel,)).copy(),
    )


def extrapolating(
    threshold: npt.ArrayLike,
    k: npt.ArrayLike,
    n_channel: int,
    confirm: int | npt.ArrayLike = 2,
    n_lag: int = 8,
) -> Motion:
    """Motion of a stated extrapolation threshold per period.

    Parameters
    ----------
    threshold : float or (n_channel,)
        γ of eq. (12). [unit]
    k : float or (n_channel,)
        Coefficient of the last increment.
    n_channel : int
    confirm : int or (n_channel,)
        Samples that must agree with a flagged one before a step is accepted.
    n_lag : int
        Lags after which increments count as uncorrelated.

    Notes
    -----
    Over gaps the increments count as AR(1) with ρ_j = k^j, of which k is the best coefficient;
    where |k| ≥ 1 is none's, as uncorrelated.
    """
    gamma = np.broadcast_to(np.asarray(threshold, dtype=float), (n_channel,))
    coefficient = np.broadcast_to(np.asarray(k, dtype=float), (n_channel,)).copy()
    rho = np.where(np.abs(coefficient) < 1.0, coefficient, 0.0)
    shape = gap_variance(np.ones(n_channel), rho[:, None] ** np.arange(1.0, n_lag + 1.0), n_lag)
    error = 1.0 + coefficient**2 - 2.0 * coefficient * rho
    return Motion(
        structure=shape * (np.square(gamma) / error)[:, None],
        k=coefficient,
        increment=np.full(n_channel, np.inf),
        extrapolation=np.ones(n_channel),
        confirm=np.broadcast_to(np.asarray(confirm, dtype=np.int64), (n_channel,)).copy(),
    )


def gap_variance(sigma: npt.ArrayLike, rho: npt.ArrayLike, n_lag: int) -> FloatArray:
    """v(0 … n_lag) from σ and ρ_1, ρ_2, …: v(m) = σ²(m + 2Σ_{i<m}(m−i)ρ_i).

    Parameters
    ----------
    sigma : (...,) array_like
        Standard deviation of the one-period increment. [unit]
    rho : (..., n) array_like
        Its autocorrelation from lag 1; 0 beyond n.
    n_lag : int

    Returns
    -------
    (..., n_lag + 1) ndarray
        [unit²]
    """
    r = np.atleast_1d(np.asarray(rho, dtype=float))
    m = np.arange(n_lag + 1)[:, None]
    i = np.arange(1, r.shape[-1] + 1)[None, :]
    weight = np.maximum(m - i, 0)
    s2 = np.square(np.asarray(sigma, dtype=float))[..., None]
    return np.asarray(s2 * (np.arange(n_lag + 1) + 2.0 * (r @ weight.T)))


def shortest(change: FloatArray, turn: float | FloatArray) -> FloatArray:
    """Change of an angle without whole turns; unchanged where the turn is infinite."""
    with np.errstate(invalid="ignore"):
        less = change - turn * np.rint(change / turn)
    return np.asarray(np.where(np.isinf(turn), change, less))


def times_sigma(quantile: FloatArray, sigma: FloatArray) -> FloatArray:
    """k·σ with ∞·0 = ∞: a check that is not made has no threshold."""
    with np.errstate(invalid="ignore"):
        product = quantile * sigma
    return np.asarray(np.where(np.isinf(quantile), np.inf, product))
