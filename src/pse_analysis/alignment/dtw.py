"""Sampling times of sources without a clock, recovered from the phasor units beside them.

Telecontrol stamps a sample when it arrives. Its branch current follows the current of a phasor unit
in series with it, whose stamps are exact: the delay of each sample is where the two curves match.

A window of the device's current and of its partner's, both z-scored, is matched by dynamic time
warping inside a causal band, eqs. (1)–(2) of [qi2025] with the absolute difference that eq. (1)
misprints as a root. The path of least cost follows every wiggle of the noise; it is better with a
price on leaving the diagonal, but it still cannot tell where it is right. So it is weighed against
the posterior of the delays (`pse_analysis.alignment.following`), by how far the two have been
apart. The spread of that posterior, relative to that of a delay about which nothing is known, is
the confidence; where there is too little of it the device's usual delay, the lag of the largest
cross-correlation, stands instead. So it does for a device whose current is explained by its usual
delay nearly as well as by the delays that were found: those are then held for noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from dtaidistance import dtw_cc
from dtaidistance.dtw import DTWSettings

from pse_analysis.alignment import lag
from pse_analysis.alignment.following import Device, follow
from pse_analysis.alignment.lag import Band, Reference
from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import ParameterError

__all__ = ["METHODS", "Match", "Method", "Reference", "Stamps", "TimeParams", "recover"]


FEWEST_SAMPLES = 6
"""Samples that a window must hold for a match."""
LAGS = 24
"""Steps into which the band is divided at least: a finer phasor current is averaged."""

GAIN = 0.1
"""Share of what the usual delay leaves unexplained that delays must explain to be believed."""

Method = Literal["none", "xcorr", "dtw"]
METHODS: tuple[Method, ...] = ("none", "xcorr", "dtw")
NONE, XCORR, DTW = range(3)


LONGEST_S = (1e-3, 1e7)
"""Windows and delays that can be matched, to a season. [s]"""


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
        Past from which a device's usual delay and its habits are learnt. [s]
    warp_penalty : float
        Cost of a step of the path off the diagonal, in σ of the window; 0 in [qi2025].
    least_confidence : float
        Confidence below which the usual delay stands instead of the match.
    least_correlation : float
        Correlation of the increments below which not even a usual delay is believed, and the stamp
        is left alone, or has the usual delay of others.
    lenders : int
        Devices of one source that must be sure of their delays for another, of which nothing is
        known, to have the same; 0 where devices do not share a network, and stamps stay alone.
    """

    sources: tuple[str, ...] = ("scada",)
    window_s: float = 2700.0
    largest_delay_s: float = 120.0
    lag_window_s: float = 86400.0
    warp_penalty: float = 1.0
    least_confidence: float = 1.0 / 3.0
    least_correlation: float = 0.2
    lenders: int = 3

    def __post_init__(self) -> None:
        for name in ("window_s", "largest_delay_s", "lag_window_s"):
            if not getattr(self, name) > 0:
                raise ParameterError(
                    f"[align] {name} must be positive, received {getattr(self, name)}"
                )
            if not LONGEST_S[0] <= getattr(self, name) <= LONGEST_S[1]:
                raise ParameterError(
                    f"[align] {name} must lie in {LONGEST_S[0]:g} … {LONGEST_S[1]:g} s, received "
                    f"{getattr(self, name)}"
                )
        if not 0 <= self.warp_penalty < np.inf:
            raise ParameterError(
                f"[align] warp_penalty must not be negative, received {self.warp_penalty}"
            )
        if self.lenders < 0 or self.lenders == 1:
            raise ParameterError(
                f"[align] expected lenders = 0 or at least 2, who can disagree, received "
                f"{self.lenders}"
            )
        if self.window_s < 2 * self.largest_delay_s:
            raise ParameterError(
                f"[align] window_s = {self.window_s:g} holds no match: expected at least twice "
                f"largest_delay_s = {self.largest_delay_s:g}"
            )

    @property
    def ignorant_s(self) -> float:
        """Standard deviation of a delay that may be anything in the band. [s]"""
        return self.largest_delay_s / float(np.sqrt(12.0))

    def sure(self, confidence: FloatArray) -> npt.NDArray[np.bool_]:
        """Which stamps are confident."""
        return np.asarray((confidence >= self.least_confidence) & (confidence > 0))


