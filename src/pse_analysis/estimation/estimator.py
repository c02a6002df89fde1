"""The shape that every estimator has, and the driver that runs one over a case.

An estimator is a record of functions built from a model and frozen parameters. ``init`` makes a
state from a snapshot, ``step`` carries it to the next one and says what it did, ``read`` turns it
into an estimate with its covariance: of a grid's voltages, or of a machine's rotor.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from pse_analysis.errors import TableError
from pse_analysis.machine import STATES, Machine
from pse_analysis.measurement import Model, SensorLayout, wrap
from pse_analysis.vocabulary import Origin, Reason, Status, usable

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

CONSISTENCY_STEPS = 12
"""Steps over which NIS is summed before a filter is called inconsistent."""
CONSISTENCY_RATIO = (0.5, 2.0)
"""NIS/m beyond which a filter is called inconsistent, if the χ² bounds are left as well.

Real load is heavy-tailed and its volatility changes with the hour, so that the χ² bounds alone,
which are right for a filter's own model, would condemn every filter.
"""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What is known at one instant; rows follow the sensor layout.

    Attributes
    ----------
    time : datetime64
    z : (m,) ndarray
        Values; 0 where not available. [p.u., rad]
    sigma : (m,) ndarray
        σ with the growth by age. [p.u., rad]
    sigma_age : (m,) ndarray
        The part of σ that age added, for filters that treat age in their model. [p.u., rad]
    available : (m,) ndarray of bool
        Rows that carry a usable value.
    fresh : (m,) ndarray of bool
        Rows whose sample has not been used at an earlier instant.
    age_s : (m,) ndarray
        Time since the sample was taken. [s]
    inputs : ndarray, optional
        Known inputs u of the model.
    topology : str
        Names the grid that was in service; "" is the base grid.
    """

    time: np.datetime64
    z: FloatArray
    sigma: FloatArray
    sigma_age: FloatArray
    available: BoolArray
    fresh: BoolArray
    age_s: FloatArray
    inputs: FloatArray | None = None
    topology: str = ""

    @property
    def sigma_own(self) -> FloatArray:
        """σ of the samples themselves, without what age added. (m,) [p.u., rad]"""
        return np.asarray(np.sqrt(np.maximum(self.sigma**2 - self.sigma_age**2, 0.0)))


@dataclass(frozen=True, eq=False)
class Info:
    """What a step did.

    Attributes
    ----------
    status : Status
    iterations : int
    nis : float
        ηᵀS⁻¹η, or the objective of a least-squares estimate; NaN without measurements.
    dof : int
        Its degrees of freedom.
    used : (m,) ndarray of bool
    innovation, sigma_innovation : (m,) ndarray
        η and √S_ii; NaN where not used. [p.u., rad]
    inflation : (m,) ndarray
        Factor φ added to the noise of a row by a robust filter; 0 where none was.
    detail : str
        What went wrong and what would help; "" if nothing did.
    reasons : (m,) ndarray of int, optional
        Bits of `Reason` for what a screening decided; without it an inflated row is
        `Reason.INNOVATION`.

    Rows with an innovation that were not used were refused.
    """

    status: Status
    iterations: int
    nis: float
    dof: int
    used: BoolArray
    innovation: FloatArray
    sigma_innovation: FloatArray
    inflation: FloatArray
    detail: str = ""
    reasons: npt.NDArray[np.int32] | None = None

    @property
    def judged(self) -> BoolArray:
        """Rows that were used or refused. (m,)"""
        return np.asarray(self.used | np.isfinite(self.innovation))

    @property
    def findings(self) -> npt.NDArray[np.int32]:
        """Bits of `Reason` of every row. (m,)"""
        found = np.where(self.inflation > 0, int(Reason.INNOVATION), 0).astype(np.int32)
        return found if self.reasons is None else self.reasons

    @classmethod
    def nothing(cls, m: int, status: Status, detail: str = "") -> Info:
        """Info of a step that used no measurement."""
        empty = np.full(m, np.nan)
        return cls(status, 0, np.nan, 0, np.zeros(m, dtype=bool), empty, empty, np.zeros(m), detail)


