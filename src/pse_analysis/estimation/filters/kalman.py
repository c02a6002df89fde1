"""Kalman filter in rectangular coordinates, with the recent past in its state.

A sample is rarely taken at the instant it is used at: a meter reports the mean of the last quarter
of an hour, SCADA arrives some seconds late. The filter therefore keeps the states of the last
instants beside the present one, and reads a sample through the weights with which its interval
covers them (`pse_analysis.estimation.filters.intervals`). So a sample enters once, where it
belongs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from pse_analysis.estimation.bad_data.innovation_test import Refuse
from pse_analysis.estimation.core.cholesky import cleaned
from pse_analysis.estimation.core.interface import (
    Dynamics,
    Estimator,
    Info,
    Snapshot,
    Transition,
    Voltages,
)
from pse_analysis.estimation.filters.angle_reference import AngleReference, Frame, absolute
from pse_analysis.estimation.filters.augmented_state import AugmentedState, Belief
from pse_analysis.estimation.filters.conditioning import Prior, Solved, misfit
from pse_analysis.estimation.filters.restart import gross_errors
from pse_analysis.estimation.filters.row_moments import Expansion, Interval, Reader, RowMoments
from pse_analysis.estimation.process import covariance_matching, dynamics
from pse_analysis.estimation.process.covariance_matching import CovarianceMatching, Matched
from pse_analysis.estimation.process.load_noise import ProcessNoise, to_polar, to_rectangular
from pse_analysis.estimation.static.start import Start
from pse_analysis.estimation.static.start_prior import StartPrior
from pse_analysis.estimation.static.wls import WlsSolution
from pse_analysis.grid.network import Network
from pse_analysis.measurement import RectangularModel, SensorLayout
from pse_analysis.measurement.rectangular import Linearisation
from pse_analysis.vocabulary import Reason, Status

MAX_PASSES = 8


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
    frame : Frame, optional
        What its angles count from, where the reference of measured angles moves.
    """

    x: FloatArray
    P: FloatArray
    process: Any = None
    noise: Matched | None = None
    frame: Frame | None = None


class _Moved(NamedTuple):
    """What a state has moved to: Q of the step and its shapes, and the snapshot in its frame."""

    prior: Belief
    noise: FloatArray
    shapes: tuple[FloatArray, ...]
    frame: Frame | None
    snapshot: Snapshot


