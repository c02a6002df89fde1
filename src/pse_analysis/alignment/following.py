"""The delays of one device, followed from instant to instant with what was known at each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pse_analysis.alignment import delays
from pse_analysis.alignment.delays import Belief, Walk
from pse_analysis.alignment.lag import FEWEST, Band, Reference, span_of
from pse_analysis.arrays import FloatArray, IntArray

DRIFTS = (0.005, 0.02, 0.06, 0.2, 1.0)
"""Standard deviations by which a delay may change between samples, relative to the band."""
EXCESS, LOADS = (part.ravel() for part in np.meshgrid((1.0, 2.0), (0.4, 1.5, 4.0), indexing="ij"))
"""Noise of both meters in multiples of what it should be, and the standard deviation by which the
offset may change between samples, in σ of the device: all pairs of a few."""
SLACK = 0.3
"""Standard deviation of the slope about its usual value, relative to it.

Magnitudes of two currents are no linear functions of each other: where infeed between the two
places nearly outweighs the load, the slope may even change its sign.
"""
MOVEMENT_S = 60.0
"""Time over which it is seen how fast a phasor current moves. [s]"""


@dataclass(frozen=True, eq=False)
class Device:
    """Samples of a device and what its partner may have been when they were taken.

    Attributes
    ----------
    arrival : (n,) ndarray
        Increasing. [s]
    value, sigma : (n,) ndarray
        Current, NaN where it is missing, and σ of its noise.
    reference : Reference
        Current of the partner.
    band : Band
        Of the reference, for the same samples.
    """

    arrival: FloatArray
    value: FloatArray
    sigma: FloatArray
    reference: Reference
    band: Band


@dataclass(frozen=True)
class _Learnt:
    """What the past says about a device: slope in its partner, the partner's noise and so on."""

    slope: float
    noise: float
    restless: float
    jump: float
    period: float


