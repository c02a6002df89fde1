"""How much a channel's good samples change from one period to the next, learnt from its history.

Everything later checks need follows from the structure function v(n) = variance of the increment
over n sampling periods: σ² = v(1), the autocorrelation of increments
ρ_n = [v(n+1) − 2v(n) + v(n−1)] / 2σ², and the spread over a gap
v(m) = σ²(m + 2Σ_{i<m}(m−i)ρ_i).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from pse_analysis.arrays import FloatArray
from pse_analysis.validation.block import Criteria, screen
from pse_analysis.validation.motion import SNAP, Motion
from pse_analysis.vocabulary import Reason

N_LAG = 8
"""Lags of v(n) that are estimated; beyond, increments count as uncorrelated."""

CLIP = 3.5
"""Standard errors beyond which a history sample is left out; 1 good one in 2,000 of a Gaussian."""

FEWEST = 20
"""Increments below which σ is not estimated."""

_MAD_TO_SIGMA = 1.4826
_ROUNDS = 12
_SETTLED = 1e-3
_STEADY = 0.95


@dataclass(frozen=True, eq=False)
class Structure:
    """Second moments of the good increments, per channel.

    Attributes
    ----------
    variance : (n_channel, N_LAG + 1)
        v(n), v(0) = 0; NaN where the history holds too few increments. [unit²]
    count : (n_channel,) array of int
        Good one-period increments that σ was estimated from.
    repeats : (n_channel,)
        Share of samples that equal their predecessor exactly, zeros not counted.
    scale : (n_bin, n_channel) or None
        σ at a time of day over the σ of all times.
    evidence : (n_channel,)
        Mean square increment less that of the one-step extrapolation error with k = ρ₁, over the
        standard error of this difference: how sure the gain is.
    """

    variance: FloatArray
    count: npt.NDArray[np.int64]
    repeats: FloatArray
    scale: FloatArray | None = None
    evidence: FloatArray = field(default_factory=lambda: np.empty(0))

    @property
    def sigma(self) -> FloatArray:
        """σ of the good one-period increment, (n_channel,). [unit]"""
        return np.asarray(np.sqrt(self.variance[:, 1]))

    @property
    def autocorrelation(self) -> FloatArray:
        """ρ_1 … ρ_{N_LAG−1} of the increments, (n_channel, N_LAG − 1)."""
        return autocorrelation(self.variance)


def autocorrelation(variance: npt.ArrayLike) -> FloatArray:
    """ρ_1 … ρ_{N−1} of increments from v(0 … N) along the last axis; 0 where v(1) = 0."""
    v = np.asarray(variance, dtype=float)
    second = v[..., 2:] - 2.0 * v[..., 1:-1] + v[..., :-2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(v[..., 1:2] > 0.0, second / (2.0 * v[..., 1:2]), 0.0))


def learn(
    value: npt.ArrayLike,
    time: npt.ArrayLike,
    *,
    bins: npt.NDArray[np.intp] | None = None,
    n_bin: int = 0,
    n_lag: int = N_LAG,
    clip: float = CLIP,
    robust: bool = True,
) -> Structure:
    """Structure function of the good increments in a history that holds gross errors.

    Parameters
    ----------
    value : (n, n_channel) array_like
        History; NaN where there is no sample or a sample is known to be bad. [unit]
    time : (n, 1) or (n, n_channel) array_like
        Time stamps in sampling periods.
    bins : (n, 1) or (n, n_channel) array of int, optional
        Time-of-day bin of each sample; with it, σ is also estimated per bin.
    n_bin : int
        Number of those bins.
    n_lag : int
        Largest lag.
    clip : float
        Standard errors beyond which a sample is left out.
    robust : bool
        False takes plain moments of every increment.

    Returns
    -------
    Structure

    Notes
    -----
    Two passes leave gross errors out of the moments. First, from the median absolute increment on,
    samples beyond ``clip`` σ of the last good one go (a spike costs one sample, not two
    increments) until σ settles. Errors below that would still lower ρ₁ much: 5 % of errors of up to
    6σ bring ρ₁ = 0.5 to 0.2. So `isolated` then compares each sample with its neighbours on *both*
    sides, which a history allows, and which is the sharper the more a process is predictable.
    """
    x = np.asarray(value, dtype=float)
    t = np.asarray(time, dtype=float)
    n, n_channel = x.shape
    kept = np.where(np.isfinite(x), x, np.nan)
    repeats = _repeats(kept, t)
    endless = np.full(n_channel, np.inf)
    moments, count = _moments(kept, t, 1, endless)
    scale: FloatArray | None = None
    if robust and n:
        kept, sigma, scale = _clipped(kept, t, bins, n_bin, clip)
        rho = autocorrelation(_structure(kept, t, 2, clip, sigma))[:, 0]
        sample_scale = None if scale is None or bins is None else _spread(scale, bins)
        kept = np.where(isolated(kept, t, rho, clip=clip, scale=sample_scale), np.nan, kept)
        moments, count = _moments(kept, t, 1, clip * sigma, sample_scale)
        moments = moments / _inside(clip)
    if bins is not None:
        scale = _by_bin(kept, t, bins, n_bin, np.sqrt(moments))
    sigma = np.where(count >= FEWEST, np.sqrt(moments), np.nan)
    variance = _structure(kept, t, n_lag, clip if robust else np.inf, sigma)
    evidence = _evidence(kept, t, autocorrelation(variance)[:, 0])
    return Structure(variance, count, repeats, scale, evidence)


def unwound(x: FloatArray, turn: FloatArray) -> FloatArray:
    """Angles as they would read without the jump at the end of a turn, (n, n_channel)."""
    out = x.copy()
    for lane in np.flatnonzero(np.isfinite(turn)):
        here = np.isfinite(x[:, lane])
        out[here, lane] = np.unwrap(x[here, lane], period=turn[lane])
    return out


def isolated(
    x: FloatArray,
    t: FloatArray,
    rho: FloatArray,
    *,
    clip: float = CLIP,
    scale: FloatArray | None = None,
) -> npt.NDArray[np.bool_]:
    """Samples that stand apart from both their neighbours, largest first; not for use online.

    Parameters
    ----------
    x : (n, n_channel)
        History; NaN where there is no sample. [unit]
    t : (n, 1) or (n, n_channel)
        Time stamps in sampling periods.
    rho : (n_channel,)
        First guess of ρ₁.
    clip : float
        Standard errors of the interpolation beyond which a sample stands apart.
    scale : (n, n_channel), optional
        Factor on σ at each sample.

    Notes
    -----
    For increments that are AR(1) with φ = ρ₁ the interpolation from two neighbours on each side
    with least variance weighs x(t ± h) by (1+φ)²/c and x(t ± 2h) by −φ/c, c = 1 + (1+φ)² + φ². A
    sample goes only if the increment across it is ordinary: a step of the process stays.
    """
    found = np.zeros(x.shape, dtype=bool)
    if len(x) < 5:
        return found
    filled = x.copy()
    even = np.abs(t[4:] - t[:-4] - 4.0) <= SNAP
    phi = np.clip(rho, -_STEADY, _STEADY)
    for _ in range(_ROUNDS):
        error = np.full(x.shape, np.nan)
        inner, outer = (1.0 + phi) ** 2, -phi
        c = 1.0 + inner + phi**2
        error[2:-2] = filled[2:-2] - (
            inner / c * (filled[1:-3] + filled[3:-1]) + outer / c * (filled[:-4] + filled[4:])
        )
        error[2:-2][np.broadcast_to(~even, error[2:-2].shape)] = np.nan
        across = np.full(x.shape, np.inf)
        across[1:-1] = np.abs(filled[2:] - filled[:-2])
        ratio = _ratio(np.where(found, np.nan, error), clip, scale)
        ordinary = _ratio(np.where(np.isinf(across), np.nan, across), np.inf, scale) <= clip
        peak = np.ones(x.shape, dtype=bool)
        for shift in (1, 2):
            peak[shift:] &= ratio[shift:] >= ratio[:-shift]
            peak[:-shift] &= ratio[:-shift] >= ratio[shift:]
        hit = peak & (ratio > clip) & ordinary
        if not hit.any():
            break
        found |= hit
        filled = np.where(hit, filled - error, filled)
        clean = np.where(found, np.nan, x)
        one, _ = _moments(clean, t, 1, np.full(x.shape[1], np.inf))
        two, _ = _moments(clean, t, 2, np.full(x.shape[1], np.inf))
        with np.errstate(divide="ignore", invalid="ignore"):
            phi = np.where(one > 0.0, np.clip(two / (2.0 * one) - 1.0, -_STEADY, _STEADY), 0.0)
    return found


def _clipped(
    dirty: FloatArray, t: FloatArray, bins: npt.NDArray[np.intp] | None, n_bin: int, clip: float
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """History without what lies beyond ``clip`` σ of the last good sample; σ; its scale by bin."""
    sigma, scale, kept = _start(dirty, t), None, dirty
    for _ in range(_ROUNDS):
        sample_scale = None if scale is None or bins is None else _spread(scale, bins)
        kept = np.where(_outlying(dirty, t, sigma, clip, sample_scale), np.nan, dirty)
        moments, count = _moments(kept, t, 1, clip * sigma, sample_scale)
        new = np.where(count >= FEWEST, np.sqrt(moments / _inside(clip)), np.nan)
        if bins is not None:
            scale = _by_bin(kept, t, bins, n_bin, new)
        with np.errstate(invalid="ignore"):
            still = np.abs(new - sigma) > _SETTLED * sigma
        sigma = np.where(np.isnan(new), sigma, new)
        if not still.any():
            break
    return kept, sigma, scale


def _structure(
    x: FloatArray, t: FloatArray, n_lag: int, clip: float, sigma: FloatArray
) -> FloatArray:
    """v(0 … n_lag) from σ and the increments over longer spans, (n_channel, n_lag + 1)."""
    variance = np.zeros((x.shape[1], n_lag + 1))
    variance[:, 1] = np.square(sigma)
    for lag in range(2, n_lag + 1):
        # Two samples n apart differ by at most n·(clip·σ) unless a step lies between them.
        bound = np.full(x.shape[1], np.inf) if np.isinf(clip) else clip * lag * sigma
        moments, pairs = _moments(x, t, lag, bound)
        white = variance[:, lag - 1] + np.maximum(variance[:, lag - 1] - variance[:, lag - 2], 0.0)
        # The clipping of one-period increments takes about as much from the longer ones.
        variance[:, lag] = np.where(pairs >= FEWEST, moments / _inside(clip), white)
    return variance


def _inside(clip: float) -> float:
    """Variance of a standard Gaussian that is cut off at ± ``clip``."""
    if np.isinf(clip):
        return 1.0
    density = float(np.exp(-0.5 * clip**2) / np.sqrt(2.0 * np.pi))
    return 1.0 - 2.0 * clip * density / (2.0 * float(ndtr(clip)) - 1.0)


def _ratio(error: FloatArray, clip: float, scale: FloatArray | None) -> FloatArray:
    """|error| over its standard error per channel; 0 where there is none."""
    size = np.abs(error) if scale is None else np.abs(error) / scale
    spread = np.zeros(error.shape[1])
    some = np.flatnonzero(np.isfinite(size).any(axis=0))
    if len(some):
        spread[some] = _MAD_TO_SIGMA * np.nanmedian(size[:, some], axis=0)
    for _ in range(_ROUNDS if np.isfinite(clip) else 0):
        with np.errstate(invalid="ignore"):
            good = size <= clip * spread
        square = np.sum(np.square(size), axis=0, where=good) / np.maximum(good.sum(axis=0), 1)
        new = np.sqrt(square / _inside(clip))
        settled = np.abs(new - spread) <= _SETTLED * spread
        spread = np.where(new > 0.0, new, spread)
        if settled.all():
            break
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(np.where(spread > 0.0, size / spread, 0.0), nan=0.0, posinf=0.0)


def _evidence(x: FloatArray, t: FloatArray, rho: FloatArray) -> FloatArray:
    """Paired statistic of the gain by extrapolation; 0 where there are too few pairs.

    The usual standard error of ρ̂₁, 1/√n, is right for Gaussian increments only: on real loads a
    few large ones can make up most of ρ̂₁.
    """
    change = _difference(x, t, 1)
    if len(change) < 2:
        return np.zeros(x.shape[1])
    now, before = change[1:], change[:-1]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        gain = np.square(now) - np.square(now - rho * before)
        real = np.isfinite(gain)
        count = np.maximum(real.sum(axis=0), 1)
        mean = np.sum(gain, axis=0, where=real) / count
        square = np.sum(np.square(gain - mean), axis=0, where=real) / count
        sure = mean / np.sqrt(square / count)
    return np.where((count >= FEWEST) & np.isfinite(sure), sure, 0.0)


def _difference(x: FloatArray, t: FloatArray, lag: int) -> FloatArray:
    """x[lag:] − x[:−lag], NaN where that is not ``lag`` periods."""
    if len(x) <= lag:
        return np.full((0, x.shape[1]), np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        change = x[lag:] - x[:-lag]
        even = np.abs(t[lag:] - t[:-lag] - lag) <= SNAP
    return np.where(even & np.isfinite(change), change, np.nan)


def _moments(
    x: FloatArray, t: FloatArray, lag: int, bound: FloatArray, scale: FloatArray | None = None
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Mean square of the increments over ``lag`` periods inside the bound, and their number."""
    change = _difference(x, t, lag)
    if scale is not None:
        change = change / scale[lag:]
    with np.errstate(invalid="ignore", over="ignore"):
        good = np.abs(change) <= bound
        total = np.sum(np.square(change), axis=0, where=good)
    count = good.sum(axis=0)
    return total / np.maximum(count, 1), count.astype(np.int64)