class KalmanFilter:
    """A filter for one grid and sensor layout; `kalman_filter` tells what the parameters mean."""

    def __init__(
        self,
        network: Network,
        layout: SensorLayout,
        noise: ProcessNoise | CovarianceMatching,
        *,
        step_s: float,
        lags: int,
        instant: bool,
        smooth: bool,
        refuse: Refuse | None,
        process: dynamics.Process,
        linearisation: Linearisation,
        reference: AngleReference | None,
    ) -> None:
        self.n_bus, self.layout = network.n_bus, layout
        self.refuse = refuse
        self.linearisation, self.reference = linearisation, reference
        # A smoother looks back from a state that knows all instants that were read.
        self.lagged = AugmentedState(2 * network.n_bus, lags + 1 if smooth else lags, process)
        self._reader = Reader(
            RectangularModel(network, layout),
            self.lagged,
            linearisation,
            None if instant else Interval(layout.window_s, step_s, lags),
        )
        self._noise = noise
        # Without an outside angle reference the slack's f stays 0: no noise, no prior, no gain.
        self._held = None if layout.has_angle else network.n_bus + network.slack

    def process_noise(
        self, memory: Matched | None, x: FloatArray, time: np.datetime64
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        """Q (2N, 2N) of the step to an instant, at a forecast; its shapes if it is estimated."""
        if isinstance(self._noise, CovarianceMatching):
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
        self,
        voltage: ComplexArray,
        covariance: FloatArray,
        time: np.datetime64,
        *,
        measured: bool = True,
    ) -> KalmanState:
        """State from a voltage and the covariance (2N, 2N) of its [e; f]."""
        x = np.concatenate([voltage.real, voltage.imag])
        noise = self._noise.begin() if isinstance(self._noise, CovarianceMatching) else None
        begun = self.lagged.begin(x, covariance, self.process_noise(noise, x, time)[0])
        frame = None if self.reference is None else self.reference.begin(measured=measured)
        return KalmanState(*begun, noise, frame)

    def step(self, state: KalmanState, snapshot: Snapshot) -> tuple[KalmanState | None, Info]:
        """Carry the state to a snapshot; None, and status ``diverged``, if S is lost."""
        m = len(self.layout)
        belief = Belief(state.x, state.P, state.process)
        prior, noise, shapes, frame, snapshot = self._moved(belief, state, snapshot)
        used, sigma = self._reader.usable(snapshot)
        told, refused = np.full((2, m), np.nan), np.zeros(m, dtype=bool)
        given = belief, prior, noise, snapshot, sigma
        try:
            if used.any():
                reading = self._reader.moments(*given, used)
                first = self._expanded(reading)
                refused[used] = self._refuses(*first)
            if refused.any():
                told[:, refused] = first[0].eta[refused[used]], first[1].sigma[refused[used]]
                used = used & ~refused
                if used.any():
                    reading = self._reader.moments(*given, used)
                    first = self._expanded(reading)
            if not used.any():
                return KalmanState(*prior, state.noise, frame), replace(
                    Info.nothing(m, Status.PREDICTED),
                    innovation=told[0],
                    sigma_innovation=told[1],
                    reasons=_refusals(refused),
                )
            found, solved, passes = self._corrected(prior.x, reading, *first)
            given_prior = Prior(prior.x, prior.P, prior.x, np.arange(len(prior.x)))
            after = found.moments.condition(
                given_prior, found.eta, found.linear.spread**2, None, solved
            )
        except np.linalg.LinAlgError as error:
            return None, Info.nothing(
                m, Status.DIVERGED, f"{error}: the filter starts again from least squares"
            )
        told[:, used] = found.eta, solved.sigma
        learnt = state.noise
        if isinstance(self._noise, CovarianceMatching) and learnt is not None:
            moving = 1.0 if found.reach is None else found.reach.moving
            response = covariance_matching.responses(shapes, found.plane, moving, solved.chol_S)
            learnt = self._noise.learn(learnt, response, solved.white)
        x = after.s
        if self.linearisation == "derivative":
            x = self.lagged.turned(prior.x, x, after.P)
        return KalmanState(x, after.P, prior.memory, learnt, frame), Info(
            Status.OK,
            passes,
            after.nis,
            len(solved.white),
            used,
            told[0],
            told[1],
            np.zeros(m),
            reasons=_refusals(refused),
            misfit=misfit(solved.chol_S, solved.white, found.linear.spread),
        )

    def _moved(self, belief: Belief, state: KalmanState, snapshot: Snapshot) -> _Moved:
        """The state at the instant of a snapshot before its measurements."""
        forecast = self.lagged.forecast(belief)
        walk, shapes = self.process_noise(state.noise, forecast[0], snapshot.time)
        frame = state.frame
        if self.reference is not None and frame is not None:
            snapshot, frame, walk = self._followed(self.reference, frame, snapshot, forecast, walk)
        noise = self.lagged.process.noise(walk)
        return _Moved(self.lagged.moved(belief, forecast, noise), noise, shapes, frame, snapshot)

    def _followed(
        self,
        reference: AngleReference,
        frame: Frame,
        snapshot: Snapshot,
        forecast: tuple[FloatArray, FloatArray, Any],
        walk: FloatArray,
    ) -> tuple[Snapshot, Frame, FloatArray]:
        """The snapshot in the filter's frame, that frame, and Q with what it may have moved."""
        n, x, P = self.n_bus, *forecast[:2]
        voltage = self.voltage(x)

        def covariance(bus: IntArray) -> FloatArray:
            both, k = np.concatenate([bus, n + bus]), len(bus)
            half = P[np.ix_(both, both)] + walk[np.ix_(both, both)]
            across = 1j * voltage[bus] / np.abs(voltage[bus]) ** 2
            left = across.real[:, None] * half[:k] + across.imag[:, None] * half[k:]
            return np.asarray(left[:, :k] * across.real + left[:, k:] * across.imag)

        found = reference.follow(frame, snapshot, np.angle(voltage), covariance)
        turn = np.concatenate([-x[n : 2 * n], x[:n]])
        walk = walk + np.outer(found.variance * turn, turn)
        return found.snapshot, found.frame, walk

    def predict(self, state: KalmanState, snapshot: Snapshot) -> Transition:
        """How the state moves to the instant of a snapshot, before that is read."""
        belief = Belief(state.x, state.P, state.process)
        prior = self._moved(belief, state, snapshot).prior
        return Transition(prior.x, prior.P, self.lagged.cross(belief))

    def estimate(self, state: KalmanState, x: FloatArray, P: FloatArray) -> Voltages:
        """Present voltages in polar form, of a mean and covariance in the frame of a state."""
        n, voltage = self.n_bus, self.voltage(x)
        turn = to_polar(voltage)
        covariance = turn @ P[: 2 * n, : 2 * n] @ turn.T
        polar = np.concatenate([np.angle(voltage), np.abs(voltage)])
        return absolute(polar, covariance, state.frame)

    def _expanded(
        self, reading: RowMoments, instants: ComplexArray | None = None
    ) -> tuple[Expansion, Solved]:
        """The rows about the forecast or other voltages, and their innovation."""
        found = reading.at(reading.instants if instants is None else instants)
        return found, found.moments.solved(found.eta, found.linear.spread**2)

    def _refuses(self, found: Expansion, solved: Solved) -> BoolArray:
        """Which rows contradict the others and the forecast. (r,)"""
        gross = gross_errors(found.eta, solved.variance, solved.nis)
        if self.refuse is None or gross.any():
            return gross
        return self.refuse(found.eta, cleaned(solved.chol_S), found.linear.spread)

    def _corrected(
        self, x: FloatArray, reading: RowMoments, found: Expansion, solved: Solved
    ) -> tuple[Expansion, Solved, int]:
        """The rows about what they correct a forecast to, where it moves far."""
        for passes in range(1, MAX_PASSES + 1):
            instants = self.lagged.revised(reading.instants, x + solved.correction())
            if passes == MAX_PASSES or reading.settled(found, instants):
                break
            found, solved = self._expanded(reading, instants)
        return found, solved, passes


