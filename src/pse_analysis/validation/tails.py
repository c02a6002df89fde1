"""How far the residuals of a channel reach by themselves: their scale by the body and by the tail.

Load is heavy-tailed: a channel whose median residual is small may still jump every few hours. A
threshold that is a multiple of a median takes each of these jumps for an error.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import special

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

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
"""Steps after which quantiles are taken for the first time, and again at least."""
SHARE = 12
"""They are taken again when the steps since are one in so many of all, or of `MEMORY` if that is
less: so few residuals hardly move them.
"""


class Residuals(NamedTuple):
    """What m channels have left of |r|, and their scales; steps add to it.

    They are written down, and scales taken again, at the same steps for all channels: the large
    array is then copied once for all of them, and the other steps hand it on.

    Attributes
    ----------
    recent : tuple of (m,) ndarray
        |r| of the steps since they were last written down; inf where nothing was learnt.
    kept : (m, MEMORY) ndarray
        Those before, the newest written over the oldest; inf where there is none yet.
    steps : int
        How many steps were written down.
    learnt, judged : (m,) ndarray of int
        How many residuals were, and how many of these the scale knows.
    scale : (m,) ndarray
        By body and tail; NaN before a channel had `RENEWAL` residuals.
    """

    recent: tuple[FloatArray, ...]
    kept: FloatArray
    steps: int
    learnt: IntArray
    judged: IntArray
    scale: FloatArray

    @classmethod
    def empty(cls, m: int) -> Residuals:
        """Of m channels of which nothing is known."""
        none = np.zeros(m, dtype=np.int64)
        return cls((), np.full((m, MEMORY), np.inf), 0, none, none, np.full(m, np.nan))

    def with_newest(self, newest: FloatArray, factor: float) -> Residuals:
        """With the |r| of one more step, inf where none is learnt; a threshold is c scales."""
        recent = (*self.recent, newest)
        if len(recent) < max(RENEWAL, min(self.steps, MEMORY) // SHARE):
            return self._replace(recent=recent)
        steps = self.steps + len(recent)
        rows = np.array(recent).T
        new = np.isfinite(rows)
        at, step = np.nonzero(new)
        number = self.learnt[:, None] + np.cumsum(new, axis=1)
        kept = self.kept.copy()
        kept[at, (number[at, step] - 1) % MEMORY] = rows[at, step]
        learnt = number[:, -1]
        due = np.flatnonzero(learnt - self.judged >= RENEWAL)
        if not len(due):
            return self._replace(recent=(), kept=kept, steps=steps, learnt=learnt)
        judged, taken = self.judged.copy(), self.scale.copy()
        judged[due] = learnt[due]
        taken[due] = scale(kept[due], np.minimum(learnt[due], MEMORY), factor)
        return Residuals((), kept, steps, learnt, judged, taken)


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
