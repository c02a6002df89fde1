"""What is known about the delay of every sample: a filter over all delays in a band.

The current of a device follows that of its partner, up to a slope and to an offset by which the
loads between the two differ. So a sample that fits its partner at one delay better than at another
says something about its delay; most samples say little, because the current hardly moves. But a
delay resembles that of the sample before: it is taken for a random walk over the credible delays,
and the offset, given the delay, for another one, as in the interacting multiple models of Blom and
Bar-Shalom (1988), with a model for every delay. How far delays and offsets walk is not known. All
combinations of a few steps are filtered side by side, and weighed by how well each has predicted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh_tridiagonal

from pse_analysis.alignment.lag import FEWEST, Band, Reference, span_of

FloatArray = npt.NDArray[np.float64]

DRIFTS = (0.005, 0.02, 0.06, 0.2, 1.0)
"""Standard deviations by which a delay may change between samples, relative to the band."""
EXCESS = (1.0, 2.0)
"""Noise of both meters together, in multiples of what it should be."""
LOADS = (0.4, 1.5, 4.0)
"""Standard deviations by which the offset may change between samples, in σ of the device."""
SLACK = 0.3
"""Standard deviation of the slope about its usual value, relative to it.

Magnitudes of two currents are no linear functions of each other: where infeed between the two
places nearly outweighs the load, the slope may even change its sign.
"""
OUTLIERS = 0.03
"""Share of samples at which a meter errs or a load between the two places switches."""
LITTLE = 1e-12
"""Weight that keeps a delay from being ruled out for ever."""


@dataclass(frozen=True, eq=False)
class Walk:
    """Random walk over the lags with a given stationary law.

    Neighbouring lags exchange weight at rates in detailed balance with the law, which makes the
    generator similar to a symmetric matrix: S = U diag(rate) Uᵀ.

    Attributes
    ----------
    rate : (n_lag,) ndarray
        Not positive. [1/s²]
    into, out_of : (n_lag, n_lag) ndarray
        √law · U and U / √law.
    """

    rate: FloatArray
    into: FloatArray
    out_of: FloatArray

    @classmethod
    def of(cls, lags: FloatArray, law: FloatArray) -> Walk:
        """From lags an equal step apart, and a law that is positive at each of them."""
        root = np.sqrt(law)
        leaving = np.zeros(len(lags))
        leaving[:-1] += root[1:] / root[:-1]
        leaving[1:] += root[:-1] / root[1:]
        scale = 0.5 / (lags[1] - lags[0]) ** 2
        rate, vector = eigh_tridiagonal(-scale * leaving, np.full(len(lags) - 1, scale))
        return cls(np.minimum(rate, 0.0), root[:, None] * vector, vector / root[:, None])

    def forward(self, weight: FloatArray, variance: FloatArray) -> FloatArray:
        """Weights (n_drift, n_lag, k) after steps of a variance (n_drift,) each. [s²]"""
        decay = np.exp(self.rate * variance[:, None])[:, :, None]
        return np.asarray(self.into @ (decay * (self.out_of.T @ weight)))

    def backward(self, ratio: FloatArray, variance: FloatArray) -> FloatArray:
        """Expectation, from each lag, of a function (n_drift, n_lag, k) of the lag after it."""
        decay = np.exp(self.rate * variance[:, None])[:, :, None]
        return np.asarray(self.out_of @ (decay * (self.into.T @ ratio)))


@dataclass(frozen=True, eq=False)
class Belief:
    """Weight of every delay and the offset that goes with it, per hypothesis.

    Attributes
    ----------
    weight : (n_drift, n_lag, n_noise) ndarray
        Sums to 1 over the lags.
    offset, variance : (n_drift, n_lag, n_noise) ndarray
        Of the device's current over its partner's, given the delay.
    """

    weight: FloatArray
    offset: FloatArray
    variance: FloatArray


def predict(belief: Belief, walk: Walk, drift: FloatArray, load: FloatArray) -> Belief:
    """Carry a belief to the next sample.

    Parameters
    ----------
    belief : Belief
    walk : Walk
    drift : (n_drift,) ndarray
        Variance of the delay's change. [s²]
    load : ndarray that broadcasts to (n_drift, n_lag, n_noise)
        Variance of the offset's change.

    Returns
    -------
    Belief
        What offsets remain of several earlier delays has their common mean and variance.
    """
    weight, offset = belief.weight, belief.offset
    moments = np.concatenate(
        [weight, weight * offset, weight * (belief.variance + offset**2)], axis=2
    )
    weight, first, second = np.split(walk.forward(moments, drift), 3, axis=2)
    weight = np.maximum(weight, LITTLE)
    mean = first / weight
    return Belief(weight, mean, np.maximum(second / weight - mean**2, 0.0) + load)


def update(
    belief: Belief, apart: FloatArray, noise: FloatArray, jump: float
) -> tuple[Belief, FloatArray]:
    """Let a sample speak.

    Parameters
    ----------
    belief : Belief
        Before the sample.
    apart : (n_lag,) ndarray
        Current of the device minus slope times its partner's, per delay.
    noise : ndarray that broadcasts to (n_lag, n_noise)
        Variance of the meters' noise in it.
    jump : float
        Variance of what an outlier adds.

    Returns
    -------
    belief : Belief
    evidence : (n_drift, n_noise) ndarray
        Log-likelihood of the sample.

    Notes
    -----
    A sample is either as usual or an outlier. An outlier is a meter's error, which leaves the
    offset alone, or a load that has switched, which moves it; the next sample tells. The three
    cases are merged into one mean and variance.
    """
    error = apart[:, None] - belief.offset
    before = belief.variance
    usual = before + noise
    wide = usual + jump
    likely = (1.0 - OUTLIERS) * np.exp(-0.5 * error**2 / usual) / np.sqrt(usual)
    unlikely = OUTLIERS * np.exp(-0.5 * error**2 / wide) / np.sqrt(wide)
    likelihood = likely + unlikely + 1e-300
    share = unlikely / likelihood
    gains = before / usual, (before + jump) / wide, before / wide
    left = before * noise / usual, (before + jump) * noise / wide, before * (noise + jump) / wide
    cases = 1.0 - share, 0.5 * share, 0.5 * share
    mean = sum((s * g for s, g in zip(cases, gains, strict=True)), np.zeros(()))
    square = sum(
        (s * (v + (g * error) ** 2) for s, g, v in zip(cases, gains, left, strict=True)),
        np.zeros(()),
    )
    variance = np.maximum(square - (mean * error) ** 2, 1e-12 * usual)
    weight = belief.weight * likelihood
    total = weight.sum(axis=1, keepdims=True)
    return (
        Belief(weight / total, belief.offset + mean * error, variance),
        np.asarray(np.log(total[:, 0, :])),
    )


def smooth(
    filtered: list[FloatArray], predicted: list[FloatArray], walk: Walk, drifts: list[FloatArray]
) -> list[FloatArray]:
    """Weights of the delays of successive samples once all of them are known.

    Parameters
    ----------
    filtered, predicted : list of (n_drift, n_lag, n_noise) ndarray
        After each sample, and before it.
    walk : Walk
    drifts : list of (n_drift,) ndarray
        Variance of the delay's change before each sample. [s²]

    Returns
    -------
    list of (n_drift, n_lag, n_noise) ndarray
        The usual backward recursion over the delays; offsets stay as they were filtered.
    """
    out = [filtered[-1]]
    for k in range(len(filtered) - 2, -1, -1):
        weight = filtered[k] * walk.backward(out[0] / predicted[k + 1], drifts[k + 1])
        weight = np.maximum(weight, 0.0)
        out.insert(0, weight / weight.sum(axis=1, keepdims=True))
    return out


def follow(
    arrival: FloatArray,
    value: FloatArray,
    sigma: FloatArray,
    reference: Reference,
    band: Band,
    usual: FloatArray,
    believed: npt.NDArray[np.bool_],
    instants: FloatArray,
    window_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of the delay of every sample, as known at the next instant.

    Parameters
    ----------
    arrival : (n,) ndarray
        Increasing. [s]
    value, sigma : (n,) ndarray
        Current of the device, NaN where it is missing, and σ of its noise.
    reference : Reference
    band : Band
        Of the reference, for the same samples.
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
    lags = band.lags
    drift = np.array(DRIFTS) * lags[-1]
    excess, loads = (part.ravel() for part in np.meshgrid(EXCESS, LOADS, indexing="ij"))
    n, n_lag, shape = len(arrival), len(lags), (len(DRIFTS), len(lags), len(excess))
    mean, deviation = np.full(n, np.nan), np.full(n, np.nan)
    known = np.flatnonzero(np.isfinite(value))
    span = span_of(arrival[known], float(lags[-1]))
    settled = np.interp(arrival - usual, reference.time, reference.value)
    evidence = np.zeros((n + 1, len(DRIFTS), len(excess)))
    habits = np.zeros((n + 1, n_lag))
    bounds = np.searchsorted(arrival, instants, side="right")
    belief, slope, last = None, 0.0, 0
    for end, begin, stop in zip(instants[1:], bounds[:-1], bounds[1:], strict=True):
        evidence[begin + 1 : stop + 1] = evidence[begin]
        habits[begin + 1 : stop + 1] = habits[begin]
        oldest = np.searchsorted(arrival, end - window_s)
        past = known[np.searchsorted(known, oldest) : np.searchsorted(known, begin)]
        if begin == stop or not believed[stop - 1] or len(past) <= span + FEWEST:
            continue
        fresh_slope = _slope(value[past], settled[past], span)
        if fresh_slope <= 0:
            continue
        period = float(np.median(np.diff(arrival[past])))
        spent = np.searchsorted(reference.known, (end - window_s, end))
        noise, restless = _noise(reference.value[slice(*spent)], reference.step)
        if belief is None:
            last = int(past[-1])
            jump = float(np.var(value[past]))
            offset = (value[last] - fresh_slope * band.value[last])[None, :, None]
            flat = np.full(shape, 1.0 / n_lag)
            belief = Belief(flat, offset + np.zeros(shape), np.full(shape, jump))
        else:
            moved = (slope - fresh_slope) * band.value[last][None, :, None]
            belief = Belief(belief.weight, belief.offset + moved, belief.variance)
        slope, jump = fresh_slope, float(np.var(value[past]))
        law = habits[begin] - habits[oldest] + 1.0 / n_lag
        walk = Walk.of(lags, law / law.sum())
        filtered, predicted, steps = [], [], []
        for k in range(begin, stop):
            gap = (arrival[k] - arrival[last]) / period
            level = float(sigma[k]) if np.isfinite(sigma[k]) else 0.0
            load = (
                gap * (loads * level) ** 2
                + (SLACK * slope * (band.value[k] - band.value[last])[:, None]) ** 2
            )
            steps.append(gap * drift**2)
            belief = predict(belief, walk, steps[-1], load)
            predicted.append(belief.weight)
            if np.isfinite(value[k]):
                meter = (slope * noise) ** 2 + slope**2 * restless * band.age[k][:, None]
                belief, spoken = update(
                    belief,
                    value[k] - slope * band.value[k],
                    excess**2 * (level**2 + meter),
                    jump,
                )
                evidence[k + 1 : stop + 1] += spoken
            filtered.append(belief.weight)
            last = k
        share = evidence[stop] - evidence[oldest]
        share = np.exp(share - share.max())
        share /= share.sum()
        for k, weight in enumerate(smooth(filtered, predicted, walk, steps), begin):
            posterior = np.einsum("dln,dn->l", weight, share)
            posterior /= posterior.sum()
            mean[k] = posterior @ lags
            deviation[k] = np.sqrt(max(posterior @ lags**2 - mean[k] ** 2, 0.0))
            habits[k + 1 : stop + 1] += posterior
        fresh = np.arange(begin, stop)
        settled[fresh] = np.interp(arrival[fresh] - mean[fresh], reference.time, reference.value)
    return mean, deviation


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
    several = min(len(value) // 2, max(1, round(60.0 / step)))
    moved = float(np.mean((value[several:] - value[:-several]) ** 2)) - 2.0 * noise**2
    return noise, max(moved, 0.0) / (several * step)
