"""Runs an estimator over the snapshots of a case, and writes down what it said and did."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import NotConverged, ParameterError, Unobservable
from pse_analysis.estimation.core.interface import FAILURES, Estimate, Estimator, Info, Snapshot
from pse_analysis.machine import STATES, Machine
from pse_analysis.measurement import Model, SensorLayout, wrap
from pse_analysis.parameters import Unbounded
from pse_analysis.vocabulary import Status

LARGEST = 4.0
"""Most that a single normalised innovation counts for where many are added up."""
JITTER = 1e-10
"""Share of the largest variance that rounding may take from one that is zero."""


Watch = Callable[[int, Any, Info], None]


@dataclass(frozen=True)
class ConsistencyParams:
    """When a filter is called inconsistent: by NIS over the last steps.

    Attributes
    ----------
    steps : int
        Steps over which NIS is summed; at the start there are fewer.
    ratio : (2,) tuple of float
        NIS/m beyond which it is, if the χ² bounds are left as well. Real load is heavy-tailed and
        its volatility changes with the hour, so that the χ² bounds alone, which are right for a
        filter's own model, would condemn every filter.
    confidence : float
        Share of good filters between the χ² bounds.
    bias : float
        Sum of the normalised innovations of one channel over the last steps, over the root of their
        number, beyond which it is as well. Innovations of a good filter are independent from step
        to step; a meter that is wrong all the time, and a filter that is lost, show by their sign.
        Angles are left out, because what they count from may turn.
    """

    steps: int = 12
    ratio: tuple[float, float] = (0.5, 2.0)
    confidence: float = 0.999
    bias: Unbounded = 8.0

    def __post_init__(self) -> None:
        low, high = self.ratio
        if not (self.steps >= 1 and 0 <= low < 1 < high and 0 < self.confidence < 1):
            raise ParameterError(
                "consistency: expected steps ≥ 1, ratio = [below 1, above 1] and 0 < confidence < "
                f"1, received {self.steps}, {list(self.ratio)} and {self.confidence}"
            )
        if not self.bias >= 3.0:
            raise ParameterError(f"consistency: expected bias ≥ 3, received {self.bias}")


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
    reference : (n,) ndarray of int
        Place of the angle that stands for the island of each angle; -1 where there is none.
    """

    element: npt.NDArray[np.object_]
    quantity: npt.NDArray[np.object_]
    factor: FloatArray
    folded: BoolArray
    reference: IntArray

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
                np.full(len(STATES), -1),
            )
        n = model.n_bus
        return cls(
            np.array([f"bus/{name}" for name in model.buses.name] * 2, dtype=object),
            np.array(["va_degree"] * n + ["vm_pu"] * n, dtype=object),
            np.concatenate([np.full(n, 180.0 / np.pi), np.ones(n)]),
            np.arange(2 * n) < n,
            np.concatenate([model.references, np.full(n, -1)]),
        )

    def relative(self, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
        """Returns angles less that of their island's reference, and σ; NaN elsewhere. (n,)"""
        value, sigma = np.full((2, len(self)), np.nan)
        angle = np.flatnonzero(self.reference >= 0)
        at, P = self.reference[angle], estimate.covariance
        value[angle] = wrap(estimate.x[angle] - estimate.x[at])
        variance = P[angle, angle] + P[at, at] - 2.0 * P[angle, at]
        sigma[angle] = np.sqrt(np.maximum(variance, 0.0))
        return value, sigma


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
    relative: list[FloatArray] = field(default_factory=list)
    sigma_relative: list[FloatArray] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    info: list[Info] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(
        self,
        time: np.datetime64,
        info: Info,
        seconds: float,
        estimate: Estimate | None,
        truth: FloatArray | None,
        states: States,
    ) -> None:
        """Note a step."""
        nothing = np.full(len(states), np.nan)
        self.time.append(time)
        self.info.append(info)
        self.seconds.append(seconds)
        found = nothing, nothing, nothing, nothing
        deviation = None if estimate is None else _deviation(estimate)
        if estimate is not None and deviation is not None:
            found = estimate.x, deviation, *states.relative(estimate)
        for column, values in zip(
            (self.x, self.sigma, self.relative, self.sigma_relative), found, strict=True
        ):
            column.append(values)
        self.nees.append(_nees(estimate, truth, states.folded))


def run(
    estimator: Estimator,
    snapshots: Iterator[Snapshot],
    model: Model,
    layout: SensorLayout,
    *,
    trial: int = 0,
    truth: FloatArray | None = None,
    watch: Sequence[Watch] = (),
    consistency: ConsistencyParams | None = None,
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
    watch : sequence of callable
        Told the number of every instant, the state after it (None if there is none) and its info.
    consistency : ConsistencyParams, optional

    Returns
    -------
    Estimated
    """
    trace = _Trace()
    state: Any = None
    states = States.of(model)
    for k, snapshot in enumerate(snapshots):
        begun = time.perf_counter()
        state, info, estimate = _outlived(estimator, state, snapshot, len(layout))
        seconds = time.perf_counter() - begun
        if estimate is not None and _deviation(estimate) is None:
            estimate, state = None, None
            info = Info.nothing(
                len(layout),
                Status.DIVERGED,
                "the state is not finite, or a variance is negative: it restarts next instant",
            )
        trace.add(
            snapshot.time, info, seconds, estimate, None if truth is None else truth[k], states
        )
        for see in watch:
            see(k, state, info)
    return _tables(estimator.name, trial, trace, states, layout, consistency)


def derived(
    name: str,
    trial: int,
    given: Sequence[tuple[np.datetime64, Info, Estimate | None, FloatArray | None]],
    seconds: float,
    model: Model,
    layout: SensorLayout,
) -> Estimated:
    """Tables of estimates that were made from those of a run, as a method of their own.

    Parameters
    ----------
    name : str
    trial : int
    given : sequence of tuple
        Time, info, estimate (None if there is none) and true state (n,) if it is known.
    seconds : float
        Time that all of them took. [s]
    model : Network or Machine
    layout : SensorLayout
    """
    trace, states = _Trace(), States.of(model)
    for when, info, estimate, truth in given:
        trace.add(when, info, seconds / len(given), estimate, truth, states)
    return _tables(name, trial, trace, states, layout)


def _outlived(
    estimator: Estimator, state: Any, snapshot: Snapshot, m: int
) -> tuple[Any, Info, Estimate | None]:
    """A step and its estimate; none of both where the numbers of the snapshot do not allow it."""
    try:
        # A state that leaves the range of numbers is told by its status.
        with np.errstate(all="ignore"):
            state, info = (
                estimator.init(snapshot) if state is None else estimator.step(state, snapshot)
            )
            return state, info, None if state is None else estimator.read(state)
    except FAILURES as error:
        if isinstance(error, Unobservable | NotConverged):
            unobservable = isinstance(error, Unobservable)
            status = Status.UNOBSERVABLE if unobservable else Status.NOT_CONVERGED
            return None, Info.nothing(m, status, str(error)), None
        why = f"{type(error).__name__}: {error}: it restarts next instant"
        return None, Info.nothing(m, Status.DIVERGED, why), None


def _deviation(estimate: Estimate) -> FloatArray | None:
    """Returns σ of an estimate, NaN where it is open; None where it is no estimate at all."""
    variance = np.diagonal(estimate.covariance).copy()
    known = np.ones(len(variance), dtype=bool) if estimate.open is None else ~estimate.open
    if not (np.isfinite(estimate.x[known]).all() and np.isfinite(variance[known]).all()):
        return None
    # A fixed angle has no variance, of which rounding may leave either sign.
    slight = JITTER * variance[known].max(initial=0.0)
    if (variance[known] < -slight).any():
        return None
    variance[known] = np.maximum(variance[known], 0.0)
    return np.sqrt(variance)


def _nees(estimate: Estimate | None, truth: FloatArray | None, folded: BoolArray) -> float:
    if estimate is None or truth is None or not np.isfinite(truth).all():
        return float("nan")
    error = estimate.x - truth
    error[folded] = wrap(error[folded])
    deviation = np.sqrt(np.maximum(np.diagonal(estimate.covariance), 0.0))
    free = deviation > 1e-12
    scaled = estimate.covariance[np.ix_(free, free)] / np.outer(deviation[free], deviation[free])
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return float("nan")
    white = np.linalg.solve(factor, error[free] / deviation[free])
    return float(white @ white)


def consistent(nis: FloatArray, dof: npt.NDArray[np.int64], params: ConsistencyParams) -> BoolArray:
    """Whether NIS of the last steps stays inside its bounds, at every step.

    At the start there are fewer; the first alone is as much as a single snapshot has to show.
    """
    known = np.isfinite(nis) & (dof > 0)
    total, freedom = _windowed(
        np.stack([np.where(known, part, 0.0) for part in (nis, dof)], axis=1), params.steps
    ).T
    with np.errstate(invalid="ignore", divide="ignore"):
        tail = 0.5 * (1.0 - params.confidence)
        low, high = stats.chi2.ppf([[tail], [1.0 - tail]], freedom)
        ratio = total / freedom
        wide = (ratio >= params.ratio[0]) & (ratio <= params.ratio[1])
    judged = np.isfinite(total) & (freedom > 0)
    return np.asarray(~judged | wide | ((total >= low) & (total <= high)))


def biased(info: Sequence[Info], params: ConsistencyParams, judged: BoolArray) -> BoolArray:
    """Whether a channel was off its forecast to the same side for the last steps, at every step.

    Of the channels (m,), those that are to be ``judged`` count.
    """
    m = len(judged)
    off = np.array([i.innovation for i in info]).reshape(len(info), m)
    sigma = np.array([i.sigma_innovation for i in info]).reshape(len(info), m)
    # What was not believed says nothing about the filter.
    believed = np.array([i.used & (i.inflation == 0) & judged for i in info]).reshape(len(info), m)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.clip(np.where(believed, off / sigma, np.nan), -LARGEST, LARGEST)
    known = np.isfinite(off)
    total, count = (
        _windowed(part, params.steps) for part in (np.where(known, off, 0.0), known.astype(float))
    )
    size = np.abs(total) / np.sqrt(np.maximum(count, 1.0))
    return np.asarray((size > params.bias).any(axis=1))


def _windowed(values: FloatArray, steps: int) -> FloatArray:
    """Sums over the last steps, of which there are fewer at the start."""
    return np.asarray(pd.DataFrame(values).rolling(steps, min_periods=1).sum())


def _tables(
    method: str,
    trial: int,
    trace: _Trace,
    states: States,
    layout: SensorLayout,
    consistency: ConsistencyParams | None = None,
) -> Estimated:
    times = pd.DatetimeIndex(np.asarray(trace.time, dtype="datetime64[us]"), tz="UTC")
    count, n = len(times), len(states)
    nis = np.array([i.nis for i in trace.info])
    dof = np.array([i.dof for i in trace.info], dtype=np.int64)
    params = consistency or ConsistencyParams()
    good = consistent(nis, dof, params) & ~biased(trace.info, params, ~layout.angular)
    status = [
        Status.INCONSISTENT if i.status is Status.OK and not (fits or i.tested) else i.status
        for i, fits in zip(trace.info, good, strict=True)
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
            "detail": [i.detail for i in trace.info],
        }
    )
    value, sigma, relative, sigma_relative = (
        (np.array(part).reshape(count, n) * states.factor).ravel()
        for part in (trace.x, trace.sigma, trace.relative, trace.sigma_relative)
    )
    estimated = pd.DataFrame(
        {
            "method": method,
            "trial": np.int32(trial),
            "time_utc": times.repeat(n),
            "element": np.tile(states.element, count),
            "quantity": np.tile(states.quantity, count),
            "value": value,
            "sigma": sigma,
            "relative": relative,
            "sigma_relative": sigma_relative,
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
