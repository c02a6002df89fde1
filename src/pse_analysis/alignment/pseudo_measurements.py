"""Pseudo-measurements: what a slow meter would read now, forecast from what it read before.

A meter that reports quarter-hourly is minutes old when it is used. Instead of its last reading the
filter may take a forecast of the mean over the interval that ends now, Z_Pre of eq. (4) of
[qi2025]. How wrong such a forecast is, is measured at every horizon on the history, and that is its
σ. A forecast uses readings of its own meter only, never a state that a filter has estimated from
them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import ParameterError

Method = Literal["none", "hold", "holt", "profile", "ar"]
SMOOTHING = tuple((a, b) for a in (0.3, 0.6, 0.8, 1.0) for b in (0.0, 0.1, 0.3))
"""Pairs (α, β) of Holt's smoothing from which the history of a meter chooses."""
FEWEST = 8
"""Readings of the history below which a meter is only held."""
RATIO = (0.5, 2.0)
"""How far today's level may scale the profile of earlier days."""


@dataclass(frozen=True)
class PseudoParams:
    """When forecasts stand for readings, and how sure they are.

    Attributes
    ----------
    sources : tuple of str
        Sources whose old readings are replaced by a forecast.
    window_s : float
        T_w: a reading not older than this stands for itself. [s]
    sigma : {"empirical", "relative"}
        The error of the forecast on the history at the same horizon, or a share of the value.
    relative : float
        That share; 0.3 in [qi2025].
    """

    sources: tuple[str, ...] = ("ami",)
    window_s: float = 300.0
    sigma: Literal["empirical", "relative"] = "empirical"
    relative: float = 0.3

    def __post_init__(self) -> None:
        if not (self.window_s >= 0 and self.relative > 0):
            raise ParameterError(
                "[align.pseudo] expected window_s ≥ 0 and relative > 0, received "
                f"{self.window_s} and {self.relative}"
            )


