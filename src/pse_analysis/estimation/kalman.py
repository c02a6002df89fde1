"""Kalman filter on the linear rectangular model, with the recent past in its state.

A sample is rarely taken at the instant it is used at: a meter reports the mean of the last quarter
of an hour, SCADA arrives some seconds late. The filter therefore keeps the states of the last
instants beside the present one, and reads a sample through the weights with which its interval
covers them (`pse_analysis.estimation.intervals`). So a sample enters once, where it belongs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pse_analysis.estimation import holt, intervals
from pse_analysis.estimation.estimator import Estimator, Info, Snapshot, Voltages
from pse_analysis.estimation.lagged import Belief, Functionals, Lagged, Reach
from pse_analysis.estimation.matching import Matched, Matching
from pse_analysis.estimation.process import ProcessNoise, to_polar, to_rectangular
from pse_analysis.estimation.readings import (
    Readings,
    conditioned,
    gained,
    innovation_of,
    responses,
)
from pse_analysis.estimation.refusal import Refuse
from pse_analysis.estimation.start import begin
from pse_analysis.estimation.wls import WeightedLeastSquares
from pse_analysis.grid.network import Network
from pse_analysis.measurement import RectangularModel, SensorLayout
from pse_analysis.measurement.rectangular import Memo
from pse_analysis.vocabulary import Reason, Status

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

REFINE_PU = 1e-3
"""The measurements are transformed again if an update moves a voltage by more than this. [p.u.]"""
MAX_PASSES = 3


@dataclass(frozen=True, eq=False)
class KalmanState:
    """State of the filter.

    Attributes
    ----------
    x : (B·2N,) ndarray
        [e; f] now, one step ago, …, K-1 steps ago, and slopes if the process has any; at the next
        instant these are up to K steps old. [p.u.]
    P : (B·2N, B·2N) ndarray
        Its covariance.
    process : object
        Memory of the process.
    noise : Matched, optional
        Memory of a noise that is estimated.
    """

    x: FloatArray
    P: FloatArray
    process: Any = None
    noise: Matched | None = None


class KalmanFilter:
    """A filter for one grid and sensor layout; `kalman_filter` tells what the parameters mean."""

    def __init__(
        self,
        network: Network,
        layout: SensorLayout,
        noise: ProcessNoise | Matching,
        *,
        step_s: float,
        lags: int,
        instant: bool,
        refuse: Refuse | None,
        process: holt.Process,
    ) -> None:
        self.n_bus, self.layout = network.n_bus, layout
        self.step_s, self.instant, self.refuse = step_s, instant, refuse
        self.model = RectangularModel(network, layout)
        self.lagged = Lagged(2 * network.n_bus, lags, process)
        self._noise = noise
        # Without an outside angle reference the slack's f stays 0: no noise, no prior, no gain.
        self._held = None if layout.has_angle else network.n_bus + network.slack
        self._first = np.where(
            self.model.partner >= 0,
            np.minimum(self.model.partner, np.arange(len(layout))),
            np.arange(len(layout)),
        )
        # The same channels report again and again, often at the same age.
        self._functionals: Memo[Functionals] = Memo()
        self._reaches: Memo[Reach] = Memo()

    def walk(
        self, memory: Matched | None, x: FloatArray, time: np.datetime64
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        """Q (2N, 2N) of the step to an instant, at a forecast; its shapes if it is estimated."""
        if isinstance(self._noise, Matching):
            halves = tuple(self._free(half) for half in self._noise.halves(self.voltage(x)))
            level = self._noise.start if memory is None else memory.level
            whole = np.hstack([np.sqrt(t) * half for t, half in zip(level, halves, strict=True)])
            return whole @ whole.T, halves
        return self._free(self._free(self._noise(self.voltage(x), time)).T), ()

    def _free(self, rows: FloatArray) -> FloatArray:
        """Rows of [e; f], zero where it is held."""
        if self._held is None:
            return rows
        rows = rows.copy()
        rows[self._held] = 0.0
        return rows

    def voltage(self, x: FloatArray) -> ComplexArray:
        """Present voltage of a state. (N,)"""
        n = self.n_bus
        return np.asarray(x[:n] + 1j * x[n : 2 * n])

    def begin(
        self, voltage: ComplexArray, covariance: FloatArray, time: np.datetime64
    ) -> KalmanState:
        """State from a voltage and the covariance (2N, 2N) of its [e; f]."""
        x = np.concatenate([voltage.real, voltage.imag])
        noise = self._noise.begin() if isinstance(self._noise, Matching) else None
        return KalmanState(*self.lagged.begin(x, covariance, self.walk(noise, x, time)[0]), noise)

    def step(self, state: KalmanState, snapshot: Snapshot) -> tuple[KalmanState | None, Info]:
        """Carry the state to a snapshot; None, and status ``diverged``, if S is lost."""
        m = len(self.layout)
        belief = Belief(state.x, state.P, state.process)
        forecast = self.lagged.forecast(belief)
        walk, shapes = self.walk(state.noise, forecast[0], snapshot.time)
        noise = self.lagged.process.noise(walk)
        prior = self.lagged.moved(belief, forecast, noise)
        used, sigma = self._usable(snapshot)
        if not used.any():
            return KalmanState(*prior, state.noise), Info.nothing(m, Status.PREDICTED)
        rows = np.flatnonzero(used)
        readings = self._read(belief, prior, noise, snapshot, rows)
        frame = self.model.frame(snapshot.z, sigma, used, rows)
        at = self.voltage(prior.x)
        full = np.full((2, m), np.nan)
        refused = np.zeros(m, dtype=bool)
        try:
            turn, z, spread = frame.at(at)
            innovation = innovation_of(readings, turn, z, spread)
            if self.refuse is not None:
                out = self.refuse(innovation.eta, innovation.chol_S, spread)
                if out.any():
                    full[0, rows], full[1, rows] = innovation.eta, innovation.sigma
                    full[:, rows[~out]] = np.nan
                    refused[rows[out]] = True
                    used = used & ~refused
                    rows, readings = rows[~out], readings._replace(group=readings.group[~out])
                    if not len(rows):
                        return KalmanState(*prior, state.noise), replace(
                            Info.nothing(m, Status.PREDICTED),
                            innovation=full[0],
                            sigma_innovation=full[1],
                            reasons=_refusals(refused),
                        )
                    frame = self.model.frame(snapshot.z, sigma, used, rows)
                    innovation = innovation_of(readings, *frame.at(at))
            for passes in range(1, MAX_PASSES + 1):
                x = prior.x + gained(readings, innovation)
                after = self.voltage(x)
                if passes == MAX_PASSES or np.abs(after - at).max() < REFINE_PU:
                    break
                at = after
                innovation = innovation_of(readings, *frame.at(at))
        except np.linalg.LinAlgError:
            return None, Info.nothing(
                m,
                Status.DIVERGED,
                "the innovation's covariance is not positive definite: the filter starts "
                "again from least squares",
            )
        full[0, rows], full[1, rows] = innovation.eta, innovation.sigma
        learnt = state.noise
        if isinstance(self._noise, Matching) and learnt is not None:
            response = responses(shapes, readings, innovation)
            learnt = self._noise.learn(learnt, response, innovation.white)
        P = conditioned(prior.P, readings, innovation)
        return KalmanState(x, P, prior.memory, learnt), Info(
            Status.OK,
            passes,
            float(innovation.white @ innovation.white),
            len(rows),
            used,
            full[0],
            full[1],
            np.zeros(m),
            reasons=_refusals(refused),
        )

    def _usable(self, snapshot: Snapshot) -> tuple[BoolArray, FloatArray]:
        """Rows that are used, and their σ."""
        if self.instant:
            return snapshot.available, snapshot.sigma
        near = intervals.covered(
            snapshot.age_s, self.layout.window_s, self.step_s, self.lagged.lags
        )
        return snapshot.available & snapshot.fresh & near, snapshot.sigma_own

    def _read(
        self,
        belief: Belief,
        prior: Belief,
        noise: FloatArray,
        snapshot: Snapshot,
        rows: IntArray,
    ) -> Readings:
        """Moments of what some rows of a snapshot read."""
        first = self._first[rows]
        age, window = snapshot.age_s, self.layout.window_s
        if not self.instant:
            alike = (age[first] == age[rows]) & (window[first] == window[rows])
            first = np.where(alike, first, rows)
        wanted = np.zeros(len(self.layout), dtype=bool)
        wanted[first] = True
        number = np.cumsum(wanted) - 1
        key = wanted.tobytes()
        functionals = self._functionals.get(
            key, lambda: Functionals(self.model.functionals[wanted])
        )
        reach: Reach | None = None
        moving: FloatArray | float = 1.0
        if not self.instant:
            ages = age[wanted]
            reach = self._reaches.get(
                key + ages.tobytes(), lambda: self._reach(ages, window[wanted])
            )
            moving = reach.moving
        expected = self.lagged.expect(belief, prior, noise, functionals, reach)
        return Readings(number[first], expected, functionals.plane, moving)

    def _reach(self, age_s: FloatArray, window_s: FloatArray) -> Reach:
        ages, windows, kind = intervals.kinds(age_s, window_s)
        between = ages, windows, self.step_s, self.lagged.lags
        bridge = intervals.bridge_covariance(*between)
        return Reach(intervals.weights(*between)[kind], bridge[kind[:, None], kind])


def kalman_filter(
    name: str,
    network: Network,
    layout: SensorLayout,
    noise: ProcessNoise | Matching,
    *,
    step_s: float,
    reach_s: float = 0.0,
    instant: bool = False,
    refuse: Refuse | None = None,
    process: holt.Process | None = None,
) -> Estimator:
    """Kalman filter on the linear rectangular model.

    Parameters
    ----------
    name : str
        Of the method.
    network : Network
    layout : SensorLayout
    noise : ProcessNoise or Matching
        Q of the step to an instant, given or estimated from the innovations before it.
    step_s : float
        Step between instants. [s]
    reach_s : float
        How far samples reach back from the instant at which they are used, age and interval
        together; it sets how many past states are kept, and older samples are passed over. [s]
    instant : bool
        Whether every value counts as one of the present instant, with the σ that its age adds, and
        held values count again. Cheap, and what [qi2025] does; but errors of values that are used
        twice are correlated, so the filter is too sure of itself.
    refuse : Refuse, optional
        Asked about the innovation before every update; rows that it names are left out, and stand
        in the info with their innovation.
    process : Process, optional
        How the mean moves; F = I if not given.

    Returns
    -------
    Estimator
        It starts from a weighted least-squares estimate and uses every sample once, unless
        ``instant``.

    Notes
    -----
    Eqs. (25)–(29) of [qi2025] with constant H where all samples are instantaneous and of
    age 0. Functionals of the state are constant, and a predicted voltage only turns and scales the
    rows in which they are read: their covariance is made once per step, however often the
    measurements are transformed again.
    """
    lags = 0 if instant else int(np.ceil(reach_s / step_s - 1e-9))
    made = KalmanFilter(
        network,
        layout,
        noise,
        step_s=step_s,
        lags=lags,
        instant=instant,
        refuse=refuse,
        process=process or holt.random_walk(),
    )
    wls = WeightedLeastSquares(network, layout)
    n = network.n_bus

    def init(snapshot: Snapshot) -> tuple[KalmanState | None, Info]:
        solution, info = begin(wls, snapshot)
        if solution is None:
            return None, info
        voltage = solution.x[n:] * np.exp(1j * solution.x[:n])
        turn = to_rectangular(voltage)
        return made.begin(voltage, turn @ solution.covariance() @ turn.T, snapshot.time), info

    def read(state: KalmanState) -> Voltages:
        voltage = made.voltage(state.x)
        turn = to_polar(voltage)
        covariance = turn @ state.P[: 2 * n, : 2 * n] @ turn.T
        return Voltages(np.concatenate([np.angle(voltage), np.abs(voltage)]), covariance)

    return Estimator(name, init, made.step, read)


def _refusals(refused: BoolArray) -> npt.NDArray[np.int32]:
    return np.where(refused, int(Reason.INNOVATION), 0).astype(np.int32)
