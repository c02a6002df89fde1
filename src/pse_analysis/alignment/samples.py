"""Usable samples in the order in which they came, and which of them an instant may see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.alignment.stamps import SamplingTimes, microseconds
from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.measurement import SensorLayout, standard_deviation, wrap
from pse_analysis.vocabulary import usable

MICROSECOND = 1_000_000
FEWEST_INCREMENTS = 12
"""History shorter than this tells nothing about how fast a channel moves."""
APART = 3
"""Positions between medians of three that share no sample."""
MEDIAN_VARIANCE = 0.4487
"""Variance of the median of three normal values, in units of theirs."""
MEDIAN_LOSS = 2.0 / np.pi
"""Steps by which medians of three shorten the increments of a random walk.

Of its instants; means over successive intervals are smooth and lose next to nothing.
"""


@dataclass(frozen=True, eq=False)
class Samples:
    """Usable samples sorted by group (trial and channel), then arrival; times in µs.

    Inside a group neither times nor arrivals decrease.

    Attributes
    ----------
    group, trial, column : (n,) ndarray of int
        Number of the group, its trial and its row of the layout.
    time, arrival : (n,) ndarray of int
    confidence, doubt : (n,) ndarray
        Of a recovered sampling time, and its standard deviation. [1, s]
    value : (n,) ndarray
        [p.u., rad]
    flag, reasons : (n,) ndarray of int
    """

    group: IntArray
    trial: IntArray
    column: IntArray
    time: IntArray
    arrival: IntArray
    confidence: FloatArray
    doubt: FloatArray
    value: FloatArray
    flag: npt.NDArray[np.int8]
    reasons: npt.NDArray[np.int32]

    @classmethod
    def of(
        cls,
        validated: pd.DataFrame,
        column: IntArray,
        layout: SensorLayout,
        stamps: SamplingTimes | None,
    ) -> Samples:
        """Usable samples, in per unit, that are not older than one which arrived before them.

        Parameters
        ----------
        validated : DataFrame
            Table ``validated``.
        column : (n,) ndarray of int
            Row of the layout of each of its rows.
        layout : SensorLayout
        stamps : SamplingTimes, optional
            Recovered times that stand for the table's own.
        """
        value = validated["corrected"].to_numpy(dtype=float) * layout.scale[column]
        keep = usable(validated["flag"].to_numpy()) & np.isfinite(value)
        rows = validated[keep]
        trial = rows["trial"].to_numpy(dtype=np.int64)
        place = np.asarray(column[keep], dtype=np.int64)
        time = microseconds(rows["time_utc"])
        came = rows["arrival_utc"].isna().to_numpy()
        confidence, doubt = np.ones(len(rows)), np.zeros(len(rows))
        arrival = np.where(came, time, microseconds(rows["arrival_utc"].fillna(rows["time_utc"])))
        # A stamp ahead of its arrival, from a clock that is fast or wrong, waits for its time.
        arrival = np.maximum(arrival, time)
        if stamps is not None:
            time, doubt = stamps.time[keep], stamps.doubt[keep]
            confidence = stamps.confidence[keep]
        order = np.lexsort((rows["seq"].to_numpy(), arrival, place, trial))
        _, group = np.unique(trial[order] * len(layout) + place[order], return_inverse=True)
        group = group.astype(np.int64)
        newest = pd.Series(time[order]).groupby(group).cummax().to_numpy()
        begins = np.concatenate([[True], group[1:] != group[:-1]])[: len(group)]
        advances = begins | np.concatenate([[True], newest[1:] > newest[:-1]])[: len(group)]
        order, group = order[advances], group[advances]
        return cls(
            group=group,
            trial=trial[order],
            column=place[order],
            time=time[order],
            arrival=arrival[order],
            confidence=confidence[order],
            doubt=doubt[order],
            value=value[keep][order],
            flag=rows["flag"].to_numpy(dtype=np.int8)[order],
            reasons=rows["reasons"].to_numpy(dtype=np.int32)[order],
        )

    def latest(self, instants: IntArray, latency: int) -> tuple[IntArray, IntArray]:
        """Newest sample of every group that was taken by an instant and had arrived by its end.

        Parameters
        ----------
        instants : (T,) ndarray of int
            [µs]
        latency : int
            How long after it an instant waits for what arrives late. [µs]

        Returns
        -------
        at, row : (k,) ndarray of int
            Pairs of instant and sample, by group and instant; none where there is no sample.
        """
        if not len(self.group):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        begin = np.unique(self.group, return_index=True)[1]
        end = np.append(begin[1:], len(self.group))
        at, row = [], []
        for b, e in zip(begin, end, strict=True):
            come = np.searchsorted(self.arrival[b:e], instants + latency, side="right")
            taken = np.searchsorted(self.time[b:e], instants, side="right")
            last = np.minimum(come, taken) - 1
            known = np.flatnonzero(last >= 0)
            at.append(known)
            row.append(b + last[known])
        return np.concatenate(at), np.concatenate(row)

    def following(self, at: IntArray, row: IntArray, instants: IntArray, latency: int) -> BoolArray:
        """Whether the sample after each of `latest` had arrived as well. (k,)"""
        after = np.minimum(row + 1, len(self.group) - 1)
        same = (after > row) & (self.group[after] == self.group[row])
        return np.asarray(same & (self.arrival[after] <= instants[at] + latency))

    def noise(self, row: IntArray, layout: SensorLayout) -> FloatArray:
        """σ of samples by their meters alone. [p.u., rad]"""
        place = self.column[row]
        return standard_deviation(self.value[row], layout.sigma[place], layout.relative[place])

    def movement(self, layout: SensorLayout, start: int, step_s: float) -> FloatArray:
        """Variance rate of every group before the study. [p.u.²/s]

        Parameters
        ----------
        layout : SensorLayout
        start : int
            Of the study; what arrived later is not looked at. [µs]
        step_s : float
            Without enough history a channel is taken to move by its own σ in this time. [s]

        Returns
        -------
        (n_group,) ndarray

        Notes
        -----
        From increments between medians of three neighbours, so that a single wild value, which a
        validation may have missed, leaves no trace, while a step of the load counts in full.
        """
        n_group = int(self.group.max(initial=-1)) + 1
        out = np.zeros(n_group)
        past = np.flatnonzero(self.arrival < start)
        bounds = np.searchsorted(self.group[past], np.arange(n_group + 1))
        first = np.searchsorted(self.group, np.arange(n_group))
        own = self.noise(first, layout) if n_group else out
        for g in range(n_group):
            rows = past[bounds[g] : bounds[g + 1]]
            if len(rows) <= FEWEST_INCREMENTS:
                out[g] = own[g] ** 2 / max(step_s, 1.0)
                continue
            place = int(self.column[rows[0]])
            value = self.value[rows]
            if layout.angular[place]:
                value = value[0] + np.concatenate([[0.0], np.cumsum(wrap(np.diff(value)))])
            middle = np.median(np.stack([value[:-2], value[1:-1], value[2:]]), axis=0)
            change = middle[APART:] - middle[:-APART]
            time = self.time[rows[1:-1]]
            elapsed = (time[APART:] - time[:-APART]) / MICROSECOND
            window = layout.window_s[place]
            lost = window / 3.0 if window > 0 else MEDIAN_LOSS * np.median(elapsed) / APART
            span = np.maximum(elapsed - lost, 1e-3)
            noise = self.noise(rows[1:-1], layout)[APART:] ** 2
            moved = change**2 - 2.0 * MEDIAN_VARIANCE * noise
            out[g] = max(float(moved.sum()), 0.0) / float(span.sum())
        return out


def first_use(at: IntArray, row: IntArray) -> BoolArray:
    """Whether a sample stands at its first instant, for pairs in any order."""
    first = np.zeros(len(row), dtype=bool)
    order = np.lexsort((at, row))
    first[order[np.unique(row[order], return_index=True)[1]]] = True
    return first