@dataclass(frozen=True, eq=False)
class Forecasts:
    """Forecasts of meters from every reading, at whole numbers of periods ahead.

    Attributes
    ----------
    value : (n, J+1, c) ndarray
        From reading k, j periods ahead, of each of c meters; j = 0 is the reading itself.
    sigma : (J+1, c) ndarray
        RMS error on the history; at j = 0 that of the meter.
    """

    value: FloatArray
    sigma: FloatArray

    def at(
        self, reading: IntArray, ahead: FloatArray, meter: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Forecasts a fraction of a period ahead: linear between whole ones, as are variances.

        Parameters
        ----------
        reading, meter : (k,) ndarray of int
        ahead : (k,) ndarray
            In periods; beyond J it counts as J.

        Returns
        -------
        value, sigma : (k,) ndarray
        """
        ahead = np.clip(ahead, 0.0, len(self.sigma) - 1.0)
        low = np.minimum(ahead.astype(np.int64), len(self.sigma) - 2)
        part = ahead - low
        value = (1 - part) * self.value[reading, low, meter] + part * self.value[
            reading, low + 1, meter
        ]
        variance = (1 - part) * self.sigma[low, meter] ** 2 + part * self.sigma[low + 1, meter] ** 2
        return np.asarray(value), np.sqrt(variance)


def forecast(
    readings: FloatArray,
    history: int,
    method: Method,
    *,
    noise: FloatArray,
    horizon: int = 3,
    day: int = 96,
) -> Forecasts:
    """Forecast meters from each of their readings, by what the history teaches.

    Parameters
    ----------
    readings : (n, c) ndarray
        Readings at even times; NaN where one is missing, which is then taken as the one before.
    history : int
        Readings before the study: parameters and σ rest on these only.
    method : {"hold", "holt", "profile", "ar"}
        ``hold``: the last reading. ``holt``: level and trend, with the smoothing that would have
        served the history best. ``profile``: the mean of the same slots of earlier days, scaled to
        the last reading. ``ar``: autoregression of second order, fitted to the history.
    noise : (c,) ndarray
        σ of the meters.
    horizon : int
        J, periods ahead.
    day : int
        Readings per day.

    Returns
    -------
    Forecasts
    """
    filled = _filled(readings)
    kernel = {"hold": _hold, "holt": _holt, "profile": _profile, "ar": _autoregression}
    if method not in kernel:
        raise ParameterError(
            f"pseudo-measurements: expected one of {', '.join(kernel)}, received {method!r}"
        )
    if history < FEWEST:
        method = "hold"
    value = kernel[method](filled, history, horizon, day)
    # On its first day a profile has nothing to go by, nor does a smoothing at its start.
    begin = min(day, history // 2)
    sigma = np.empty((horizon + 1, filled.shape[1]))
    sigma[0] = noise
    for ahead in range(1, horizon + 1):
        count = history - ahead
        if count - begin < FEWEST:
            sigma[ahead] = sigma[ahead - 1] * np.sqrt(2.0)
            continue
        error = readings[begin + ahead : history] - value[begin:count, ahead]
        known = np.isfinite(error)
        square = np.where(known, error, 0.0) ** 2
        sigma[ahead] = np.sqrt(square.sum(axis=0) / np.maximum(known.sum(axis=0), 1))
    return Forecasts(value, np.maximum.accumulate(np.maximum(sigma, 1e-9), axis=0))


def _filled(readings: FloatArray) -> FloatArray:
    """Readings with the last one before every gap, and the first one before it all."""
    row = np.where(np.isfinite(readings), np.arange(len(readings))[:, None], -1)
    last = np.maximum.accumulate(row, axis=0)
    first = np.argmax(np.isfinite(readings), axis=0)
    filled = np.take_along_axis(readings, np.where(last >= 0, last, first), axis=0)
    return np.nan_to_num(filled)


def _hold(readings: FloatArray, history: int, horizon: int, day: int) -> FloatArray:
    return np.repeat(readings[:, None, :], horizon + 1, axis=1)


def _holt(readings: FloatArray, history: int, horizon: int, day: int) -> FloatArray:
    pairs = np.array(SMOOTHING)
    alpha, beta = pairs[:, :1], pairs[:, 1:]
    n, c = readings.shape
    level = np.repeat(readings[:1], len(pairs), axis=0)
    trend = np.zeros_like(level)
    levels, trends = np.empty((2, n, len(pairs), c))
    for k in range(n):
        before = level
        level = alpha * readings[k] + (1 - alpha) * (level + trend)
        trend = beta * (level - before) + (1 - beta) * trend
        levels[k], trends[k] = level, trend
    error = readings[1:history, None, :] - (levels + trends)[: history - 1]
    best = np.argmin(np.mean(error**2, axis=0), axis=0)
    meter = np.arange(c)
    ahead = np.arange(horizon + 1)[:, None]
    value = levels[:, best, meter][:, None, :] + ahead * trends[:, best, meter][:, None, :]
    value[:, 0] = readings
    return np.asarray(value)


def _profile(readings: FloatArray, history: int, horizon: int, day: int) -> FloatArray:
    n, c = readings.shape
    padded = np.concatenate([readings, np.repeat(readings[-1:], horizon, axis=0)])
    usual = np.full((n + horizon, c), np.nan)
    for slot in range(day, n + horizon):
        # Of earlier days only: a slot ahead is at least a day minus the horizon old.
        usual[slot] = padded[slot % day : slot - day + 1 : day].mean(axis=0)
    value = _hold(readings, history, horizon, day)
    scale = np.abs(readings[: max(history, 1)]).mean(axis=0)
    for k in range(day, n):
        fit = np.abs(usual[k]) > 0.1 * scale
        ratio = np.clip(readings[k] / np.where(fit, usual[k], 1.0), *RATIO)
        ahead = usual[k + 1 : k + horizon + 1] * ratio
        value[k, 1:] = np.where(fit, ahead, readings[k])
    return value


def _autoregression(readings: FloatArray, history: int, horizon: int, day: int) -> FloatArray:
    c = readings.shape[1]
    value = _hold(readings, history, horizon, day)
    before = np.concatenate([readings[:1], readings[:-1]])
    for meter in range(c):
        past = readings[:history, meter]
        design = np.column_stack([past[1:-1], past[:-2], np.ones(history - 2)])
        weight, *_ = np.linalg.lstsq(design, past[2:], rcond=1e-8)
        if np.abs(np.roots([1.0, -weight[0], -weight[1]])).max(initial=0.0) >= 1.0:
            continue  # an explosive fit tells nothing about the future: held
        now, last = readings[:, meter], before[:, meter]
        for ahead in range(1, horizon + 1):
            now, last = weight[0] * now + weight[1] * last + weight[2], now
            value[:, ahead, meter] = now
    return value
