"""How a sample that covers an interval of the past reads a random walk known at regular instants.

Between instants the walk is its linear interpolation plus a Brownian bridge. The interpolation
gives the weights of the instants; the bridge is noise, and it is common to all samples whose
intervals overlap.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.measurement import SensorLayout

_INSTANT = 1e-3
"""Width, in steps, of the interval that stands for an instant in the bridge's covariance."""


def covered(age_s: FloatArray, window_s: FloatArray, step_s: float, lags: int) -> BoolArray:
    """Whether samples lie inside the last ``lags`` steps. (m,)"""
    return np.asarray((age_s + window_s) / step_s <= lags + 1e-9)


def kinds(
    age_s: FloatArray, window_s: FloatArray
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
    """Distinct pairs of age and window, (κ,) each, and which of them every sample has, (m,).

    Samples of one device, and of all meters of a kind, share their interval.
    """
    found, kind = np.unique(age_s + 1j * window_s, return_inverse=True)
    return found.real, found.imag, kind


def weights(age_s: FloatArray, window_s: FloatArray, step_s: float, lags: int) -> FloatArray:
    """Weights with which samples read the instants.

    Parameters
    ----------
    age_s, window_s : (m,) ndarray
        A sample averages the interval of length ``window_s`` that ended ``age_s`` ago; 0 is an
        instantaneous value. [s]
    step_s : float
        Between instants. [s]
    lags : int
        K, the number of past instants.

    Returns
    -------
    (m, K+1) ndarray
        For the present, one step ago, …; rows of samples that `covered` accepts sum to 1.
    """
    lag = np.arange(lags + 1)
    near = np.asarray(age_s)[:, None] / step_s - lag
    width = np.asarray(window_s)[:, None] / step_s
    passed = _hat_integral(np.stack([near + width, near]))
    mean = passed[0] - passed[1]
    lasting = width > 0
    mean /= np.where(lasting, width, 1.0)
    return np.where(lasting, mean, np.maximum(0.0, 1.0 - np.abs(near)))


def _hat_integral(u: FloatArray) -> FloatArray:
    """∫ max(0, 1-|v|) dv from -∞ to u."""
    rest = 1.0 - np.minimum(np.abs(u), 1.0)
    tail = 0.5 * rest * rest
    return np.where(u < 0, tail, 1.0 - tail)


def bridge_covariance(
    age_s: FloatArray, window_s: FloatArray, step_s: float, lags: int
) -> FloatArray:
    """Covariance of what linear interpolation leaves out of samples.

    Parameters
    ----------
    age_s, window_s, step_s, lags
        As for `weights`.

    Returns
    -------
    (m, m) ndarray
        In units of the walk's variance per step: u(1-u) for an instant a fraction u into a step,
        1/12 for the mean over a step, 0 between samples in different steps.

    Notes
    -----
    The bridge of one step has the covariance min(u, v) - uv; samples average it over their parts of
    the step, so that the covariance of two of them is its integral over a rectangle.
    """
    near = np.asarray(age_s) / step_s
    width = np.maximum(np.asarray(window_s) / step_s, _INSTANT)
    step = np.arange(lags)[:, None]
    begin, end = np.clip(near - step, 0.0, 1.0), np.clip(near + width - step, 0.0, 1.0)
    k = len(near)
    area = _min_integral(np.concatenate([end, begin], axis=1))
    square = 0.5 * (end * end - begin * begin)
    common = area[:, :k, :k] - area[:, k:, :k] - area[:, :k, k:] + area[:, k:, k:]
    common -= square[:, :, None] * square[:, None, :]
    return np.asarray(common.sum(axis=0) / np.outer(width, width))


def _min_integral(x: FloatArray) -> FloatArray:
    """∫∫ min(u, v) dv du from 0 to every x and from 0 to every other of its row."""
    low = np.minimum(x[:, :, None], x[:, None, :])
    high = np.maximum(x[:, :, None], x[:, None, :])
    return np.asarray(low * low * (0.5 * high - low / 6.0))


def usual_reach(history: Record, layout: SensorLayout, step_s: float) -> float:
    """How far fresh samples usually reach back; the few that come later are not worth the states.

    Without history a sample is expected within one step of its end.
    """
    span = history.age_s + layout.window_s
    usual = [
        np.quantile(span[history.fresh[:, row], row], 0.95)
        for row in np.flatnonzero(history.fresh.any(axis=0))
    ]
    expected = float(np.max(layout.window_s, initial=0.0)) + step_s
    return float(max(usual)) if usual else expected
