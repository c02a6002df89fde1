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

import numpy as np
import numpy.typing as npt

from pse_analysis.vocabulary import Reason

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

SNAP = 0.25
"""Elapsed times within a quarter period of n periods count as n: jitter is not a change of rate."""

CHUNK_SAMPLES = 1 << 19
"""Samples worked on at once; what bounds the memory beside the results."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What counts as an ordinary change, per channel (arrays of length n_channel).

    Attributes
    ----------
    structure : (n_channel, n_lag + 1)
        v(n), variance of the good increment over n periods, v(0) = 0; beyond the last lag it
        grows as between the last two. [unit²]
    k : (n_channel,)
        Coefficient of the last increment in the one-step extrapolation; 0 is "no change".
    increment : (n_channel,)
        Threshold of the first-increment check over its σ = √v(1); inf where it is not made.
    extrapolation : (n_channel,)
        Threshold of the extrapolation check over the σ of its error; inf where it is not made.
    confirm : (n_channel,)
        Samples that must agree with a flagged one before the step is accepted.
    """

    structure: Array
    k: Array
    increment: Array
    extrapolation: Array
    confirm: Ints

    def __post_init__(self) -> None:
        n = len(self.structure)
        for name in ("k", "increment", "extrapolation", "confirm"):
            if getattr(self, name).shape != (n,):
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}: expected ({n},), "
                    "one entry per channel"
                )

    @property
    def increment_threshold(self) -> Array:
        """γ of the first-increment check over one period, (n_channel,). [unit]"""
        return _product(self.increment, np.sqrt(self.structure[:, 1]))

    @property
    def extrapolation_threshold(self) -> Array:
        """γ of the extrapolation check over one period, (n_channel,). [unit]"""
        return _product(self.extrapolation, np.sqrt(self.one_step_variance))

    @property
    def one_step_variance(self) -> Array:
        """σ²(1 − 2kρ₁ + k²) for the k in use, (n_channel,). [unit²]"""
        v1, v2 = self.structure[:, 1], self.structure[:, 2]
        return np.maximum(v1 * (1.0 + self.k**2) - self.k * (v2 - 2.0 * v1), 0.0)


def given(
    threshold: npt.ArrayLike, n_channel: int, confirm: int | npt.ArrayLike = 2, n_lag: int = 2
) -> Motion:
    """Motion of a stated first-increment threshold per period, growing as √m over m periods.

    Parameters
    ----------
    threshold : float or (n_channel,)
        γ of eq. (1). [unit]
    """
    gamma = np.broadcast_to(np.asarray(threshold, dtype=float), (n_channel,))
    return Motion(
        structure=np.square(gamma)[:, None] * np.arange(n_lag + 1.0)[None, :],
        k=np.zeros(n_channel),
        increment=np.ones(n_channel),
        extrapolation=np.full(n_channel, np.inf),
        confirm=np.broadcast_to(np.asarray(confirm, dtype=np.int64), (n_channel,)).copy(),
    )