@dataclass(frozen=True, eq=False)
class Stamps:
    """Recovered sampling times of one device.

    Attributes
    ----------
    delay : (n,) ndarray
        Arrival minus sampling time. [s]
    confidence : (n,) ndarray
        1 - (spread left)/(spread of a delay that may be anything in the band).
    doubt : (n,) ndarray
        That spread; half the band where confidence is 0. [s]
    method : (n,) ndarray of int8
        What the delay rests on: index into `METHODS`. ``dtw`` wherever it is confident, but for a
        device whose delay does not vary.
    """

    delay: FloatArray
    confidence: FloatArray
    doubt: FloatArray
    method: npt.NDArray[np.int8]

    @classmethod
    def untouched(cls, n: int, params: TimeParams) -> Stamps:
        """Stamps that are left alone: late by anything in the band."""
        late = np.full(n, 0.5 * params.largest_delay_s)
        return cls(np.zeros(n), np.zeros(n), late, np.zeros(n, dtype=np.int8))


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
    belongs to no sample. A single value that neither of its neighbours shares is a spike, and the
    median of the three stands for it.
    """
    step = reference.step
    radius = max(1, round(0.5 * params.largest_delay_s / step))
    last = int(np.searchsorted(reference.known, end, side="right")) - 1
    first = max(0, last - round(params.window_s / step))
    seen = reference.time[first : last + 1]
    grid = seen + radius * step
    owner = np.searchsorted(0.5 * (arrival[1:] + arrival[:-1]), grid)
    device = _z_score(_without_spikes(value)[owner])
    other = _z_score(reference.value[first : last + 1])
    path = _path(device, other, radius, params.warp_penalty)
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
        Current magnitude, NaN where it is missing, and σ of its noise, in any one unit.
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
    stamps = Stamps.untouched(n, params)
    known = np.isfinite(value)
    enough = min(known.sum(), len(reference.time)) >= lag.FEWEST
    if method == "none" or not enough:
        return stamps
    reference = reference.thinned(params.largest_delay_s / LAGS)
    band = Band.of(arrival, reference, params.largest_delay_s)
    usual, found = lag.usual_delay(
        arrival[known], value[known], band.rows(known), params.lag_window_s
    )
    # A sample without a current has the usual delay that was known before it.
    before = np.maximum(np.cumsum(known) - 1, 0)
    usual, found = usual[before], found[before]
    believed = (found >= params.least_correlation) & (np.cumsum(known) > 0)
    stamps.delay[believed] = usual[believed]
    stamps.method[believed] = XCORR
    if method == "xcorr":
        return stamps
    device = Device(arrival, value, sigma, reference, band)
    mean, spread = follow(device, usual, believed, instants, params.lag_window_s)
    path = _paths(arrival, value, reference, instants, params)
    bounds = np.searchsorted(arrival, instants, side="right")
    edges = np.concatenate([[0], bounds])
    begin = edges[np.searchsorted(bounds, np.arange(n), side="right")]
    apart = _apart(path - mean, begin)
    varies = _varies(device, usual, np.where(np.isfinite(mean), mean, usual), begin, params)
    share = np.where(np.isfinite(path) & (apart > 0), spread**2 / (spread**2 + apart**2), 0.0)
    mean = mean + np.where(share > 0, share * (path - mean), 0.0)
    left = np.hypot(spread, 0.3 * reference.step)
    confidence = np.clip(1.0 - left / params.ignorant_s, 0.0, 1.0)
    told = believed & (confidence > 0)
    stamps.confidence[told], stamps.doubt[told] = confidence[told], left[told]
    sure = varies & params.sure(stamps.confidence)
    stamps.delay[sure] = mean[sure]
    stamps.method[sure] = DTW
    return stamps


def correlation(
    arrival: FloatArray, value: FloatArray, reference: Reference, params: TimeParams
) -> float:
    """Largest cross-correlation of all increments of a device with a reference; -1 without any."""
    known = np.isfinite(value)
    if known.sum() <= lag.FEWEST:
        return -1.0
    reference = reference.thinned(params.largest_delay_s / LAGS)
    band = Band.of(arrival[known], reference, params.largest_delay_s)
    return float(lag.usual_delay(arrival[known], value[known], band, np.inf)[1][-1])


def _paths(
    arrival: FloatArray,
    value: FloatArray,
    reference: Reference,
    instants: FloatArray,
    params: TimeParams,
) -> FloatArray:
    """Delay at which each sample was matched, in the window that ends with the next instant."""
    path = np.full(len(arrival), np.nan)
    known = np.isfinite(value)
    when, current, where = arrival[known], value[known], np.flatnonzero(known)
    bounds = np.searchsorted(when, instants, side="right")
    for end, begin, stop in zip(instants[1:], bounds[:-1], bounds[1:], strict=True):
        first = int(np.searchsorted(when, end - params.window_s))
        if begin == stop or stop - first < FEWEST_SAMPLES or reference.known[0] > end:
            continue
        rows = slice(first, stop)
        match = match_window(when[rows], current[rows], reference, float(end), params)
        path[where[begin:stop]] = (when[rows] - match.matched)[begin - first :]
    return path


def _apart(difference: FloatArray, begin: IntArray) -> FloatArray:
    """RMS of the differences of the samples before ``begin``; 0 while too few."""
    some = np.isfinite(difference)
    square = np.concatenate([[0.0], np.cumsum(np.where(some, difference, 0.0) ** 2)])
    count = np.concatenate([[0], np.cumsum(some)])
    mean = square[begin] / np.maximum(count[begin], 1)
    return np.asarray(np.where(count[begin] >= lag.FEWEST, np.sqrt(mean), 0.0))


def _varies(
    device: Device, usual: FloatArray, found: FloatArray, begin: IntArray, params: TimeParams
) -> npt.NDArray[np.bool_]:
    """Whether the delays found explained a device better, before ``begin``, than its usual one."""
    reference, known = device.reference, np.isfinite(device.value)
    both = np.stack(
        [
            np.interp((device.arrival - delay)[known], reference.time, reference.value)
            for delay in (usual, found)
        ],
        axis=1,
    )
    agreed = lag.correlations(
        device.arrival[known],
        device.value[known],
        both,
        params.largest_delay_s,
        params.lag_window_s,
    )
    left = 1.0 - np.maximum(agreed, 0.0) ** 2
    better = np.concatenate([[False], left[:, 1] < (1.0 - GAIN) * left[:, 0]])
    return np.asarray(better[np.concatenate([[0], np.cumsum(known)])[begin]])


def _path(device: FloatArray, other: FloatArray, radius: int, penalty: float) -> IntArray:
    """Path of least summed absolute difference plus penalties, inside a band. (k, 2)"""
    # The library's own wrapper for paths drops the inner distance, and squares are its default.
    settings = DTWSettings.for_dtw(
        device, other, window=radius + 1, inner_dist="euclidean", penalty=penalty
    )
    pairs = dtw_cc.warping_path(device, other, False, **settings.c_kwargs())
    return np.asarray(pairs, dtype=np.int64).reshape(-1, 2)


def _without_spikes(value: FloatArray) -> FloatArray:
    """Running median of three, but for the two ends."""
    if len(value) < 3:
        return value
    middle = np.median(np.stack([value[:-2], value[1:-1], value[2:]]), axis=0)
    return np.concatenate([value[:1], middle, value[-1:]])


def _z_score(series: FloatArray) -> FloatArray:
    """Series with mean 0 and σ 1; a flat one stays at 0."""
    deviation = float(series.std())
    return np.asarray((series - series.mean()) / (deviation if deviation > 0 else 1.0))
