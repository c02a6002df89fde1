"""Sampling times of sources without a clock, recovered from the phasor units beside them.

Telecontrol stamps a sample when it arrives. Its branch current follows the current of a phasor unit
in series with it, whose stamps are exact: the delay of each sample is where the two curves match.

A window of the device's current and of its partner's, both z-scored, is matched by dynamic time
warping inside a causal band, eqs. (1)–(2) of [qi2025] with the absolute difference that eq. (1)
misprints as a root. The match of a single noisy sample is worth little where the current hardly
moves. So it is weighed against two other things that the same data tell: the likelihood of every
delay in the band, given how far the two currents usually differ, and the usual delay of the device
with its spread. The spread that is left, relative to that of a delay about which nothing is known,
is the confidence; where there is next to none the device's usual delay, the lag of the largest
cross-correlation, stands instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import Literal

import numpy as np
import numpy.typing as npt
from dtaidistance import dtw

from pse_analysis.errors import ParameterError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FEWEST_SAMPLES = 6
"""Samples that a window must hold for a match, and for a line between two currents."""
LAST = 2
"""Samples that say how far the loads between two places have moved their currents apart."""
FEWEST_FOR_LAG = 20
"""Increments below which a cross-correlation says nothing."""
SPREADS = (0.02, 0.1, 0.2, 0.4, 2.0)
"""Spreads of a device's delay that are weighed against each other, relative to the band."""
EXCESS = (1.0, 1.5, 2.2, 3.3, 5.0, 10.0)
"""Differences between two currents that are weighed, in multiples of the meter's own noise."""
EVIDENCE = 3.0
"""Log-likelihood by which a narrower spread must beat a wider one: ignorance is not constancy."""

Method = Literal["none", "xcorr", "dtw"]
METHODS: tuple[Method, ...] = ("none", "xcorr", "dtw")
NONE, XCORR, DTW = range(3)


