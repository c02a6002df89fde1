"""How far the residuals of a channel reach by themselves: their scale by the body and by the tail.

Load is heavy-tailed: a channel whose median residual is small may still jump every few hours. A
threshold that is a multiple of a median takes each of these jumps for an error.
"""

from __future__ import annotations

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
