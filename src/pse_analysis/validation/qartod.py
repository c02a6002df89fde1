"""Flags in the words of QARTOD, the scheme that peer quality-control libraries share.

1 good, 2 not evaluated, 3 suspect, 4 fail, 9 missing.
"""

from __future__ import annotations

import enum

import numpy as np
import numpy.typing as npt

from pse_analysis.vocabulary import Flag


class Qartod(enum.IntEnum):
    """The codes of QARTOD's primary flag."""

    GOOD = 1
    NOT_EVALUATED = 2
    SUSPECT = 3
    FAIL = 4
    MISSING = 9


_OF_FLAG = {
    Flag.GOOD: Qartod.GOOD,
    Flag.SUSPECT: Qartod.SUSPECT,
    Flag.BAD: Qartod.FAIL,
    Flag.MISSING: Qartod.MISSING,
}


def codes(flag: npt.ArrayLike, threshold: npt.ArrayLike | None = None) -> npt.NDArray[np.int8]:
    """QARTOD codes of `Flag` values.

    Parameters
    ----------
    flag : (n,) array_like of int
        Values of `Flag`.
    threshold : (n,) array_like, optional
        Threshold of the decisive check. A good sample without one was compared with nothing and
        is "not evaluated".

    Returns
    -------
    (n,) ndarray of int8
    """
    level = np.asarray(flag, dtype=np.int64)
    table = np.array([_OF_FLAG[Flag(i)] for i in range(len(Flag))], dtype=np.int8)
    out = table[level]
    if threshold is not None:
        out = np.where(
            (level == Flag.GOOD) & np.isnan(np.asarray(threshold, dtype=float)),
            np.int8(Qartod.NOT_EVALUATED),
            out,
        )
    return np.asarray(out, dtype=np.int8)
