"""The time checks: stamps from the future, late, duplicate and backward ones, gaps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.vocabulary import Reason

GAP_PERIODS = 1.5
"""Elapsed periods from which at least one sample is missing."""

FAR_PERIODS = 10.0
"""Periods ahead from which a stamp that the next ones contradict is no gap but a wrong clock."""

AHEAD_RUN = 3
"""Such stamps in a row at most: a longer run may as well be live samples before a backfill."""

SKEW_S = 10.0
"""Least lead of a stamp over its own arrival that is no skew of clocks. [s]"""

NO_TIME = np.iinfo(np.int64).min


@dataclass(frozen=True, eq=False)
class Stamps:
    """Time stamps of samples sorted by lane (one channel of one trial), then order of arrival.

    Attributes
    ----------
    lane : (n,) array of int
        0, 0, …, 1, 1, …
    time, arrival : (n,) array of int
        Microseconds since 1970; `NO_TIME` where the arrival is not known.
    """

    lane: IntArray
    time: IntArray
    arrival: IntArray
    start: IntArray = field(init=False)
    length: IntArray = field(init=False)

    def __post_init__(self) -> None:
        first = np.flatnonzero(np.diff(self.lane, prepend=-1))
        object.__setattr__(self, "start", first)
        object.__setattr__(self, "length", np.diff(np.append(first, len(self.lane))))

    @property
    def arrived(self) -> BoolArray:
        """Whether the time of arrival is known."""
        return np.asarray(self.arrival != NO_TIME)


def ahead(stamps: Stamps, period_s: FloatArray) -> BoolArray:
    """Samples whose stamp lies in the future.

    Where the arrival is known, a stamp more than a period (`SKEW_S` at least) after it is
    impossible; a smaller lead is a skew of clocks that leaves the samples in their order. Where it
    is not, a stamp has jumped that lies more than `FAR_PERIODS` ahead and is followed, after
    `AHEAD_RUN` samples at most, by one that goes on where the others were; or that has run so far
    ahead, as the last of its lane, of every sample of the other lanes.
    """
    time, lane = stamps.time, stamps.lane
    period = period_s[lane] * 1e6
    out = stamps.arrived.copy()
    out[out] = (time[out] - stamps.arrival[out]) > np.maximum(period[out], SKEW_S * 1e6)
    unknown = ~stamps.arrived & ~out
    if not unknown.any():
        return out
    far = FAR_PERIODS * period
    # A step back over the far distance is rare, so what stands before it is looked at one by one.
    back = (lane[1:] == lane[:-1]) & (time[:-1] - time[1:] > far[1:])
    for at in np.flatnonzero(back) + 1:
        first = stamps.start[lane[at]]
        for start in range(at - 1, max(at - AHEAD_RUN, first) - 1, -1):
            run = slice(start, at)
            if not (unknown[run].all() and (time[run] - time[at] > far[at]).all()):
                break
            goes_on = start == first or 0 <= time[at] - time[start - 1] <= far[at]
            if goes_on:
                out[run] = True
                break
    if len(stamps.start) > 1:
        top = np.maximum.reduceat(np.where(out, NO_TIME, time), stamps.start)
        leader = int(np.argmax(top))
        final = int(stamps.start[leader] + stamps.length[leader] - 1)
        others = max(int(np.delete(top, leader).max()), int(time[final - 1]))
        if stamps.length[leader] > 1 and unknown[final] and time[final] - others > far[final]:
            out[final] = True
    return out


def latest_before(stamps: Stamps, wrong: BoolArray | None = None) -> IntArray:
    """Latest stamp among the earlier samples of the lane; `NO_TIME` where there is none."""
    out = np.full(len(stamps.time), NO_TIME)
    if not len(stamps.time):
        return out
    # Ranks keep lanes apart in one running maximum without overflow.
    time = stamps.time if wrong is None else np.where(wrong, NO_TIME, stamps.time)
    order = np.lexsort((time, stamps.lane))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    top = order[np.maximum.accumulate(rank)]
    out[1:] = time[top[:-1]]
    out[stamps.start] = NO_TIME
    return out


def duplicates(stamps: Stamps) -> BoolArray:
    """Samples whose stamp an earlier sample of the lane already had."""
    out = np.zeros(len(stamps.time), dtype=bool)
    if len(out):
        order = np.lexsort((np.arange(len(out)), stamps.time, stamps.lane))
        same = (np.diff(stamps.time[order]) == 0) & (np.diff(stamps.lane[order]) == 0)
        out[order[1:][same]] = True
    return out


def echoes(stamps: Stamps, value: FloatArray, period_s: FloatArray) -> BoolArray:
    """Samples that repeat their predecessor's value within half a period of its stamp.

    A source without a clock of its own is stamped on arrival, so a telegram that is delivered
    twice comes with two stamps.
    """
    out = np.zeros(len(stamps.time), dtype=bool)
    if len(out) > 1:
        same = (value[1:] == value[:-1]) & (stamps.lane[1:] == stamps.lane[:-1])
        at = np.flatnonzero(same) + 1
        soon = 0.5e6 * period_s[stamps.lane[at]]
        out[at] = np.abs(stamps.time[at] - stamps.time[at - 1]) < soon
    return out


def usual_delay(stamps: Stamps, history: BoolArray) -> FloatArray:
    """Median delay of arrival in the history of each lane; 0 where it has none. [s]"""
    out = np.zeros(len(stamps.start))
    chosen = history & stamps.arrived
    if not chosen.any():
        return out
    lane = stamps.lane[chosen]
    delay = (stamps.arrival[chosen] - stamps.time[chosen]) / 1e6
    order = np.lexsort((delay, lane))
    lane, delay = lane[order], delay[order]
    first = np.flatnonzero(np.diff(lane, prepend=-1))
    count = np.diff(np.append(first, len(lane)))
    out[lane[first]] = 0.5 * (delay[first + (count - 1) // 2] + delay[first + count // 2])
    return out


def time_reasons(
    stamps: Stamps, value: FloatArray, period_s: FloatArray, late_s: FloatArray, history: BoolArray
) -> tuple[npt.NDArray[np.int32], BoolArray]:
    """Reasons of the time checks, and which samples are older than one that arrived before them.

    Parameters
    ----------
    stamps : Stamps
    value : (n,)
        [unit]
    period_s : (n_lane,)
        Sampling period. [s]
    late_s : (n_lane,)
        Delay that is flagged; NaN takes one period above the usual delay. [s]
    history : (n,) array of bool
        Samples that the usual delay is learnt from.
    """
    reasons = np.zeros(len(stamps.time), dtype=np.int32)
    future = ahead(stamps, period_s)
    latest = latest_before(stamps, future)
    some = (latest != NO_TIME) & ~future
    repeated = duplicates(stamps) | echoes(stamps, value, period_s)
    backward = some & (stamps.time < latest) & ~repeated
    period = period_s[stamps.lane] * 1e6
    gap = some & ~repeated & ~backward
    gap[gap] = (stamps.time[gap] - latest[gap]) > GAP_PERIODS * period[gap]
    allowed = np.where(np.isnan(late_s), usual_delay(stamps, history) + period_s, late_s)
    late = stamps.arrived.copy()
    late[late] = (stamps.arrival[late] - stamps.time[late]) > allowed[stamps.lane[late]] * 1e6
    for where, reason in (
        (future, Reason.AHEAD),
        (repeated, Reason.DUPLICATE),
        (backward, Reason.BACKWARD),
        (gap, Reason.GAP),
        (late, Reason.LATE),
    ):
        reasons[where] |= np.int32(reason)
    return reasons, backward
