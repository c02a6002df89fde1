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

import enum
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pse_analysis.validation.motion import SNAP, Motion, shortest
from pse_analysis.vocabulary import Reason

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

CHUNK_SAMPLES = 1 << 20
"""Samples worked on at once; what bounds the memory beside the results."""

_CACHED_SAMPLES = 1 << 15
_NOWHERE = -9.0
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


class _At(enum.IntEnum):
    """Columns of the state: the reference, the increment that led there, a pending step."""

    VALUE = 0
    TIME = 1
    ROW = 2
    LEAD = 3
    SPAN = 4
    LEAD_ROW = 5
    COUNT = 6
    STEP_VALUE = 7
    STEP_TIME = 8


def _unknown(n_channel: int) -> Array:
    """State of channels that have had no sample, (n_channel, 9)."""
    state = np.full((n_channel, len(_At)), np.nan)
    state[:, [_At.ROW, _At.LEAD_ROW]] = _NOWHERE
    state[:, _At.COUNT] = -1.0
    return state


def _ordinary(state: Array, row: Ints | float) -> Bools:
    """Whether the two rows before ``row`` are the reference and its predecessor."""
    return np.asarray(
        (state[:, _At.ROW] == row - 1)
        & (state[:, _At.LEAD_ROW] == row - 2)
        & (state[:, _At.SPAN] == 1.0)
        & (state[:, _At.COUNT] < 0.0)
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
    _state: Array = field(init=False)
    _row: int = field(init=False, default=0)
    _last_time: Array | None = field(init=False, default=None)
    _whole: bool = field(init=False, default=True)
    _scratch: tuple[Array, Bools] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        motion = self.motion
        self._state = _unknown(len(motion.k))
        self._extrapolates = np.isfinite(motion.extrapolation)
        self._both = self._extrapolates & np.isfinite(motion.increment)
        self._gamma = np.where(
            self._extrapolates, motion.extrapolation_threshold, motion.increment_threshold
        )
        self._k = np.where(self._extrapolates, motion.k, 0.0)
        agreement = np.minimum(motion.increment, motion.extrapolation)
        self._limits = np.column_stack(
            [
                motion.increment,
                motion.extrapolation,
                self._k,
                motion.one_step_variance,
                agreement,
                motion.confirm,
            ]
        )
        self._turns = bool(np.isfinite(motion.turn).any())
        # v(n) and its slope to the right of each lag; past the last one it never falls.
        self._n_lag = motion.structure.shape[1] - 1
        self._v = np.ascontiguousarray(motion.structure).ravel()
        rise = np.diff(motion.structure, axis=1)
        self._rise = np.hstack([rise, np.maximum(rise[:, -1:], 0.0)]).ravel()

    def samples(self, n: int) -> Array:
        """Buffer for the samples of the next chunk, (n, n_channel), NaN where ruled out."""
        return self._work(n)[0][2:]

    def _work(self, n: int) -> tuple[Array, Bools]:
        # Fresh arrays of this size would cost a page fault every 512 samples.
        if self._scratch is None or len(self._scratch[1]) < n:
            width = len(self.motion.k)
            self._scratch = (np.empty((n + 2, width)), np.empty((n, width), dtype=bool))
        extended, fine = self._scratch
        return extended[: n + 2], fine[:n]

    def step(self, chunk: Chunk) -> None:
        """Advance over a chunk, whose values stand in `samples`, and write what is found."""
        n, n_channel = chunk.value.shape
        if not n or not n_channel:
            return
        extended = self._work(n)[0]
        # Two rows of halo carry the references of ordinary channels into this chunk.
        ordinary = _ordinary(self._state, self._row)
        value, lead = self._state[:, _At.VALUE], self._state[:, _At.LEAD]
        extended[1] = np.where(ordinary, value, np.nan)
        extended[0] = np.where(ordinary, value - lead, np.nan)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            fine = self._sieve(chunk, extended, np.where(ordinary, lead, np.nan))
            self._mark_uneven(fine, chunk.time)
            self._walk(fine, extended, chunk)
        self._row += n
        self._last_time = np.array(chunk.time[-1:], copy=True)

    def _sieve(self, chunk: Chunk, extended: Array, lead: Array) -> Bools:
        """Which samples are inside their threshold if all before them are ordinary."""
        n, n_channel = chunk.value.shape
        fine = self._work(n)[1]
        second = None
        if self._both.any():
            second = np.where(self._both, self.motion.increment_threshold, np.inf)
        turning = np.flatnonzero(np.isfinite(self.motion.turn))
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
                moved[:, lane] = shortest(moved[:, lane], self.motion.turn[lane])
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
        whole = bool(np.all(np.rint(chunk.time) == chunk.time)) and self._whole
        self._whole = whole
        while True:
            alive = row < stop[lane]
            if not alive.all():
                lane, row = lane[alive], row[alive]
            if not len(lane):
                return
            state = self._decide(lane, row, chunk, whole)
            row = row + 1
            calm = np.flatnonzero(_ordinary(state, row + self._row))
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
        state = np.empty((len(lane), len(_At)))
        state[:, _At.VALUE] = extended[row + 1, lane]
        state[:, _At.LEAD] = self._shortest(lane, state[:, _At.VALUE] - extended[row, lane])
        state[:, _At.TIME] = _at(time, row - 1, lane)
        state[:, _At.ROW] = row - 1 + self._row
        state[:, _At.LEAD_ROW] = row - 2 + self._row
        state[:, _At.SPAN] = 1.0
        state[:, _At.COUNT] = -1.0
        self._state[lane] = state

    def _decide(self, lane: Ints, row: Ints, chunk: Chunk, whole: bool) -> Array:
        """Decide one sample of each given channel; the channels' state after it."""
        state = self._state[lane]
        x = chunk.value[row, lane]
        absent = x != x
        if absent.any():
            for table in (chunk.statistic, chunk.threshold):
                if table is not None:
                    table[row[absent], lane[absent]] = np.nan
        t = _at(chunk.time, row, lane)
        factor = None if chunk.scale is None else _at(chunk.scale, row, lane)
        older = None if chunk.backward is None else _at(chunk.backward, row, lane)
        increment, extrapolation, k, floor, agreement, confirm = self._limits[lane].T

        reference = state[:, _At.VALUE]
        change = self._shortest(lane, x - reference)
        elapsed = np.abs(t - state[:, _At.TIME])
        elapsed = elapsed if whole else _snapped(elapsed)
        predicted, error, variance = self._extrapolate(lane, state, elapsed, k, floor, older)
        moved = np.abs(change)
        surprise = np.abs(change - predicted)
        # A check that is not made has no finite threshold, and NaN is exceeded by nothing: neither
        # by a sample that is absent nor by the first one, which has no reference.
        plain = increment * np.sqrt(variance)
        sharp = extrapolation * np.sqrt(error)
        if factor is not None:
            plain, sharp = plain * factor, sharp * factor
        over_increment = moved > plain
        over_extrapolation = surprise > sharp
        flagged = over_increment | over_extrapolation

        bits = over_increment * np.int32(Reason.INCREMENT)
        bits += over_extrapolation * np.int32(Reason.EXTRAPOLATION)
        moves = ~(flagged | absent)
        waits = flagged
        if older is not None:
            moves, waits = moves & ~older, flagged & ~older
        if waits.any():
            accepted = self._confirm(
                lane, state, x, t, factor, waits, agreement, floor, confirm, whole
            )
            bits[accepted] = np.int32(Reason.STEP_ACCEPTED)
        chunk.reasons[row, lane] |= bits
        if chunk.statistic is not None or chunk.threshold is not None:
            by_extrapolation = self._extrapolates[lane] & (over_extrapolation | ~over_increment)
            if chunk.statistic is not None:
                chunk.statistic[row, lane] = np.where(by_extrapolation, surprise, moved)
            if chunk.threshold is not None:
                limit = np.where(by_extrapolation, sharp, plain)
                limit[change != change] = np.nan
                chunk.threshold[row, lane] = limit

        # Good samples become the reference.
        np.copyto(state[:, _At.LEAD_ROW], state[:, _At.ROW], where=moves)
        np.copyto(state[:, _At.ROW], row + float(self._row), where=moves)
        np.copyto(state[:, _At.VALUE], x, where=moves)
        np.copyto(state[:, _At.TIME], t, where=moves)
        np.copyto(state[:, _At.LEAD], change, where=moves)
        np.copyto(state[:, _At.SPAN], elapsed, where=moves)
        np.copyto(state[:, _At.COUNT], -1.0, where=moves)
        if waits.any():
            step = np.flatnonzero(accepted)
            state[step, _At.VALUE], state[step, _At.TIME] = x[step], t[step]
            state[step, _At.ROW], state[step, _At.LEAD_ROW] = row[step] + self._row, _NOWHERE
        self._state[lane] = state
        return state

    def _confirm(
        self,
        lane: Ints,
        state: Array,
        x: Array,
        t: Array,
        factor: Array | None,
        waits: Bools,
        agreement: Array,
        floor: Array,
        confirm: Array,
        whole: bool,
    ) -> Bools:
        """Whether flagged samples confirm a step, a level that flagged ones share; keeps count."""
        accepted = np.zeros(len(lane), dtype=bool)
        which = np.flatnonzero(waits)
        now, when = x[which], t[which]
        waited = np.abs(when - state[which, _At.STEP_TIME])
        waited = waited if whole else _snapped(waited)
        near = agreement[which] * np.sqrt(self._variance(lane[which], waited, floor[which]))
        if factor is not None:
            near = near * factor[which]
        led = self._shortest(lane[which], now - state[which, _At.STEP_VALUE])
        before = state[which, _At.COUNT]
        agrees = (before >= 0.0) & (np.abs(led) <= near)
        count = np.where(agrees, before + 1.0, 0.0)
        enough = agrees & (count >= confirm[which])
        accepted[which] = enough
        state[which, _At.COUNT] = np.where(enough, -1.0, count)
        state[which, _At.STEP_VALUE] = now
        state[which, _At.STEP_TIME] = when
        state[which, _At.LEAD] = np.where(enough, led, state[which, _At.LEAD])
        state[which, _At.SPAN] = np.where(enough, waited, state[which, _At.SPAN])
        return accepted

    def _shortest(self, lane: Ints, change: Array) -> Array:
        return shortest(change, self.motion.turn[lane]) if self._turns else change

    def _variance(self, lane: Ints, periods: Array, floor: Array) -> Array:
        """v(n) at real n ≥ 1, linear between whole lags and beyond the last; (n,) [unit²]."""
        n = np.fmax(periods, 1.0)
        low = np.minimum(n, self._n_lag).astype(np.int64)
        index = lane * (self._n_lag + 1) + low
        v = self._v[index] + (n - low) * self._rise[index]
        # Estimated v(n) may dip; over a gap nothing becomes more certain than over one period.
        return np.asarray(np.maximum(v, floor))

    def _extrapolate(
        self,
        lane: Ints,
        state: Array,
        elapsed: Array,
        k_one: Array,
        floor: Array,
        older: Bools | None,
    ) -> tuple[Array | float, Array, Array]:
        """Predicted change since the reference, the variance of its error, and v(elapsed)."""
        lead, span = state[:, _At.LEAD], state[:, _At.SPAN]
        usable = (k_one != 0.0) & (lead == lead)
        if older is not None:
            usable &= ~older
        if not usable.any():
            variance = self._variance(lane, elapsed, floor)
            return 0.0, variance, variance
        n = len(lane)
        three = self._variance(
            np.concatenate([lane, lane, lane]),
            np.concatenate([elapsed, span, elapsed + span]),
            np.concatenate([floor, floor, floor]),
        )
        variance, v_span, v_both = three[:n], three[n : 2 * n], three[2 * n :]
        # v(span) is 0 only where nothing ever changes; k is then of no account.
        k = 0.5 * (v_both - variance - v_span) / np.where(v_span > 0.0, v_span, np.inf)
        one = (elapsed == 1.0) & (span == 1.0)
        k = np.where(one, k_one, k)
        error = np.where(one, floor, np.maximum(variance - k * k * v_span, floor))
        # Within less than a period only part of the predicted change can have happened.
        predicted = k * lead * np.minimum(elapsed, 1.0)
        return np.where(usable, predicted, 0.0), np.where(usable, error, variance), variance


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
