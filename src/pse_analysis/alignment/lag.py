"""The current of a phasor unit as a clock, and the usual delay of a device by cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import FloatArray

FEWEST = 20
"""Increments below which a cross-correlation says nothing."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Current of a phasor unit on an even grid of exact times.

    Attributes
    ----------
    time : (n,) ndarray
        Even. [s]
    known : (n,) ndarray
        When the value had arrived. [s]
    value : (n,) ndarray
    age : (n,) ndarray, optional
        How long before ``time`` the value was measured; all were in time without it. [s]
    """

    time: FloatArray
    known: FloatArray
    value: FloatArray
    age: FloatArray | None = None

    @classmethod
    def of(cls, time: FloatArray, arrival: FloatArray, value: FloatArray) -> Reference:
        """Even grid at the usual period, holding the last value where one is missing."""
        step = float(np.median(np.diff(time)))
        even = np.arange(time[0], time[-1] + 0.5 * step, step)
        last = np.searchsorted(time, even + 1e-6, side="right") - 1
        known = np.maximum.accumulate(np.maximum(arrival[last], even))
        return cls(even, known, value[last], np.maximum(even - time[last], 0.0))

    @property
    def step(self) -> float:
        """Of the grid. [s]"""
        return float(self.time[1] - self.time[0])

    def thinned(self, step_s: float) -> Reference:
        """Means over as many values as fit into a step; as it is where fewer than two do."""
        several = int(step_s / self.step + 1e-6)
        if several < 2:
            return self
        count = len(self.time) // several
        time, known, value, age = (
            part[: count * several].reshape(count, several)
            for part in (self.time, self.known, self.value, self.held)
        )
        return Reference(time.mean(axis=1), known[:, -1], value.mean(axis=1), age.mean(axis=1))

    @property
    def held(self) -> FloatArray:
        """Age of every value. [s]"""
        return np.zeros(len(self.time)) if self.age is None else self.age


@dataclass(frozen=True, eq=False)
class Band:
    """What the reference was at every credible sampling time, as known at arrival.

    Attributes
    ----------
    lags : (n_lag,) ndarray
        Credible delays, as far apart as the reference's values. [s]
    value : (n, n_lag) ndarray
    age : (n, n_lag) ndarray
        How long before that time the value was measured. [s]
    """

    lags: FloatArray
    value: FloatArray
    age: FloatArray

    @classmethod
    def of(cls, arrival: FloatArray, reference: Reference, largest_s: float) -> Band:
        """Of samples that arrived then, for delays up to the largest one."""
        lags = np.arange(0.0, largest_s + 0.5 * reference.step, reference.step)
        last = np.searchsorted(reference.known, arrival, side="right") - 1
        newest = reference.time[np.maximum(last, 0)]
        asked = arrival[:, None] - lags
        at = np.minimum(asked, newest[:, None])
        value, age = (
            np.interp(at.ravel(), reference.time, part).reshape(at.shape)
            for part in (reference.value, reference.held)
        )
        return cls(lags, np.asarray(value), np.asarray(age + (asked - at)))

    def rows(self, which: npt.NDArray[np.bool_]) -> Band:
        """Of some of the samples."""
        return Band(self.lags, self.value[which], self.age[which])


def usual_delay(
    arrival: FloatArray, value: FloatArray, band: Band, window_s: float
) -> tuple[FloatArray, FloatArray]:
    """Lag of the largest cross-correlation of the increments so far, and that correlation.

    Parameters
    ----------
    arrival : (n,) ndarray
        Increasing. [s]
    value : (n,) ndarray
        Current of the device.
    band : Band
        Of its partner, for the same samples.
    window_s : float
        Past that counts. [s]

    Returns
    -------
    delay, correlation : (n,) ndarray
        As known at each arrival; 0 and -1 while increments are too few. [s, 1]

    Notes
    -----
    Increments, because the levels of all loads share a daily curve that fits at any lag. They reach
    over about the largest delay: over less, a delay that varies puts most movements of the two
    currents into different increments.
    """
    lags = band.lags
    found = correlations(arrival, value, band.value, float(lags[-1]), window_s)
    # The peak of a parabola through the best lag and its neighbours.
    row = np.arange(len(arrival))
    middle = np.clip(found.argmax(axis=1), 1, len(lags) - 2)
    left, centre, right = (found[row, middle + k] for k in (-1, 0, 1))
    bend = left - 2 * centre + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1.0), 0.0)
    usual = lags[middle] + np.clip(shift, -1.0, 1.0) * (lags[1] - lags[0])
    best = found.max(axis=1)
    return np.where(best > -1.0, usual, 0.0), best


def correlations(
    arrival: FloatArray, value: FloatArray, others: FloatArray, reach_s: float, window_s: float
) -> FloatArray:
    """Correlation of a device's increments so far with those of several series.

    Parameters
    ----------
    arrival, value : (n,) ndarray
        [s, any unit]
    others : (n, k) ndarray
        What the current may follow, at each sample.
    reach_s, window_s : float
        Time over which an increment reaches, at least from a sample to the next, and the past that
        counts. [s]

    Returns
    -------
    (n, k) ndarray
        As known at each arrival; -1 while increments are too few.
    """
    out = np.full(others.shape, -1.0)
    span = span_of(arrival, reach_s)
    if len(arrival) <= span + FEWEST:
        return out
    own, other = value[span:] - value[:-span], others[span:] - others[:-span]
    # A load step is worth as much as a hundred quiet minutes, a meter's spike should not be.
    scale = 1.4826 * _running_median(np.abs(own)) + 1e-12
    own = np.clip(own, -6 * scale, 6 * scale)[:, None]
    begin = np.searchsorted(arrival[span:], arrival[span:] - window_s)
    row = np.arange(1, len(own) + 1)

    def past(product: FloatArray) -> FloatArray:
        total = np.concatenate([np.zeros((1, product.shape[1])), np.cumsum(product, axis=0)])
        return np.asarray(total[row] - total[begin])

    with np.errstate(invalid="ignore", divide="ignore"):
        found = past(own * other) / np.sqrt(past(own**2) * past(other**2))
    enough = (row - begin) >= FEWEST
    out[span:] = np.where(enough[:, None] & np.isfinite(found), found, -1.0)
    return out


def span_of(arrival: FloatArray, reach_s: float) -> int:
    """Samples over which an increment reaches about as far as asked."""
    first = np.diff(arrival[: FEWEST + 1])
    return max(1, round(reach_s / float(np.median(first)))) if len(first) else 1


def _running_median(series: FloatArray) -> FloatArray:
    """Median of what came so far, renewed whenever that has grown by a tenth."""
    out = np.empty(len(series))
    begin = 0
    while begin < len(series):
        end = max(begin + FEWEST, begin + begin // 10)
        out[begin:end] = np.median(series[: begin or end])
        begin = end
    return out
