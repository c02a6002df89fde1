"""How a sample that covers an interval of the past reads a random walk known at regular instants.

Between instants the walk is its linear interpolation plus a Brownian bridge. The interpolation
gives the weights of the instants; the bridge is noise, and it is common to all samples whose
intervals overlap.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_INSTANT = 1e-3
"""Width, in steps, of the interval that stands for an instant in the bridge's covariance."""


def covered(age_s: FloatArray, window_s: FloatArray, step_s: float, lags: int) -> BoolArray:
    """Whether samples lie inside the last ``lags`` steps. (m,)"""
    return np.asarray((age_s + window_s) / step_s <= lags + 1e-9)


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
    near = np.asarray(age_s)[:, None] / step_s
    width = np.asarray(window_s)[:, None] / step_s
    lag = np.arange(lags + 1)
    hat = np.maximum(0.0, 1.0 - np.abs(near - lag))
    mean = _hat_integral(near + width - lag) - _hat_integral(near - lag)
    return np.where(width > 0, mean / np.where(width > 0, width, 1.0), hat)


def _hat_integral(u: FloatArray) -> FloatArray:
    """∫ max(0, 1-|v|) dv from -∞ to u."""
    u = np.clip(u, -1.0, 1.0)
    return np.where(u < 0, 0.5 * (1 + u) ** 2, 1.0 - 0.5 * (1 - u) ** 2)


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
    # Samples of one device, and of all meters of a kind, share their interval.
    kinds, kind = np.unique(np.stack([near, width]), axis=1, return_inverse=True)
    near, width = kinds
    among = np.zeros((len(near), len(near)))
    for step in range(lags):
        begin = np.clip(near - step, 0.0, 1.0)
        end = np.clip(near + width - step, 0.0, 1.0)
        area = (
            _min_integral(end[:, None], end)
            - _min_integral(begin[:, None], end)
            - _min_integral(end[:, None], begin)
            + _min_integral(begin[:, None], begin)
        )
        square = 0.5 * (end**2 - begin**2)
        among += area - np.outer(square, square)
    among /= np.outer(width, width)
    kind = np.ravel(kind)
    return np.asarray(among[np.ix_(kind, kind)])


def _min_integral(x: FloatArray, y: FloatArray) -> FloatArray:
    """∫₀ˣ∫₀ʸ min(u, v) dv du."""
    low, high = np.minimum(x, y), np.maximum(x, y)
    return np.asarray(0.5 * low**2 * high - low**3 / 6.0)
