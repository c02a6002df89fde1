"""Conditioning of a normal state on measurements: factorisations and symmetric products only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from scipy.linalg import blas, lapack

from pse_analysis.estimation.robust import Suspicion

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
Rows = slice | IntArray

FEW = 4
"""Up to one in so many channels, inflated noise is added to S by a correction of its factor."""

Verdict = Callable[[Suspicion], FloatArray]
"""Inflation φ (m,) of the noise that an innovation calls for."""


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
    carried : (N, N) ndarray, optional
        Lower triangular root of P, where the filter carries one.
    """

    s: FloatArray
    P: FloatArray
    x: FloatArray
    columns: IntArray
    carried: FloatArray | None = None

    @property
    def n(self) -> int:
        """Number of estimated voltages; s holds their slopes behind them."""
        return len(self.columns)

    @cached_property
    def chol_P(self) -> FloatArray:
        """Lower triangular root of P. (N, N)"""
        return cholesky(self.P) if self.carried is None else self.carried

    def filled(self, s: FloatArray) -> FloatArray:
        """[θ; |V|] of another s."""
        x = self.x.copy()
        x[self.columns] = s[: self.n]
        return x


class Posterior(NamedTuple):
    """What is known after a snapshot.

    Attributes
    ----------
    s, P : (N,), (N, N) ndarray
    variance : (m,) ndarray
        S_ii before inflation.
    inflation : (m,) ndarray
        φ.
    nis : float
        ηᵀ(S + φR)⁻¹η.
    chol_P : (N, N) ndarray, optional
        Lower triangular root of P, if it is to be carried on.
    """

    s: FloatArray
    P: FloatArray
    variance: FloatArray
    inflation: FloatArray
    nis: float
    chol_P: FloatArray | None = None


class Predicted(Protocol):
    """A prediction of the measurements, which knows how to condition on them."""

    @property
    def mean(self) -> FloatArray:
        """ŷ. (m,)"""

    @property
    def tuned(self) -> float:
        """What the observation remembers for the next step."""

    def condition(
        self, prior: Prior, innovation: FloatArray, noise: FloatArray, verdict: Verdict | None
    ) -> Posterior:
        """Condition on an innovation, with the noise that a verdict leaves.

        Parameters
        ----------
        prior : Prior
        innovation : (m,) ndarray
            η.
        noise : (m,) ndarray
            Diagonal of R.
        verdict : Verdict, optional
            Everything is believed without one.

        Returns
        -------
        Posterior

        Raises
        ------
        numpy.linalg.LinAlgError
            If S is not positive definite.
        """


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

    def condition(
        self, prior: Prior, innovation: FloatArray, noise: FloatArray, verdict: Verdict | None
    ) -> Posterior:
        """Condition on an innovation, with the noise that a verdict leaves; see `Predicted`.

        Notes
        -----
        With S = L Lᵀ and X = C L⁻ᵀ: K η = X (L⁻¹η) and P - K S Kᵀ = P - X Xᵀ, a symmetric product.
        """
        variance = np.diagonal(self.own) + noise
        chol_S = factor(self.own, variance)
        white = solve(chol_S, innovation)
        nis = float(white @ white)
        inflation, relaxed = np.zeros(len(noise)), None
        if verdict is not None:
            inflation = verdict(Suspicion(innovation, variance, noise, chol_S, nis))
        wrong = np.flatnonzero(inflation)
        if FEW * len(wrong) > len(noise):
            chol_S = factor(self.own, variance + inflation * noise)
            white = solve(chol_S, innovation)
            nis = float(white @ white)
        elif len(wrong):
            relaxed = _relaxation(chol_S, wrong, (inflation * noise)[wrong])
            through = relaxed @ white
            white = white - relaxed.T @ through
            nis -= float(through @ through)
        X = blas.dtrsm(1.0, chol_S, self.cross, side=1, lower=1, trans_a=1)
        # P is symmetric, so that its transpose is itself in the order that BLAS reads.
        lower = blas.dsyrk(-1.0, X, beta=1.0, c=prior.P.T, lower=1)
        if relaxed is not None:
            lower = blas.dsyrk(1.0, X @ relaxed.T, beta=1.0, c=lower, lower=1, overwrite_c=1)
        return Posterior(prior.s + X @ white, symmetric(lower), variance, inflation, nis)


def _relaxation(chol_S: FloatArray, rows: IntArray, added: FloatArray) -> FloatArray:
    """Y of Lᵀ(S + U diag(a) Uᵀ)⁻¹L = I - YᵀY, for S = L Lᵀ and a few rows U of the identity.

    It spares a second factorisation.
    """
    unit = np.zeros((len(chol_S), len(rows)), order="F")
    unit[rows, np.arange(len(rows))] = 1.0
    V = solve(chol_S, unit)
    core = V.T @ V
    core[np.diag_indices_from(core)] += 1.0 / added
    return solve(cholesky(core), V.T)


def cholesky(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a covariance that rounding may have made a little indefinite.

    Above the diagonal the result is zero. If the factorisation fails, the diagonal is raised by the
    smallest of 1e-14, 1e-12, … 1e-6 of itself that mends it.

    Parameters
    ----------
    matrix : (n, n) ndarray
        Symmetric.

    Raises
    ------
    numpy.linalg.LinAlgError
        If not even that helps.
    """
    # Its transpose is itself, in the order that LAPACK reads.
    found, failed = lapack.dpotrf(matrix.T, lower=1, clean=1)
    for power in (-14, -12, -10, -8, -6):
        if not failed:
            return np.asarray(found)
        raised = matrix + np.diag(10.0**power * np.diagonal(matrix))
        found, failed = lapack.dpotrf(raised.T, lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("covariance is not positive definite")
    return np.asarray(found)


def factor(own: FloatArray, diagonal: FloatArray) -> FloatArray:
    """Lower Cholesky factor of an innovation's covariance, with another diagonal in its place.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """
    S = own.copy(order="F")
    S.reshape(-1, order="A")[:: len(S) + 1] = diagonal
    found, failed = lapack.dpotrf(S, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the innovation's covariance is not positive definite")
    return np.asarray(found)


def solve(chol: FloatArray, right: FloatArray) -> FloatArray:
    """L⁻¹ times one or many vectors, for a lower triangular L."""
    found, _ = lapack.dtrtrs(chol, right, lower=1)
    return np.asarray(found)


def symmetric(lower: FloatArray) -> FloatArray:
    """The symmetric matrix of a lower triangle."""
    out = lower.copy(order="C")
    np.copyto(out, lower.T, where=_above(len(lower)))
    return out


def block(rows: Rows, columns: Rows) -> tuple[Rows, Rows]:
    """Index of a block of a matrix."""
    if isinstance(rows, slice) or isinstance(columns, slice):
        return rows, columns
    return rows[:, None], columns[None, :]


@cache
def _above(n: int) -> BoolArray:
    """Where a matrix of n rows is above its diagonal."""
    return np.triu(np.ones((n, n), dtype=np.bool_), 1)