def _start(x: FloatArray, t: FloatArray) -> FloatArray:
    """First σ: from the median absolute increment, of those that are not 0 where half are."""
    change = np.abs(_difference(x, t, 1))
    change[~(change > 0.0)] = np.nan
    sigma = np.zeros(x.shape[1])
    some = np.flatnonzero(np.isfinite(change).any(axis=0))
    if len(some):
        sigma[some] = _MAD_TO_SIGMA * np.nanmedian(change[:, some], axis=0)
    return sigma


def _outlying(
    x: FloatArray, t: FloatArray, sigma: FloatArray, clip: float, scale: FloatArray | None
) -> npt.NDArray[np.bool_]:
    n_channel = x.shape[1]
    quantile = np.where(sigma > 0.0, clip, np.inf)
    motion = Motion(
        structure=np.square(np.nan_to_num(sigma))[:, None] * np.arange(3.0)[None, :],
        k=np.zeros(n_channel),
        increment=quantile,
        extrapolation=np.full(n_channel, np.inf),
        confirm=np.full(n_channel, 2),
    )
    criteria = Criteria(
        lower=np.full(n_channel, np.nan),
        upper=np.full(n_channel, np.nan),
        motion=motion,
        stuck=np.zeros(n_channel, dtype=np.int64),
        stuck_at_zero=np.zeros(n_channel, dtype=bool),
    )
    found = screen(x, t, criteria, scale=scale, detail=False).reasons
    return np.asarray((found & Reason.INCREMENT) != 0)


