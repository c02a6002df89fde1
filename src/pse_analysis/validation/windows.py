"""Windows on the past of many channels at once: one row per sample, one column per channel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


def near(z: FloatArray, last: FloatArray, turn: FloatArray | float) -> FloatArray:
    """Samples, with angles turned by whole turns to the last value of their channel."""
    angle = np.isfinite(turn) & np.isfinite(last)
    if not angle.any():
        return z
    full = np.broadcast_to(turn, z.shape)[angle]
    near = z.copy()
    near[angle] -= np.rint((z[angle] - last[angle]) / full) * full
    return near


def weighted(weight: npt.NDArray[np.floating], rows: FloatArray) -> FloatArray:
    """Weighted sum of rows, added in one order however many columns there are."""
    return np.asarray((weight[:, None] * rows).sum(axis=0))


def pushed(past: FloatArray, new: FloatArray, where: BoolArray) -> FloatArray:
    """The past with a new row at its end, in some columns."""
    if where.all():
        return np.concatenate([past[1:], new[None]])
    out = past.copy()
    out[:-1, where] = past[1:, where]
    out[-1, where] = new[where]
    return out


def agree(suspects: FloatArray, bound: FloatArray) -> BoolArray:
    """Whether the last run of each column lies within a bound about its own line."""
    n = len(suspects)
    time = np.arange(n) - 0.5 * (n - 1)
    centred = suspects - suspects.mean(axis=0)
    slope = weighted(time, centred) / (time @ time)
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(centred - np.outer(time, slope)) <= bound).all(axis=0))