def follow(
    device: Device,
    usual: FloatArray,
    believed: npt.NDArray[np.bool_],
    instants: FloatArray,
    window_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of the delay of every sample, as known at the next instant.

    Parameters
    ----------
    device : Device
    usual : (n,) ndarray
        Usual delay, with which the first slope is learnt. [s]
    believed : (n,) ndarray of bool
        Whether the partner is one, as known at each arrival.
    instants : (T,) ndarray
        Nothing that was not known at an instant counts for the samples before it. [s]
    window_s : float
        Past from which slope, noise, steps and usual delays are learnt. [s]

    Returns
    -------
    mean, deviation : (n,) ndarray
        NaN where nothing can be said. [s]

    Notes
    -----
    The stationary law of the walk is the mean of the posteriors so far, with one sample's weight
    spread over the band: a device whose delays have all been alike is expected to go on so.
    """
    arrival, band, lags = device.arrival, device.band, device.band.lags
    n, n_lag = len(arrival), len(lags)
    mean, deviation = np.full(n, np.nan), np.full(n, np.nan)
    known = np.flatnonzero(np.isfinite(device.value))
    span = span_of(arrival[known], float(lags[-1]))
    settled = np.interp(arrival - usual, device.reference.time, device.reference.value)
    # Both are sums over all samples before; a difference of two is that over a window.
    evidence = np.zeros((n + 1, len(DRIFTS), len(LOADS)))
    habits = np.zeros((n + 1, n_lag))
    bounds = np.searchsorted(arrival, instants, side="right")
    belief, learnt, last = None, None, 0
    for end, begin, stop in zip(instants[1:], bounds[:-1], bounds[1:], strict=True):
        evidence[begin + 1 : stop + 1] = evidence[begin]
        habits[begin + 1 : stop + 1] = habits[begin]
        oldest = np.searchsorted(arrival, end - window_s)
        past = known[np.searchsorted(known, oldest) : np.searchsorted(known, begin)]
        if begin == stop or not believed[stop - 1] or len(past) <= span + FEWEST:
            continue
        before = learnt.slope if learnt else 0.0
        found = _learn(device, settled, past, span, (float(end) - window_s, float(end)))
        if found is None:
            continue
        learnt = found
        if belief is None:
            last = int(past[-1])
            shape = (len(DRIFTS), n_lag, len(LOADS))
            offset = (device.value[last] - learnt.slope * band.value[last])[None, :, None]
            belief = Belief(
                np.full(shape, 1.0 / n_lag), offset + np.zeros(shape), np.full(shape, learnt.jump)
            )
        else:
            moved = (before - learnt.slope) * band.value[last][None, :, None]
            belief = Belief(belief.weight, belief.offset + moved, belief.variance)
        law = habits[begin] - habits[oldest] + 1.0 / n_lag
        walk = Walk.of(lags, law / law.sum())
        fresh = np.arange(begin, stop)
        belief, weights, spoken = _hear(device, fresh, last, belief, walk, learnt)
        last = stop - 1
        evidence[begin + 1 : stop + 1] += np.cumsum(spoken, axis=0)
        share = evidence[stop] - evidence[oldest]
        share = np.exp(share - share.max())
        posterior = np.einsum("kdln,dn->kl", weights, share)
        posterior /= posterior.sum(axis=1, keepdims=True)
        mean[fresh] = posterior @ lags
        deviation[fresh] = np.sqrt(np.maximum(posterior @ lags**2 - mean[fresh] ** 2, 0.0))
        habits[begin + 1 : stop + 1] += np.cumsum(posterior, axis=0)
        settled[fresh] = np.interp(
            arrival[fresh] - mean[fresh], device.reference.time, device.reference.value
        )
    return mean, deviation


def _learn(
    device: Device, settled: FloatArray, past: IntArray, span: int, window: tuple[float, float]
) -> _Learnt | None:
    """What the past says; None where the two currents do not move together."""
    value, reference = device.value[past], device.reference
    slope = _slope(value, settled[past], span)
    if slope <= 0:
        return None
    noise, restless = _noise(
        reference.value[slice(*np.searchsorted(reference.known, window))], reference.step
    )
    period = float(np.median(np.diff(device.arrival[past])))
    return _Learnt(slope, noise, restless, float(np.var(value)), period)


def _hear(
    device: Device, fresh: IntArray, last: int, belief: Belief, walk: Walk, learnt: _Learnt
) -> tuple[Belief, FloatArray, FloatArray]:
    """Belief after successive samples, weights of their delays, and what each of them spoke for.

    Weights are (k, n_drift, n_lag, n_noise) once all k samples are known, log-likelihoods
    (k, n_drift, n_noise); ``last`` is the sample before.
    """
    band, slope = device.band, learnt.slope
    drift = np.array(DRIFTS) * band.lags[-1]
    filtered, predicted, steps = [], [], []
    spoken = np.zeros((len(fresh), len(DRIFTS), len(LOADS)))
    for i, k in enumerate(fresh):
        gap = (device.arrival[k] - device.arrival[last]) / learnt.period
        level = float(device.sigma[k]) if np.isfinite(device.sigma[k]) else 0.0
        bent = SLACK * slope * (band.value[k] - band.value[last])
        steps.append(gap * drift**2)
        belief = delays.predict(
            belief, walk, steps[-1], gap * (LOADS * level) ** 2 + bent[:, None] ** 2
        )
        predicted.append(belief.weight)
        if np.isfinite(device.value[k]):
            held = learnt.restless * band.age[k]
            meters = level**2 + slope**2 * (learnt.noise**2 + held)
            apart = device.value[k] - slope * band.value[k]
            belief, spoken[i] = delays.update(
                belief, apart, EXCESS**2 * meters[:, None], learnt.jump
            )
        filtered.append(belief.weight)
        last = int(k)
    return belief, np.stack(delays.smooth(filtered, predicted, walk, steps)), spoken


def _slope(value: FloatArray, settled: FloatArray, span: int) -> float:
    """Slope of a device's current in its partner's, by increments over some samples; or 0.

    The median of their ratios, weighted by the square of what the partner moved: least squares that
    no single spike can turn.
    """
    own, other = value[span:] - value[:-span], settled[span:] - settled[:-span]
    moved = other != 0
    if not moved.any():
        return 0.0
    ratio, weight = own[moved] / other[moved], other[moved] ** 2
    order = np.argsort(ratio)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    return float(max(ratio[order][half], 0.0))


def _noise(value: FloatArray, step: float) -> tuple[float, float]:
    """σ of a phasor unit's noise, and the variance per second by which its current moves."""
    if len(value) < FEWEST:
        return 0.0, 0.0
    # Second differences of a current that is straight over three samples are noise alone.
    noise = 1.4826 * float(np.median(np.abs(np.diff(value, 2)))) / np.sqrt(6.0)
    several = min(len(value) // 2, max(1, round(MOVEMENT_S / step)))
    moved = float(np.mean((value[several:] - value[:-several]) ** 2)) - 2.0 * noise**2
    return noise, max(moved, 0.0) / (several * step)