def _repeats(x: FloatArray, t: FloatArray) -> FloatArray:
    change = _difference(x, t, 1)
    real = np.isfinite(change) & (x[1:] != 0.0) if len(x) > 1 else np.isfinite(change)
    same = real & (change == 0.0)
    return np.asarray(same.sum(axis=0) / np.maximum(real.sum(axis=0), 1))


def _spread(scale: FloatArray, bins: npt.NDArray[np.intp]) -> FloatArray:
    """Scale of each sample, (n, n_channel), from (n_bin, n_channel)."""
    if bins.shape[1] == 1:
        return scale[bins[:, 0]]
    return scale[bins, np.arange(scale.shape[1])[None, :]]


def _by_bin(
    x: FloatArray, t: FloatArray, bins: npt.NDArray[np.intp], n_bin: int, sigma: FloatArray
) -> FloatArray:
    """σ per bin over σ; 1 where a bin holds too few increments."""
    change = _difference(x, t, 1)
    at = np.broadcast_to(bins[1:], change.shape) if len(bins) > 1 else bins[:0]
    scale = np.ones((n_bin, x.shape[1]))
    for which in range(n_bin):
        good = (at == which) & np.isfinite(change)
        count = good.sum(axis=0)
        square = np.sum(np.square(change), axis=0, where=good) / np.maximum(count, 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(square) / sigma
        usable = (count >= FEWEST) & np.isfinite(ratio) & (ratio > 0.0)
        scale[which, usable] = ratio[usable]
    return scale
