"""Last value: what had arrived by each instant, with its age and the σ that age adds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.measurement import IA, VA, Model, SensorLayout, standard_deviation, wrap
from pse_analysis.parameters import Study
from pse_analysis.vocabulary import Origin, check, usable

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MICROSECOND = 1_000_000
FEWEST_INCREMENTS = 12
"""History shorter than this tells nothing about how fast a channel moves."""


@dataclass(frozen=True)
class AlignParams:
    """How samples are brought to instants.

    Attributes
    ----------
    variant : str
        Name of the result.
    max_age_s : dict of str to float
        Age beyond which a sample is no longer used, by source. [s]
    default_max_age_s : float
        The same for sources that are not named. [s]
    growth : {"history", "none"}
        Whether σ grows with age, at the rate at which the channel moved before the study.
    """

    variant: str = "last"
    max_age_s: dict[str, float] = field(default_factory=dict)
    default_max_age_s: float = 3600.0
    growth: Literal["history", "none"] = "history"


def align(
    validated: pd.DataFrame,
    channels: pd.DataFrame,
    model: Model,
    study: Study,
    params: AlignParams | None = None,
) -> pd.DataFrame:
    """Bring usable samples to the estimation instants by last value.

    Parameters
    ----------
    validated : DataFrame
        Table ``validated``.
    channels : DataFrame
        Table ``channels``.
    model : Network or Machine
        What the channels measure.
    study : Study
        Instants reach from ``history_start`` to ``end``.
    params : AlignParams, optional

    Returns
    -------
    DataFrame
        Table ``aligned``: per trial, instant and channel the usable sample of latest time stamp
        among those that had *arrived*; absent where none is young enough.

    Raises
    ------
    TableError
        If a channel is not in the channels table.

    Notes
    -----
    A channel that moves as a random walk with variance rate r leaves, at age a and for means over
    W, the variance r (a + W/3): that is added to the sample's own. r comes from increments between
    consecutive samples before the study, so nothing after an instant is known at it.
    """
    params = params or AlignParams()
    layout = SensorLayout.from_channels(channels, model)
    column = pd.Index(layout.channel).get_indexer(validated["channel"])
    if (column < 0).any():
        name = validated["channel"].iloc[int(np.argmin(column))]
        raise TableError(
            f"validated: channel {name!r} is not in the channels table: add it there, or drop it"
        )
    instants = _instants(study)
    samples = _usable_in_order(validated, column, layout)
    rate = _movement(samples, layout, study) if params.growth == "history" else None
    limit = np.array(
        [params.max_age_s.get(s, params.default_max_age_s) for s in channels["source"]]
    )
    at, row = _latest(samples, instants)
    age = (instants[at] - samples.time[row]) / MICROSECOND
    young = age <= limit[samples.column[row]]
    at, row, age = at[young], row[young], age[young]
    place = samples.column[row]
    own = standard_deviation(samples.value[row], layout.sigma[place], layout.relative[place])
    grown = np.zeros(len(row))
    if rate is not None:
        grown = np.sqrt(rate[samples.group[row]] * (age + layout.window_s[place] / 3.0))
    order = np.lexsort((place, at, samples.trial[row]))
    at, row, age, place = at[order], row[order], age[order], place[order]
    own, grown = own[order], grown[order]
    first = _first_use(at, row)
    times = pd.DatetimeIndex(instants.astype("datetime64[us]"), tz="UTC")
    stamps = pd.DatetimeIndex(samples.time.astype("datetime64[us]"), tz="UTC")
    return check(
        "aligned",
        pd.DataFrame(
            {
                "variant": params.variant,
                "trial": samples.trial[row].astype(np.int32),
                "time_utc": times[at],
                "channel": np.asarray(layout.channel, dtype=object)[place],
                "value_pu": samples.value[row],
                "sigma_pu": np.hypot(own, grown),
                "sigma_age_pu": grown,
                "origin": np.where(first, str(Origin.MEASURED), str(Origin.HELD)).astype(object),
                "sample_utc": stamps[row],
                "time_confidence": 1.0,
                "age_s": age,
                "flag": samples.flag[row],
                "reasons": samples.reasons[row],
            }
        ),
    )


@dataclass(frozen=True, eq=False)
class _Samples:
    """Usable samples sorted by group (trial and channel), then arrival; times in µs."""

    group: IntArray
    trial: IntArray
    column: IntArray
    time: IntArray
    arrival: IntArray
    value: FloatArray
    flag: npt.NDArray[np.int8]
    reasons: npt.NDArray[np.int32]


def _instants(study: Study) -> IntArray:
    start, end, history = (
        pd.Timestamp(t).tz_convert("UTC").value // 1000
        for t in (study.start, study.end, study.history_start)
    )
    step = round(study.step_s * MICROSECOND)
    before = (start - history) // step
    return np.arange(start - before * step, end, step, dtype=np.int64)


def _microseconds(times: pd.Series) -> IntArray:
    naive = times.dt.tz_convert("UTC").dt.tz_localize(None)
    return np.asarray(naive.to_numpy().astype("datetime64[us]").astype(np.int64))


def _usable_in_order(validated: pd.DataFrame, column: IntArray, layout: SensorLayout) -> _Samples:
    """Usable samples, in per unit, that are not older than one which arrived before them."""
    value = validated["corrected"].to_numpy(dtype=float) * layout.scale[column]
    keep = usable(validated["flag"].to_numpy()) & np.isfinite(value)
    rows = validated[keep]
    trial = rows["trial"].to_numpy(dtype=np.int64)
    place = np.asarray(column[keep], dtype=np.int64)
    time = _microseconds(rows["time_utc"])
    came = rows["arrival_utc"].isna().to_numpy()
    arrival = np.where(came, time, _microseconds(rows["arrival_utc"].fillna(rows["time_utc"])))
    # A stamp ahead of its arrival, from a clock that is fast or wrong, waits for its time.
    arrival = np.maximum(arrival, time)
    order = np.lexsort((rows["seq"].to_numpy(), arrival, place, trial))
    _, group = np.unique(np.stack([trial, place]), axis=1, return_inverse=True)
    group = np.ravel(group)[order].astype(np.int64)
    newest = pd.Series(time[order]).groupby(group).cummax().to_numpy()
    begins = np.concatenate([[True], group[1:] != group[:-1]]) if len(group) else np.zeros(0, bool)
    advances = begins | np.concatenate([[True], newest[1:] > newest[:-1]])[: len(group)]
    order, group = order[advances], group[advances]
    return _Samples(
        group=group,
        trial=trial[order],
        column=place[order],
        time=time[order],
        arrival=arrival[order],
        value=value[keep][order],
        flag=rows["flag"].to_numpy(dtype=np.int8)[order],
        reasons=rows["reasons"].to_numpy(dtype=np.int32)[order],
    )


def _latest(samples: _Samples, instants: IntArray) -> tuple[IntArray, IntArray]:
    """For every group and instant the last sample that had arrived: (instant, sample) pairs."""
    if not len(samples.group):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    begin = np.unique(samples.group, return_index=True)[1]
    end = np.append(begin[1:], len(samples.group))
    at, row = [], []
    for b, e in zip(begin, end, strict=True):
        last = np.searchsorted(samples.arrival[b:e], instants, side="right") - 1
        known = np.flatnonzero(last >= 0)
        at.append(known)
        row.append(b + last[known])
    return np.concatenate(at), np.concatenate(row)


def _first_use(at: IntArray, row: IntArray) -> npt.NDArray[np.bool_]:
    """Whether a sample stands at its first instant, for rows in any order."""
    first = np.zeros(len(row), dtype=bool)
    order = np.lexsort((at, row))
    first[order[np.unique(row[order], return_index=True)[1]]] = True
    return first


def _movement(samples: _Samples, layout: SensorLayout, study: Study) -> FloatArray:
    """Variance rate of every group before the study. [p.u.²/s]

    Without enough history a channel is taken to move by its own σ per step.
    """
    n_group = int(samples.group.max(initial=-1)) + 1
    start = pd.Timestamp(study.start).tz_convert("UTC").value // 1000
    same = samples.group[1:] == samples.group[:-1]
    past = same & (samples.arrival[1:] < start)
    group, place = samples.group[1:][past], samples.column[1:][past]
    change = np.diff(samples.value)[past]
    angular = np.isin(layout.quantity[place], (VA, IA))
    change = np.where(angular, wrap(change), change)
    elapsed = np.diff(samples.time)[past] / MICROSECOND
    sigma = standard_deviation(samples.value[1:][past], layout.sigma[place], layout.relative[place])
    span = np.maximum(elapsed - layout.window_s[place] / 3.0, 1e-3)
    count = np.bincount(group, minlength=n_group)
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = np.bincount(group, weights=change**2 - 2.0 * sigma**2, minlength=n_group)
        rate = np.maximum(moved, 0.0) / np.bincount(group, weights=span, minlength=n_group)
    little = count < FEWEST_INCREMENTS
    if little.any():
        first = np.searchsorted(samples.group, np.flatnonzero(little))
        own = standard_deviation(
            samples.value[first],
            layout.sigma[samples.column[first]],
            layout.relative[samples.column[first]],
        )
        rate[little] = own**2 / np.maximum(study.step_s, 1.0)
    return np.asarray(rate)
