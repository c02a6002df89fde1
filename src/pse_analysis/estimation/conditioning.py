"""Conditioning of a normal state on measurements: factorisations and symmetric products only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import blas, lapack

from pse_analysis.estimation.robust import Judge, Suspicion

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Moments(NamedTuple):
    """Joint moments of a state and its measurements.

    Attributes
    ----------
    mean : (m,) ndarray
        ŷ.
    own : (m, m) ndarray
        Covariance of h(x), without the measurements' noise. Only the lower triangle counts.
    cross : (N, m) ndarray
        C, covariance of s and h(x).
    tuned : float
        What the observation remembers for the next step.
    """

    mean: FloatArray
    own: FloatArray
    cross: FloatArray
    tuned: float = 0.0


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before a snapshot.

    Attributes
    ----------
    s, P : (N,), (N, N) ndarray
    x : (2N_bus,) ndarray
        [θ; |V|] of s, with the angles that are fixed.
    columns : (n,) ndarray of int
        Place of s's first n entries in x.
    """

    s: FloatArray
    P: FloatArray
    x: FloatArray
    columns: IntArray

    @property
    def n(self) -> int:
        """Number of estimated voltages; s holds their slopes behind them."""
        return len(self.columns)

    def filled(self, s: FloatArray) -> FloatArray:
        """[θ; |V|] of another s."""
        x = self.x.copy()
        x[self.columns] = s[: self.n]
        return x


def cholesky(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a covariance that rounding may have made a little indefinite.

    Reads the lower triangle; above the diagonal the result is zero. If the factorisation fails,
    the diagonal is raised by the smallest of 1e-14, 1e-12, … 1e-6 of itself that mends it.

    Raises
    ------
    numpy.linalg.LinAlgError
        If not even that helps.
    """
    factor, failed = lapack.dpotrf(matrix, lower=1, clean=1)
    for power in (-14, -12, -10, -8, -6):
        if not failed:
            return np.asarray(factor)
        raised = matrix + np.diag(10.0**power * np.diagonal(matrix))
        factor, failed = lapack.dpotrf(raised, lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("covariance is not positive definite")
    return np.asarray(factor)


def condition(
    prior: Prior, moments: Moments, innovation: FloatArray, noise: FloatArray, judge: Judge
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Condition on an innovation, with the noise that a judge leaves.

    Parameters
    ----------
    prior : Prior
    moments : Moments
    innovation : (m,) ndarray
        η.
    noise : (m,) ndarray
        Diagonal of R.
    judge : Judge

    Returns
    -------
    s, P : (N,), (N, N) ndarray
    variance : (m,) ndarray
        S_ii before inflation.
    inflation : (m,) ndarray
        φ.
    nis : float
        ηᵀ(S + φR)⁻¹η.

    Raises
    ------
    numpy.linalg.LinAlgError
        If S is not positive definite.

    Notes
    -----
    With S = L Lᵀ and X = C L⁻ᵀ: K η = X (L⁻¹η) and P - K S Kᵀ = P - X Xᵀ, a symmetric product.
    """
    m = len(innovation)
    diagonal = np.diag_indices(m)
    own = moments.own
    variance = np.diagonal(own) + noise
    S = own.copy(order="F")
    S[diagonal] = variance
    chol_S = _factor(S)
    white, _ = lapack.dtrtrs(chol_S, innovation, lower=1)
    nis = float(white @ white)
    inflation = judge(Suspicion(innovation, variance, noise, chol_S, nis))
    if inflation.any():
        S = own.copy(order="F")
        S[diagonal] = variance + inflation * noise
        chol_S = _factor(S)
        white, _ = lapack.dtrtrs(chol_S, innovation, lower=1)
        nis = float(white @ white)
    X = blas.dtrsm(1.0, chol_S, moments.cross, side=1, lower=1, trans_a=1)
    return (
        prior.s + X @ white,
        _less(prior.P, X),
        variance,
        inflation,
        nis,
    )


def _factor(S: FloatArray) -> FloatArray:
    """Lower Cholesky factor, in the place of S."""
    factor, failed = lapack.dpotrf(S, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the innovation's covariance is not positive definite")
    return np.asarray(factor)


def _less(P: FloatArray, X: FloatArray) -> FloatArray:
    """P - X Xᵀ, exactly symmetric."""
    # P is symmetric, so that its transpose is itself in the order that BLAS reads.
    lower = blas.dsyrk(-1.0, X, beta=1.0, c=P.T, lower=1)
    return symmetric(lower)


def symmetric(lower: FloatArray) -> FloatArray:
    """The symmetric matrix of a lower triangle."""
    out = np.tril(lower)
    out += np.tril(lower, -1).T
    return out