@dataclass(eq=False)
class _Lanes:
    """Where each channel stands: its reference, the increment that led there, a pending step."""

    n: int
    value: Array = field(init=False)
    time: Array = field(init=False)
    row: Ints = field(init=False)
    lead: Array = field(init=False)
    span: Array = field(init=False)
    lead_row: Ints = field(init=False)
    count: Ints = field(init=False)
    step_value: Array = field(init=False)
    step_time: Array = field(init=False)

    def __post_init__(self) -> None:
        self.value = np.full(self.n, np.nan)
        self.time = np.full(self.n, np.nan)
        self.row = np.full(self.n, -9)
        self.lead = np.full(self.n, np.nan)
        self.span = np.full(self.n, np.nan)
        self.lead_row = np.full(self.n, -9)
        self.count = np.full(self.n, -1)
        self.step_value = np.full(self.n, np.nan)
        self.step_time = np.full(self.n, np.nan)

    def ordinary(self, lanes: Ints, row: Ints) -> Bools:
        """Whether the two rows before ``row`` are the reference and its predecessor."""
        return np.asarray(
            (self.count[lanes] < 0)
            & (self.row[lanes] == row - 1)
            & (self.lead_row[lanes] == row - 2)
            & (self.span[lanes] == 1.0)
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

    def __post_init__(self) -> None:
        self._lanes = _Lanes(len(self.motion.k))

    def step(
        self,
        value: Array,
        time: Array,
        scale: Array | None,
        reasons: npt.NDArray[np.int32],
        statistic: Array | None,
        threshold: Array | None,
        backward: Bools | None = None,
    ) -> None:
        """Advance over a chunk of rows and write what was found into the output arrays.

        Parameters
        ----------
        value : (n, n_channel)
            Samples; NaN where another check has ruled them out. [unit]
        time : (n, 1) or (n, n_channel)
            Time stamps in periods.
        scale : (n, 1) or (n, n_channel) or None
            Factor on σ at each sample, for a σ that follows the time of day.
        reasons, statistic, threshold : (n, n_channel)
            Written in place; the last two may be None.
        backward : (n, 1) or (n, n_channel) or None
            Samples that are older than one before them: checked, but never a reference.
        """
        n, n_channel = value.shape
        motion, lanes = self.motion, self._lanes
        first = self._row
        use_extrapolation = np.isfinite(motion.extrapolation)
        both = use_extrapolation & np.isfinite(motion.increment)
        motion_limit = np.where(
            use_extrapolation, motion.extrapolation_threshold, motion.increment_threshold
        )

        # Two rows of halo carry the references of ordinary channels into this chunk.
        extended = np.empty((n + 2, n_channel))
        extended[2:] = value
        ordinary = lanes.ordinary(np.arange(n_channel), np.full(n_channel, first))
        extended[1] = np.where(ordinary, lanes.value, np.nan)
        extended[0] = np.where(ordinary, lanes.value - lanes.lead, np.nan)

        with np.errstate(over="ignore", invalid="ignore"):
            change = np.diff(extended, axis=0)
            change[0] = np.where(ordinary, lanes.lead, np.nan)
            naive = change[1:]
            limit = motion_limit[None, :] if scale is None else motion_limit * scale
            if use_extrapolation.any():
                score = change[:-1] * np.where(use_extrapolation, motion.k, 0.0)
                np.subtract(naive, score, out=score)
                np.abs(score, out=score)
                fine = score <= limit
            else:
                score = np.abs(naive)
                fine = score <= limit
                # Both samples behind must be good here too, so that "ordinary" means one thing.
                fine[~(change[:-1] == change[:-1])] = False
            if both.any():
                second = motion.increment_threshold[None, both]
                if scale is not None:
                    second = second * (scale if scale.shape[1] == 1 else scale[:, both])
                fine[:, both] &= np.abs(naive[:, both]) <= second

        self._mark_uneven(fine, time)
        if statistic is not None:
            statistic[...] = score
        if threshold is not None:
            threshold[...] = limit
        self._walk(fine, extended, value, time, scale, reasons, statistic, threshold, backward)
        self._row += n
        self._last_time = np.array(time[-1:], copy=True) if n else self._last_time

    def _mark_uneven(self, fine: Bools, time: Array) -> None:
        """Rows whose own or whose predecessor's elapsed time is not one period are not ordinary."""
        before = self._last_time
        if before is None:
            before = np.full((1, time.shape[1]), np.nan)
        elapsed = np.diff(np.vstack([before, time]), axis=0)
        uneven = ~(np.abs(elapsed - 1.0) <= SNAP)
        if time.shape[1] == 1:
            rows = np.flatnonzero(uneven[:, 0])
            fine[rows] = False
        else:
            fine[uneven] = False

    def _walk(
        self,
        fine: Bools,
        extended: Array,
        value: Array,
        time: Array,
        scale: Array | None,
        reasons: npt.NDArray[np.int32],
        statistic: Array | None,
        threshold: Array | None,
        backward: Bools | None,
    ) -> None:
        n, n_channel = value.shape
        first, lanes = self._row, self._lanes
        stop = np.full(n_channel, n)
        if self.n_row is not None:
            stop = np.clip(self.n_row - first, 0, n)
        events = np.flatnonzero(np.ascontiguousarray(~fine.T))
        events = np.append(events, n * n_channel)
        lane = np.arange(n_channel)
        row = _next_event(events, lane, np.zeros(n_channel, dtype=np.int64), n)
        # A channel that is not ordinary at the chunk's first row has a NaN halo: an event there.
        self._enter(lane[row > 0], row[row > 0], extended, time)
        alive = row < stop
        lane, row = lane[alive], row[alive]
        while len(lane):
            self._decide(
                lane, row, value, time, scale, reasons, statistic, threshold, backward, first
            )
            row = row + 1
            calm = lanes.ordinary(lane, row + first)
            if calm.any():
                jumped = _next_event(events, lane[calm], row[calm], n)
                skip = jumped > row[calm]
                target = row.copy()
                target[calm] = jumped
                moved = np.flatnonzero(calm)[skip]
                row = target
                self._enter(lane[moved], np.minimum(row[moved], stop[lane[moved]]), extended, time)
            alive = row < stop[lane]
            lane, row = lane[alive], row[alive]

    def _enter(self, lane: Ints, row: Ints, extended: Array, time: Array) -> None:
        """Set the state of channels that reach ``row`` in the ordinary way."""
        if not len(lane):
            return
        lanes = self._lanes
        column = 0 if time.shape[1] == 1 else lane
        lanes.value[lane] = extended[row + 1, lane]
        lanes.lead[lane] = extended[row + 1, lane] - extended[row, lane]
        lanes.time[lane] = time[row - 1, column]
        lanes.row[lane] = row - 1 + self._row
        lanes.lead_row[lane] = row - 2 + self._row
        lanes.span[lane] = 1.0
        lanes.count[lane] = -1

    def _decide(
        self,
        lane: Ints,
        row: Ints,
        value: Array,
        time: Array,
        scale: Array | None,
        reasons: npt.NDArray[np.int32],
        statistic: Array | None,
        threshold: Array | None,
        backward: Bools | None,
        first: int,
    ) -> None:
        """Decide one sample of each given channel and move the channel's state past it."""
        x = value[row, lane]
        if statistic is not None:
            statistic[row, lane] = np.nan
        if threshold is not None:
            threshold[row, lane] = np.nan
        present = ~np.isnan(x)
        if not present.all():
            lane, row, x = lane[present], row[present], x[present]
        if not len(lane):
            return
        t = time[row, 0] if time.shape[1] == 1 else time[row, lane]
        older = np.zeros(len(lane), dtype=bool)
        if backward is not None:
            older = backward[row, 0] if backward.shape[1] == 1 else backward[row, lane]
        factor = np.ones(len(lane))
        if scale is not None:
            factor = scale[row, 0] if scale.shape[1] == 1 else scale[row, lane]

        with np.errstate(over="ignore", invalid="ignore"):
            self._judge(lane, row, x, t, factor, older, reasons, statistic, threshold, first)

    def _judge(
        self,
        lane: Ints,
        row: Ints,
        x: Array,
        t: Array,
        factor: Array,
        older: Bools,
        reasons: npt.NDArray[np.int32],
        statistic: Array | None,
        threshold: Array | None,
        first: int,
    ) -> None:
        lanes, motion = self._lanes, self.motion
        known = ~np.isnan(lanes.value[lane])
        change = x - lanes.value[lane]
        elapsed = _snapped(np.abs(t - lanes.time[lane]))
        variance = self._variance(lane, elapsed)
        plain = _product(motion.increment[lane], np.sqrt(variance)) * factor
        predicted, error = self._extrapolate(lane, elapsed, variance, older)
        extrapolated = np.abs(change - predicted)
        sharp = _product(motion.extrapolation[lane], error) * factor

        over_increment = known & (np.abs(change) > plain)
        over_extrapolation = known & (extrapolated > sharp)
        flagged = over_increment | over_extrapolation
        bits = np.where(over_increment, np.int32(Reason.INCREMENT), np.int32(0))
        bits |= np.where(over_extrapolation, np.int32(Reason.EXTRAPOLATION), np.int32(0))

        # A flagged level that the following samples share is a step of the process.
        waited = _snapped(np.abs(t - lanes.step_time[lane]))
        quantile = np.minimum(motion.increment[lane], motion.extrapolation[lane])
        agrees = np.abs(x - lanes.step_value[lane]) <= (
            _product(quantile, np.sqrt(self._variance(lane, waited))) * factor
        )
        agrees &= (lanes.count[lane] >= 0) & flagged & ~older
        count = np.where(agrees, lanes.count[lane] + 1, 0)
        accepted = agrees & (count >= motion.confirm[lane])
        bits = np.where(accepted, np.int32(Reason.STEP_ACCEPTED), bits)
        reasons[row, lane] |= bits

        if statistic is not None or threshold is not None:
            by_extrapolation = np.isfinite(motion.extrapolation[lane]) & ~(
                over_increment & ~over_extrapolation
            )
            if statistic is not None:
                statistic[row, lane] = np.where(by_extrapolation, extrapolated, np.abs(change))
            if threshold is not None:
                threshold[row, lane] = np.where(
                    known, np.where(by_extrapolation, sharp, plain), np.nan
                )

        moves = ~older & (~flagged | accepted)
        at, when, new = lane[moves], t[moves], x[moves]
        lead = np.where(accepted, x - lanes.step_value[lane], change)[moves]
        span = np.where(accepted, waited, elapsed)[moves]
        lanes.lead_row[at] = np.where(accepted[moves], -9, lanes.row[at])
        lanes.value[at], lanes.time[at], lanes.row[at] = new, when, row[moves] + first
        lanes.lead[at], lanes.span[at], lanes.count[at] = lead, span, -1
        waits = ~older & flagged & ~accepted
        at = lane[waits]
        lanes.count[at] = count[waits]
        lanes.step_value[at], lanes.step_time[at] = x[waits], t[waits]

    def _variance(self, lane: Ints, periods: Array) -> Array:
        """v(n) at real n ≥ 1, linear between whole lags and beyond the last; (n,) [unit²]."""
        table = self.motion.structure
        last = table.shape[1] - 1
        n = np.maximum(np.nan_to_num(periods, nan=1.0, posinf=1e12), 1.0)
        low = np.minimum(n.astype(np.int64), last - 1)
        v_low, v_high = table[lane, low], table[lane, low + 1]
        # Estimated v(n) may dip; over longer gaps nothing becomes more certain than over one.
        floor = self.motion.one_step_variance[lane]
        slope = np.where(n > last, np.maximum(v_high - v_low, 0.0), v_high - v_low)
        return np.asarray(np.maximum(v_low + (n - low) * slope, floor))

    def _extrapolate(
        self, lane: Ints, elapsed: Array, variance: Array, older: Bools
    ) -> tuple[Array, Array]:
        """Predicted change since the reference and the σ of its error; both (n,) [unit]."""
        lanes, motion = self._lanes, self.motion
        lead, span = lanes.lead[lane], lanes.span[lane]
        usable = ~np.isnan(lead) & (motion.k[lane] != 0.0) & ~older
        v_span = self._variance(lane, span)
        covariance = 0.5 * (self._variance(lane, elapsed + span) - variance - v_span)
        with np.errstate(divide="ignore", invalid="ignore"):
            k = np.where(v_span > 0.0, covariance / v_span, 0.0)
        one = (elapsed == 1.0) & (span == 1.0)
        k = np.where(one, motion.k[lane], k)
        floor = motion.one_step_variance[lane]
        error = np.where(one, floor, np.maximum(variance - k * k * v_span, floor))
        # Within less than a period only part of the predicted change can have happened.
        predicted = k * np.nan_to_num(lead) * np.minimum(elapsed, 1.0)
        return (
            np.where(usable, predicted, 0.0),
            np.sqrt(np.where(usable, error, variance)),
        )


def _snapped(periods: Array) -> Array:
    whole = np.rint(periods)
    near = (np.abs(periods - whole) <= SNAP) & (whole >= 1.0)
    return np.asarray(np.where(near, whole, periods))


def _next_event(events: Ints, lane: Ints, row: Ints, n: int) -> Ints:
    """First event of each lane at or after its row; n where there is none in the chunk."""
    found = events[np.searchsorted(events, lane * n + row)]
    return np.asarray(np.minimum(found - lane * n, n))


def _product(quantile: Array, sigma: Array) -> Array:
    """Quantile · σ with ∞ · 0 = ∞: a check that is not made has no threshold."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(np.isinf(quantile), np.inf, quantile * sigma))
