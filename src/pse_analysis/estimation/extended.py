"""Extended prediction of the measurements: h and its Jacobian at the forecast, or iterated."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.conditioning import Moments, Prior
from pse_analysis.estimation.estimator import Snapshot
from pse_analysis.estimation.update import Observation
from pse_analysis.measurement import MeasurementModel, wrap

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


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
        return Moments(mean, np.asfortranarray(H @ cross[:n]), cross)

    return Observation(predict, passes=passes)
