"""Fusion of sources of different rates at the instants of estimation.

What had arrived by each instant, with its age and the σ that age adds, eq. (3) of [qi2025]. A
variant may correct the stamps of sources without a clock before, and let forecasts stand for
readings of slow meters that have grown old, eq. (4). An instant may wait for what arrives late, and
then a source that is sampled often enough is interpolated to it.
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
from pse_analysis.alignment.samples import MICROSECOND, Samples, first_use
from pse_analysis.alignment.stamps import sampling_times
from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.grid.network import Network
from pse_analysis.measurement import Model, SensorLayout, standard_deviation, wrap
from pse_analysis.parameters import Study, Unbounded
from pse_analysis.vocabulary import Origin, Quantity, check

CENTURY_S = 3.2e9


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
    face_value : tuple of str
        Sources whose readings keep the σ of their meter however old they are, as in a system that
        fuses nothing.
    """

    name: str
    time: dtw.Method = "none"
    pseudo: pseudo_measurements.Method = "none"
    face_value: tuple[str, ...] = ()


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
    latency_s : float
        How long after it an instant is estimated, so that samples taken by then arrive. [s]
    interpolate : tuple of str
        Sources brought to an instant on the line between the samples around it, where the later one
        has arrived; by its last sample otherwise.
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
    latency_s: float = 0.0
    interpolate: tuple[str, ...] = ()
    max_age_s: dict[str, Unbounded] = field(default_factory=dict)
    default_max_age_s: Unbounded = 3600.0
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
        if not 0 <= self.latency_s <= 1e9:
            raise ParameterError(
                f"[align] expected latency_s ≥ 0, at most 1e9, received {self.latency_s}"
            )
        for name, age in {"default_max_age_s": self.default_max_age_s, **self.max_age_s}.items():
            if not age > 0:
                raise ParameterError(f"[align] expected {name} > 0, received {age}")

    def fits(self, channels: pd.DataFrame) -> None:
        """Whether the sources that are named are there.

        Raises
        ------
        ParameterError
            If a name is no source of the channels, or a variant has nothing to work on.
        """
        there = sorted(set(channels["source"]))
        variants = self.variants or (Variant(self.variant),)
        named = {"interpolate": self.interpolate, "max_age_s": tuple(self.max_age_s)}
        named |= {f"variants] {v.name!r}: face_value": v.face_value for v in variants}
        for where, sources in named.items():
            for name in sources:
                if name not in there:
                    raise ParameterError(
                        f"[align{'' if ']' in where else ']'} {where}: no channel has the source "
                        f"{name!r}: expected one of {', '.join(there)}"
                    )
        for variant in variants:
            timed, forecast = variant.time != "none", variant.pseudo != "none"
            for asked, part, sources in (
                (timed, "time", self.time.sources),
                (forecast, "pseudo", self.pseudo.sources),
            ):
                if asked and not set(sources) & set(there):
                    raise ParameterError(
                        f"[align.variants] {variant.name!r} works on {', '.join(sources)}, but the "
                        f"channels have {', '.join(there)}: name others in [align.{part}] sources"
                    )
            if timed and not (channels["quantity"] == Quantity.I_KA).any():
                raise ParameterError(
                    f"[align.variants] {variant.name!r}: sampling times are found beside measured "
                    'currents, but no channel is i_ka: use time = "none"'
                )


def align(
    validated: pd.DataFrame,
    channels: pd.DataFrame,
    model: Model,
    study: Study,
    params: AlignParams | None = None,
) -> pd.DataFrame:
    """Bring usable samples to the estimation instants.

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
        Table ``aligned``: per variant, trial, instant and channel the usable sample of latest time
        stamp among those that had *arrived* when the instant is estimated; absent where none is
        young enough.

    Raises
    ------
    TableError
        If a channel is not in the channels table, or no sample falls into the study.
    ParameterError
        If a source that is named is not there.

    Notes
    -----
    A channel that moves as a random walk with variance rate r leaves, at age a and for means over
    W, the variance r (a + W/3), and a fraction u between two samples that lie g apart the variance
    r g u (1-u): that is added to the samples' own, and r times the spread that is left of a
    recovered sampling time. r comes from samples before the study, so nothing after an instant is
    known at it.
    """
    params = params or AlignParams()
    params.fits(channels)
    layout = SensorLayout.from_channels(channels, model)
    validated = _within(validated, study, params)
    column = pd.Index(layout.channel).get_indexer(validated["channel"])
    if (column < 0).any():
        name = validated["channel"].iloc[int(np.argmin(column))]
        raise TableError(
            f"validated: channel {name!r} is not in the channels table: add it there, or drop it"
        )
    instants = instants_of(study)
    wait = round(params.latency_s * MICROSECOND)
    source = channels["source"].to_numpy(dtype=object)
    start = start_of(study)
    stamped: dict[str, Samples] = {}
    tables = []
    for variant in params.variants or (Variant(params.variant),):
        if variant.time not in stamped:
            stamps = None
            if variant.time != "none":
                if not isinstance(model, Network):
                    raise ParameterError(
                        f"[align.variants] {variant.name!r}: sampling times come from currents "
                        'of a grid, but the case is about a machine: use time = "none"'
                    )
                stamps = sampling_times(
                    validated, layout, source, model, instants + wait, start, params.time,
                    variant.time,
                )  # fmt: skip
            stamped[variant.time] = Samples.of(validated, column, layout, stamps)
        samples = stamped[variant.time]
        tables.append(_fuse(samples, instants, wait, layout, source, study, params, variant))
    return check("aligned", pd.concat(tables, ignore_index=True))


