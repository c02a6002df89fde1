"""Sampling times for a table of telemetry: devices without a clock and their partners."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.alignment import dtw, lag, lending
from pse_analysis.alignment.dtw import METHODS, NONE, Method, Stamps, TimeParams
from pse_analysis.alignment.lag import Reference
from pse_analysis.alignment.lending import Lender
from pse_analysis.arrays import FloatArray, IntArray, utc_microseconds
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, IM, TO, P, Q, SensorLayout, standard_deviation
from pse_analysis.vocabulary import usable

MICROSECOND = 1_000_000
ALONE = 0.5
"""Correlation that a partner must show which is not in series with the device."""
RESTS_ON: tuple[str, ...] = (*METHODS, "lent")
"""What a stamp may rest on: one of the methods, or the usual delays of other devices."""
LENT = len(METHODS)


@dataclass(frozen=True, eq=False)
class SamplingTimes:
    """When the samples of a telemetry table were taken, row by row.

    Attributes
    ----------
    time : (n,) ndarray of int64
        Microseconds since 1970 UTC.
    confidence : (n,) ndarray
        1 where the stamp is the source's own and nothing was asked; else from
        `pse_analysis.alignment.dtw.Stamps`, so 0 where the delay is lent.
    doubt : (n,) ndarray
        Standard deviation of the stamp; half the largest delay where it is left alone. [s]
    method : (n,) ndarray of int8
        Index into `RESTS_ON`.
    partner : dict of str to str
        Channel that each device was matched with; absent where there is none.
    """

    time: IntArray
    confidence: FloatArray
    doubt: FloatArray
    method: npt.NDArray[np.int8]
    partner: dict[str, str]


@dataclass(frozen=True, eq=False)
class _Dated:
    """Stamps of one device: of its rows in the table, each at a position among its arrivals."""

    source: str
    rows: IntArray
    at: IntArray
    arrival: FloatArray
    found: Stamps


def sampling_times(
    validated: pd.DataFrame,
    layout: SensorLayout,
    source: npt.NDArray[np.object_],
    network: Network,
    instants: IntArray,
    study_start: int,
    params: TimeParams | None = None,
    method: Method = "dtw",
) -> SamplingTimes:
    """Recover the sampling times of devices that stamp by arrival.

    Parameters
    ----------
    validated : DataFrame
        Table ``validated``.
    layout : SensorLayout
        Of all channels.
    source : (m,) ndarray of str
        Source of every row of the layout.
    network : Network
    instants : (T,) ndarray of int64
        A stamp is settled at the first instant after the arrival. [µs]
    study_start : int
        Partners are chosen on what arrived before it. [µs]
    params : TimeParams, optional
    method : {"none", "xcorr", "dtw"}

    Returns
    -------
    SamplingTimes

    Notes
    -----
    Only samples of ``params.sources`` whose stamp is their arrival change. All channels of one
    device share its delays, because they arrive together. What ``dtw`` would leave alone is late by
    what the other devices of its source usually are, where enough of them are sure of theirs and
    agree (`pse_analysis.alignment.lending`).
    """
    params = params or TimeParams()
    n = len(validated)
    stamp, arrival = (microseconds(validated[c]) for c in ("time_utc", "arrival_utc"))
    out = SamplingTimes(stamp.copy(), np.ones(n), np.zeros(n), np.zeros(n, dtype=np.int8), {})
    if method == "none" or not n:
        return out
    column = pd.Index(layout.channel).get_indexer(validated["channel"])
    clockless = np.isin(source, params.sources)[column] & (stamp == arrival)
    trial = validated["trial"].to_numpy()
    device = pd.factorize(
        pd.Series(layout.channel).str.rsplit(":", n=1).str[0].to_numpy(dtype=object)
    )[0]
    value = validated["corrected"].to_numpy(dtype=float) * layout.scale[column]
    good = usable(validated["flag"].to_numpy()) & np.isfinite(value)
    base = int(instants[0])
    seconds = (instants - base) / MICROSECOND
    study_begins = (study_start - base) / MICROSECOND
    chosen: dict[int, list[int]] = {}
    for number in np.unique(trial):
        mine = trial == number
        references = _references(
            layout, source, column, (stamp - base) / MICROSECOND, (arrival - base) / MICROSECOND,
            value, mine & good,
        )  # fmt: skip
        dated = []
        for place in np.unique(device[column[mine & clockless]]):
            rows = np.flatnonzero(mine & clockless & (device[column] == place))
            spot = int(column[rows[0]])
            came, current, sigma = _current(layout, column, arrival, value, rows, good)
            when = (came - base) / MICROSECOND
            if place not in chosen:
                chosen[place] = _ranked(
                    network, layout, spot, references, when, current, params, study_begins
                )
            found = Stamps.untouched(len(when), params)
            if chosen[place]:
                partner = chosen[place][0]
                out.partner[layout.channel[spot].rsplit(":", 1)[0]] = layout.channel[partner]
                if partner in references:
                    found = dtw.recover(
                        when, current, sigma, references[partner], seconds, params, method
                    )
            at = np.searchsorted(came, arrival[rows])
            dated.append(_Dated(str(source[spot]), rows, at, when, found))
        if method == "dtw":
            _lend(dated, seconds, params)
        for one in dated:
            rows, at, found = one.rows, one.at, one.found
            out.time[rows] = arrival[rows] - np.rint(found.delay[at] * MICROSECOND).astype(np.int64)
            out.confidence[rows] = found.confidence[at]
            out.doubt[rows] = found.doubt[at]
            out.method[rows] = found.method[at]
    return out


def rms_errors(
    times: SamplingTimes, validated: pd.DataFrame, sample_truth: pd.DataFrame, since: pd.Timestamp
) -> pd.DataFrame:
    """RMS time error of recovered stamps against the true sampling times.

    Parameters
    ----------
    times : SamplingTimes
    validated, sample_truth : DataFrame
        Tables of these names.
    since : Timestamp
        Only samples that arrived from then on.

    Returns
    -------
    DataFrame
        ``device``, ``method`` that the stamp rests on, ``count``, ``rms_s`` of it and ``arrival_s``
        of the arrival taken for the sampling time; devices with neither a partner nor a lent delay
        are left out.
    """
    key = ["trial", "channel", "seq"]
    frame = validated[[*key, "arrival_utc"]].assign(
        time=times.time, how=np.array(RESTS_ON, dtype=object)[times.method]
    )
    frame["device"] = frame["channel"].str.rsplit(":", n=1).str[0]
    known = {*times.partner, *frame["device"][times.method != NONE]}
    frame = frame[frame["device"].isin(known) & (frame["arrival_utc"] >= since)]
    frame = frame.merge(sample_truth[[*key, "time_utc"]], on=key)
    true = microseconds(frame["time_utc"])
    frame["error"] = (frame["time"] - true) / MICROSECOND
    frame["late"] = (microseconds(frame["arrival_utc"]) - true) / MICROSECOND
    grouped = frame.groupby(["device", "how"], sort=True)
    return pd.DataFrame(
        {
            "count": grouped.size(),
            "rms_s": grouped["error"].apply(_rms),
            "arrival_s": grouped["late"].apply(_rms),
        }
    ).reset_index(names=["device", "method"])


def _lend(dated: list[_Dated], instants: FloatArray, params: TimeParams) -> None:
    """Let samples that were left alone have the usual delay of the other devices of their source.

    What is lent has confidence 0, so nobody lends it on and the order of devices does not matter.
    """
    for one in dated:
        alone = np.flatnonzero(one.found.method == NONE)
        others = [m for m in dated if m is not one and m.source == one.source]
        if not len(alone) or not params.lenders:
            continue
        lenders = [
            Lender(m.arrival[sure], m.found.delay[sure], m.found.doubt[sure])
            for m, sure in ((m, params.sure(m.found.confidence)) for m in others)
        ]
        delay, sigma = lending.lend(
            lenders, instants, params.lag_window_s, params.ignorant_s, params.lenders
        )
        # As known at the first instant after the arrival, like every other stamp.
        when = np.minimum(np.searchsorted(instants, one.arrival[alone]), len(instants) - 1)
        lent = np.isfinite(delay[when])
        alone, when = alone[lent], when[lent]
        one.found.delay[alone], one.found.doubt[alone] = delay[when], sigma[when]
        one.found.method[alone] = LENT


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(values.to_numpy(dtype=float) ** 2)))


def microseconds(times: pd.Series) -> IntArray:
    """Times as whole numbers. [µs since 1970 UTC]"""
    return utc_microseconds(times).astype(np.int64)


def _references(
    layout: SensorLayout,
    source: npt.NDArray[np.object_],
    column: IntArray,
    stamp: FloatArray,
    arrival: FloatArray,
    value: FloatArray,
    rows: npt.NDArray[np.bool_],
) -> dict[int, Reference]:
    """Currents of the phasor units of one trial, by row of the layout; times in s."""
    out = {}
    for place in np.flatnonzero((source == "pmu") & (layout.quantity == IM) & (layout.side != BUS)):
        own = np.flatnonzero(rows & (column == place))
        own = own[np.argsort(stamp[own], kind="stable")]
        own = own[np.append(True, np.diff(stamp[own]) > 0)] if len(own) else own
        if len(own) >= lag.FEWEST:
            out[int(place)] = Reference.of(stamp[own], arrival[own], value[own])
    return out


def _current(
    layout: SensorLayout,
    column: IntArray,
    arrival: IntArray,
    value: FloatArray,
    rows: IntArray,
    good: npt.NDArray[np.bool_],
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Arrivals of a device, its current magnitude and σ: measured, or apparent power at 1 p.u.

    The current is NaN where it, or a half of the power, is missing or bad.
    """
    wide = pd.DataFrame(
        {
            "at": arrival[rows],
            "kind": layout.quantity[column[rows]],
            "value": np.where(good[rows], value[rows], np.nan),
        }
    ).pivot_table(index="at", columns="kind", values="value", aggfunc="first", dropna=False)
    some = layout.sigma[column[rows[:1]]], layout.relative[column[rows[:1]]]
    came = wide.index.to_numpy(np.int64)
    if IM in wide:
        current = wide[IM].to_numpy()
        return came, current, standard_deviation(current, *some)
    if P not in wide or Q not in wide:
        nothing = np.full(len(came), np.nan)
        return came, nothing, nothing
    power = wide[[P, Q]].to_numpy()
    size = np.maximum(np.hypot(*power.T), 1e-9)
    sigma = np.hypot(*(power * standard_deviation(power, *some)).T) / size
    return came, size, np.maximum(sigma, 1e-9)


