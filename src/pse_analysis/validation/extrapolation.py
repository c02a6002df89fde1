"""The coefficient of the extrapolating filter: how much of the last increment carries on.

Eqs. (14)–(16) of [anishchenko2018] with k₀ = 1: x̂(t) = x(t−τ) + k[x(t−τ) − x(t−τ−h)]. With
increments of autocorrelation ρ_j, the variance over τ = m·h is least at k_opt = Σ_{j=1..m} ρ_j; at
m = 1 it is σ²(1 − ρ₁²), a gain (16) of 100·ρ₁² %. White measurement noise adds a negative lag-1
term, so k_opt may be negative.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import FloatArray
from pse_analysis.validation.increments import Structure, autocorrelation
from pse_analysis.validation.motion import SNAP

SIGNIFICANT = 3.0
"""Standard errors by which the gain must exceed 0 for extrapolation to be used."""


def closed_form(variance: npt.ArrayLike, m: int = 1) -> FloatArray:
    """k_opt for τ = m·h from the structure function: Σ_{j=1..m} ρ_j.

    Parameters
    ----------
    variance : (..., n_lag + 1) array_like
        v(0 … n_lag) with n_lag > m. [unit²]
    m : int
        Extrapolation interval in sampling periods.
    """
    rho = autocorrelation(variance)
    if not 1 <= m <= rho.shape[-1]:
        raise ValueError(
            f"τ = {m} periods needs ρ_1 … ρ_{m}: received v for {rho.shape[-1] + 1} lags, "
            f"estimate at least {m + 1}"
        )
    return np.asarray(rho[..., :m].sum(axis=-1))


def error_variance(variance: npt.ArrayLike, k: npt.ArrayLike, m: int = 1) -> FloatArray:
    """Variance of the extrapolation error over τ = m·h: v(m) − 2kσ²Σ_{j≤m} ρ_j + k²σ². [unit²]"""
    v = np.asarray(variance, dtype=float)
    u = np.asarray(k, dtype=float)
    return np.asarray(v[..., m] + v[..., 1] * u * (u - 2.0 * closed_form(v, m)))


def gain_percent(naive_variance: npt.ArrayLike, optimal_variance: npt.ArrayLike) -> FloatArray:
    """Gain in resolution ΔPC = 100·(D_n − D_opt)/D_n; eq. (16). [%]"""
    naive = np.asarray(naive_variance, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(100.0 * (naive - np.asarray(optimal_variance, dtype=float)) / naive)


def gains(structure: Structure) -> npt.NDArray[np.bool_]:
    """Whether the history shows for sure that extrapolation gains; (n_channel,).

    Notes
    -----
    The paired difference of squared errors must exceed 0 by `SIGNIFICANT` of its standard errors.
    With n Gaussian increments that asks for |ρ̂₁| > 6/√n; with heavy tails for more.
    """
    return np.asarray(structure.evidence > SIGNIFICANT)


def errors(
    value: npt.ArrayLike, k: float | FloatArray, m: int = 1, time: FloatArray | None = None
) -> FloatArray:
    """Extrapolation errors x(t) − x̂(t) of eq. (12), referred to t − m·h and t − (m+1)·h.

    Parameters
    ----------
    value : (n,) or (n, n_channel) array_like
        [unit]
    k : float or (n_channel,)
    m : int
        τ in sampling periods.
    time : (n,) or (n, n_channel), optional
        Stamps in periods; where samples are not the stated periods apart the error is NaN.

    Returns
    -------
    ndarray of the shape of ``value``; NaN in the first m + 1 rows. [unit]
    """
    x = np.asarray(value, dtype=float)
    out = np.full(x.shape, np.nan)
    if len(x) > m + 1:
        with np.errstate(over="ignore", invalid="ignore"):
            past = x[1:-m]
            out[m + 1 :] = x[m + 1 :] - past - np.asarray(k) * (past - x[: -m - 1])
            if time is not None:
                t = np.asarray(time, dtype=float)
                uneven = ~(np.abs(t[m + 1 :] - t[1:-m] - m) <= SNAP)
                uneven |= ~(np.abs(t[1:-m] - t[: -m - 1] - 1.0) <= SNAP)
                out[m + 1 :][np.broadcast_to(uneven, out[m + 1 :].shape)] = np.nan
    return out


def scan(
    value: npt.ArrayLike,
    grid: npt.ArrayLike | None = None,
    m: int = 1,
    time: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """The paper's search (15): variance of the extrapolation error against k, Fig. 2.

    Parameters
    ----------
    value : (n,) or (n, n_channel) array_like
        History. [unit]
    grid : (n_k,) array_like, optional
        Values of k; default −1 … 2 in steps of 0.01.
    m : int
        τ in sampling periods.
    time : (n,) or (n, n_channel), optional
        Stamps in periods.

    Returns
    -------
    k_opt : () or (n_channel,)
        The grid's best value; 0 where no error is defined.
    variance : (n_k,) or (n_k, n_channel)
        Mean square error at each k. [unit²]
    """
    k = np.linspace(-1.0, 2.0, 301) if grid is None else np.asarray(grid, dtype=float)
    x = np.asarray(value, dtype=float)
    rows = []
    for each in k:
        e = errors(x, float(each), m, time)
        count = np.isfinite(e).sum(axis=0)
        rows.append(np.nansum(np.square(e), axis=0) / np.maximum(count, 1))
    variance = np.array(rows)
    defined = np.isfinite(errors(x, 0.0, m, time)).any(axis=0)
    best = np.where(defined, k[np.argmin(variance, axis=0)], 0.0)
    return np.asarray(best), variance
