"""What a filter takes for its process noise: known beforehand, or learnt on the way (Sage–Husa)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import linalg

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.process.dynamics import Process
from pse_analysis.estimation.process.load_noise import ProcessNoise, in_frame, to_polar
from pse_analysis.grid.network import Network

ROUNDING = 1e-14
"""Share of the variances that make up another one, below which it is zero."""

VoltageNoise = Callable[[FloatArray, np.datetime64], FloatArray]
"""Covariance (n, n) of the step to an instant, at a forecast [θ; |V|] (2N,)."""


class Learnt(NamedTuple):
    """What a step teaches about the noise that it met.

    Attributes
    ----------
    moved : (N,) ndarray
        x̂ - (F x̂₋₁ + g).
    correction : (N,) ndarray
        K η.
    posterior, forecast : (N, N) ndarray
        P and F P₋₁ Fᵀ.
    """

    moved: FloatArray
    correction: FloatArray
    posterior: FloatArray
    forecast: FloatArray


class Noise(NamedTuple):
    """Mean and covariance of the process noise, and how they are learnt.

    Attributes
    ----------
    begin : (x, time) -> memory
        At the first [θ; |V|].
    current : (memory, x, time) -> (q, Q, memory)
        At a forecast [θ; |V|]; q (N,), Q (N, N).
    learn : (memory, Learnt) -> memory
    voltages : VoltageNoise
        What it starts from.
    wait : memory -> memory
        At an instant at which nothing was measured.
    """

    begin: Callable[[FloatArray, np.datetime64], Any]
    current: Callable[[Any, FloatArray, np.datetime64], tuple[FloatArray, FloatArray, Any]]
    learn: Callable[[Any, Learnt], Any]
    voltages: VoltageNoise
    wait: Callable[[Any], Any] = lambda memory: memory


def constant(covariance: FloatArray) -> VoltageNoise:
    """Q that never changes, from one variance per state (n,) or a matrix (n, n). [p.u.², rad²]"""
    matrix = np.diag(covariance) if covariance.ndim == 1 else covariance
    return lambda _x, _time: matrix


def of_grid(network: Network, noise: ProcessNoise, columns: npt.NDArray[np.int64]) -> VoltageNoise:
    """Polar form of a noise of [e; f], for the estimated columns of [θ; |V|]."""
    n = network.n_bus
    inside = np.ix_(columns, columns)

    def polar(x: FloatArray, time: np.datetime64) -> FloatArray:
        # In the frame of the source: angles move alike in all.
        voltage, _ = in_frame(x[n:] * np.exp(1j * (x[:n] - x[network.slack])), network.slack)
        turn = to_polar(voltage)
        Q = noise(voltage, time)
        found = (turn @ Q @ turn.T)[inside]
        # What does not move must not move by what rounding makes of it.
        still = np.diagonal(found) <= ROUNDING * (turn**2 @ np.diagonal(Q))[columns]
        found[still] = found[:, still] = 0.0
        return np.asarray(found)

    return polar


def known(voltages: VoltageNoise, process: Process) -> Noise:
    """Noise of mean 0 and given covariance."""

    def current(
        _memory: None, x: FloatArray, time: np.datetime64
    ) -> tuple[FloatArray, FloatArray, None]:
        covariance = process.noise(voltages(x, time))
        return np.zeros(len(covariance)), covariance, None

    return Noise(lambda _x, _time: None, current, lambda memory, _learnt: memory, voltages)


class _Moments(NamedTuple):
    """What was learnt of the noise.

    Attributes
    ----------
    mean : (N,) ndarray
    covariance : (N, N) ndarray
    start : (N, N) ndarray
        Covariance before all.
    steps : int
    square : float
        Mean of |x̂ - F x̂₋₁ - g|².
    weights : float
        Sum of the squared weights of the steps in these means.
    """

    mean: FloatArray
    covariance: FloatArray
    start: FloatArray
    steps: int
    square: float = 0.0
    weights: float = 0.0

    @property
    def drift(self) -> FloatArray:
        """The mean, as far as it is more than what few steps make of noise of mean 0. (N,)"""
        length = float(self.mean @ self.mean)
        if length == 0.0:
            return self.mean
        return max(1.0 - self.weights * self.square / length, 0.0) * self.mean


def sage_husa(voltages: VoltageNoise, process: Process, forgetting: float = 0.97) -> Noise:
    """Noise whose mean and covariance are learnt with fading memory; R is taken as known.

    Parameters
    ----------
    voltages : VoltageNoise
        Covariance at the start.
    process : Process
    forgetting : float
        b: the weight of a step fades by this factor at every later one.

    Returns
    -------
    Noise

    Raises
    ------
    ParameterError
        If the factor does not lie in (0, 1).

    Notes
    -----
    With d = (1-b)/(1-b^{k+1}): q ← (1-d) q + d (x̂ - F x̂₋₁ - g) and
    Q ← (1-d) Q + d (K ηηᵀ Kᵀ + P - F P₋₁ Fᵀ). Where the latter is not positive definite, P - F P₋₁
    Fᵀ is left out, which is biased but never negative.

    The mean of so few steps is never zero, and a filter that follows it drifts. It is therefore
    shrunk as James and Stein shrink a mean, q (1 - Σw² E|x̂ - F x̂₋₁ - g|²/|q|²)₊.

    Fading memory holds (1+b)/(1-b) = ν steps, few more than a grid has voltages, n, and the
    covariance of so few samples is far too small in some directions. What the filter uses is
    therefore drawn towards the shape of the start, by the share n/(n + ν) and at the size learnt,
    and what is left of the samples is as much larger as n of them make a forecast, (n + ν)/ν.

    q is as uncertain as a mean of so few samples, which P does not know. What it moves while
    nothing is measured would be wrong by as much as all noise of that time, so it fades by b.
    """
    if not 0.0 < forgetting < 1.0:
        raise ParameterError(f"sage_husa: expected 0 < forgetting < 1, received {forgetting}")

    def begin(x: FloatArray, time: np.datetime64) -> _Moments:
        covariance = process.noise(voltages(x, time))
        return _Moments(np.zeros(len(covariance)), covariance, covariance, 0)

    def current(
        memory: _Moments, _x: FloatArray, _time: np.datetime64
    ) -> tuple[FloatArray, FloatArray, _Moments]:
        n, size = len(memory.start), float(np.trace(memory.start))
        if memory.steps == 0 or size == 0.0:
            return memory.drift, memory.covariance, memory
        share = n / (n + min(memory.steps, (1.0 + forgetting) / (1.0 - forgetting)))
        scale = float(np.trace(memory.covariance)) / size
        return memory.drift, memory.covariance + (share * scale) * memory.start, memory

    def learn(memory: _Moments, step: Learnt) -> _Moments:
        count = memory.steps + 1
        share = (1.0 - forgetting) / (1.0 - forgetting ** (count + 1))
        mean = (1.0 - share) * memory.mean + share * step.moved
        safe = np.outer(share * step.correction, step.correction)
        safe += (1.0 - share) * memory.covariance
        unbiased = safe + share * (step.posterior - step.forecast)
        square = (1.0 - share) * memory.square + share * float(step.moved @ step.moved)
        weights = (1.0 - share) ** 2 * memory.weights + share**2
        covariance = unbiased if _positive(unbiased) else safe
        return _Moments(mean, covariance, memory.start, count, square, weights)

    def wait(memory: _Moments) -> _Moments:
        return memory._replace(mean=forgetting * memory.mean)

    return Noise(begin, current, learn, voltages, wait)


def _positive(matrix: FloatArray) -> bool:
    try:
        linalg.cholesky(matrix, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return False
    return True
