"""Observer of a machine on sampled telemetry, with gaps; and many runs of it at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.interface import Estimate, Estimator, Info, Snapshot
from pse_analysis.estimation.machine.gain import Poles, Tuning, discrete_gain, filter_gain
from pse_analysis.machine import Densities, Machine, sample
from pse_analysis.vocabulary import Status

NEEDS_INPUT = (
    "the observer needs the machine's input ΔM = M_mech - M_el in per unit of {base:g} MVA at "
    "every instant (Snapshot.inputs = [ΔM]); give a channel of quantity delta_m_pu at {element}, "
    "or compute it as (P_mech - P_el)/S_rated"
)


@dataclass(frozen=True, eq=False)
class ObserverState:
    """State of an observer.

    Attributes
    ----------
    time : datetime64
    x : (2,) ndarray
        [θ; ω]. [rad, rad/s]
    P : (2, 2) ndarray
        Covariance by the densities that the observer believes.
    u : float
        Last known ΔM. [p.u.]
    """

    time: np.datetime64
    x: FloatArray
    P: FloatArray
    u: float


def observer(
    name: str,
    machine: Machine,
    tuning: Tuning,
    step_s: float,
    *,
    belief: Densities | None = None,
    gain: Literal["constant", "recursive"] = "constant",
    start: tuple[float, float] = (0.0, 0.0),
    start_sigma: tuple[float, float] = (10.0, 10.0),
) -> Estimator:
    """Discrete equivalent of the machine's observer.

    Parameters
    ----------
    name : str
        Of the method.
    machine : Machine
    tuning : Densities or Poles
        The gain is designed from it.
    step_s : float
        Step of the telemetry for which a constant gain is designed. [s]
    belief : Densities, optional
        Densities from which σ is computed; those of the tuning by default. A tuning by poles has
        none, so that it needs them.
    gain : {"constant", "recursive"}
        ``constant``: the stationary gain from the first sample on, which is the paper's observer.
        ``recursive``: the Kalman filter's, large while the start is forgotten and after gaps.
    start, start_sigma : (2,) tuple of float
        x̂ before the first sample, and how far off it may be. [rad, rad/s]

    Returns
    -------
    Estimator
        Snapshots carry one row, θ, and inputs [ΔM]. A sample that is missing, unusable or was used
        before leaves a prediction. Between two values ΔM is taken to run straight; where one is
        missing the last is held, and `Info.detail` says so.

    Raises
    ------
    ParameterError
        If the gain cannot be designed, or σ has no densities to come from.
    """
    trusted = belief or (None if isinstance(tuning, Poles) else tuning)
    if trusted is None:
        raise ParameterError(
            f"method {name!r} places poles, from which no σ follows: give `belief`, the densities "
            "of disturbances and noise"
        )
    if gain == "recursive" and isinstance(tuning, Poles):
        raise ParameterError(
            f"method {name!r}: a gain by poles is constant; use gain='constant', or densities"
        )
    C, eye = machine.C, np.eye(2)
    constant = discrete_gain(machine, tuning, step_s)
    # The noise of a sample belongs to the telemetry's step, however long ago the last one was.
    noise = sample(machine, trusted, step_s).R

    def advance(
        prior: ObserverState, snapshot: Snapshot, detail: str
    ) -> tuple[ObserverState, Info]:
        if not (snapshot.available[0] and snapshot.fresh[0]):
            return prior, Info.nothing(1, Status.PREDICTED, detail)
        S = C @ prior.P @ C.T + noise
        K = constant if gain == "constant" else filter_gain(prior.P, C, noise)
        innovation = snapshot.z - C @ prior.x
        keep = eye - K @ C
        # Joseph's form holds for any gain, matched or not.
        P = keep @ prior.P @ keep.T + K @ noise @ K.T
        state = ObserverState(prior.time, prior.x + K @ innovation, P, prior.u)
        nis = float(innovation[0] ** 2 / S[0, 0])
        used, deviation = np.ones(1, dtype=bool), np.sqrt(np.diagonal(S))
        return state, Info(Status.OK, 1, nis, 1, used, innovation, deviation, np.zeros(1), detail)

    def init(snapshot: Snapshot) -> tuple[ObserverState | None, Info]:
        if snapshot.inputs is None:
            return None, Info.nothing(1, Status.UNOBSERVABLE, missing)
        prior = ObserverState(
            snapshot.time,
            np.array(start, dtype=float),
            np.diag(np.square(start_sigma)),
            float(snapshot.inputs[0]),
        )
        return advance(prior, snapshot, "")

    def step(state: ObserverState, snapshot: Snapshot) -> tuple[ObserverState, Info]:
        elapsed = (snapshot.time - state.time) / np.timedelta64(1, "us") * 1e-6
        if elapsed <= 0:
            raise ParameterError(
                f"snapshots must follow each other in time: {snapshot.time} after {state.time}; "
                "align the telemetry first"
            )
        over = sample(machine, trusted, elapsed)
        u, detail = state.u, f"ΔM is missing, the last value is held: {missing}"
        if snapshot.inputs is not None:
            u, detail = float(snapshot.inputs[0]), ""
        prior = ObserverState(
            snapshot.time,
            over.F @ state.x + over.G0[:, 0] * state.u + over.G1[:, 0] * u,
            over.F @ state.P @ over.F.T + over.Q,
            u,
        )
        return advance(prior, snapshot, detail)

    def read(state: ObserverState) -> Estimate:
        return Estimate(state.x, state.P)

    missing = NEEDS_INPUT.format(base=machine.s_mva, element=machine.element)
    return Estimator(name, init, step, read)


def observe(
    machine: Machine,
    gain: npt.ArrayLike,
    step_s: float,
    y: FloatArray,
    u: FloatArray,
    x0: FloatArray,
) -> FloatArray:
    """Run an observer of constant gain on many records at once.

    Parameters
    ----------
    machine : Machine
    gain : (2, 1) array_like
        K.
    step_s : float
        [s]
    y : (T, n) ndarray
        Angle at steps 1 … T of n records. [rad]
    u : (T+1, n) or (T+1, 1) ndarray
        ΔM at steps 0 … T. [p.u.]
    x0 : (2, n) ndarray
        x̂ at step 0. [rad, rad/s]

    Returns
    -------
    (T, 2, n) ndarray
        x̂ at steps 1 … T.

    Raises
    ------
    ParameterError
        If the shapes do not fit.
    """
    K = np.asarray(gain, dtype=float).reshape(2, 1)
    count, n = y.shape
    if u.shape not in ((count + 1, n), (count + 1, 1)) or x0.shape != (2, n):
        raise ParameterError(
            f"y has shape {y.shape}: expected u with {(count + 1, n)} or {(count + 1, 1)} and x0 "
            f"with {(2, n)}, received {u.shape} and {x0.shape}; give the input at the start as well"
        )
    step = sample(machine, Densities(0.0, 0.0, 0.0), step_s)
    # x̂⁺ = (I-KC)(F x̂ + G₀u + G₁u⁺) + K y⁺: everything but F acts on known series.
    keep = np.eye(2) - K @ machine.C
    error = keep @ step.F
    driven = keep @ step.G0 @ u[:-1, None, :] + keep @ step.G1 @ u[1:, None, :]
    driven = driven + K @ y[:, None, :]
    out = np.empty((count, 2, n))
    x = x0
    for k in range(count):
        x = error @ x + driven[k]
        out[k] = x
    return out
