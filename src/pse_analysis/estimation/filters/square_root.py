"""Conditioning that carries a root of the covariance, and never takes one matrix from another.

With P = L Lᵀ, weighted deviations D of h along L and B of the rest, V Vᵀ = R + B Bᵀ and A = V⁻¹ D,
conditioning on η means

    P⁺ = L (I + AᵀA)⁻¹ Lᵀ = (L G)(L G)ᵀ,   s⁺ = s + L G Gᵀ Aᵀ V⁻¹ η,

where G⁻¹ is the triangular factor of [I; A], by Householder reflections. Rounding makes L G
inexact, but P⁺ never indefinite. G is lower triangular, as L is, because the directions are
eliminated from the last to the first. V⁻¹η as one more column of A gives Gᵀ Aᵀ V⁻¹ η and the root
of ηᵀS⁻¹η without any subtraction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import blas, lapack

from pse_analysis.arrays import FloatArray
from pse_analysis.estimation.bad_data.robust import InnovationStats
from pse_analysis.estimation.core.cholesky import Root, absorbed, factor, reflect, solve, symmetric
from pse_analysis.estimation.filters.conditioning import Posterior, Prior, Rows, Verdict, block


class Halves(NamedTuple):
    """Mean of the measurements, and a root of their covariance; a `Predicted`.

    Attributes
    ----------
    mean : (m,) ndarray
        ŷ.
    odd : (m, n) ndarray
        D: C = L Dᵀ with the first n columns of L.
    curved : slice or (k,) ndarray of int
        Rows that deviate in other ways as well.
    bent : (k, j) ndarray
        How: S = R + D Dᵀ + B Bᵀ, where B has these rows.
    alpha : float
        What the observation remembers for the next step.
    """

    mean: FloatArray
    odd: FloatArray
    curved: Rows
    bent: FloatArray
    alpha: float = 0.0

    @property
    def rest(self) -> FloatArray:
        """B Bᵀ of all rows, its lower triangle. (m, m)"""
        m = len(self.mean)
        rest = np.zeros((m, m), order="F")
        if len(self.bent):
            inside = block(self.curved, self.curved)
            rest[inside] = blas.dsyrk(1.0, self.bent.T, trans=1, lower=1)
        return rest

    def condition(
        self, prior: Prior, innovation: FloatArray, noise: FloatArray, verdict: Verdict | None
    ) -> Posterior:
        """Condition on an innovation, with the noise that a verdict leaves; see `Predicted`."""
        m, rest = len(noise), self.rest
        known = np.diagonal(rest).copy()
        variance = known + noise + np.einsum("ij,ij->i", self.odd, self.odd)
        inflation = np.zeros(m)
        if verdict is not None:
            own = blas.dsyrk(1.0, self.odd.T, trans=1, lower=1, beta=1.0, c=rest)
            chol_S = factor(own, variance)
            white = solve(chol_S, innovation)
            inflation = verdict(InnovationStats(innovation, variance, noise, white, Root(chol_S)))
        chol_V = factor(rest, known + (1.0 + inflation) * noise)
        moved, chol_P, nis = absorbed(prior.chol_P, self.odd, chol_V, innovation)
        P = symmetric(blas.dsyrk(1.0, chol_P, lower=1))
        return Posterior(prior.s + moved, P, variance, inflation, nis, chol_P)


def carried(chol_P: FloatArray, noise: FloatArray) -> FloatArray:
    """Lower triangular root of L Lᵀ + Q.

    Parameters
    ----------
    chol_P : (N, N) ndarray
        L, triangular or not.
    noise : (N, N) ndarray
        Q, which may be singular.
    """
    added, failed = lapack.dpotrf(noise.T, lower=1, clean=1)
    if failed:
        added, pivot, rank, _ = lapack.dpstrf(noise.T, lower=1)
        turned = np.zeros((len(noise), rank))
        turned[pivot - 1] = np.tril(added)[:, :rank]
        added = reflect(np.zeros_like(noise, order="F"), turned.T, 0).T
    both_triangular = not np.triu(chol_P, 1).any()
    return reflect(added.T, chol_P.T, len(chol_P) if both_triangular else 0).T
