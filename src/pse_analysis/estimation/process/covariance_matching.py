"""Process noise estimated from a filter's own innovations, by covariance matching.

Q = Σ θ_k B_k B_kᵀ has a few known shapes, and the levels θ are estimated: single loads that move on
their own, all loads together, the source, other held voltages. Whatever the levels, Q belongs to
the grid and is semi-definite, and some hours hold enough innovations for so few numbers. What is
passed on is not the best fit of a level but the mean of what it may be, so that P knows of the
doubt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import lapack

from pse_analysis.arrays import ComplexArray, FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.process.load_noise import Sensitivity, at_least, in_frame, turned_rows
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, P, Q, SensorLayout

START = np.array([0.02, 0.02, 1e-3]) ** 2
"""Levels before anything was seen: (share of nominal load)² alone and together, and p.u.²"""
HELD_START = 1e-4**2
"""The same of held voltages other than the references. [p.u.²]"""
WINDOW = 18
"""Steps after which the weight of an innovation has faded to 1/e.

Innovations are then as old on average as in a window of 36, three hours of five minutes.
"""
FLOOR = 1e-4
"""Smallest share of its start that a level may sink to: no movement is ever ruled out."""
BEYOND = 9.0
"""How far above its best fit a level is looked for, over that and its start: σ is at most √10 of
the larger."""
GRID = (np.arange(64) + 0.5) / 64
"""Where √θ is tried, over the largest that is credible."""


class Matched(NamedTuple):
    """Levels, and what the innovations so far say about them.

    Attributes
    ----------
    level : (c,) ndarray
        θ.
    A, b : (c, c), (c,) ndarray
        Normal equations A θ = b, sums that fade.
    steps : float
        Sum of the weights that are in them.
    """

    level: FloatArray
    A: FloatArray
    b: FloatArray
    steps: float = 0.0


LEAST_INFORMATION = 1e-30
"""Information on the levels, in their starts' own scale, that stands for none."""


