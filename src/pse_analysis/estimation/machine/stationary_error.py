"""What a gain is worth: stationary error of any observer, and the price of a wrong tuning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.machine.gain import (
    Tuning,
    continuous_gain,
    discrete_gain,
)
from pse_analysis.machine import Densities, Machine, sample


def continuous_covariance(
    machine: Machine, gain: npt.ArrayLike, densities: Densities
) -> FloatArray:
    """Stationary covariance of the error of a continuous observer with any gain.

    Parameters
    ----------
    machine : Machine
    gain : (2, 1) array_like
        L, from wherever. [1/s, 1/s²]
    densities : Densities
        The true ones.

    Returns
    -------
    (2, 2) ndarray
        Solution of (A+LC)P + P(A+LC)ᵀ + Q + LRLᵀ = 0. [rad², rad²/s, rad²/s²]

    Raises
    ------
    ParameterError
        If the observer is not stable.
    """
    L = np.asarray(gain, dtype=float).reshape(2, 1)
    error = machine.A + L @ machine.C
    poles = linalg.eigvals(error)
    if not (poles.real < 0).all():
        raise ParameterError(
            f"the observer with L = {L.ravel().tolist()} is not stable: its error has the poles "
            f"{poles.tolist()}; with L = -[l1, l2] both l1 and l2 must exceed what damping lacks"
        )
    noise = densities.Q + L @ densities.R @ L.T
    return np.asarray(linalg.solve_continuous_lyapunov(error, -noise))


def discrete_covariance(
    machine: Machine, gain: npt.ArrayLike, densities: Densities, step_s: float
) -> FloatArray:
    """Stationary covariance of the error of a sampled observer with any gain.

    Parameters
    ----------
    machine : Machine
    gain : (2, 1) array_like
        K of x̂ = x̂⁻ + K (y - C x̂⁻).
    densities : Densities
        The true ones.
    step_s : float
        Time between samples. [s]

    Returns
    -------
    (2, 2) ndarray
        Of the error after the update, (I-KC)(FPFᵀ + Q_h)(I-KC)ᵀ + KR_hKᵀ = P.

    Raises
    ------
    ParameterError
        If the observer is not stable at this step.
    """
    K = np.asarray(gain, dtype=float).reshape(2, 1)
    step = sample(machine, densities, step_s)
    keep = np.eye(2) - K @ machine.C
    error = keep @ step.F
    radius = float(np.abs(linalg.eigvals(error)).max())
    if radius >= 1.0:
        raise ParameterError(
            f"the observer with K = {K.ravel().tolist()} is not stable at a step of {step_s} s: "
            f"its error grows by {radius:.4g} per step; design K for this step with discrete_gain"
        )
    noise = keep @ step.Q @ keep.T + K @ step.R @ K.T
    return np.asarray(linalg.solve_discrete_lyapunov(error, noise))


def rms(
    machine: Machine, tuning: Tuning, densities: Densities, step_s: float | None = None
) -> FloatArray:
    """Stationary RMS error of a tuning under the true densities.

    Parameters
    ----------
    machine : Machine
    tuning : Densities or Poles
    densities : Densities
        The true ones.
    step_s : float, optional
        Time between samples; continuous without. [s]

    Returns
    -------
    (2,) ndarray
        Of θ and ω. [rad, rad/s]
    """
    if step_s is None:
        P = continuous_covariance(machine, continuous_gain(machine, tuning), densities)
    else:
        P = discrete_covariance(machine, discrete_gain(machine, tuning, step_s), densities, step_s)
    return np.asarray(np.sqrt(np.diagonal(P)))


@dataclass(frozen=True, eq=False)
class Tuned:
    """The matched observer, and what other choices of Q/R would cost.

    Attributes
    ----------
    ratio : float
        True Q/R, ``densities.omega / densities.angle``.
    gain : (2, 1) ndarray
        Matched L, or K if a step was given.
    matched : (2,) ndarray
        Its stationary RMS of θ and ω, the least there is. [rad, rad/s]
    ratios : (r,) ndarray
        The ratios that were tried.
    gains : (r, 2, 1) ndarray
    rms : (r, 2) ndarray
        Stationary RMS at the true densities. [rad, rad/s]
    cost : (r, 2) ndarray
        rms/matched - 1.
    """

    ratio: float
    gain: FloatArray
    matched: FloatArray
    ratios: FloatArray
    gains: FloatArray
    rms: FloatArray
    cost: FloatArray


def tune(
    machine: Machine,
    densities: Densities,
    ratios: npt.ArrayLike = (),
    step_s: float | None = None,
) -> Tuned:
    """Matched gain and the cost of mismatch, without simulation.

    Parameters
    ----------
    machine : Machine
    densities : Densities
        The true ones.
    ratios : (r,) array_like
        Values of Q/R to judge; Q keeps the proportions of the true one, so that the true ratio is
        ``densities.omega / densities.angle``.
    step_s : float, optional
        Time between samples; continuous without. [s]

    Returns
    -------
    Tuned

    Raises
    ------
    ParameterError
        If a ratio is not above 0, or the Riccati equation has no stabilising solution.
    """
    tried = np.atleast_1d(np.asarray(ratios, dtype=float))
    if not (tried > 0).all():
        raise ParameterError(f"ratios Q/R must be above 0, received {tried[~(tried > 0)].tolist()}")

    def judged(tuning: Densities) -> tuple[FloatArray, FloatArray]:
        if step_s is None:
            gain = continuous_gain(machine, tuning)
            P = continuous_covariance(machine, gain, densities)
        else:
            gain = discrete_gain(machine, tuning, step_s)
            P = discrete_covariance(machine, gain, densities, step_s)
        return gain, np.sqrt(np.diagonal(P))

    gain, matched = judged(densities)
    results = [
        judged(Densities(a * densities.theta / densities.omega, a, 1.0)) for a in tried.tolist()
    ]
    gains = np.array([g for g, _ in results]).reshape(-1, 2, 1)
    spread = np.array([s for _, s in results]).reshape(-1, 2)
    return Tuned(
        ratio=densities.omega / densities.angle,
        gain=gain,
        matched=matched,
        ratios=tried,
        gains=gains,
        rms=spread,
        cost=spread / matched - 1.0,
    )


@dataclass(frozen=True, eq=False)
class ModelError:
    """Stationary error of an observer whose machine is not the true one.

    Attributes
    ----------
    rms : (2,) ndarray
        √(variance + bias²) of θ and ω. [rad, rad/s]
    deviation, bias : (2,) ndarray
        Its random part, and its mean at the given operating point.
    """

    rms: FloatArray
    deviation: FloatArray
    bias: FloatArray


def model_error(
    true: Machine,
    assumed: Machine,
    gain: npt.ArrayLike,
    densities: Densities,
    *,
    omega: float = 0.0,
    acceleration: float = 0.0,
) -> ModelError:
    """What an unknown T_j or K_d costs a continuous observer.

    Parameters
    ----------
    true, assumed : Machine
    gain : (2, 1) array_like
        L, designed on the assumed machine.
    densities : Densities
        The true ones.
    omega, acceleration : float
        Operating point: a speed deviation that lasts, and the acceleration (ω′) that goes with it.
        [rad/s, rad/s²]

    Returns
    -------
    ModelError

    Raises
    ------
    ParameterError
        If the observer is not stable, or if a wrong damping meets a true machine without any,
        whose speed has no stationary variance.

    Notes
    -----
    The error e = x̂ - x follows e′ = (A′+LC)e + (A′-A)x + (B′-B)u - f - Lξ. A′ - A acts on ω only,
    so [ω; e] is a closed linear system.
    """
    L = np.asarray(gain, dtype=float).reshape(2, 1)
    error = assumed.A + L @ true.C
    if not (linalg.eigvals(error).real < 0).all():
        raise ParameterError(
            f"the observer with L = {L.ravel().tolist()} is not stable on the assumed machine: "
            "design it there with continuous_gain"
        )
    damping = -true.A[1, 1]
    wrong = (assumed.A - true.A)[:, 1:]
    u = (acceleration + damping * omega) / true.B[1, 0]
    bias = -np.linalg.solve(error, wrong[:, 0] * omega + (assumed.B - true.B)[:, 0] * u)
    noise = densities.Q + L @ densities.R @ L.T
    if not wrong.any():
        P = linalg.solve_continuous_lyapunov(error, -noise)
    elif damping <= 0:
        raise ParameterError(
            "the true machine has no damping, so its speed drifts without bound and a wrong K_d "
            "costs more the longer it runs: give the true machine k_d_pu > 0"
        )
    else:
        joint = np.block([[np.array([[-damping]]), np.zeros((1, 2))], [wrong, error]])
        spread = np.zeros((3, 3))
        spread[0, 0] = densities.omega
        spread[0, 2] = spread[2, 0] = -densities.omega
        spread[1:, 1:] = noise
        P = linalg.solve_continuous_lyapunov(joint, -spread)[1:, 1:]
    deviation = np.sqrt(np.diagonal(P))
    return ModelError(np.hypot(deviation, bias), deviation, bias)
