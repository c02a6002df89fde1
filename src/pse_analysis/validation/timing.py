"""The time checks: late, duplicate and backward stamps, gaps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pse_analysis.vocabulary import Reason

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

GAP_PERIODS = 1.5
"""Elapsed periods from which at least one sample is missing."""

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

    lane: Ints
    time: Ints
    arrival: Ints
    start: Ints = field(init=False)
    length: Ints = field(init=False)

    def __post_init__(self) -> None:
        first = np.flatnonzero(np.diff(self.lane, prepend=-1))
        object.__setattr__(self, "start", first)
        object.__setattr__(self, "length", np.diff(np.append(first, len(self.lane))))

    @property
    def arrived(self) -> Bools:
        """Whether the time of arrival is known."""
        return np.asarray(self.arrival != NO_TIME)


def latest_before(stamps: Stamps) -> Ints:
    """Latest stamp among the earlier samples of the lane; `NO_TIME` for its first."""
    out = np.full(len(stamps.time), NO_TIME)
    if not len(stamps.time):
        return out
    # Ranks keep lanes apart in one running maximum without overflow.
    order = np.lexsort((stamps.time, stamps.lane))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    top = order[np.maximum.accumulate(rank)]
    out[1:] = stamps.time[top[:-1]]
    out[stamps.start] = NO_TIME
    return out


def duplicates(stamps: Stamps) -> Bools:
    """Samples whose stamp an earlier sample of the lane already had."""
    out = np.zeros(len(stamps.time), dtype=bool)
    if len(out):
        order = np.lexsort((np.arange(len(out)), stamps.time, stamps.lane))
        same = (np.diff(stamps.time[order]) == 0) & (np.diff(stamps.lane[order]) == 0)
        out[order[1:][same]] = True
    return out


def echoes(stamps: Stamps, value: Array, period_s: Array) -> Bools:
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


def usual_delay(stamps: Stamps, history: Bools) -> Array:
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
    stamps: Stamps, value: Array, period_s: Array, late_s: Array, history: Bools
) -> tuple[npt.NDArray[np.int32], Bools]:
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
    latest = latest_before(stamps)
    some = latest != NO_TIME
    repeated = duplicates(stamps) | echoes(stamps, value, period_s)
    backward = some & (stamps.time < latest) & ~repeated
    period = period_s[stamps.lane] * 1e6
    gap = some & ~repeated & ~backward
    gap[gap] = (stamps.time[gap] - latest[gap]) > GAP_PERIODS * period[gap]
    allowed = np.where(np.isnan(late_s), usual_delay(stamps, history) + period_s, late_s)
    late = stamps.arrived.copy()
    late[late] = (stamps.arrival[late] - stamps.time[late]) > allowed[stamps.lane[late]] * 1e6
    for where, reason in (
        (repeated, Reason.DUPLICATE),
        (backward, Reason.BACKWARD),
        (gap, Reason.GAP),
        (late, Reason.LATE),
    ):
        reasons[where] |= np.int32(reason)
    return reasons, backward
