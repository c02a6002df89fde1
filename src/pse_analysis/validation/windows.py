"""Windows on the past of many channels at once: one row per sample, one column per channel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, FloatArray


def near(z: FloatArray, last: FloatArray, turn: FloatArray | float) -> FloatArray:
    """Samples, with angles turned by whole turns to the last value of their channel."""
    beyond = z - last
    far = np.abs(beyond) > 0.5 * turn
    if not far.any():
        return z
    full = np.broadcast_to(turn, z.shape)[far]
    near = z.copy()
    near[far] -= np.rint(beyond[far] / full) * full
    return near


def weighted(weight: npt.NDArray[np.floating], rows: FloatArray) -> FloatArray:
    """Weighted sum of rows, added in one order however many columns there are."""
    return np.asarray((weight[:, None] * rows).sum(axis=0))


def pushed(past: FloatArray, new: FloatArray, where: BoolArray) -> FloatArray:
    """The past with a new row at its end, in some columns."""
    moved = np.concatenate([past[1:], new[None]])
    return moved if where.all() else np.where(where, moved, past)


def agree(suspects: FloatArray, bound: FloatArray) -> BoolArray:
    """Whether the last run of each column lies within a bound about its own line."""
    n = len(suspects)
    time = np.arange(n) - 0.5 * (n - 1)
    centred = suspects - suspects.mean(axis=0)
    slope = weighted(time, centred) / (time @ time)
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(centred - np.outer(time, slope)) <= bound).all(axis=0))
