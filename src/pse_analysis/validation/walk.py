"""Follow many channels through time: each sample against what the last good ones predict.

One kernel serves the first-increment and the extrapolation check, on a block of (time × channel)
samples. Almost all samples are ordinary: their two predecessors are good, one period apart, and
their statistic lies inside its threshold. These are decided by whole-array operations. The rest
(around a spike, a gap, a step) are walked sample by sample, all channels in lockstep, until the
channel is ordinary again.

Notes
-----
Eqs. (1), (12), (14) of [anishchenko2018] with k₀ = 1, referred to the last *good* samples, so that
the good sample after a spike is not flagged with it. With v(n) the variance of the increment over n
periods, the increment D over g periods that ends at the reference predicts the one over the m
periods that follow as K·D, with K = [v(m+g) − v(m) − v(g)] / 2v(g) and error variance
v(m) − K²·v(g). At m = g = 1 these are K = ρ₁ and σ²(1 − ρ₁²).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pse_analysis.validation.motion import SNAP, Motion, times_sigma
from pse_analysis.vocabulary import Reason

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

CHUNK_SAMPLES = 1 << 20
"""Samples worked on at once; what bounds the memory beside the results."""

_NOWHERE = -9
_Scalar = TypeVar("_Scalar", bound=np.generic)


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

    value: Array
    time: Array
    reasons: npt.NDArray[np.int32]
    statistic: Array | None = None
    threshold: Array | None = None
    scale: Array | None = None
    backward: Bools | None = None


class _Lanes:
    """Where each channel stands: its reference, the increment that led there, a pending step."""

    def __init__(self, n: int) -> None:
        self.value = np.full(n, np.nan)
        self.time = np.full(n, np.nan)
        self.row = np.full(n, _NOWHERE)
        self.lead = np.full(n, np.nan)
        self.span = np.full(n, np.nan)
        self.lead_row = np.full(n, _NOWHERE)
        self.count = np.full(n, -1)
        self.step_value = np.full(n, np.nan)
        self.step_time = np.full(n, np.nan)

    def ordinary(self, lane: Ints, row: Ints | int) -> Bools:
        """Whether the two rows before ``row`` are the reference and its predecessor."""
        return np.asarray(
            (self.row[lane] == row - 1)
            & (self.lead_row[lane] == row - 2)
            & (self.span[lane] == 1.0)
            & (self.count[lane] < 0)
        )


@dataclass(eq=False)
class Walk:
    """Follows one block of channels, chunk after chunk of rows.

    Parameters
    ----------
    motion : Motion
    n_row : (n_channel,) array of int or None
        Rows that belong to each channel, where channels are padded to a common length.
    """

    motion: Motion
    n_row: Ints | None = None
    _lanes: _Lanes = field(init=False)
    _row: int = field(init=False, default=0)
    _last_time: Array | None = field(init=False, default=None)
    _scratch: tuple[Array, Array, Array, Bools] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        motion = self.motion
        self._lanes = _Lanes(len(motion.k))
        self._extrapolates = np.isfinite(motion.extrapolation)
        self._both = self._extrapolates & np.isfinite(motion.increment)
        self._gamma = np.where(
            self._extrapolates, motion.extrapolation_threshold, motion.increment_threshold
        )
        self._k = np.where(self._extrapolates, motion.k, 0.0)
        self._floor = motion.one_step_variance
        self._agreement = np.minimum(motion.increment, motion.extrapolation)
        # v(n) and its slope to the right of each lag; past the last one it never falls.
        self._n_lag = motion.structure.shape[1] - 1
        self._v = np.ascontiguousarray(motion.structure).ravel()
        rise = np.diff(motion.structure, axis=1)
        self._rise = np.hstack([rise, np.maximum(rise[:, -1:], 0.0)]).ravel()

    def samples(self, n: int) -> Array:
        """Buffer for the samples of the next chunk, (n, n_channel), NaN where ruled out."""
        return self._work(n)[0][2:]

    def _work(self, n: int) -> tuple[Array, Array, Array, Bools]:
        # Fresh arrays of this size would cost a page fault every 512 samples.
        if self._scratch is None or len(self._scratch[1]) <= n:
            width = len(self.motion.k)
            self._scratch = (
                np.empty((n + 2, width)),
                np.empty((n + 1, width)),
                np.empty((n, width)),
                np.empty((n, width), dtype=bool),
            )
        extended, change, score, fine = self._scratch
        return extended[: n + 2], change[: n + 1], score[:n], fine[:n]

    def step(self, chunk: Chunk) -> None:
        """Advance over a chunk, whose values stand in `samples`, and write what is found."""
        n, n_channel = chunk.value.shape
        if not n or not n_channel:
            return
        extended = self._work(n)[0]
        # Two rows of halo carry the references of ordinary channels into this chunk.
        lanes = self._lanes
        ordinary = lanes.ordinary(np.arange(n_channel), self._row)
        extended[1] = np.where(ordinary, lanes.value, np.nan)
        extended[0] = np.where(ordinary, lanes.value - lanes.lead, np.nan)
        with np.errstate(over="ignore", invalid="ignore"):
            fine = self._sieve(chunk, extended, np.where(ordinary, lanes.lead, np.nan))
            self._mark_uneven(fine, chunk.time)
            self._walk(fine, extended, chunk)
        self._row += n
        self._last_time = np.array(chunk.time[-1:], copy=True)

    def _sieve(self, chunk: Chunk, extended: Array, lead: Array) -> Bools:
        """Which samples are inside their threshold if all before them are ordinary."""
        scale = chunk.scale
        limit = self._gamma[None, :] if scale is None else self._gamma * scale
        _, change, score, fine = self._work(len(chunk.value))
        if chunk.statistic is not None:
            score = chunk.statistic
        np.subtract(extended[1:], extended[:-1], out=change)
        change[0] = lead
        naive = change[1:]
        # With k = 0 this still spreads a NaN behind, so that "ordinary" means one thing.
        np.multiply(change[:-1], self._k, out=score)
        np.subtract(naive, score, out=score)
        np.abs(score, out=score)
        np.less_equal(score, limit, out=fine)
        if self._both.any():
            second = self.motion.increment_threshold[None, self._both]
            if scale is not None:
                second = second * (scale if scale.shape[1] == 1 else scale[:, self._both])
            fine[:, self._both] &= np.abs(naive[:, self._both]) <= second
        if chunk.threshold is not None:
            chunk.threshold[...] = limit
        return fine

    def _mark_uneven(self, fine: Bools, time: Array) -> None:
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

    def _walk(self, fine: Bools, extended: Array, chunk: Chunk) -> None:
        """Walk every channel from each sample that is not fine until it is ordinary again."""
        n, n_channel = chunk.value.shape
        lanes = self._lanes
        stop = np.full(n_channel, n)
        if self.n_row is not None:
            stop = np.clip(self.n_row - self._row, 0, n)
        at_row, at_lane = np.divmod(np.flatnonzero(~fine), n_channel)
        events = np.append(np.sort(at_lane * n + at_row), n * n_channel)
        lane = np.arange(n_channel)
        # A channel that is not ordinary at the first row has a NaN halo, hence an event there.
        row = _next_event(events, lane, np.zeros(n_channel, dtype=np.int64), n)
        later = row > 0
        self._enter(lane[later], row[later], extended, chunk.time)
        while True:
            alive = row < stop[lane]
            if not alive.all():
                lane, row = lane[alive], row[alive]
            if not len(lane):
                return
            self._decide(lane, row, chunk)
            row = row + 1
            calm = np.flatnonzero(lanes.ordinary(lane, row + self._row))
            if len(calm):
                ahead = _next_event(events, lane[calm], row[calm], n)
                jumps = ahead > row[calm]
                row[calm] = ahead
                moved = calm[jumps]
                self._enter(lane[moved], row[moved], extended, chunk.time)

    def _enter(self, lane: Ints, row: Ints, extended: Array, time: Array) -> None:
        """Set the state of channels that reach ``row`` in the ordinary way."""
        if not len(lane):
            return
        lanes = self._lanes
        value, before = extended[row + 1, lane], extended[row, lane]
        lanes.value[lane] = value
        lanes.lead[lane] = value - before
        lanes.time[lane] = _at(time, row - 1, lane)
        lanes.row[lane] = row - 1 + self._row
        lanes.lead_row[lane] = row - 2 + self._row
        lanes.span[lane] = 1.0
        lanes.count[lane] = -1

    def _decide(self, lane: Ints, row: Ints, chunk: Chunk) -> None:
        """Decide one sample of each given channel and move the channel's state past it."""
        lanes, motion = self._lanes, self.motion
        x = chunk.value[row, lane]
        present = x == x
        if not present.all():
            absent = ~present
            for table in (chunk.statistic, chunk.threshold):
                if table is not None:
                    table[row[absent], lane[absent]] = np.nan
            lane, row, x = lane[present], row[present], x[present]
        t = _at(chunk.time, row, lane)
        factor = None if chunk.scale is None else _at(chunk.scale, row, lane)
        older = None if chunk.backward is None else _at(chunk.backward, row, lane)

        reference = lanes.value[lane]
        change = x - reference
        elapsed = _snapped(np.abs(t - lanes.time[lane]))
        variance = self._variance(lane, elapsed)
        predicted, error = self._extrapolate(lane, elapsed, variance, older)
        surprise = np.abs(change - predicted)
        plain = times_sigma(motion.increment[lane], np.sqrt(variance))
        sharp = times_sigma(motion.extrapolation[lane], np.sqrt(error))
        if factor is not None:
            plain, sharp = plain * factor, sharp * factor
        # Without a reference the change is NaN, which exceeds nothing: the first sample is taken.
        over_increment = np.abs(change) > plain
        over_extrapolation = surprise > sharp
        flagged = over_increment | over_extrapolation

        accepted, count, waited = self._confirm(lane, x, t, factor, flagged, older)
        bits = over_increment * np.int32(Reason.INCREMENT)
        bits += over_extrapolation * np.int32(Reason.EXTRAPOLATION)
        bits[accepted] = np.int32(Reason.STEP_ACCEPTED)
        chunk.reasons[row, lane] |= bits
        by_extrapolation = self._extrapolates[lane] & (over_extrapolation | ~over_increment)
        if chunk.statistic is not None:
            chunk.statistic[row, lane] = np.where(by_extrapolation, surprise, np.abs(change))
        if chunk.threshold is not None:
            limit = np.where(by_extrapolation, sharp, plain)
            limit[reference != reference] = np.nan
            chunk.threshold[row, lane] = limit
        self._move(lane, row, x, t, change, elapsed, flagged, accepted, count, waited, older)

    def _confirm(
        self,
        lane: Ints,
        x: Array,
        t: Array,
        factor: Array | None,
        flagged: Bools,
        older: Bools | None,
    ) -> tuple[Bools, Ints, Array]:
        """Whether a flagged sample confirms a step: a level that flagged samples share."""
        lanes = self._lanes
        accepted = np.zeros(len(lane), dtype=bool)
        count = np.zeros(len(lane), dtype=np.int64)
        waited = np.ones(len(lane))
        asks = flagged & (lanes.count[lane] >= 0)
        if older is not None:
            asks &= ~older
        which = np.flatnonzero(asks)
        if len(which):
            at = lane[which]
            wait = _snapped(np.abs(t[which] - lanes.step_time[at]))
            near = times_sigma(self._agreement[at], np.sqrt(self._variance(at, wait)))
            if factor is not None:
                near = near * factor[which]
            agrees = np.abs(x[which] - lanes.step_value[at]) <= near
            count[which] = np.where(agrees, lanes.count[at] + 1, 0)
            accepted[which] = agrees & (count[which] >= self.motion.confirm[at])
            waited[which] = wait
        return accepted, count, waited

    def _move(
        self,
        lane: Ints,
        row: Ints,
        x: Array,
        t: Array,
        change: Array,
        elapsed: Array,
        flagged: Bools,
        accepted: Bools,
        count: Ints,
        waited: Array,
        older: Bools | None,
    ) -> None:
        """Good samples become the reference, flagged ones the level a step might have."""
        lanes = self._lanes
        moves, waits = ~flagged | accepted, flagged & ~accepted
        if older is not None:
            moves, waits = moves & ~older, waits & ~older
        if accepted.any():
            change = np.where(accepted, x - lanes.step_value[lane], change)
            elapsed = np.where(accepted, waited, elapsed)
        at = lane[moves]
        lanes.lead_row[at] = np.where(accepted[moves], _NOWHERE, lanes.row[at])
        lanes.value[at] = x[moves]
        lanes.time[at] = t[moves]
        lanes.row[at] = row[moves] + self._row
        lanes.lead[at] = change[moves]
        lanes.span[at] = elapsed[moves]
        lanes.count[at] = -1
        at = lane[waits]
        lanes.count[at] = count[waits]
        lanes.step_value[at] = x[waits]
        lanes.step_time[at] = t[waits]

    def _variance(self, lane: Ints, periods: Array) -> Array:
        """v(n) at real n ≥ 1, linear between whole lags and beyond the last; (n,) [unit²]."""
        n = np.fmax(periods, 1.0)
        np.minimum(n, 1e12, out=n)
        low = np.minimum(n, self._n_lag).astype(np.int64)
        index = lane * (self._n_lag + 1) + low
        v = self._v[index] + (n - low) * self._rise[index]
        # Estimated v(n) may dip; over a gap nothing becomes more certain than over one period.
        return np.asarray(np.maximum(v, self._floor[lane]))

    def _extrapolate(
        self, lane: Ints, elapsed: Array, variance: Array, older: Bools | None
    ) -> tuple[Array, Array]:
        """Predicted change since the reference and the variance of its error; both (n,)."""
        lanes = self._lanes
        k_one = self._k[lane]
        lead, span = lanes.lead[lane], lanes.span[lane]
        usable = (k_one != 0.0) & (lead == lead)
        if older is not None:
            usable &= ~older
        if not usable.any():
            return np.zeros(len(lane)), variance
        floor = self._floor[lane]
        v_span = self._variance(lane, span)
        covariance = 0.5 * (self._variance(lane, elapsed + span) - variance - v_span)
        with np.errstate(divide="ignore"):
            k = np.where(v_span > 0.0, covariance / v_span, 0.0)
        one = (elapsed == 1.0) & (span == 1.0)
        k = np.where(one, k_one, k)
        error = np.where(one, floor, np.maximum(variance - k * k * v_span, floor))
        # Within less than a period only part of the predicted change can have happened.
        predicted = k * lead * np.minimum(elapsed, 1.0)
        return np.where(usable, predicted, 0.0), np.where(usable, error, variance)


def _at(table: npt.NDArray[_Scalar], row: Ints, lane: Ints) -> npt.NDArray[_Scalar]:
    return np.asarray(table[row, 0] if table.shape[1] == 1 else table[row, lane])


def _snapped(periods: Array) -> Array:
    whole = np.rint(periods)
    near = (np.abs(periods - whole) <= SNAP) & (whole >= 1.0)
    return np.asarray(np.where(near, whole, periods))


def _next_event(events: Ints, lane: Ints, row: Ints, n: int) -> Ints:
    """First event of each lane at or after its row; n where there is none in the chunk."""
    start = lane * n
    return np.asarray(np.minimum(events[np.searchsorted(events, start + row)] - start, n))