class Estimate(NamedTuple):
    """Estimate x (n,) with its covariance (n, n); what the entries are follows from the model.

    A grid's are [θ; |V|] (2N,) [rad, p.u.], a machine's [θ; ω] (2,) [rad, rad/s].
    """

    x: FloatArray
    covariance: FloatArray


Voltages = Estimate
"""An estimate of a grid in polar form."""


@dataclass(frozen=True, eq=False)
class States:
    """What the entries of a model's estimate are called in tables.

    Attributes
    ----------
    element, quantity : (n,) ndarray of str
    factor : (n,) ndarray
        Reported value over the estimate's own.
    folded : (n,) ndarray of bool
        Angles that are known up to full turns.
    """

    element: npt.NDArray[np.object_]
    quantity: npt.NDArray[np.object_]
    factor: FloatArray
    folded: BoolArray

    def __len__(self) -> int:
        return len(self.factor)

    @classmethod
    def of(cls, model: Model) -> States:
        """States of a grid or a machine."""
        if isinstance(model, Machine):
            return cls(
                np.array([model.element] * len(STATES), dtype=object),
                np.array(STATES, dtype=object),
                np.ones(len(STATES)),
                np.zeros(len(STATES), dtype=bool),
            )
        n = model.n_bus
        return cls(
            np.array([f"bus/{name}" for name in model.buses.name] * 2, dtype=object),
            np.array(["va_degree"] * n + ["vm_pu"] * n, dtype=object),
            np.concatenate([np.full(n, 180.0 / np.pi), np.ones(n)]),
            np.arange(2 * n) < n,
        )


class Estimator(NamedTuple):
    """A method: three functions over an opaque state."""

    name: str
    init: Callable[[Snapshot], tuple[Any, Info]]
    step: Callable[[Any, Snapshot], tuple[Any, Info]]
    read: Callable[[Any], Estimate | None]


@dataclass(frozen=True, eq=False)
class Record:
    """Aligned telemetry of one trial as arrays: T instants by m rows of a layout."""

    time: npt.NDArray[np.datetime64]
    z: FloatArray
    sigma: FloatArray
    sigma_age: FloatArray
    available: BoolArray
    fresh: BoolArray
    age_s: FloatArray

    def snapshots(self) -> Iterator[Snapshot]:
        """One snapshot per instant."""
        for t in range(len(self.time)):
            yield Snapshot(
                self.time[t],
                self.z[t],
                self.sigma[t],
                self.sigma_age[t],
                self.available[t],
                self.fresh[t],
                self.age_s[t],
            )

    def between(self, start: np.datetime64 | None, end: np.datetime64 | None) -> Record:
        """The instants in [start, end)."""
        keep = np.ones(len(self.time), dtype=bool)
        if start is not None:
            keep &= self.time >= start
        if end is not None:
            keep &= self.time < end
        return Record(
            *(
                getattr(self, name)[keep]
                for name in ("time", "z", "sigma", "sigma_age", "available", "fresh", "age_s")
            )
        )