@dataclass(frozen=True, eq=False)
class CovarianceMatching:
    """Process noise with estimated levels.

    Attributes
    ----------
    halves : (voltage (N,)) -> tuple of c (2N, r_k) ndarrays
        B_k at a forecast voltage.
    start : (c,) ndarray
        Levels at the start, which count as one step.
    window : float
        Steps after which the weight of an innovation has faded to 1/e.
    """

    halves: Callable[[ComplexArray], tuple[FloatArray, ...]]
    start: FloatArray
    window: float = WINDOW

    def __post_init__(self) -> None:
        if self.window < 1 or not (self.start > 0).all():
            raise ParameterError(
                "noise from innovations: expected window ≥ 1 and levels above 0 at the start, "
                f"received {self.window} and {self.start.tolist()}"
            )

    def begin(self) -> Matched:
        """Before the first innovation."""
        c = len(self.start)
        return Matched(self.start, np.zeros((c, c)), np.zeros(c))

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
        past: Σ tr(S⁻¹D_k S⁻¹D_l) θ_l = Σ ηᵀS⁻¹D_k S⁻¹η - tr(S⁻¹D_k S⁻¹C), where C is the rest of S.
        This is a step of Fisher's scoring for the likelihood, with the earlier steps' covariance
        taken as given, so the estimate has the covariance 2 A⁻¹.
        """
        flat = response.reshape(len(response), -1)
        information = flat @ flat.T
        surprise = white @ response @ white - np.trace(response, axis1=1, axis2=2)
        fading = np.exp(-1.0 / self.window)
        A = fading * memory.A + information
        b = fading * memory.b + surprise + information @ memory.level
        steps = fading * memory.steps + 1.0
        prior = A / steps
        return Matched(self._expected(A + prior, b + prior @ self.start), A, b, steps)

    def _expected(self, A: FloatArray, b: FloatArray) -> FloatArray:
        """Mean of every level under N(A⁻¹b, 2 A⁻¹), √θ being half-Cauchy of the start's scale.

        The best fit of a level that is barely seen is often zero or less, and a filter that
        believes in it stops listening for hours; what the level may still be is above zero.
        """
        scale = self.start
        scaled = A * np.outer(scale, scale)
        # Where the meters tell nothing of a shape, its start is the best fit; where they tell
        # nothing at all, that of every shape, and the ridge must still have an inverse.
        ridge = max(1e-9 * float(np.trace(scaled)), LEAST_INFORMATION)
        inverse = np.linalg.inv(scaled + ridge * np.eye(len(scale)))
        best, spread = inverse @ (b * scale + ridge), np.sqrt(2.0 * np.diagonal(inverse))
        above = np.maximum(best, 0.0)
        largest = above + np.minimum(6.0 * spread, BEYOND * (1.0 + above))
        level = largest[:, None] * GRID**2
        fit = -0.5 * ((level - best[:, None]) / spread[:, None]) ** 2 - np.log1p(level)
        # Measured from the likeliest, so that not all weights vanish.
        weight = np.exp(fit - fit.max(axis=1, keepdims=True))
        mean = (weight * level).sum(axis=1) / weight.sum(axis=1)
        return np.asarray(scale * np.maximum(mean, FLOOR))


def of_loads(
    network: Network, metered: FloatArray | None = None, window: float = WINDOW
) -> CovarianceMatching:
    """Loads alone in proportion to their size, all loads together, references, other held voltages.

    Parameters
    ----------
    network : Network
        Its nominal injections are the sizes, where there are any.
    metered : (2N,) ndarray, optional
        Usual [P; Q] where they are known otherwise, NaN elsewhere. [p.u.]
    window : float
        As for `CovarianceMatching`.

    Raises
    ------
    ParameterError
        If neither says how large any load is.
    """
    sensitivity = Sensitivity(network)
    moves = sensitivity.renewed()
    n = network.n_bus
    size = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    if metered is not None:
        unknown = np.tile((size[:n] == 0) & (size[n:] == 0), 2) & np.isfinite(metered)
        size = np.where(unknown, metered, size)
    size = size[sensitivity.inputs]
    if not size.any():
        raise ParameterError(
            'noise = "innovation" needs to know how large the loads are: give p_load_mw and '
            "q_load_mvar in the buses table, or meter injections before the study"
        )

    least = at_least(size)
    reference = np.isin(sensitivity.held, network.references)
    groups = [group for group in (reference, ~reference) if group.any()]

    def halves(voltage: ComplexArray) -> tuple[FloatArray, ...]:
        at_source, frame = in_frame(voltage, network.slack)
        by_input, by_voltage = moves(at_source)
        shapes = [by_input * least, (by_input @ size)[:, None]]
        shapes += [by_voltage[:, group] for group in groups]
        return tuple(turned_rows(shape, frame) for shape in shapes)

    start = START if len(groups) == 1 else np.append(START, HELD_START)
    return CovarianceMatching(halves, start, window)


def responses(
    halves: tuple[FloatArray, ...],
    plane: sparse.csr_array,
    moving: FloatArray | float,
    chol_S: FloatArray,
) -> FloatArray:
    """How the covariance of an innovation follows the levels, in units of itself.

    Parameters
    ----------
    halves : tuple of c (2N, r_k) ndarrays
        B_k.
    plane : (m, 2N) csr_array
        The rows as functionals of one instant's [e; f].
    moving : (m, m) ndarray or 1
        Share of Q in the covariance of the rows.
    chol_S : (m, m) ndarray
        L of S = L Lᵀ; what stands above the diagonal does not count.

    Returns
    -------
    (c, m, m) ndarray
        L⁻¹ D_k L⁻ᵀ, where D_k = ∂S/∂θ_k.
    """
    out = []
    for half in halves:
        rows = plane @ half
        left, _ = lapack.dtrtrs(chol_S, moving * (rows @ rows.T), lower=1)
        out.append(lapack.dtrtrs(chol_S, left.T, lower=1)[0])
    return np.array(out)


def usual_injections(history: Record, layout: SensorLayout, network: Network) -> FloatArray:
    """Mean of the metered [P; Q] of every bus before the study, NaN where none is. (2N,) [p.u.]"""
    out = np.full(2 * network.n_bus, np.nan)
    read = history.available & history.fresh
    for q, offset in ((P, 0), (Q, network.n_bus)):
        for row in np.flatnonzero((layout.quantity == q) & (layout.side == BUS)):
            if read[:, row].any():
                out[offset + layout.position[row]] = history.z[read[:, row], row].mean()
    return out
