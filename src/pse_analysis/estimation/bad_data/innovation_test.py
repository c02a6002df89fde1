"""Bad data inside a filter, by its own innovation.

A Kalman filter asks `refuse` about its innovation before it believes it. Unlike an adaptive
threshold on a channel's own past (`pse_analysis.estimation.bad_data.adaptive_threshold`), it knows
how the load may move, and what the other channels say about the same movement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import ParameterError

Refuse = Callable[[FloatArray, FloatArray, FloatArray], BoolArray]
"""(innovation (m,), lower Cholesky factor of its covariance (m, m), σ of the measurements (m,)) ->
rows not to be used (m,).

The filter has the factor already; above the diagonal it is zero.
"""


@dataclass(frozen=True)
class InnovationTest:
    """When a filter refuses a channel.

    Attributes
    ----------
    factor : float
        c: refused if the innovation lies more than c of its σ away from what all other channels and
        the forecast predict.
    forecast_inflation : float
        How many times larger the forecast's σ is taken to be for that. Loads are heavy-tailed:
        where a customer switches, the few channels that see it lie far off and are right. An error
        shows against its neighbours whatever the loads do. 1 for a noise without such tails.
    alone : float
        A channel that lies less than so many of its own σ away from the forecast alone is not
        refused: what only the others speak against rests on correlations that are learnt, of loads
        and of values that are held, and these are not as certain as the covariance has them.
    certain : float
        Unless it lies so many σ away from what the others predict. Where the forecast knows next to
        nothing, as with one variance for all voltages, nothing is odd by itself.
    largest_share : float
        Share of the channels of a snapshot that may be refused: if more seem wrong, the forecast
        is.
    """

    factor: float = 4.0
    forecast_inflation: float = 5.0
    alone: float = 2.5
    certain: float = 20.0
    largest_share: float = 0.25

    def __post_init__(self) -> None:
        if not (
            0 < self.factor <= self.certain
            and self.forecast_inflation >= 1
            and self.alone >= 0
            and 0 < self.largest_share < 1
        ):
            raise ParameterError(
                "screening: expected 0 < factor ≤ certain, forecast_inflation ≥ 1, alone ≥ 0 "
                f"and 0 < largest_share < 1, received {self}"
            )


def refuse(params: InnovationTest | None = None) -> Refuse:
    """Refuse the channel that disagrees most with the others and the forecast, and so on.

    Parameters
    ----------
    params : InnovationTest, optional

    Returns
    -------
    Refuse

    Notes
    -----
    With M = S⁻¹ the innovation of channel i, given those of all others, has the mean
    η_i - (Mη)_i/M_ii and the variance 1/M_ii; so |(Mη)_i|/√M_ii is the largest normalised residual
    of a least-squares estimate that counts the forecast among its measurements. Taking a channel
    out changes M by one rank. A snapshot in which no channel is odd under S itself passes; the
    others are judged under R + forecast_inflation² (S - R).
    """
    params = params or InnovationTest()
    inflation = params.forecast_inflation**2

    def refused(innovation: FloatArray, chol_S: FloatArray, sigma: FloatArray) -> BoolArray:
        m = len(innovation)
        out = np.zeros(m, dtype=bool)
        expected = innovation**2 <= params.alone**2 * np.einsum("ij,ij->i", chol_S, chol_S)
        bound = np.where(expected, params.certain, params.factor)
        if not _odd(innovation, chol_S, bound):
            return out
        inflated = inflation * (chol_S @ chol_S.T)
        inflated.flat[:: m + 1] -= (inflation - 1.0) * sigma**2
        M = _inverse(inflated)
        y = M @ innovation
        for _ in range(int(params.largest_share * m)):
            variance = np.where(out, np.inf, np.diagonal(M))
            excess = np.abs(y) / (bound * np.sqrt(variance))
            worst = int(excess.argmax())
            if excess[worst] <= 1.0:
                return out
            out[worst] = True
            column, own = M[:, worst].copy(), M[worst, worst]
            y = y - column * (y[worst] / own)
            M = M - np.outer(column, column / own)
        return out

    return refused


def _odd(innovation: FloatArray, chol_S: FloatArray, bound: FloatArray) -> bool:
    """Whether any |(S⁻¹η)_i| exceeds its bound times √(S⁻¹)_ii."""
    white, _ = lapack.dtrtrs(chol_S, innovation, lower=1)
    # No residual is larger than √(ηᵀS⁻¹η), so that few rows need a look.
    rows = np.flatnonzero(bound**2 < white @ white)
    if not len(rows):
        return False
    columns = np.zeros((len(innovation), len(rows)), order="F")
    columns[rows, np.arange(len(rows))] = 1.0
    columns, _ = lapack.dtrtrs(chol_S, columns, lower=1, overwrite_b=1)
    square = np.einsum("ij,ij->j", columns, columns)
    return bool(((white @ columns) ** 2 > bound[rows] ** 2 * square).any())


def _inverse(S: FloatArray) -> FloatArray:
    """S⁻¹ of a positive definite matrix, both halves."""
    # A symmetric matrix is its own transpose in the order that LAPACK reads.
    factor, _ = lapack.dpotrf(S.T, lower=1, overwrite_a=1)
    inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
    inverse += np.tril(inverse, -1).T
    return np.asarray(inverse)
