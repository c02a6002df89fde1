"""A machine on load with its governor, a step of load, and white noise of a stated density.

Two parts, as in Fig. 1 of [frolov2025]: a small power system gives ΔM(t); the linear machine driven
by it *and* by disturbances is the plant whose angle is measured. The plant is linear, and without
disturbances it moves as the power system's own rotor does, so its state is the sum of that motion
and the response to the disturbances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import integrate, linalg

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import NotConverged, ParameterError
from pse_analysis.machine import Densities, Machine

LARGEST_GAIN = 1e4
"""Gains and times of a governor; beyond them its motion is stiff, and solving it never ends."""
LARGEST_LOAD = 1e9
FASTEST_S = 1e-3
"""Time constant of the fastest turbine. [s]"""


@dataclass(frozen=True)
class GovernorParams:
    """Proportional-derivative governor: p_ref = p₀ - k_p Δω - k_v dΔω/dt, Δω per unit.

    Attributes
    ----------
    proportional : float
        k_p, the inverse of the droop. [p.u. power per p.u. speed]
    derivative_s : float
        k_v. [s]
    time_constant_s : float
        Of servo and turbine together. [s]
    """

    proportional: float = 20.0
    derivative_s: float = 2.0
    time_constant_s: float = 0.3

    def __post_init__(self) -> None:
        if not (
            0 <= self.proportional <= LARGEST_GAIN
            and 0 <= self.derivative_s <= LARGEST_GAIN
            and FASTEST_S <= self.time_constant_s <= LARGEST_GAIN
        ):
            raise ParameterError(
                "[governor] expected proportional ≥ 0, derivative_s ≥ 0 and time_constant_s > 0, "
                f"received {self}; none above {LARGEST_GAIN:g}, and no time constant below "
                f"{FASTEST_S:g} s"
            )


@dataclass(frozen=True)
class LoadStepParams:
    """The load that the machine feeds alone.

    Attributes
    ----------
    load_mw, step_mw : float
        Before the step, and what is switched on. [MW]
    step_at_s : float
        When, after the begin. [s]
    per_speed : float
        Change of the load with speed. [p.u. of load per p.u. speed]
    """

    load_mw: float = 150.0
    step_mw: float = 10.0
    step_at_s: float = 5.0
    per_speed: float = 1.0

    def __post_init__(self) -> None:
        for name in ("load_mw", "step_mw", "step_at_s", "per_speed"):
            if not abs(getattr(self, name)) <= LARGEST_LOAD:
                raise ParameterError(
                    f"[simulate.load] {name} must be finite, at most {LARGEST_LOAD:g} in size, "
                    f"received {getattr(self, name)}"
                )

    def at(self, time_s: float) -> float:
        """Load at nominal speed; at the instant of the step it is on. [MW]"""
        return self.load_mw + (self.step_mw if time_s >= self.step_at_s else 0.0)


class Motion(NamedTuple):
    """How the machine moves without disturbances.

    Attributes
    ----------
    time_s : (T,) ndarray
    delta_m : (T,) ndarray
        ΔM = M_mech - M_el, friction not included. [p.u.]
    x : (T, 2) ndarray
        [θ; ω]. [rad, rad/s]
    """

    time_s: FloatArray
    delta_m: FloatArray
    x: FloatArray


def load_step(
    machine: Machine,
    load: LoadStepParams,
    governor: GovernorParams,
    time_s: npt.ArrayLike,
    start: tuple[float, float] = (0.0, 0.0),
) -> Motion:
    """Motion of a machine that feeds a load alone, without excitation control.

    Parameters
    ----------
    machine : Machine
    load : LoadStepParams
    governor : GovernorParams
    time_s : (T,) array_like
        Increasing; the first is the begin of the run. [s]
    start : (2,) tuple of float
        θ and ω at the begin, with the mechanical power of a balanced load. [rad, rad/s]

    Returns
    -------
    Motion
        ΔM at the instant of the step is the value after it.

    Raises
    ------
    ParameterError
        If times do not increase, or the load exceeds the machine.
    NotConverged
        If the solver gives up, as when the governor lets the machine stall.

    Notes
    -----
    Power is what governor and load set; torque is power over speed, which makes the system
    non-linear. Solved with an eighth-order Runge–Kutta method up to the step and again after it.
    """
    time = np.asarray(time_s, dtype=float)
    if time.ndim != 1 or len(time) < 2 or not (np.diff(time) > 0).all():
        raise ParameterError("time_s must be one increasing series of at least two times")
    for power in (load.load_mw, load.load_mw + load.step_mw):
        if not 0 <= power <= machine.s_mva:
            raise ParameterError(
                f"a load of {power:g} MW does not fit a machine of {machine.s_mva:g} MVA: choose "
                "load_mw and step_mw within its rating"
            )
    p0 = load.load_mw / machine.s_mva

    def torques(x: FloatArray, power: float) -> tuple[FloatArray, FloatArray]:
        speed = 1.0 + x[1] / machine.omega0
        return x[2] / speed, power * (1.0 + load.per_speed * (speed - 1.0)) / speed

    def slope(time: float, x: FloatArray, power: float) -> list[float]:
        mechanical, electrical = torques(x, power)
        deviation = x[1] / machine.omega0
        change = float(mechanical - electrical - machine.k_d_pu * deviation) / machine.t_j_s
        asked = p0 - governor.proportional * deviation - governor.derivative_s * change
        return [x[1], machine.omega0 * change, (asked - x[2]) / governor.time_constant_s]

    x = np.array([start[0], start[1], p0])
    out = np.empty((len(time), 3))
    delta_m = np.empty(len(time))
    at = float(time[0])
    edge = float(np.clip(load.step_at_s, time[0], time[-1]))
    for end, here in ((edge, time < load.step_at_s), (float(time[-1]), time >= load.step_at_s)):
        power = load.at(at) / machine.s_mva if end > at else load.at(end) / machine.s_mva
        if end > at:
            wanted = np.union1d(time[here], [end])
            solution = integrate.solve_ivp(
                slope, (at, end), x, "DOP853", wanted, args=(power,), rtol=1e-9, atol=1e-11
            )
            if not solution.success:
                raise NotConverged(
                    f"the machine's motion ends at {solution.t[-1] if len(solution.t) else at:g} s "
                    f"({solution.message}): give the governor a larger proportional gain"
                )
            out[here] = solution.y.T[np.isin(wanted, time[here])]
            x, at = solution.y[:, -1], end
        elif here.any():
            out[here] = x
        mechanical, electrical = torques(out[here].T, power)
        delta_m[here] = mechanical - electrical
    return Motion(time, delta_m, out[:, :2])


def band_limited_white_noise(
    density: float, step_s: float, shape: tuple[int, ...], rng: np.random.Generator
) -> FloatArray:
    """White noise held for a sample time.

    Parameters
    ----------
    density : float
        Two-sided spectral density, which the sequence has well below 1/step. [unit²·s]
    step_s : float
        Time for which each value is held. [s]
    shape : tuple of int
    rng : Generator

    Returns
    -------
    ndarray
        Independent normal values of variance density/step.

    Raises
    ------
    ParameterError
        If density or step cannot be.
    """
    if not (density >= 0 and step_s > 0):
        raise ParameterError(
            f"white noise needs density ≥ 0 and a sample time above 0, received {density} and "
            f"{step_s} s"
        )
    return np.asarray(rng.standard_normal(shape) * np.sqrt(density / step_s))


class Disturbed(NamedTuple):
    """Response to disturbances from rest, and the noise of the angle.

    Attributes
    ----------
    x : (T+1, 2, n) ndarray
        What disturbances add to [θ; ω] at steps 0 … T; 0 at the start. [rad, rad/s]
    noise : (T+1, n) ndarray
        Noise of the angle at the same steps. [rad]
    """

    x: FloatArray
    noise: FloatArray


def disturb(
    machine: Machine,
    densities: Densities,
    step_s: float,
    steps: int,
    trials: int,
    rng: np.random.Generator,
    *,
    every: int = 1,
) -> Disturbed:
    """Draw what white noise does to the machine and to its measured angle.

    Parameters
    ----------
    machine : Machine
    densities : Densities
    step_s : float
        Time between samples; the noise of the angle is held for it. [s]
    steps : int
        T.
    trials : int
        n, drawn at once.
    rng : Generator
    every : int
        Disturbances are held for step_s/every.

    Returns
    -------
    Disturbed
    """
    fine = step_s / every
    A = machine.A
    F = linalg.expm(A * fine)
    # ∫₀ʰ e^{As} ds, exact also for A's zero eigenvalue.
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2:] = A, np.eye(2)
    hold = linalg.expm(block * fine)[:2, 2:]
    root = np.sqrt(np.array([densities.theta, densities.omega]) / fine)
    x = np.zeros((2, trials))
    out = np.empty((steps + 1, 2, trials))
    out[0] = x
    for k in range(steps):
        f = rng.standard_normal((every, 2, trials)) * root[:, None]
        for part in f:
            x = F @ x + hold @ part
        out[k + 1] = x
    noise = band_limited_white_noise(densities.angle, step_s, (steps + 1, trials), rng)
    return Disturbed(out, noise)
