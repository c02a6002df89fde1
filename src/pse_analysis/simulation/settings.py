"""What a case file may say about its simulation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

from pse_analysis.errors import ParameterError
from pse_analysis.parameters import Unbounded
from pse_analysis.vocabulary import FaultKind, Quantity, Source

SHORTEST_S = 1e-6
"""Stamps count microseconds. [s]"""
LONGEST_S = 1e9
"""Thirty years, beyond any study. [s]"""
MOST_SAMPLES = 300_000_000
"""Samples, or true values, of one simulation, which are held in memory."""


def _require(condition: bool, where: str, expected: str, received: object) -> None:
    if not condition:
        raise ParameterError(f"[{where}] expected {expected}, received {received!r}")


def require_few(count: float, what: str) -> None:
    """Refuse a simulation that does not fit into memory.

    Raises
    ------
    ParameterError
        With the number of values, and what makes them fewer.
    """
    if not count <= MOST_SAMPLES:
        raise ParameterError(
            f"[simulate] {count:.3g} {what} are to be drawn, expected at most {MOST_SAMPLES:g}: "
            "raise period_s or truth_step_s, or lower trials, history_s or the number of channels"
        )


@dataclass(frozen=True)
class LoadParams:
    """How loads are made of curves.

    Attributes
    ----------
    classes
        Curves to draw from, e.g. ``lv_rural1``: ``<class>_pload`` and ``<class>_qload``.
    per_bus
        Classes mixed at a bus, drawn without replacement.
    concentration
        Of the Dirichlet law of their weights; large: equal shares.
    level
        Mean load over the week, relative to the nominal load. [1]
    rho1
        Lag-1 autocorrelation of the load's increments per truth step.
    window
        Quarter hours over which the volatility of the bridge is averaged.
    """

    classes: tuple[str, ...] = (
        *("lv_rural1", "lv_rural2", "lv_semiurb4", "lv_semiurb5", "lv_urban6"),
        *("H0-H", "G3-H", "G4-H", "BL-H", "WB-H", "G0-M", "G3-M", "G4-M", "L2-M"),
    )
    per_bus: int = 3
    concentration: float = 2.0
    level: float = 0.6
    rho1: float = 0.0
    window: int = 8

    def __post_init__(self) -> None:
        where = "simulate.load"
        n = len(self.classes)
        _require(1 <= self.per_bus <= n, where, f"per_bus in 1 … {n}", self.per_bus)
        _require(
            1e-3 <= self.concentration <= 1e6,
            where,
            "concentration > 0, 0.001 … 1e6",
            self.concentration,
        )
        _require(0 < self.level <= 1e3, where, "level > 0, at most 1000", self.level)
        _require(-1 < self.rho1 < 1, where, "-1 < rho1 < 1", self.rho1)
        _require(1 <= self.window <= 1e6, where, "window ≥ 1, at most 1e6", self.window)


@dataclass(frozen=True)
class SourceVoltageParams:
    """How the slack bus's voltage moves about its set-point.

    Attributes
    ----------
    sigma_pu, time_constant_s
        Standard deviation and time constant of a stationary AR(1) process. [p.u., s]
    tap_pu, taps_per_day, max_taps
        Size and mean number of tap changes, and how far they may lead from the set-point.
    """

    sigma_pu: float = 0.002
    time_constant_s: float = 1800.0
    tap_pu: float = 0.00625
    taps_per_day: float = 6.0
    max_taps: int = 2

    def __post_init__(self) -> None:
        where = "simulate.source_voltage"
        _require(0 <= self.sigma_pu <= 1, where, "sigma_pu ≥ 0, at most 1", self.sigma_pu)
        _require(
            SHORTEST_S <= self.time_constant_s <= LONGEST_S,
            where,
            f"time_constant_s > 0, {SHORTEST_S:g} … {LONGEST_S:g}",
            self.time_constant_s,
        )
        _require(abs(self.tap_pu) <= 1, where, "tap_pu of at most 1 in size", self.tap_pu)
        _require(
            0 <= self.taps_per_day <= 1e6, where, "taps_per_day ≥ 0, at most 1e6", self.taps_per_day
        )
        _require(0 <= self.max_taps <= 1000, where, "max_taps ≥ 0, at most 1000", self.max_taps)


@dataclass(frozen=True)
class LoadStepParams:
    """Steps of single loads, as machines, pumps and tariff switches make them.

    Attributes
    ----------
    per_day
        Mean number of steps of each load. [1/day]
    size
        Range of a step, relative to the nominal load; up or down with equal odds.
    duration_s
        Range of the time until the load steps back. [s]
    at
        Names of the buses whose loads step; empty for all.
    """

    per_day: float = 0.0
    size: tuple[float, float] = (0.1, 0.3)
    duration_s: tuple[float, float] = (600.0, 5400.0)
    at: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        where = "simulate.load_steps"
        _require(0 <= self.per_day <= 1e5, where, "per_day ≥ 0, at most 1e5", self.per_day)
        for name, most in (("size", 1e3), ("duration_s", LONGEST_S)):
            low, high = getattr(self, name)
            _require(
                0 < low <= high <= most,
                where,
                f"{name} = [low, high], 0 < low ≤ high ≤ {most:g}",
                (low, high),
            )


@dataclass(frozen=True)
class PvParams:
    """A PV plant at unity power factor: bus name, rated power [MW] and its curve."""

    bus: str
    peak_mw: float
    profile: str = "PV1"

    def __post_init__(self) -> None:
        _require(abs(self.peak_mw) <= 1e6, "simulate.pv", "peak_mw of at most 1e6", self.peak_mw)


@dataclass(frozen=True)
class SensorParams:
    """A group of like sensors.

    Attributes
    ----------
    source
        ``scada``, ``pmu`` or ``ami``.
    quantities
        What each of them measures.
    at
        Elements (``bus/6``, ``branch/7-8``) or groups: ``buses``, ``loads`` (buses with a nominal
        load), ``injections`` (with load or generation), ``branches`` (in service).
    sigma, sigma_kind
        Standard deviation, in the channel's unit or as a fraction of the magnitude
        (`pse_analysis.measurement.standard_deviation` states the floor).
    period_s, phase_s
        Samples stand at history start + phase + j·period; a mean first after a full period. [s]
    side
        Metered end of branches.
    aggregation
        ``instant``, or ``mean`` over the truth instants in (stamp − period, stamp].
    delay_s, jitter_s
        A sample arrives delay + U(0, jitter) after its sampling time, the jitter of each sample
        being its own; all quantities that one element measures arrive together. [s]
    wander_s, wander_time_s
        Range of a part of the delay that drifts between 0 and ``wander_s``, each element's on its
        own, as congestion of a network does, and the integral of its autocorrelation. With it
        jitter and drift must leave the samples in their order. [s]
    stamp
        ``sampling``: the time stamp is the sampling time. ``arrival``: the source has no clock, and
        the master station stamps what arrives.
    sign
        −1 for a source that counts consumption, or flow out of the branch, as positive.
    limits
        Credible range by quantity, in the channel's unit.
    limit_factor
        Credible range of powers and currents without one in ``limits``: this multiple of the
        apparent power or current at nominal load; 0 for none.
    """

    source: str
    quantities: tuple[str, ...]
    at: tuple[str, ...]
    sigma: float
    period_s: float
    sigma_kind: Literal["absolute", "relative"] = "absolute"
    phase_s: float = 0.0
    side: Literal["from", "to"] = "from"
    aggregation: Literal["instant", "mean"] = "instant"
    delay_s: float = 0.0
    jitter_s: float = 0.0
    wander_s: float = 0.0
    wander_time_s: float = 1800.0
    stamp: Literal["sampling", "arrival"] = "sampling"
    sign: Literal[1, -1] = 1
    limits: Mapping[str, tuple[Unbounded, Unbounded]] = field(default_factory=dict)
    limit_factor: float = 0.0

    def __post_init__(self) -> None:
        where = "simulate.sensors"
        sources = [str(s) for s in Source if s is not Source.PSEUDO]
        _require(self.source in sources, where, f"source in {', '.join(sources)}", self.source)
        known = [str(q) for q in Quantity]
        for name in (*self.quantities, *self.limits):
            _require(name in known, where, f"quantities in {', '.join(known)}", name)
        _require(bool(self.quantities) and bool(self.at), where, "quantities and at", self.at)
        _require(self.sigma > 0, where, "sigma > 0", self.sigma)
        _require(1e-12 <= self.sigma <= 1e12, where, "sigma in 1e-12 … 1e12", self.sigma)
        _require(
            self.sigma_kind != "relative" or self.sigma <= 1,
            where,
            "a relative sigma of at most 1, a fraction of the magnitude (1 % is 0.01)",
            self.sigma,
        )
        for name in ("period_s", "wander_time_s"):
            _require(
                SHORTEST_S <= getattr(self, name) <= LONGEST_S,
                where,
                f"{name} > 0, {SHORTEST_S:g} … {LONGEST_S:g}",
                getattr(self, name),
            )
        for name in ("phase_s", "delay_s", "jitter_s", "wander_s", "limit_factor"):
            _require(
                0 <= getattr(self, name) <= LONGEST_S,
                where,
                f"{name} ≥ 0, at most {LONGEST_S:g}",
                getattr(self, name),
            )
        for name, (low, high) in self.limits.items():
            _require(low <= high, where, f"limits of {name} = [low, high], low ≤ high", (low, high))
        if self.wander_s:
            # Five standard deviations of the drift over a period, where it drifts fastest.
            fraction = 2.0 * self.period_s / self.wander_time_s
            changed = math.sqrt(2.0 - 2.0 * (1.0 + fraction) * math.exp(-fraction))
            drift = self.wander_s * min(1.0, 5.0 * changed / math.sqrt(2.0 * math.pi))
            _require(
                self.jitter_s + drift < self.period_s,
                where,
                f"jitter_s + drift over a period ({drift:.0f} s) < period_s = {self.period_s:g}, "
                "or samples overtake each other: lower jitter_s or wander_s, or raise "
                "wander_time_s",
                self.jitter_s,
            )


@dataclass(frozen=True)
class FaultParams:
    """One kind of fault of telemetry; a sample has at most one fault, the first in the list.

    Attributes
    ----------
    kind
        ``spike``, ``stale``, ``lost``, ``duplicated``, ``delayed`` or ``empty`` (a telegram without
        a value).
    rate
        Share of the samples concerned (for ``stale``: of samples inside episodes), on average.
    size
        Range from which the size is drawn uniformly; its meaning follows the kind:
        spike: multiples of the channel's σ, or of the true magnitude if ``relative``, of random
        sign; stale: length of an episode [s]; duplicated: how much later the copy arrives [s];
        delayed: how much later than usual the sample arrives [s]; lost, empty: unused.
    relative
        Whether the size of spikes is relative to the true magnitude.
    source, quantities, at
        Only these channels; empty for all. ``at`` lists elements.
    start, end
        Only samples taken in [start, end).
    """

    kind: str
    rate: float
    size: tuple[float, float] = (0.0, 0.0)
    relative: bool = False
    source: str = ""
    quantities: tuple[str, ...] = ()
    at: tuple[str, ...] = ()
    start: datetime | None = None
    end: datetime | None = None

    def __post_init__(self) -> None:
        where = "simulate.faults"
        kinds = [str(k) for k in FaultKind]
        _require(self.kind in kinds, where, f"kind in {', '.join(kinds)}", self.kind)
        _require(0 <= self.rate <= 1, where, "rate in 0 … 1", self.rate)
        low, high = self.size
        needs_size = self.kind not in (FaultKind.LOST, FaultKind.EMPTY)
        most = 1e6 if self.kind == FaultKind.SPIKE else LONGEST_S
        _require(
            (0 < low <= high <= most) if needs_size else True,
            where,
            f"size = [low, high] with 0 < low ≤ high ≤ {most:g} for {self.kind!r}",
            self.size,
        )
        _require(
            not self.source or self.source in [str(s) for s in Source],
            where,
            f"source in {', '.join(Source)}, or none for all",
            self.source,
        )
        known = [str(q) for q in Quantity]
        for name in self.quantities:
            _require(name in known, where, f"quantities in {', '.join(known)}", name)
        for name in ("start", "end"):
            time = getattr(self, name)
            _require(time is None or time.tzinfo is not None, where, f"{name} with 'Z'", time)


@dataclass(frozen=True)
class SimulateParams:
    """Everything that a simulated case is made of; one seed gives the same bytes again.

    Attributes
    ----------
    seed
        Of all randomness. The mix of load classes belongs to the case and is shared by its trials;
        bridges, source voltage, noise and faults belong to a trial. A trial does not depend on how
        many there are, nor a sensor group's noise on the groups after it.
    trials
        Number of realisations.
    truth_step_s
        Step of the truth; divides 900 s and the study's step. [s]
    """

    seed: int
    sensors: tuple[SensorParams, ...]
    trials: int = 1
    truth_step_s: float = 60.0
    load: LoadParams = field(default_factory=LoadParams)
    load_steps: LoadStepParams = field(default_factory=LoadStepParams)
    source_voltage: SourceVoltageParams = field(default_factory=SourceVoltageParams)
    pv: tuple[PvParams, ...] = ()
    faults: tuple[FaultParams, ...] = ()

    def __post_init__(self) -> None:
        _require(self.seed >= 0, "simulate", "seed ≥ 0", self.seed)
        _require(self.trials >= 1, "simulate", "trials ≥ 1", self.trials)
        _require(
            SHORTEST_S <= self.truth_step_s <= 900 and (900.0 / self.truth_step_s).is_integer(),
            "simulate",
            "truth_step_s that divides 900",
            self.truth_step_s,
        )
        _require(bool(self.sensors), "simulate", "at least one [[simulate.sensors]]", self.sensors)