def kalman_filter(
    name: str,
    network: Network,
    layout: SensorLayout,
    noise: ProcessNoise | CovarianceMatching,
    *,
    step_s: float,
    reach_s: float = 0.0,
    instant: bool = False,
    smooth: bool = False,
    refuse: Refuse | None = None,
    process: dynamics.Process | None = None,
    linearisation: Linearisation = "derivative",
    reference: AngleReference | None = None,
    prior: StartPrior | None = None,
) -> Estimator:
    """Kalman filter in rectangular coordinates.

    Parameters
    ----------
    name : str
        Of the method.
    network : Network
    layout : SensorLayout
    noise : ProcessNoise or CovarianceMatching
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
    smooth : bool
        Whether a smoother is to look back from its states, which takes one instant more in each.
    refuse : Refuse, optional
        Asked about the innovation before every update; rows that it names are left out, and stand
        in the info with their innovation.
    process : Process, optional
        How the mean moves; F = I if not given.
    linearisation : {"derivative", "transform"}
        Whether the rows of powers have the whole derivative, or are the currents of [qi2025], which
        claim to know the angle that all buses share; see `RectangularModel`.
    reference : AngleReference, optional
        How the reference of measured angles moves; it stands still if not given.
    prior : StartPrior, optional
        What was usual before the first snapshot.

    Returns
    -------
    Estimator
        It uses every sample once, unless ``instant``.

    Notes
    -----
    With ``transform``, eqs. (25)–(29) of [qi2025] where all samples are instantaneous and of age 0.
    With ``derivative`` it is the extended Kalman filter of the same measurements, iterated where
    the remainder of an expansion matters.
    """
    lags = 0 if instant else int(np.ceil(reach_s / step_s - 1e-9))
    made = KalmanFilter(
        network,
        layout,
        noise,
        step_s=step_s,
        lags=lags,
        instant=instant,
        smooth=smooth,
        refuse=refuse,
        process=process or dynamics.random_walk(),
        linearisation=linearisation,
        reference=reference,
    )
    start, n = Start(network, layout, prior), network.n_bus

    def begun(
        found: tuple[WlsSolution | None, Info], time: np.datetime64
    ) -> tuple[KalmanState | None, Info]:
        solution, info = found
        if solution is None:
            return None, info
        voltage = solution.x[n:] * np.exp(1j * solution.x[:n])
        turn = to_rectangular(voltage)
        covariance = turn @ solution.covariance() @ turn.T
        return made.begin(voltage, covariance, time, measured=not solution.pinned), info

    def read(state: KalmanState) -> Voltages:
        return made.estimate(state, state.x, state.P)

    def with_covariance(state: KalmanState, P: FloatArray) -> KalmanState:
        return replace(state, P=P)

    moves = Dynamics(lambda state: (state.x, state.P), made.predict, made.estimate)
    return Estimator(
        name,
        lambda snapshot: begun(start.first(snapshot), snapshot.time),
        made.step,
        read,
        with_covariance,
        moves,
        lambda snapshot: begun(start.alone(snapshot), snapshot.time),
    )


def _refusals(refused: BoolArray) -> npt.NDArray[np.int32]:
    return np.where(refused, int(Reason.INNOVATION), 0).astype(np.int32)
