"""Extended prediction of the measurements: h and its Jacobian at the forecast, or iterated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.conditioning import Moments, Prior
from pse_analysis.estimation.filters.update import Observation
from pse_analysis.measurement import IA, IM, MeasurementModel, wrap
from pse_analysis.measurement.layout import Terminals

NEGLIGIBLE = 0.1
"""Share of its σ up to which the remainder of an expansion is passed over."""


def linearised(model: MeasurementModel, passes: int = 1) -> Observation:
    """First-order prediction, renewed at the estimate if more than one pass is allowed.

    Parameters
    ----------
    model : MeasurementModel
        Its columns are the voltages that are estimated.
    passes : int
        1 is the extended filter; more is the iterated one, which stops when the estimate does.

    Returns
    -------
    Observation

    Raises
    ------
    ParameterError
        If ``passes`` is below 1.

    Notes
    -----
    With H the Jacobian at x_j: ŷ = h(x_j) + H (x⁻ - x_j), S = H P⁻ Hᵀ + R, C = P⁻ Hᵀ, so that pass
    j gives x⁻ + K_j [z - h(x_j) - H_j (x⁻ - x_j)], the reading of eqs. (8)–(22) of [batseva2023].
    """
    curvature = _curvature(model)

    def remainder(
        prior: Prior, rows: IntArray, at: FloatArray, found: FloatArray, sigma: FloatArray
    ) -> FloatArray:
        n = prior.n
        moved = (found - at)[:n]
        # Mostly a bound is enough to see that nothing bends.
        far = np.abs(moved).max(initial=0.0)
        if (curvature[rows] * far**2 <= NEGLIGIBLE * sigma).all():
            return np.zeros(len(rows))
        x = prior.filled(at)
        apart = (model.h(prior.filled(found)) - model.h(x))[rows]
        angular = model.angular[rows]
        apart[angular] = wrap(apart[angular])
        return np.asarray(apart - model.jacobian(x)[rows] @ moved)

    if passes < 1:
        raise ParameterError(f"extended filter: expected at least one pass, received {passes}")

    def predict(
        prior: Prior, _snapshot: Snapshot, rows: IntArray, _tuned: float, at: FloatArray
    ) -> Moments:
        x, n = prior.filled(at), prior.n
        H = model.jacobian(x)[rows]
        mean = model.h(x)[rows] + H @ (prior.s - at)[:n]
        angular = model.angular[rows]
        mean[angular] = wrap(mean[angular])
        cross = np.asfortranarray((H @ prior.P[:n]).T)
        return Moments(mean, np.asfortranarray(H @ cross[:n]), cross, halves=linear_halves(H))

    return Observation(predict, passes=passes, remainder=remainder)


def linear_halves(H: sparse.csr_array) -> Callable[[Prior], tuple[FloatArray, FloatArray]]:
    """How rows that are linear in the first entries of s deviate along the root of P."""

    def made(prior: Prior) -> tuple[FloatArray, FloatArray]:
        m, n = H.shape
        return np.asarray(H @ prior.chol_P[:n, :n]), np.zeros((m, m))

    return made


def _curvature(model: MeasurementModel) -> FloatArray:
    """Bounds of the second derivatives of h near rated voltage, summed up. (m,)

    A power is a product of two voltages and an admittance, with which a move of all of them by d
    bends it by no more than 4 d² times the sum of these. Currents may bend without bounds.
    """
    layout = model.layout
    terminals = Terminals(model.network, layout)
    total = np.zeros(len(layout))
    electric = np.flatnonzero(terminals.of_row >= 0)
    if len(electric):
        total[electric] = np.abs(terminals.y).sum(axis=1)[terminals.of_row[electric]]
    return np.where(np.isin(layout.quantity, (IM, IA)), np.inf, 4.0 * total)