@dataclass(frozen=True)
class TimeParams:
    """How the sampling times of clockless sources are recovered.

    Attributes
    ----------
    sources : tuple of str
        Sources without a clock.
    window_s : float
        T_w, the window that is matched. [s]
    largest_delay_s : float
        Largest credible delay: the width of the causal band. [s]
    lag_window_s : float
        Past from which a device's usual delay and its spread are learnt. [s]
    least_confidence : float
        Confidence below which the usual delay stands instead of the match.
    least_correlation : float
        Correlation of the increments below which not even a usual delay is believed, and the stamp
        is left alone.
    """

    sources: tuple[str, ...] = ("scada",)
    window_s: float = 2700.0
    largest_delay_s: float = 120.0
    lag_window_s: float = 86400.0
    least_confidence: float = 0.05
    least_correlation: float = 0.2

    def __post_init__(self) -> None:
        for name in ("window_s", "largest_delay_s", "lag_window_s"):
            if not getattr(self, name) > 0:
                raise ParameterError(
                    f"[align] {name} must be positive, received {getattr(self, name)}"
                )
        if self.window_s < 2 * self.largest_delay_s:
            raise ParameterError(
                f"[align] window_s = {self.window_s:g} holds no match: expected at least twice "
                f"largest_delay_s = {self.largest_delay_s:g}"
            )


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
    """

    time: FloatArray
    known: FloatArray
    value: FloatArray

    @classmethod
    def of(cls, time: FloatArray, arrival: FloatArray, value: FloatArray) -> Reference:
        """Even grid at the usual period, holding the last value where one is missing."""
        step = float(np.median(np.diff(time)))
        even = np.arange(time[0], time[-1] + 0.5 * step, step)
        last = np.searchsorted(time, even + 1e-6, side="right") - 1
        known = np.maximum.accumulate(np.maximum(arrival[last], even))
        return cls(even, known, value[last])

    @property
    def step(self) -> float:
        """Of the grid. [s]"""
        return float(self.time[1] - self.time[0])


@dataclass(frozen=True, eq=False)
class Stamps:
    """Recovered sampling times of one device.

    Attributes
    ----------
    delay : (n,) ndarray
        Arrival minus sampling time. [s]
    confidence : (n,) ndarray
        1 - (spread left)/(spread of a delay that may be anything in the band).
    method : (n,) ndarray of int8
        What the delay rests on: index into `METHODS`.
    """

    delay: FloatArray
    confidence: FloatArray
    method: npt.NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Match:
    """DTW of one window, for those who want to see it.

    Attributes
    ----------
    time : (n,) ndarray
        Grid on which both series stand. [s]
    device, reference : (n,) ndarray
        Z-scored; the reference is delayed by half the band.
    path : (k, 2) ndarray of int
        Matched positions of device and reference.
    matched : (m,) ndarray
        Mean reference time that each of the window's samples was matched to; NaN without. [s]
    """

    time: FloatArray
    device: FloatArray
    reference: FloatArray
    path: IntArray
    matched: FloatArray


def match_window(
    arrival: FloatArray, value: FloatArray, reference: Reference, end: float, params: TimeParams
) -> Match:
    """Match the samples of one window, all of which arrived by its end.

    Parameters
    ----------
    arrival, value : (m,) ndarray
        Samples of the window. [s, any unit]
    reference : Reference
    end : float
        Nothing that was not known by then is looked at. [s]
    params : TimeParams

    Returns
    -------
    Match

    Notes
    -----
    Each sample stands for the time around its arrival. The reference is delayed by half the largest
    delay, so that the symmetric Sakoe–Chiba band of that radius allows delays from zero to the
    largest one. The grid reaches half the band beyond the last known value; what stands there
    belongs to no sample.
    """
    step = reference.step
    radius = max(1, round(0.5 * params.largest_delay_s / step))
    last = int(np.searchsorted(reference.known, end, side="right")) - 1
    first = max(0, last - round(params.window_s / step))
    seen = reference.time[first : last + 1]
    grid = seen + radius * step
    owner = np.searchsorted(0.5 * (arrival[1:] + arrival[:-1]), grid)
    device, other = _z_score(value[owner]), _z_score(reference.value[first : last + 1])
    pairs = dtw.warping_path_fast(device, other, window=radius + 1, inner_dist="euclidean")
    path = np.fromiter(chain.from_iterable(pairs), np.int64, 2 * len(pairs)).reshape(-1, 2)
    time = seen[path[:, 1]]
    whose = owner[path[:, 0]]
    delay = arrival[whose] - time
    inside = (grid[path[:, 0]] <= end) & (delay >= 0) & (delay <= params.largest_delay_s)
    count = np.bincount(whose[inside], minlength=len(arrival))
    total = np.bincount(whose[inside], weights=time[inside], minlength=len(arrival))
    with np.errstate(invalid="ignore", divide="ignore"):
        matched = np.where(count > 0, total / count, np.nan)
    return Match(grid, device, other, path, matched)


def recover(
    arrival: FloatArray,
    value: FloatArray,
    sigma: FloatArray,
    reference: Reference,
    instants: FloatArray,
    params: TimeParams,
    method: Method = "dtw",
) -> Stamps:
    """Recover the delay of every sample of a device, as known at the next instant.

    Parameters
    ----------
    arrival : (n,) ndarray
        Increasing. [s]
    value, sigma : (n,) ndarray
        Current magnitude and σ of its noise, in any one unit.
    reference : Reference
        Current of the partner.
    instants : (T,) ndarray
        A sample's delay is settled at the first instant after its arrival, from what was known
        then. [s]
    params : TimeParams
    method : {"none", "xcorr", "dtw"}
        ``none`` takes the arrival for the sampling time, ``xcorr`` subtracts the device's usual
        delay, ``dtw`` matches sample by sample.

    Returns
    -------
    Stamps
        What no correlation supports is left alone, with confidence 0.
    """
    n = len(arrival)
    stamps = Stamps(np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int8))
    if method == "none" or n < FEWEST_FOR_LAG or len(reference.time) < FEWEST_FOR_LAG:
        return stamps
    lags = np.arange(0.0, params.largest_delay_s + 0.5 * reference.step, reference.step)
    band = _band(arrival, reference, lags)
    usual, found = _usual_delay(arrival, value, band, lags, params.lag_window_s)
    believed = found >= params.least_correlation
    stamps.delay[believed] = usual[believed]
    stamps.method[believed] = XCORR
    if method == "dtw":
        _match_all(arrival, value, sigma, reference, instants, params, lags, band, usual, stamps)
    return stamps


def correlation(
    arrival: FloatArray, value: FloatArray, reference: Reference, params: TimeParams
) -> float:
    """Largest cross-correlation of all increments of a device with a reference; -1 without any."""
    if len(arrival) <= FEWEST_FOR_LAG:
        return -1.0
    lags = np.arange(0.0, params.largest_delay_s + 0.5 * reference.step, reference.step)
    band = _band(arrival, reference, lags)
    return float(_usual_delay(arrival, value, band, lags, np.inf)[1][-1])


def _band(arrival: FloatArray, reference: Reference, lags: FloatArray) -> FloatArray:
    """Reference at every credible sampling time, as known at arrival. (n, n_lag)"""
    last = np.searchsorted(reference.known, arrival, side="right") - 1
    newest = reference.time[np.maximum(last, 0)]
    at = np.minimum(arrival[:, None] - lags, newest[:, None])
    return np.asarray(np.interp(at.ravel(), reference.time, reference.value).reshape(at.shape))


def _usual_delay(
    arrival: FloatArray, value: FloatArray, band: FloatArray, lags: FloatArray, window_s: float
) -> tuple[FloatArray, FloatArray]:
    """Lag of the largest cross-correlation of the increments so far, and that correlation. (n,)

    Increments, because the levels of all loads share a daily curve that fits at any lag.
    """
    own, other = np.diff(value)[:, None], np.diff(band, axis=0)
    # A load step is worth as much as a hundred quiet minutes, a meter's spike should not be.
    scale = 1.4826 * np.median(np.abs(own)) + 1e-12
    own = np.clip(own, -6 * scale, 6 * scale)
    begin = np.searchsorted(arrival[1:], arrival[1:] - window_s)
    row = np.arange(1, len(arrival))

    def past(product: FloatArray) -> FloatArray:
        total = np.concatenate([np.zeros((1, product.shape[1])), np.cumsum(product, axis=0)])
        return np.asarray(total[row] - total[begin])

    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = past(own * other) / np.sqrt(past(own**2) * past(other**2))
    enough = (row - begin) >= FEWEST_FOR_LAG
    correlation = np.where(enough[:, None] & np.isfinite(correlation), correlation, -1.0)
    best = correlation.argmax(axis=1)
    # The peak of a parabola through the best lag and its neighbours.
    middle = np.clip(best, 1, len(lags) - 2)
    left, centre, right = (correlation[row - 1, middle + k] for k in (-1, 0, 1))
    bend = left - 2 * centre + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1.0), 0.0)
    usual = lags[middle] + np.clip(shift, -1.0, 1.0) * (lags[1] - lags[0])
    found = correlation.max(axis=1)
    return np.concatenate([[0.0], usual]), np.concatenate([[-1.0], found])


def _match_all(
    arrival: FloatArray,
    value: FloatArray,
    sigma: FloatArray,
    reference: Reference,
    instants: FloatArray,
    params: TimeParams,
    lags: FloatArray,
    band: FloatArray,
    usual: FloatArray,
    stamps: Stamps,
) -> None:
    """Weigh the match of every sample, instant by instant, and write what it says into stamps."""
    width = float(lags[-1])
    ignorant = width / np.sqrt(12.0)
    noise = float(np.median(sigma)) * np.array(EXCESS)
    evidence = np.zeros((len(arrival), len(EXCESS), len(SPREADS)))
    settled = np.interp(arrival - stamps.delay, reference.time, reference.value)
    bounds = np.searchsorted(arrival, instants, side="right")
    for end, begin, stop in zip(instants[1:], bounds[:-1], bounds[1:], strict=True):
        rows = np.arange(np.searchsorted(arrival, end - params.window_s), stop)
        fresh = np.arange(begin, stop)
        fresh = fresh[stamps.method[fresh] == XCORR]
        if len(fresh) == 0 or len(rows) < FEWEST_SAMPLES or reference.known[0] > end:
            continue
        past = np.arange(np.searchsorted(arrival, end - params.lag_window_s), begin)
        line = _line(value[past], settled[past])
        if line is None:
            continue
        apart = value[fresh, None] - line[0] - line[1] * band[fresh]
        likelihood = _likelihood(apart, noise)
        prior = _priors(usual[fresh], lags, width)
        joint = likelihood[:, :, None, :] * prior[:, None, :, :]
        evidence[fresh] = np.log(joint.sum(axis=3))
        excess, spread = _widest(evidence[past[0] : stop].sum(axis=0))
        posterior = joint[:, excess, spread]
        mean, left = _moments(posterior, lags)
        confidence = np.clip(1.0 - np.hypot(left, 0.3 * reference.step) / ignorant, 0.0, 1.0)
        # The path knows the neighbours and their order; it is as sure as the sample itself.
        blur = np.hypot(_moments(likelihood[:, excess], lags)[1], reference.step)
        match = match_window(arrival[rows], value[rows], reference, float(end), params)
        path = arrival[fresh] - match.matched[fresh - rows[0]]
        known = np.isfinite(path)
        away = (lags - np.where(known, path, 0.0)[:, None]) / blur[:, None]
        pull = np.where(known[:, None], np.exp(-0.5 * away**2), 1.0)
        mean, _ = _moments(posterior * pull, lags)
        sure = confidence >= params.least_confidence
        stamps.confidence[fresh] = confidence
        stamps.delay[fresh[sure]] = mean[sure]
        stamps.method[fresh[sure]] = DTW
        settled[fresh] = np.interp(
            arrival[fresh] - stamps.delay[fresh], reference.time, reference.value
        )


def _line(value: FloatArray, settled: FloatArray) -> tuple[float, float] | None:
    """Offset and slope of a device's current in its partner's; None where they do not agree.

    The slope is that of the increments so far. The offset is that of the last few samples, because
    the loads between the two places move it.
    """
    if len(value) < FEWEST_FOR_LAG:
        return None
    own, other = np.diff(value), np.diff(settled)
    moved = float(other @ other)
    slope = float(own @ other) / moved if moved > 0 else 0.0
    if slope <= 0:
        return None
    return float(np.median((value - slope * settled)[-LAST:])), slope


def _likelihood(apart: FloatArray, noise: FloatArray) -> FloatArray:
    """Likelihood (k, n_noise, n_lag) of differences (k, n_lag) by Student's law of 4 degrees.

    Loads between the two places jump now and then, which a normal law would take for a delay.
    """
    square = (apart[:, None, :] / noise[:, None]) ** 2
    return np.asarray((1.0 + 0.25 * square) ** -2.5 / noise[:, None])


def _moments(weight: FloatArray, lags: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of a delay under weights (k, n_lag)."""
    share = weight / weight.sum(axis=1, keepdims=True)
    mean = share @ lags
    return mean, np.sqrt(np.maximum(share @ lags**2 - mean**2, 0.0))


def _priors(usual: FloatArray, lags: FloatArray, width: float) -> FloatArray:
    """Laws of a delay about its usual value, (k, n_spread, n_lag)."""
    spread = np.maximum(np.array(SPREADS) * width, 0.3 * (lags[1] - lags[0]))
    away = (lags - usual[:, None])[:, None, :] / spread[None, :, None]
    law = np.exp(-0.5 * np.minimum(away**2, 500.0))
    return np.asarray(law / law.sum(axis=2, keepdims=True))


def _widest(evidence: FloatArray) -> tuple[int, int]:
    """Noise and spread of the best evidence, with the widest spread that none beats clearly."""
    best = evidence.max(axis=0)
    spread = int(np.flatnonzero(best >= best.max() - EVIDENCE)[-1])
    return int(evidence[:, spread].argmax()), spread


def _z_score(series: FloatArray) -> FloatArray:
    """Series with mean 0 and σ 1; a flat one stays at 0."""
    deviation = float(series.std())
    return np.asarray((series - series.mean()) / (deviation if deviation > 0 else 1.0))
