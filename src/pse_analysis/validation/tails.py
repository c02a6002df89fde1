"""How far the residuals of a channel reach by themselves: their scale by the body and by the tail.

Load is heavy-tailed: a channel whose median residual is small may still jump every few hours. A
threshold that is a multiple of a median takes each of these jumps for an error.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from pse_analysis.arrays import FloatArray, IntArray

FEWEST_IN_TAIL = 40
"""Residuals below which nothing is said about their tail."""
MAD = 1.4826
"""σ of a normal law over its median absolute deviation."""
UPPER = (0.8, 0.975)
"""Quantiles through which the tail runs; errors among less than 1 in 40 do not move them."""
HEAVIEST = 1.0
"""Largest 1/k of the tail: 1 is an exponential law, 1/2 comes close to a normal one."""

MEMORY = 288
"""Residuals that quantiles are taken of: a day of five-minute steps has calm hours and others."""
RENEWAL = 8
"""Steps, and new residuals of a channel, that it takes at least before quantiles are taken."""
SHARE = 12
"""They are taken again when the steps since are one in so many of all, or of `MEMORY` if that is
less: so few residuals hardly move them.
"""


class Residuals(NamedTuple):
    """What m channels have left of |r|, and their scales.

    Attributes
    ----------
    kept : (m, MEMORY) ndarray
        The last |r| of each, the newest written over the oldest; inf where there is none yet.
    steps : int
        How many steps were written down.
    learnt, judged : (m,) ndarray of int
        How many residuals were, and how many of these the scale knows.
    scale : (m,) ndarray
        By body and tail; NaN before a channel had `RENEWAL` residuals.
    """

    kept: FloatArray
    steps: int
    learnt: IntArray
    judged: IntArray
    scale: FloatArray

    @classmethod
    def empty(cls, m: int) -> Residuals:
        """Of m channels of which nothing is known."""
        none = np.zeros(m, dtype=np.int64)
        return cls(np.full((m, MEMORY), np.inf), 0, none, none, np.full(m, np.nan))

    @property
    def patience(self) -> int:
        """Steps that may wait to be written down.

        The large array is copied then, so all channels are written at the same steps.
        """
        return max(RENEWAL, min(self.steps, MEMORY) // SHARE)

    def written(self, rows: FloatArray, factor: float) -> Residuals:
        """With |r| of k more steps (m, k), inf where none is learnt; a threshold is c scales."""
        new = np.isfinite(rows)
        at, step = np.nonzero(new)
        number = self.learnt[:, None] + np.cumsum(new, axis=1)
        kept = self.kept.copy()
        kept[at, (number[at, step] - 1) % MEMORY] = rows[at, step]
        steps, learnt = self.steps + rows.shape[1], number[:, -1]
        judged, taken = self.judged.copy(), self.scale.copy()
        due = np.flatnonzero(learnt - judged >= RENEWAL)
        if len(due):
            judged[due] = learnt[due]
            taken[due] = scale(kept[due], np.minimum(learnt[due], MEMORY), factor)
        return Residuals(kept, steps, learnt, judged, taken)


def scale(residuals: FloatArray, count: IntArray, factor: float) -> FloatArray:
    """Scale of absolute residuals for a threshold of c scales.

    Parameters
    ----------
    residuals : (m, n) ndarray
        |r| of m channels in any order; inf where there is none.
    count : (m,) ndarray of int
        How many of each there are, at least 1.
    factor : float
        c.

    Returns
    -------
    (m,) ndarray
        The larger of 1.4826 median |r| and a c-th of the residual that the channel exceeds as
        rarely as a normal law exceeds c σ, by a tail P(|r| > u) = exp(-(u/s)^k) through two upper
        quantiles. Both are σ where the residuals are normal (the latter within a tenth at c = 4).
    """
    ordered = np.sort(residuals, axis=1)
    row = np.arange(len(ordered))
    median = 0.5 * (ordered[row, (count - 1) // 2] + ordered[row, count // 2])
    low, high = (ordered[row, np.ceil(q * count).astype(np.int64) - 1] for q in UPPER)
    # u(p) ∝ (-log p)^(1/k), so two quantiles give 1/k.
    near, far = -np.log1p(-np.array(UPPER))
    beyond = -np.log(special.erfc(factor / np.sqrt(2.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        heavy = np.fmin(np.log(high / low) / np.log(far / near), HEAVIEST)
    tail = high * (beyond / far) ** heavy / factor
    return np.maximum(MAD * median, np.where(count >= FEWEST_IN_TAIL, tail, 0.0))
