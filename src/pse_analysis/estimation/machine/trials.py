"""Errors of observers over many stationary starts, to hold theory to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import FloatArray
from pse_analysis.estimation.machine.gain import Tuning, discrete_gain
from pse_analysis.estimation.machine.observer import observe
from pse_analysis.estimation.machine.stationary_error import discrete_covariance
from pse_analysis.machine import Densities, Machine
from pse_analysis.simulation.machine import disturb


class Simulated(NamedTuple):
    """RMS error over trials, and what theory says.

    Attributes
    ----------
    rms, standard_error, theory : (2,) ndarray
        Of θ and ω; the standard error is that of ``rms``. [rad, rad/s]
    """

    rms: FloatArray
    standard_error: FloatArray
    theory: FloatArray


def simulated_rms(
    machine: Machine,
    tunings: Mapping[str, Tuning],
    densities: Densities,
    step_s: float,
    *,
    duration_s: float = 60.0,
    trials: int = 40,
    seed: int = 0,
) -> dict[str, Simulated]:
    """RMS error of observers on the same disturbances and noise.

    Parameters
    ----------
    machine : Machine
    tunings : mapping of str to Tuning
    densities : Densities
        The true ones.
    step_s : float
        Time between samples. [s]
    duration_s : float
        Of each trial. [s]
    trials : int
        Each starts with an error drawn from the observer's stationary law.
    seed : int

    Returns
    -------
    dict of str to Simulated
    """
    steps = round(duration_s / step_s)
    rng = np.random.default_rng(seed)
    drawn = disturb(machine, densities, step_s, steps, trials, rng)
    start = rng.standard_normal((2, trials))
    y, quiet = drawn.x[1:, 0] + drawn.noise[1:], np.zeros((steps + 1, 1))
    found = {}
    for name, tuning in tunings.items():
        K = discrete_gain(machine, tuning, step_s)
        P = discrete_covariance(machine, K, densities, step_s)
        x = observe(machine, K, step_s, y, quiet, np.linalg.cholesky(P) @ start)
        power = np.mean((x - drawn.x[1:]) ** 2, axis=0)
        rms = np.sqrt(power.mean(axis=1))
        spread = power.std(axis=1, ddof=1) / np.sqrt(trials)
        found[name] = Simulated(rms, spread / (2.0 * rms), np.sqrt(np.diagonal(P)))
    return found