def _ranked(
    network: Network,
    layout: SensorLayout,
    spot: int,
    references: dict[int, Reference],
    when: FloatArray,
    current: FloatArray,
    params: TimeParams,
    until: float,
) -> list[int]:
    """Phasor currents in the order in which they suit a device.

    Those in series with it, the source feeding one through the other, come first, then those that
    correlate by at least `ALONE`; among equals the one whose increments correlate best, at the best
    lag, in the history.
    """
    if not references:
        return []
    past = when < until
    past = past if past.sum() > lag.FEWEST else np.ones(len(when), dtype=bool)
    feeding = _feeding(network)
    own = _far_end(network, layout, spot, feeding)
    rank = {}
    for place, reference in references.items():
        far = _far_end(network, layout, place, feeding)
        series = far in feeding[own] or own in feeding[far]
        found = dtw.correlation(when[past], current[past], reference, params)
        if series or found >= ALONE:
            rank[place] = (not series, -found)
    return sorted(rank, key=lambda place: rank[place])


def _feeding(network: Network) -> list[set[int]]:
    """Buses on the shortest way from the slack to each bus, itself included."""
    neighbours: list[list[int]] = [[] for _ in range(network.n_bus)]
    for a, b, on in zip(
        network.branches.from_bus,
        network.branches.to_bus,
        network.branches.in_service,
        strict=True,
    ):
        if on:
            neighbours[a].append(int(b))
            neighbours[b].append(int(a))
    way: list[set[int]] = [set() for _ in range(network.n_bus)]
    way[network.slack] = {network.slack}
    queue = deque([network.slack])
    while queue:
        bus = queue.popleft()
        for other in neighbours[bus]:
            if not way[other]:
                way[other] = {*way[bus], other}
                queue.append(other)
    return way


def _far_end(network: Network, layout: SensorLayout, row: int, feeding: list[set[int]]) -> int:
    """The end of a metered branch that lies farther from the source; the bus of a bus."""
    place = int(layout.position[row])
    if layout.side[row] == BUS:
        return place
    ends = int(network.branches.from_bus[place]), int(network.branches.to_bus[place])
    return max(ends, key=lambda bus: (len(feeding[bus]), layout.side[row] == TO))
