"""What is known about the delay of every sample: a filter over all delays in a band.

The current of a device follows that of its partner, up to a slope and to an offset by which the
loads between the two differ. So a sample that fits its partner at one delay better than at another
says something about its delay; most samples say little, because the current hardly moves. But a
delay resembles that of the sample before: it is taken for a random walk over the credible delays,
and the offset, given the delay, for another one, as in the interacting multiple models of Blom and
Bar-Shalom (1988), with a model for every delay. How far delays and offsets walk is not known. All
combinations of a few steps are filtered side by side, and `pse_analysis.alignment.following` weighs
them by how well each has predicted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh_tridiagonal

from pse_analysis.arrays import FloatArray

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
