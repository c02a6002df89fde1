"""Process noise estimated from a filter's own innovations, by covariance matching.

Q = Σ θ_k B_k B_kᵀ has a few known shapes, and the levels θ are estimated: single loads that move on
their own, all loads together, the source. Whatever the levels, Q belongs to the grid and is
semi-definite, and a window of some hours holds enough innovations for so few numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import linalg, optimize

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.process import Sensitivity
from pse_analysis.grid.network import Network

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

START = np.array([0.02, 0.02, 1e-3]) ** 2
"""Levels before anything was seen: (share of nominal load)² alone and together, and p.u.²"""
WINDOW = 36
"""Steps of which the innovations count; three hours of five minutes."""
FLOOR = 1e-4
"""Smallest share of its start that a level may sink to: no movement is ever ruled out."""


class Matched(NamedTuple):
    """Levels, and what the innovations of the window say about them.

    Attributes
    ----------
    level : (c,) ndarray
        θ.
    evidence : tuple of ((c, c), (c,)) ndarrays
        Normal equations A θ = b of every step.
    """

    level: FloatArray
    evidence: tuple[tuple[FloatArray, FloatArray], ...] = ()


@dataclass(frozen=True, eq=False)
class Matching:
    """Process noise with estimated levels.

    Attributes
    ----------
    halves : (voltage (N,)) -> tuple of c (2N, r_k) ndarrays
        B_k at a forecast voltage.
    start : (c,) ndarray
        Levels at the start, which count as one step of the window.
    window : int
    """

    halves: Callable[[ComplexArray], tuple[FloatArray, ...]]
    start: FloatArray
    window: int = WINDOW

    def __post_init__(self) -> None:
        if self.window < 1 or not (self.start > 0).all():
            raise ParameterError(
                "noise from innovations: expected window ≥ 1 and levels above 0 at the start, "
                f"received {self.window} and {self.start.tolist()}"
            )

    def begin(self) -> Matched:
        """Before the first innovation."""
        return Matched(self.start)

    def learn(self, memory: Matched, response: FloatArray, white: FloatArray) -> Matched:
        """Levels for the next step.

        Parameters
        ----------
        memory : Matched
        response : (c, m, m) ndarray
            L⁻¹ D_k L⁻ᵀ, where D_k = ∂S/∂θ_k and S = L Lᵀ.
        white : (m,) ndarray
            L⁻¹ η.

        Notes
        -----
        The levels whose S fits ηηᵀ best in the least squares of L⁻¹(ηηᵀ - S)L⁻ᵀ, summed over the
        window: Σ tr(S⁻¹D_k S⁻¹D_l) θ_l = Σ ηᵀS⁻¹D_k S⁻¹η - tr(S⁻¹D_k S⁻¹C), where C is the rest
        of S. This is a step of Fisher's scoring for the likelihood, with the earlier steps'
        covariance taken as given.
        """
        information = np.einsum("kij,lij->kl", response, response)
        surprise = white @ response @ white - np.trace(response, axis1=1, axis2=2)
        step = information, surprise + information @ memory.level
        evidence = (*memory.evidence, step)[-self.window :]
        A = np.mean([a for a, _ in evidence], axis=0)
        total = A * (len(evidence) + 1)
        target = np.sum([b for _, b in evidence], axis=0) + A @ self.start
        return Matched(self._solved(total, target), evidence)

    def _solved(self, A: FloatArray, b: FloatArray) -> FloatArray:
        """Minimise θᵀAθ/2 - bᵀθ over levels that are not below their floor."""
        scale = self.start
        scaled = A * np.outer(scale, scale)
        # Where the meters tell nothing of a shape, it keeps its start.
        ridge = 1e-9 * max(float(np.trace(scaled)), 1e-300)
        scaled = scaled + ridge * np.eye(len(scale))
        factor = np.linalg.cholesky(scaled)
        above = b * scale + ridge - scaled @ np.full(len(scale), FLOOR)
        level, _ = optimize.nnls(factor.T, linalg.solve_triangular(factor, above, lower=True))
        return np.asarray(scale * (FLOOR + level))


def of_loads(network: Network, window: int = WINDOW) -> Matching:
    """Loads alone in proportion to their nominal power, all loads together, and the source."""
    sensitivity = Sensitivity(network)
    moves = sensitivity.renewed()
    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])[sensitivity.inputs]

    def halves(voltage: ComplexArray) -> tuple[FloatArray, ...]:
        by_input, by_voltage = moves(voltage)
        alone = by_input * np.abs(nominal)
        return alone, (by_input @ nominal)[:, None], by_voltage

    return Matching(halves, START, window)