def record(
    aligned: pd.DataFrame,
    layout: SensorLayout,
    instants: npt.NDArray[np.datetime64] | None = None,
) -> Record:
    """Arrays from the aligned table of one trial and variant.

    Parameters
    ----------
    aligned : DataFrame
    layout : SensorLayout
    instants : (T,) ndarray of datetime64, optional
        Instants that are there even if no sample is; a filter has to pass through them.

    Raises
    ------
    TableError
        If a channel is not in the layout, or a row stands twice.
    """
    stamps = _utc(aligned["time_utc"])
    times = np.unique(stamps if instants is None else np.concatenate([stamps, instants]))
    row = np.searchsorted(times, stamps)
    column = pd.Index(layout.channel).get_indexer(aligned["channel"])
    if (column < 0).any():
        name = aligned["channel"].iloc[int(np.argmin(column))]
        raise TableError(
            f"aligned: channel {name!r} is not in the channels table: add it there, or align again"
        )
    if len(np.unique(row * len(layout) + column)) != len(row):
        raise TableError(
            "aligned: a channel stands twice at one instant: expected one trial and one variant"
        )
    shape = (len(times), len(layout))

    def scattered(values: npt.ArrayLike, start: float, kind: type = float) -> npt.NDArray[Any]:
        out: npt.NDArray[Any] = np.full(shape, start, dtype=kind)
        out[row, column] = values
        return out

    good = usable(aligned["flag"].to_numpy())
    return Record(
        time=times,
        z=scattered(aligned["value_pu"], 0.0),
        sigma=scattered(aligned["sigma_pu"], 1.0),
        sigma_age=scattered(aligned["sigma_age_pu"], 0.0),
        available=scattered(good, 0, bool),
        fresh=scattered(good & (aligned["origin"] != Origin.HELD).to_numpy(), 0, bool),
        age_s=scattered(aligned["age_s"], 0.0),
    )


def _utc(times: pd.Series) -> npt.NDArray[np.datetime64]:
    naive = times.dt.tz_convert("UTC").dt.tz_localize(None)
    return np.asarray(naive.to_numpy().astype("datetime64[us]"))


@dataclass(frozen=True, eq=False)
class Estimated:
    """Tables of one method on one trial; the schemas of the same names say what they hold."""

    estimated: pd.DataFrame
    residuals: pd.DataFrame
    steps: pd.DataFrame


@dataclass
class _Trace:
    """What the driver collects per step, before it becomes tables."""

    time: list[np.datetime64] = field(default_factory=list)
    x: list[FloatArray] = field(default_factory=list)
    sigma: list[FloatArray] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    info: list[Info] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def run(
    estimator: Estimator,
    snapshots: Iterator[Snapshot],
    model: Model,
    layout: SensorLayout,
    *,
    trial: int = 0,
    truth: FloatArray | None = None,
) -> Estimated:
    """Run an estimator over snapshots; no snapshot stops the run.

    Parameters
    ----------
    estimator : Estimator
    snapshots : iterator of Snapshot
    model : Network or Machine
    layout : SensorLayout
    trial : int
    truth : (T, n) ndarray, optional
        True states at the instants, for NEES: [θ; |V|] [rad, p.u.], or [θ; ω] [rad, rad/s].

    Returns
    -------
    Estimated
    """
    trace = _Trace()
    state: Any = None
    states = States.of(model)
    nothing = np.full(len(states), np.nan)
    for k, snapshot in enumerate(snapshots):
        begun = time.perf_counter()
        state, info = estimator.init(snapshot) if state is None else estimator.step(state, snapshot)
        seconds = time.perf_counter() - begun
        estimate = None if state is None else estimator.read(state)
        if estimate is not None and not (
            np.isfinite(estimate.x).all() and np.isfinite(np.diagonal(estimate.covariance)).all()
        ):
            estimate, state = None, None
            info = Info.nothing(
                len(layout), Status.DIVERGED, "the state is not finite: it restarts next instant"
            )
        trace.time.append(snapshot.time)
        trace.info.append(info)
        trace.seconds.append(seconds)
        trace.x.append(nothing if estimate is None else estimate.x)
        trace.sigma.append(
            nothing
            if estimate is None
            else np.sqrt(np.maximum(np.diagonal(estimate.covariance), 0.0))
        )
        reference = None if truth is None else truth[k]
        trace.nees.append(_nees(estimate, reference, states.folded))
    return _tables(estimator.name, trial, trace, states, layout)


