"""Most samples are ordinary: whole-array operations find them, and leave the others to a walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.validation.motion import SNAP, Motion, shortest

_CACHED_SAMPLES = 1 << 15


@dataclass(frozen=True, eq=False)
class Chunk:
    """Rows of a block, and where their findings go.

    Attributes
    ----------
    value : (n, n_channel)
        Samples; NaN where another check has ruled them out. [unit]
    time : (n, 1) or (n, n_channel)
        Time stamps in periods.
    reasons, statistic, threshold : (n, n_channel)
        Written in place; the last two may be None.
    scale : (n, 1) or (n, n_channel) or None
        Factor on σ at each sample, for a σ that follows the time of day.
    backward : (n, 1) or (n, n_channel) or None
        Samples that are older than one before them: checked, but never a reference.
    """

    value: FloatArray
    time: FloatArray
    reasons: npt.NDArray[np.int32]
    statistic: FloatArray | None = None
    threshold: FloatArray | None = None
    scale: FloatArray | None = None
    backward: BoolArray | None = None


class Sieve:
    """Finds the samples of a block that are ordinary if all before them are.

    Parameters
    ----------
    motion : Motion
    """

    def __init__(self, motion: Motion) -> None:
        extrapolates = np.isfinite(motion.extrapolation)
        self._gamma = np.where(
            extrapolates, motion.extrapolation_threshold, motion.increment_threshold
        )
        self._k = np.where(extrapolates, motion.k, 0.0)
        both = extrapolates & np.isfinite(motion.increment)
        self._second = np.where(both, motion.increment_threshold, np.inf) if both.any() else None
        self._turn = motion.turn
        self._last_time: FloatArray | None = None
        self._scratch: tuple[FloatArray, BoolArray] | None = None

    def samples(self, n: int) -> FloatArray:
        """Buffer for the samples of the next chunk after two rows of halo, (n + 2, n_channel)."""
        return self._work(n)[0]

    def _work(self, n: int) -> tuple[FloatArray, BoolArray]:
        # Fresh arrays of this size would cost a page fault every 512 samples.
        if self._scratch is None or len(self._scratch[1]) < n:
            width = len(self._k)
            self._scratch = (np.empty((n + 2, width)), np.empty((n, width), dtype=bool))
        extended, fine = self._scratch
        return extended[: n + 2], fine[:n]

    def fine(self, chunk: Chunk, value: FloatArray, lead: FloatArray) -> BoolArray:
        """Find the samples of a chunk, which stand in `samples`, that are ordinary.

        Parameters
        ----------
        chunk : Chunk
            Its statistic and threshold are written as if all its samples were ordinary.
        value, lead : (n_channel,)
            Reference before the chunk and the increment that led there, NaN where the channel is
            not ordinary. [unit]

        Returns
        -------
        (n, n_channel) array of bool
            Valid until the next chunk.
        """
        extended, fine = self._work(len(chunk.value))
        extended[1], extended[0] = value, value - lead
        self._compare(chunk, extended, lead, fine)
        self._mark_uneven(fine, chunk.time)
        self._last_time = np.array(chunk.time[-1:], copy=True)
        return fine

    def _compare(
        self, chunk: Chunk, extended: FloatArray, lead: FloatArray, fine: BoolArray
    ) -> None:
        """Mark the samples that lie inside their threshold."""
        n, n_channel = chunk.value.shape
        second = self._second
        turning = np.flatnonzero(np.isfinite(self._turn))
        # Slabs that stay in the processor's cache: the arithmetic is nothing beside the traffic.
        slab = max(1, _CACHED_SAMPLES // n_channel)
        change = np.empty((min(slab, n) + 1, n_channel))
        scores = np.empty((min(slab, n), n_channel))
        for start in range(0, n, slab):
            rows = slice(start, min(start + slab, n))
            size = rows.stop - rows.start
            moved, score = change[: size + 1], scores[:size]
            if chunk.statistic is not None:
                score = chunk.statistic[rows]
            scale = None if chunk.scale is None else chunk.scale[rows]
            limit = self._gamma[None, :] if scale is None else self._gamma * scale
            np.subtract(
                extended[start + 1 : rows.stop + 2], extended[start : rows.stop + 1], out=moved
            )
            if start == 0:
                moved[0] = lead
            for lane in turning:
                moved[:, lane] = shortest(moved[:, lane], self._turn[lane])
            # With k = 0 this still spreads a NaN behind, so that "ordinary" means one thing.
            np.multiply(moved[:-1], self._k, out=score)
            np.subtract(moved[1:], score, out=score)
            np.abs(score, out=score)
            np.less_equal(score, limit, out=fine[rows])
            if second is not None:
                naive = np.abs(moved[1:], out=moved[1:])
                # NaN has been dealt with above; here it must not count as exceeding.
                fine[rows] &= ~(naive > (second if scale is None else second * scale))
            if chunk.threshold is not None:
                chunk.threshold[rows] = limit

    def _mark_uneven(self, fine: BoolArray, time: FloatArray) -> None:
        """Take out the samples that do not come one period after the row before."""
        before = self._last_time
        if before is None:
            before = np.full((1, time.shape[1]), np.nan)
        elapsed = np.diff(np.vstack([before, time]), axis=0)
        uneven = ~(np.abs(elapsed - 1.0) <= SNAP)
        if time.shape[1] == 1:
            fine[np.flatnonzero(uneven[:, 0])] = False
        else:
            fine[uneven] = False
