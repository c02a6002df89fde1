"""Bad data inside a filter, by its own innovation.

A Kalman filter asks `refuse` about its innovation before it believes it. Unlike an adaptive
threshold on a channel's own past (`pse_analysis.estimation.screening`), it knows how the load may
move, and what the other channels say about the same movement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg

from pse_analysis.errors import ParameterError

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

Refuse = Callable[[FloatArray, FloatArray], BoolArray]
"""(innovation (m,), lower Cholesky factor of its covariance (m, m)) -> rows not to be used (m,).

The filter has the factor already; above the diagonal it is zero.
"""


@dataclass(frozen=True)
class InnovationParams:
    """When a filter refuses a channel.

    Attributes
    ----------
    factor : float
        c: refused if the innovation lies more than c of its own σ, given all other channels, away
        from what these and the forecast predict. Loads are heavy-tailed: where single customers
        switch, a good channel that alone sees a step lies 4 to 6 σ off, and to refuse it costs more
        than the few errors of that size do.
    alone : float
        Nor is a channel refused that lies less than so many of its own σ away from the forecast
        alone: what only the others speak against rests on correlations that are learnt, of loads
        and of values that are held, and these are not as certain as S has them.
    largest_share : float
        Share of the channels of a snapshot that may be refused: if more seem wrong, the forecast
        is.
    """

    factor: float = 6.0
    alone: float = 2.5
    largest_share: float = 0.25

    def __post_init__(self) -> None:
        if not (self.factor > 0 and self.alone >= 0 and 0 < self.largest_share < 1):
            raise ParameterError(
                "screening: expected factor > 0, alone ≥ 0 and 0 < largest_share < 1, received "
                f"{self.factor}, {self.alone} and {self.largest_share}"
            )


def refuse(params: InnovationParams | None = None) -> Refuse:
    """Refuse the channel that disagrees most with the others and the forecast, and so on.

    Parameters
    ----------
    params : InnovationParams, optional

    Returns
    -------
    Refuse

    Notes
    -----
    With M = S⁻¹ the innovation of channel i, given those of all others, has the mean
    η_i - (Mη)_i/M_ii and the variance 1/M_ii; so |(Mη)_i|/√M_ii is the largest normalised residual
    of a least-squares estimate that counts the forecast among its measurements. Taking a channel
    out changes M by one rank.
    """
    params = params or InnovationParams()

    def refused(innovation: FloatArray, chol_S: FloatArray) -> BoolArray:
        m = len(innovation)
        out = np.zeros(m, dtype=bool)
        own_variance = np.einsum("ij,ij->i", chol_S, chol_S)
        expected = innovation**2 <= params.alone**2 * own_variance
        if expected.all():
            return out
        inverse, _ = linalg.lapack.dtrtri(chol_S, lower=1)
        y = inverse.T @ (inverse @ innovation)
        # Most snapshots hold no error: the diagonal of M = L⁻ᵀL⁻¹ is enough to see that.
        odd = y * y > params.factor**2 * np.einsum("ij,ij->j", inverse, inverse)
        if not (odd & ~expected).any():
            return out
        M = inverse.T @ inverse
        for _ in range(int(params.largest_share * m)):
            variance = np.where(out | expected, np.inf, np.diagonal(M))
            suspicion = np.abs(y) / np.sqrt(variance)
            worst = int(suspicion.argmax())
            if suspicion[worst] <= params.factor:
                return out
            out[worst] = True
            column, own = M[:, worst].copy(), M[worst, worst]
            y = y - column * (y[worst] / own)
            M = M - np.outer(column, column / own)
        return out

    return refused