def _within(validated: pd.DataFrame, study: Study, params: AlignParams) -> pd.DataFrame:
    """Samples that an instant of the history or the study may use.

    A clock that was reset stamps samples decades away; nothing is to be laid out over them.
    """
    oldest = max(params.default_max_age_s, *params.max_age_s.values(), params.pseudo.window_s)
    # Infinity is no length of time that can be subtracted.
    oldest = min(oldest, CENTURY_S)
    latest = params.latency_s + params.time.largest_delay_s
    since, until = (pd.Timestamp(t).tz_convert("UTC") for t in (study.history_start, study.end))
    since -= pd.Timedelta(seconds=oldest)
    times = validated["time_utc"]
    inside = validated[(times >= since) & (times < until + pd.Timedelta(seconds=latest))]
    begun = pd.Timestamp(study.start).tz_convert("UTC") - pd.Timedelta(seconds=oldest)
    if len(validated) and not ((inside["time_utc"] >= begun) & (inside["time_utc"] < until)).any():
        raise TableError(
            f"telemetry reaches from {times.min():%Y-%m-%d %H:%M} to {times.max():%Y-%m-%d %H:%M} "
            f"UTC, the study asks for {study.start:%Y-%m-%d %H:%M} to {study.end:%Y-%m-%d %H:%M}: "
            "move [study] start and end"
        )
    return inside


def _fuse(
    samples: Samples,
    instants: IntArray,
    wait: int,
    layout: SensorLayout,
    source: npt.NDArray[np.object_],
    study: Study,
    params: AlignParams,
    variant: Variant,
) -> pd.DataFrame:
    """The aligned rows of one variant."""
    limit = np.array([params.max_age_s.get(s, params.default_max_age_s) for s in source])
    at, row = samples.latest(instants, wait)
    age = (instants[at] - samples.time[row]) / MICROSECOND
    young = age <= limit[samples.column[row]]
    at, row, age = at[young], row[young], age[young]
    place = samples.column[row]
    value = samples.value[row]
    own = samples.noise(row, layout)
    grown = np.zeros(len(row))
    rate = np.zeros(int(samples.group.max(initial=-1)) + 1)
    # A stamp that is off by δ reads a walk that has moved by r |δ|.
    doubt = samples.doubt
    if params.growth == "history":
        rate = samples.movement(layout, start_of(study), study.step_s)
        own = np.sqrt(own**2 + rate[samples.group[row]] * doubt[row])
        grown = np.sqrt(rate[samples.group[row]] * (age + layout.window_s[place] / 3.0))
        grown[np.isin(source, variant.face_value)[place]] = 0.0
    first = first_use(at, row)
    stands = row.copy()

    between = np.isin(source, params.interpolate)[place] & (layout.window_s[place] == 0)
    between &= samples.following(at, row, instants, wait)
    if between.any():
        left, right = row[between], row[between] + 1
        gap = (samples.time[right] - samples.time[left]) / MICROSECOND
        share = age[between] / gap
        change = samples.value[right] - samples.value[left]
        change = np.where(layout.angular[place[between]], wrap(change), change)
        value[between] += share * change
        bridge = rate[samples.group[left]] * gap * share * (1 - share)
        late = np.sqrt(
            samples.noise(right, layout) ** 2 + rate[samples.group[right]] * doubt[right]
        )
        noise = np.hypot((1 - share) * own[between], share * late)
        # The value is one of the instant: what is left of the movement is not the age's doing.
        own[between], grown[between], age[between] = np.sqrt(noise**2 + bridge), 0.0, 0.0
        first[between] = first_use(at[between], right)
        stands[between] = np.where(share > 0.5, right, left)

    origin = np.where(first, str(Origin.MEASURED), str(Origin.HELD)).astype(object)
    if variant.pseudo != "none":
        old = np.isin(source, params.pseudo.sources)[place] & (age > params.pseudo.window_s)
        value[old], own[old] = _forecasts(
            samples, at[old], row[old], instants, layout, study, params.pseudo, variant.pseudo
        )
        origin[old], grown[old], age[old] = str(Origin.PSEUDO), 0.0, 0.0
    order = np.lexsort((place, at, samples.trial[row]))
    times = pd.DatetimeIndex(instants.astype("datetime64[us]"), tz="UTC")
    stands, place = stands[order], place[order]
    taken = pd.DatetimeIndex(samples.time[stands].astype("datetime64[us]"), tz="UTC")
    return pd.DataFrame(
        {
            "variant": variant.name,
            "trial": samples.trial[stands].astype(np.int32),
            "time_utc": times[at[order]],
            "channel": np.asarray(layout.channel, dtype=object)[place],
            "value_pu": value[order],
            "sigma_pu": np.hypot(own, grown)[order],
            "sigma_age_pu": grown[order],
            "origin": origin[order],
            "sample_utc": taken,
            "time_confidence": samples.confidence[stands],
            "age_s": age[order],
            "flag": samples.flag[stands],
            "reasons": samples.reasons[stands],
        }
    )


def _forecasts(
    samples: Samples,
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
