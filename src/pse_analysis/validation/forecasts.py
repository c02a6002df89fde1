"""Forecasts of a channel from its last values, and which of them served it best of late."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray

SPAN = 4
"""Values that a forecast rests on."""
AHEAD = np.array([[-0.5, 0.0, 0.5, 1.0], [0.0, 0.0, 0.0, 1.0], [0.25, 0.25, 0.25, 0.25]])
"""Weights of the last four values in the next one: on their line, as the last one, as their mean.

√(1 + Σ w²) is √(1 + x'(X'X)⁻¹x) of the designs. (3, SPAN)
"""
GROWTH = np.sqrt(1.0 + (AHEAD**2).sum(axis=1))
"""σ of a forecast's residual over that of a sample. (3,)"""
RATE = 1 / 20
"""Weight of the newest residual in how well each forecast served."""


class Choice(NamedTuple):
    """The forecast of each of m channels.

    Attributes
    ----------
    scores : (3, m) ndarray
        Mean |r| of every forecast of late.
    weights : (SPAN, m) ndarray
        Of the last values in the forecast that has the least.
    growth : (m,) ndarray
        σ of its residual over that of a sample.
    """

    scores: FloatArray
    weights: FloatArray
    growth: FloatArray

    @classmethod
    def of(cls, scores: FloatArray) -> Choice:
        """The best by scores; the line where they are alike."""
        served = scores.argmin(axis=0)
        return cls(scores, np.ascontiguousarray(AHEAD[served].T), GROWTH[served])

    def forecast(self, values: FloatArray) -> FloatArray:
        """What is expected after values, of which the last rows are the newest. (m,)"""
        return np.asarray(np.add.reduce(self.weights * values[-SPAN:]))

    def told(self, pasts: FloatArray, z: FloatArray, present: BoolArray) -> Choice:
        """The choice after k more samples.

        Parameters
        ----------
        pasts : (k, L, m) ndarray
            Values before each.
        z : (k, m) ndarray
        present : (k, m) ndarray of bool
            Where there is one.
        """
        missed = np.abs(deviations(np.moveaxis(pasts, 1, 0), z))
        present = present & np.isfinite(missed[0])
        # Every sample takes the same share of what came before it: the newest counts most.
        since = np.cumsum(present[::-1], axis=0)[::-1]
        weight = np.where(present, RATE * (1.0 - RATE) ** (since - 1), 0.0)
        newer = np.add.reduce(weight * np.where(present, missed, 0.0), axis=1)
        return Choice.of(newer + (1.0 - RATE) ** since[0] * self.scores)

    def begun_again(self, where: BoolArray, run: FloatArray) -> Choice:
        """The choice if some channels know no more than a run of values (n, m)."""
        missed = [np.abs(deviations(run[:k], run[k])) for k in range(SPAN, len(run))]
        return Choice.of(np.where(where, np.mean(missed, axis=0), self.scores))


def deviations(values: FloatArray, z: FloatArray) -> FloatArray:
    """How far samples lie from every forecast of `AHEAD`, one small sum after the other.

    Parameters
    ----------
    values : (L, …) ndarray
        From old to new, `SPAN` at least.
    z : (…) ndarray

    Returns
    -------
    (3, …) ndarray
    """
    first, second, third, last = values[-SPAN:]
    return np.array(
        [
            z - (last + 0.5 * (third - first)),
            z - last,
            z - 0.25 * ((first + second) + (third + last)),
        ]
    )