def _nees(estimate: Estimate | None, truth: FloatArray | None, folded: BoolArray) -> float:
    if estimate is None or truth is None or not np.isfinite(truth).all():
        return float("nan")
    error = estimate.x - truth
    error[folded] = wrap(error[folded])
    deviation = np.sqrt(np.diagonal(estimate.covariance))
    free = deviation > 1e-12
    scaled = estimate.covariance[np.ix_(free, free)] / np.outer(deviation[free], deviation[free])
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return float("nan")
    white = np.linalg.solve(factor, error[free] / deviation[free])
    return float(white @ white)


def _consistent(nis: FloatArray, dof: npt.NDArray[np.int64]) -> BoolArray:
    """Whether NIS of the last steps stays inside its bounds, at every step."""
    known = np.isfinite(nis) & (dof > 0)
    total = pd.Series(np.where(known, nis, 0.0)).rolling(CONSISTENCY_STEPS).sum().to_numpy()
    freedom = pd.Series(np.where(known, dof, 0)).rolling(CONSISTENCY_STEPS).sum().to_numpy()
    with np.errstate(invalid="ignore", divide="ignore"):
        low, high = stats.chi2.ppf([[0.0005], [0.9995]], freedom)
        ratio = total / freedom
        wide = (ratio >= CONSISTENCY_RATIO[0]) & (ratio <= CONSISTENCY_RATIO[1])
    judged = np.isfinite(total) & (freedom > 0)
    return np.asarray(~judged | wide | ((total >= low) & (total <= high)))


def _tables(
    method: str, trial: int, trace: _Trace, states: States, layout: SensorLayout
) -> Estimated:
    times = pd.DatetimeIndex(np.asarray(trace.time, dtype="datetime64[us]"), tz="UTC")
    count, n = len(times), len(states)
    nis = np.array([i.nis for i in trace.info])
    dof = np.array([i.dof for i in trace.info], dtype=np.int64)
    status = [
        Status.INCONSISTENT if i.status is Status.OK and not good else i.status
        for i, good in zip(trace.info, _consistent(nis, dof), strict=True)
    ]
    used = np.array([i.used for i in trace.info]).reshape(count, len(layout))
    steps = pd.DataFrame(
        {
            "method": method,
            "trial": np.int32(trial),
            "time_utc": times,
            "status": [str(s) for s in status],
            "iterations": np.array([i.iterations for i in trace.info], dtype=np.int32),
            "nis": nis,
            "nees": np.array(trace.nees),
            "dof": dof.astype(np.int32),
            "rejected": np.array(
                [int((i.judged & ((i.inflation > 0) | ~i.used)).sum()) for i in trace.info],
                dtype=np.int32,
            ),
            "seconds": np.array(trace.seconds),
        }
    )
    x, sigma = np.array(trace.x).reshape(count, n), np.array(trace.sigma).reshape(count, n)
    estimated = pd.DataFrame(
        {
            "method": method,
            "trial": np.int32(trial),
            "time_utc": times.repeat(n),
            "element": np.tile(states.element, count),
            "quantity": np.tile(states.quantity, count),
            "value": (x * states.factor).ravel(),
            "sigma": (sigma * states.factor).ravel(),
        }
    )
    judged = np.array([i.judged for i in trace.info]).reshape(count, len(layout))
    at, row = np.nonzero(judged)
    innovation, deviation, inflation, findings = (
        np.array([getattr(i, name) for i in trace.info]).reshape(count, len(layout))[at, row]
        for name in ("innovation", "sigma_innovation", "inflation", "findings")
    )
    residuals = pd.DataFrame(
        {
            "method": method,
            "trial": np.int32(trial),
            "time_utc": times[at],
            "channel": np.asarray(layout.channel, dtype=object)[row],
            "innovation": innovation,
            "sigma_innovation": deviation,
            "inflation": inflation,
            "used": used[at, row],
            "reasons": findings.astype(np.int32),
        }
    )
    return Estimated(estimated, residuals, steps)
