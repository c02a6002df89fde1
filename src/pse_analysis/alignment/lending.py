"""A delay for who has none of its own: the usual one of other devices on the same network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pse_analysis.alignment.lag import FEWEST
from pse_analysis.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Lender:
    """Confident delays of a device.

    Attributes
    ----------
    arrival : (n,) ndarray
        Increasing. [s]
    delay, spread : (n,) ndarray
        Arrival minus sampling time, and its standard deviation. [s]
    """

    arrival: FloatArray
    delay: FloatArray
    spread: FloatArray


def lend(
    lenders: Sequence[Lender], instants: FloatArray, window_s: float, ignorant_s: float, fewest: int
) -> tuple[FloatArray, FloatArray]:
    """Delay to be expected of one more device, as known at each instant.

    Parameters
    ----------
    lenders : sequence of Lender
        Other devices whose samples travel the same way.
    instants : (T,) ndarray
        Only what arrived by an instant counts at it. [s]
    window_s : float
        Past that counts. [s]
    ignorant_s : float
        Standard deviation of a delay about which nothing is known. Lenders that disagree by as much
        have nothing to lend. [s]
    fewest : int
        Lenders that it takes, two at least; each with `pse_analysis.alignment.lag.FEWEST` samples.

    Returns
    -------
    delay, sigma : (T,) ndarray
        NaN where nothing is lent. [s]

    Notes
    -----
    Every lender has a usual delay, about which its delays vary; one more device is taken for
    another draw of both. So with k lenders the variance is the mean of theirs, each with what is
    left of the doubt about its delays, plus that between their usual delays times 1 + 1/k.
    """
    delay, sigma = np.full(len(instants), np.nan), np.full(len(instants), np.nan)
    if len(lenders) < fewest:
        return delay, sigma
    habits = [_habit(lender, instants, window_s) for lender in lenders]
    count, usual, variance = (np.stack(part) for part in zip(*habits, strict=True))
    some = count >= FEWEST
    k = some.sum(axis=0)
    able = np.flatnonzero(k >= fewest)
    some, k = some[:, able], k[able]
    mean = (usual[:, able] * some).sum(axis=0) / k
    within = (variance[:, able] * some).sum(axis=0) / k
    between = ((usual[:, able] - mean) ** 2 * some).sum(axis=0) / (k - 1)
    spread = np.sqrt(within + between * (1.0 + 1.0 / k))
    agreed = spread < ignorant_s
    delay[able[agreed]], sigma[able[agreed]] = mean[agreed], spread[agreed]
    return delay, sigma


def _habit(
    lender: Lender, instants: FloatArray, window_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Number of delays in the window before each instant, their mean, and variance about it."""
    end = np.searchsorted(lender.arrival, instants, side="right")
    begin = np.searchsorted(lender.arrival, instants - window_s)

    def past(series: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(series)])
        return np.asarray((total[end] - total[begin]) / np.maximum(end - begin, 1))

    mean = past(lender.delay)
    square = past(lender.delay**2 + lender.spread**2)
    return (end - begin).astype(float), mean, np.maximum(square - mean**2, 0.0)
