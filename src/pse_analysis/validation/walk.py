"""Follow many channels through time: each sample against what the last good ones predict.

One kernel serves the first-increment check, eq. (1) of [anishchenko2018], and the extrapolation
check, `pse_analysis.validation.prediction`, on a block of (time × channel) samples. Almost all
samples are ordinary: their two predecessors are good, one period apart, and their statistic lies
inside its threshold. A sieve (`pse_analysis.validation.sieve`) finds those. The rest (around a
spike, a gap, a step) are walked sample by sample, all channels in lockstep, until the channel is
ordinary again.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.validation.motion import SNAP, Motion
from pse_analysis.validation.prediction import Prediction
from pse_analysis.validation.sieve import Chunk, Sieve
from pse_analysis.vocabulary import Reason

_NOWHERE = -9.0
_Scalar = TypeVar("_Scalar", bound=np.generic)


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


def _unknown(n_channel: int) -> FloatArray:
    """State of channels that have had no sample, (n_channel, 9)."""
    state = np.full((n_channel, len(_At)), np.nan)
    state[:, [_At.ROW, _At.LEAD_ROW]] = _NOWHERE
    state[:, _At.COUNT] = -1.0
    return state


def _ordinary(state: FloatArray, row: IntArray | float) -> BoolArray:
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
    n_row: IntArray | None = None
    _state: FloatArray = field(init=False)
    _row: int = field(init=False, default=0)
    _whole: bool = field(init=False, default=True)

    def __post_init__(self) -> None:
        motion = self.motion
        self._state = _unknown(len(motion.k))
        self._sieve = Sieve(motion)
        self._prediction = Prediction(motion)
        self._extrapolates = np.isfinite(motion.extrapolation)
        self._limits = np.column_stack(
            [
                motion.increment,
                motion.extrapolation,
                np.where(self._extrapolates, motion.k, 0.0),
                motion.one_step_variance,
                np.minimum(motion.increment, motion.extrapolation),
                motion.confirm,
            ]
        )

    def samples(self, n: int) -> FloatArray:
        """Buffer for the samples of the next chunk, (n, n_channel), NaN where ruled out."""
        return self._sieve.samples(n)[2:]

    def step(self, chunk: Chunk) -> None:
        """Advance over a chunk, whose values stand in `samples`, and write what is found."""
        n, n_channel = chunk.value.shape
        if not n or not n_channel:
            return
        # Two rows of halo carry the references of ordinary channels into this chunk.
        ordinary = _ordinary(self._state, self._row)
        value, lead = (
            np.where(ordinary, self._state[:, column], np.nan) for column in (_At.VALUE, _At.LEAD)
        )
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            fine = self._sieve.fine(chunk, value, lead)
            self._walk(fine, self._sieve.samples(n), chunk)
        self._row += n

    def _walk(self, fine: BoolArray, extended: FloatArray, chunk: Chunk) -> None:
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

    def _enter(self, lane: IntArray, row: IntArray, extended: FloatArray, time: FloatArray) -> None:
        """Set the state of channels that reach ``row`` in the ordinary way."""
        if not len(lane):
            return
        state = np.empty((len(lane), len(_At)))
        state[:, _At.VALUE] = extended[row + 1, lane]
        state[:, _At.LEAD] = self._prediction.shortest(
            lane, state[:, _At.VALUE] - extended[row, lane]
        )
        state[:, _At.TIME] = _at(time, row - 1, lane)
        state[:, _At.ROW] = row - 1 + self._row
        state[:, _At.LEAD_ROW] = row - 2 + self._row
        state[:, _At.SPAN] = 1.0
        state[:, _At.COUNT] = -1.0
        self._state[lane] = state

    def _decide(self, lane: IntArray, row: IntArray, chunk: Chunk, whole: bool) -> FloatArray:
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
        change = self._prediction.shortest(lane, x - reference)
        elapsed = np.abs(t - state[:, _At.TIME])
        elapsed = elapsed if whole else _snapped(elapsed)
        predicted, error, variance = self._prediction.extrapolate(
            lane, state[:, _At.LEAD], state[:, _At.SPAN], elapsed, k, floor, older
        )
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
        lane: IntArray,
        state: FloatArray,
        x: FloatArray,
        t: FloatArray,
        factor: FloatArray | None,
        waits: BoolArray,
        agreement: FloatArray,
        floor: FloatArray,
        confirm: FloatArray,
        whole: bool,
    ) -> BoolArray:
        """Whether flagged samples confirm a step, a level that flagged ones share; keeps count."""
        accepted = np.zeros(len(lane), dtype=bool)
        which = np.flatnonzero(waits)
        now, when = x[which], t[which]
        waited = np.abs(when - state[which, _At.STEP_TIME])
        waited = waited if whole else _snapped(waited)
        near = agreement[which] * np.sqrt(
            self._prediction.variance(lane[which], waited, floor[which])
        )
        if factor is not None:
            near = near * factor[which]
        led = self._prediction.shortest(lane[which], now - state[which, _At.STEP_VALUE])
        before = state[which, _At.COUNT]
        agrees = (before >= 0.0) & (np.abs(led) <= near)
        same = (now == state[which, _At.STEP_VALUE]) & ~self.motion.repeats[lane[which]]
        count = np.where(agrees, before + ~same, 0.0)
        enough = agrees & ~same & (count >= confirm[which])
        accepted[which] = enough
        state[which, _At.COUNT] = np.where(enough, -1.0, count)
        state[which, _At.STEP_VALUE] = now
        state[which, _At.STEP_TIME] = when
        state[which, _At.LEAD] = np.where(enough, led, state[which, _At.LEAD])
        state[which, _At.SPAN] = np.where(enough, waited, state[which, _At.SPAN])
        return accepted


def _at(table: npt.NDArray[_Scalar], row: IntArray, lane: IntArray) -> npt.NDArray[_Scalar]:
    return np.asarray(table[row, 0] if table.shape[1] == 1 else table[row, lane])


def _snapped(periods: FloatArray) -> FloatArray:
    whole = np.rint(periods)
    near = (np.abs(periods - whole) <= SNAP) & (whole >= 1.0)
    return np.asarray(np.where(near, whole, periods))


def _next_event(events: IntArray, lane: IntArray, row: IntArray, n: int) -> IntArray:
    """First event of each lane at or after its row; n where there is none in the chunk."""
    start = lane * n
    return np.asarray(np.minimum(events[np.searchsorted(events, start + row)] - start, n))
