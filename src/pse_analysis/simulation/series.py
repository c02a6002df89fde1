"""One seed to the raw case of metered loads: generated ones and real curves at their own step.

There is no measurement model in it: every series is what a meter reads, its own noise included, as
the increments of eq. (2) of [anishchenko2018] include it. So nothing stands between a check and
the series that it is tried on, and no real curve is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np
import pandas as pd

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import ParameterError
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.parameters import Study, Unbounded
from pse_analysis.simulation import faults
from pse_analysis.simulation.case import sample_tables, utc
from pse_analysis.simulation.profiles import PROFILE_STEP_S, ar1, column
from pse_analysis.simulation.scenario import SECOND, microseconds
from pse_analysis.simulation.sensors import Samples
from pse_analysis.simulation.settings import LONGEST_S, SHORTEST_S, FaultParams, require_few
from pse_analysis.telemetry import RawCase
from pse_analysis.vocabulary import Aggregation, Quantity, SigmaKind, Source

SOURCE_BUS = "source"
BASE_MVA = 100.0
VN_KV = 110.0
_X_PU = 0.01
LARGEST_MW = 1e9


@dataclass(frozen=True)
class StepParams:
    """A true change of level: from ``at`` on the load is higher by ``size_mw``."""

    at: datetime
    size_mw: float

    def __post_init__(self) -> None:
        if self.at.tzinfo is None:
            raise ParameterError(
                f"[simulate.generated.steps] at has no time zone: received {self.at.isoformat()}; "
                "append 'Z'"
            )


@dataclass(frozen=True)
class GeneratedParams:
    """A load whose increments are AR(1).

    Attributes
    ----------
    name : str
        Of its bus.
    level_mw : float
        Load before the first sample. [MW]
    sigma_mw : float
        Standard deviation of its increments over a period. [MW]
    rho1 : float
        Their autocorrelation at lag 1; ρ_j = ρ₁ʲ.
    period_s : float
    limits : (2,) tuple of float
        Credible range. [MW]
    steps : tuple of StepParams
        True changes of level on top.
    """

    name: str
    level_mw: float
    sigma_mw: float
    rho1: float = 0.5
    period_s: float = 120.0
    limits: tuple[Unbounded, Unbounded] = (0.0, np.inf)
    steps: tuple[StepParams, ...] = ()

    def __post_init__(self) -> None:
        where = f"[simulate.generated] {self.name}"
        if not (0 < self.sigma_mw <= LARGEST_MW and SHORTEST_S <= self.period_s <= LONGEST_S):
            raise ParameterError(
                f"{where}: expected sigma_mw > 0 and period_s > 0, received {self.sigma_mw} and "
                f"{self.period_s}; at most {LARGEST_MW:g} MW, and {SHORTEST_S:g} … {LONGEST_S:g} s"
            )
        if not abs(self.level_mw) <= LARGEST_MW:
            raise ParameterError(
                f"{where}: expected level_mw of at most {LARGEST_MW:g}, received {self.level_mw}"
            )
        if not -1.0 < self.rho1 < 1.0:
            raise ParameterError(f"{where}: expected -1 < rho1 < 1, received {self.rho1}")


@dataclass(frozen=True)
class CurveParams:
    """A real curve, read at each of its own points.

    Attributes
    ----------
    name : str
        Of its bus.
    profile : str
        Column of the load profiles, e.g. ``G3-H_pload``.
    peak_mw : float
        Load where the curve is 1. [MW]
    limits : (2,) tuple of float
        Credible range. [MW]
    """

    name: str
    profile: str
    peak_mw: float
    limits: tuple[Unbounded, Unbounded] = (0.0, np.inf)

    def __post_init__(self) -> None:
        if not 0 < self.peak_mw <= LARGEST_MW:
            raise ParameterError(
                f"[simulate.curves] {self.name}: expected peak_mw > 0, at most {LARGEST_MW:g}, "
                f"received {self.peak_mw}"
            )


@dataclass(frozen=True)
class SeriesSimulateParams:
    """Everything that a case of metered loads is made of; one seed gives the same bytes again.

    Attributes
    ----------
    seed : int
        Of all randomness; a trial does not depend on how many there are.
    trials : int
        Each draws its own generated loads and faults; real curves are the same in all.
    generated : tuple of GeneratedParams
    curves : tuple of CurveParams
    accuracy : float
        σ of a meter over its reading, as the table of channels states it.
    faults : tuple of FaultParams
        Spikes that are not relative count in σ of the series' own good increments, as A = a/σ does.
    """

    seed: int
    trials: int = 1
    generated: tuple[GeneratedParams, ...] = ()
    curves: tuple[CurveParams, ...] = ()
    accuracy: float = 0.005
    faults: tuple[FaultParams, ...] = ()

    def __post_init__(self) -> None:
        for name, low in (("seed", 0), ("trials", 1)):
            if getattr(self, name) < low:
                raise ParameterError(
                    f"[simulate] {name} must be ≥ {low}, received {getattr(self, name)}"
                )
        if not 1e-12 <= self.accuracy <= 1:
            raise ParameterError(
                f"[simulate] accuracy must be > 0, a fraction of the reading of at most 1, "
                f"received {self.accuracy}"
            )
        names = [one.name for one in self.metered]
        if not names:
            raise ParameterError(
                "[simulate] expected [[simulate.generated]] or [[simulate.curves]]"
            )
        for name in names:
            if names.count(name) > 1 or name == SOURCE_BUS:
                raise ParameterError(
                    f"[simulate] the name {name!r} stands twice or is the source's: give each "
                    "series one of its own"
                )

    @property
    def metered(self) -> tuple[GeneratedParams | CurveParams, ...]:
        """All series, in the order of their channels."""
        return (*self.generated, *self.curves)


@dataclass(frozen=True, eq=False)
class _Series:
    """A load over the record: times [µs], values [MW] and σ of its good increments [MW]."""

    time: IntArray
    value: FloatArray
    sigma: float


def simulate_series(profiles: pd.DataFrame, study: Study, params: SeriesSimulateParams) -> RawCase:
    """Telemetry of metered loads, with their truth and with recorded faults.

    Parameters
    ----------
    profiles : DataFrame
        Real curves, from `pse_analysis.simulation.profiles.load`.
    study : Study
        Telemetry begins ``history_s`` before its start and ends with it.
    params : SeriesSimulateParams

    Returns
    -------
    RawCase
        The grid is a star: a source, and one bus per series. Truth is the injection at those
        instants of the study at which a series has a value.

    Raises
    ------
    ParameterError
        If a curve is unknown or does not cover the record.
    """
    start, end = microseconds(study.history_start), microseconds(study.end)
    span = (end - start) / SECOND
    drawn_values = sum(span / one.period_s for one in params.generated)
    drawn_values += len(params.curves) * span / PROFILE_STEP_S
    require_few(params.trials * drawn_values, "samples")
    real = [_curve(profiles, one, start, end) for one in params.curves]
    channels = _channels(params)
    parts: list[tuple[pd.DataFrame, ...]] = []
    for trial, seed in enumerate(np.random.SeedSequence(params.seed).spawn(params.trials)):
        load_seed, fault_seed = seed.spawn(2)
        drawn = [
            _generated(one, start, end, np.random.default_rng(child))
            for one, child in zip(
                params.generated, load_seed.spawn(len(params.generated)), strict=True
            )
        ]
        series = [*drawn, *real]
        samples = faults.inject(_samples(series), channels, params.faults, fault_seed)
        parts.append(
            (
                _truth_table(series, channels, study, trial),
                *sample_tables(samples, channels, np.zeros(len(channels), dtype=bool), trial),
            )
        )
    truth, telemetry, sample_truth, injected = (
        pd.concat(part, ignore_index=True) for part in zip(*parts, strict=True)
    )
    return RawCase(_star(params), channels, telemetry, truth, sample_truth, injected)


def _generated(params: GeneratedParams, start: int, end: int, rng: np.random.Generator) -> _Series:
    time = np.arange(start, end, round(params.period_s * SECOND), dtype=np.int64)
    drive = rng.standard_normal(len(time))
    # The first increment is drawn from the stationary law, so no run-up has to be thrown away.
    drive[1:] *= np.sqrt(1.0 - params.rho1**2)
    value = params.level_mw + params.sigma_mw * np.cumsum(ar1(drive, params.rho1))
    for step in params.steps:
        value[time >= microseconds(step.at)] += step.size_mw
    return _Series(time, value, params.sigma_mw)


def _curve(profiles: pd.DataFrame, params: CurveParams, start: int, end: int) -> _Series:
    points = params.peak_mw * column(profiles, params.profile, "simulate.curves")
    time = pd.DatetimeIndex(profiles.index).asi8.astype(np.int64)
    inside = (time >= start) & (time < end)
    covered = inside.any() and time[0] <= start and time[-1] + PROFILE_STEP_S * SECOND >= end
    if not covered:
        first, last = profiles.index[0], profiles.index[-1]
        raise ParameterError(
            f"[study] the load curves reach from {first.isoformat()} to {last.isoformat()}: the "
            "record with its history must lie inside; move start and end, or shorten history_s"
        )
    value = points[inside]
    return _Series(time[inside], value, float(np.sqrt(np.mean(np.diff(value) ** 2))))


def _samples(series: list[_Series]) -> Samples:
    time = np.concatenate([one.time for one in series])
    value = np.concatenate([one.value for one in series])
    count = [len(one.time) for one in series]
    n = len(time)
    return Samples(
        channel=np.repeat(np.arange(len(series)), count),
        sampled=time,
        arrival=time.copy(),
        value=value,
        truth=value.copy(),
        sigma=np.repeat([one.sigma for one in series], count),
        kind=np.zeros(n, dtype=np.int8),
        size=np.zeros(n),
        taken=np.zeros(n, dtype=bool),
    )


def _channels(params: SeriesSimulateParams) -> pd.DataFrame:
    metered = params.metered
    elements = [f"bus/{one.name}" for one in metered]
    limits: FloatArray = np.array([one.limits for one in metered], dtype=np.float64)
    return pd.DataFrame(
        {
            "channel": [f"{Source.SCADA}:{element}:{Quantity.P_MW}" for element in elements],
            "source": str(Source.SCADA),
            "quantity": str(Quantity.P_MW),
            "element": elements,
            "side": "",
            "unit": "mw",
            "sigma": float(params.accuracy),
            "sigma_kind": str(SigmaKind.RELATIVE),
            "lower": np.where(np.isfinite(limits[:, 0]), limits[:, 0], np.nan),
            "upper": np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.nan),
            "period_s": [getattr(one, "period_s", PROFILE_STEP_S) for one in metered],
            # A plant's meter counts consumption.
            "sign": np.full(len(metered), -1, dtype=np.int8),
            "aggregation": str(Aggregation.INSTANT),
        }
    )


def _truth_table(
    series: list[_Series], channels: pd.DataFrame, study: Study, trial: int
) -> pd.DataFrame:
    origin, step = microseconds(study.start), round(study.step_s * SECOND)
    tables = []
    for one, element in zip(series, channels["element"], strict=True):
        studied = (one.time >= origin) & ((one.time - origin) % step == 0)
        n = int(studied.sum())
        tables.append(
            pd.DataFrame(
                {
                    "trial": np.full(n, trial, dtype=np.int32),
                    "time_utc": utc(one.time[studied]),
                    "element": np.full(n, element, dtype=object),
                    "quantity": np.full(n, str(Quantity.P_MW), dtype=object),
                    "value": -one.value[studied],
                }
            )
        )
    return pd.concat(tables, ignore_index=True)


def _star(params: SeriesSimulateParams) -> Network:
    names = [one.name for one in params.metered]
    nominal = [one.level_mw for one in params.generated] + [one.peak_mw for one in params.curves]
    return Network.from_tables(
        pd.DataFrame({"name": ["metered_loads"], "base_mva": [BASE_MVA]}),
        pd.DataFrame(
            {
                "name": [SOURCE_BUS, *names],
                "kind": [int(BusKind.SLACK)] + [int(BusKind.PQ)] * len(names),
                "vn_kv": VN_KV,
                "p_load_mw": [0.0, *nominal],
            }
        ),
        pd.DataFrame({"from_bus": SOURCE_BUS, "to_bus": names, "r_pu": 0.0, "x_pu": _X_PU}),
    )
