"""Fusion of sources of different rates at the instants of estimation.

What had arrived by each instant, with its age and the σ that age adds, eq. (3) of [qi2025]. A
variant may correct the stamps of sources without a clock before, and let forecasts stand for
readings of slow meters that have grown old, eq. (4).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.alignment import dtw, pseudo_measurements
from pse_analysis.alignment.dtw import TimeParams
from pse_analysis.alignment.pseudo_measurements import PseudoParams
from pse_analysis.alignment.stamps import SamplingTimes, sampling_times
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.grid.network import Network
from pse_analysis.measurement import IA, VA, Model, SensorLayout, standard_deviation, wrap
from pse_analysis.parameters import Study
from pse_analysis.vocabulary import Origin, check, usable

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MICROSECOND = 1_000_000
FEWEST_INCREMENTS = 12
"""History shorter than this tells nothing about how fast a channel moves."""


@dataclass(frozen=True)
class Variant:
    """One way to align, of several that are compared.

    Attributes
    ----------
    name : str
        Of the variant; a method of the estimate stage names the one it reads.
    time : {"none", "xcorr", "dtw"}
        How sampling times of sources without a clock are recovered.
    pseudo : {"none", "hold", "holt", "profile", "ar"}
        What stands for old readings of slow meters; ``none`` keeps the readings.
    """

    name: str
    time: dtw.Method = "none"
    pseudo: pseudo_measurements.Method = "none"


@dataclass(frozen=True)
class AlignParams:
    """How samples are brought to instants.

    Attributes
    ----------
    variant : str
        Name of the result where no variants are listed: the last values, with the stamps they
        carry.
    variants : tuple of Variant
        Several results side by side.
    max_age_s : dict of str to float
        Age beyond which a sample is no longer used, by source. [s]
    default_max_age_s : float
        The same for sources that are not named. [s]
    growth : {"history", "none"}
        Whether σ grows with age, at the rate at which the channel moved before the study.
    time : TimeParams
        Of variants that recover sampling times.
    pseudo : PseudoParams
        Of variants with forecasts.
    """

    variant: str = "last"
    variants: tuple[Variant, ...] = ()
    max_age_s: dict[str, float] = field(default_factory=dict)
    default_max_age_s: float = 3600.0
    growth: Literal["history", "none"] = "history"
    time: TimeParams = field(default_factory=TimeParams)
    pseudo: PseudoParams = field(default_factory=PseudoParams)

    def __post_init__(self) -> None:
        names = [variant.name for variant in self.variants]
        for name in names:
            if names.count(name) > 1:
                raise ParameterError(
                    f"[align.variants] the name {name!r} stands twice: give each its own"
                )


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
    instants = instants_of(study)
    source = channels["source"].to_numpy(dtype=object)
    start = start_of(study)
    stamps: dict[str, SamplingTimes | None] = {"none": None}
    tables = []
    for variant in params.variants or (Variant(params.variant),):
        if variant.time not in stamps:
            if not isinstance(model, Network):
                raise ParameterError(
                    f"[align.variants] {variant.name!r}: sampling times come from currents "
                    'of a grid, but the case is about a machine: use time = "none"'
                )
            stamps[variant.time] = sampling_times(
                validated, layout, source, model, instants, start, params.time, variant.time
            )
        samples = _usable_in_order(validated, column, layout, stamps[variant.time])
        tables.append(_fuse(samples, instants, layout, source, study, params, variant))
    return check("aligned", pd.concat(tables, ignore_index=True))


def _fuse(
    samples: _Samples,
    instants: IntArray,
    layout: SensorLayout,
    source: npt.NDArray[np.object_],
    study: Study,
    params: AlignParams,
    variant: Variant,
) -> pd.DataFrame:
    """The aligned rows of one variant."""
    rate = _movement(samples, layout, study) if params.growth == "history" else None
    limit = np.array([params.max_age_s.get(s, params.default_max_age_s) for s in source])
    at, row = _latest(samples, instants)
    age = (instants[at] - samples.time[row]) / MICROSECOND
    young = age <= limit[samples.column[row]]
    at, row, age = at[young], row[young], age[young]
    place = samples.column[row]
    value = samples.value[row]
    own = standard_deviation(value, layout.sigma[place], layout.relative[place])
    grown = np.zeros(len(row))
    if rate is not None:
        grown = np.sqrt(rate[samples.group[row]] * (age + layout.window_s[place] / 3.0))
    origin = np.where(_first_use(at, row), str(Origin.MEASURED), str(Origin.HELD)).astype(object)
    if variant.pseudo != "none":
        old = np.isin(source, params.pseudo.sources)[place] & (age > params.pseudo.window_s)
        value[old], own[old] = _forecasts(
            samples, at[old], row[old], instants, layout, study, params.pseudo, variant.pseudo
        )
        origin[old], grown[old], age[old] = str(Origin.PSEUDO), 0.0, 0.0
    order = np.lexsort((place, at, samples.trial[row]))
    at, row, age, place = at[order], row[order], age[order], place[order]
    value, own, grown, origin = value[order], own[order], grown[order], origin[order]
    times = pd.DatetimeIndex(instants.astype("datetime64[us]"), tz="UTC")
    taken = pd.DatetimeIndex(samples.time.astype("datetime64[us]"), tz="UTC")
    return pd.DataFrame(
        {
            "variant": variant.name,
            "trial": samples.trial[row].astype(np.int32),
            "time_utc": times[at],
            "channel": np.asarray(layout.channel, dtype=object)[place],
            "value_pu": value,
            "sigma_pu": np.hypot(own, grown),
            "sigma_age_pu": grown,
            "origin": origin,
            "sample_utc": taken[row],
            "time_confidence": samples.confidence[row],
            "age_s": age,
            "flag": samples.flag[row],
            "reasons": samples.reasons[row],
        }
    )


def _forecasts(
    samples: _Samples,
    at: IntArray,
    row: IntArray,
    instants: IntArray,
    layout: SensorLayout,
    study: Study,
    params: PseudoParams,
    method: pseudo_measurements.Method,
) -> tuple[FloatArray, FloatArray]:
    """Forecasts for instants ``at`` from samples ``row``, and their σ.

    Forecasts of successive instants from one reading share their error, and a filter would take
    them for news each time: their variance is multiplied by the instants that a reading serves.
    """
    value, sigma = np.zeros(len(row)), np.ones(len(row))
    start = start_of(study)
    group = samples.group[row]
    period = {g: _period(samples.time[samples.group == g]) for g in np.unique(group)}
    for length in sorted(set(period.values())):
        groups = np.array([g for g in period if period[g] == length])
        mine = np.isin(group, groups)
        member = np.isin(samples.group, groups)
        first = int(samples.time[member].min())
        slot = np.rint((samples.time - first) / length).astype(np.int64)
        number = np.searchsorted(groups, samples.group)
        readings = np.full((int(slot[member].max()) + 1, len(groups)), np.nan)
        readings[slot[member], number[member]] = samples.value[member]
        begin = np.searchsorted(samples.group, groups)
        places = samples.column[begin]
        usual = np.nanmedian(np.abs(readings), axis=0)
        noise = standard_deviation(usual, layout.sigma[places], layout.relative[places])
        # What had not arrived by the start of the study is no history.
        known = member & (samples.arrival < start)
        history = int(slot[known].max()) + 1 if known.any() else 0
        horizon = 1 + int(np.ceil((instants[at[mine]] - samples.time[row[mine]]).max() / length))
        made = pseudo_measurements.forecast(
            readings, history, method, noise=noise, horizon=horizon,
            day=max(1, round(86_400 * MICROSECOND / length)),
        )  # fmt: skip
        ahead = (instants[at[mine]] - samples.time[row[mine]]) / length
        value[mine], sigma[mine] = made.at(slot[row[mine]], ahead, number[row[mine]])
        if params.sigma == "relative":
            sigma[mine] = standard_deviation(value[mine], params.relative, True)
        else:
            sigma[mine] *= np.sqrt(max(1.0, length / (study.step_s * MICROSECOND)))
    return value, sigma


def _period(time: IntArray) -> int:
    """Usual time between two readings. [µs]"""
    return int(np.median(np.diff(time))) if len(time) > 1 else 900 * MICROSECOND


@dataclass(frozen=True, eq=False)
class _Samples:
    """Usable samples sorted by group (trial and channel), then arrival; times in µs."""

    group: IntArray
    trial: IntArray
    column: IntArray
    time: IntArray
    arrival: IntArray
    confidence: FloatArray
    value: FloatArray
    flag: npt.NDArray[np.int8]
    reasons: npt.NDArray[np.int32]


def instants_of(study: Study) -> IntArray:
    """Instants of history and study. [µs since 1970 UTC]"""
    start, end, history = (
        pd.Timestamp(t).tz_convert("UTC").value // 1000
        for t in (study.start, study.end, study.history_start)
    )
    step = round(study.step_s * MICROSECOND)
    before = (start - history) // step
    return np.arange(start - before * step, end, step, dtype=np.int64)


def start_of(study: Study) -> int:
    """First instant of the study. [µs since 1970 UTC]"""
    return int(pd.Timestamp(study.start).tz_convert("UTC").value // 1000)


def _microseconds(times: pd.Series) -> IntArray:
    naive = times.dt.tz_convert("UTC").dt.tz_localize(None)
    return np.asarray(naive.to_numpy().astype("datetime64[us]").astype(np.int64))


def _usable_in_order(
    validated: pd.DataFrame, column: IntArray, layout: SensorLayout, stamps: SamplingTimes | None
) -> _Samples:
    """Usable samples, in per unit, that are not older than one which arrived before them."""
    value = validated["corrected"].to_numpy(dtype=float) * layout.scale[column]
    keep = usable(validated["flag"].to_numpy()) & np.isfinite(value)
    rows = validated[keep]
    trial = rows["trial"].to_numpy(dtype=np.int64)
    place = np.asarray(column[keep], dtype=np.int64)
    time = _microseconds(rows["time_utc"])
    came = rows["arrival_utc"].isna().to_numpy()
    confidence = np.ones(len(rows))
    arrival = np.where(came, time, _microseconds(rows["arrival_utc"].fillna(rows["time_utc"])))
    # A stamp ahead of its arrival, from a clock that is fast or wrong, waits for its time.
    arrival = np.maximum(arrival, time)
    if stamps is not None:
        time, confidence = stamps.time[keep], stamps.confidence[keep]
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
        confidence=confidence[order],
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
    start = start_of(study)
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
