"""Conditioning of a normal state on measurements: factorisations and symmetric products only.

P - K S Kᵀ is exact to rounding of P. What measurements leave of a variance must therefore be larger
than that, or the difference is no covariance any more: then a root of P takes them in instead
(`pse_analysis.estimation.core.cholesky.absorbed`), which loses nothing and takes longer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import blas

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.estimation.bad_data.robust import InnovationStats
from pse_analysis.estimation.core.cholesky import Root, absorbed, cholesky, factor, solve, symmetric

Rows = slice | IntArray

FEW = 4
"""Up to one in so many channels, inflated noise is added to S by a correction of its factor."""

LEFT = 1e-5
"""Least share of a variance that may be left for its difference to be believed."""
EXACT = 1e-10
"""Least share of S_ii that a measurement's own noise may be for the same."""
ROUNDING = 1e-14
"""Least noise of a measurement, as a share of the variance that the forecast expects of it."""

Verdict = Callable[[InnovationStats], FloatArray]
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
    def alpha(self) -> float:
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
    alpha : float
        What the observation remembers for the next step.
    entry : (k,) ndarray of int, optional
        Which entry of s each of the first k measurements reads.
    halves : callable, optional
        (prior) -> D (m, n) and the rest of ``own`` (m, m): C = L Dᵀ with the first n columns of
        the root of P, own = D Dᵀ + rest. They are taken from the moments where this is not given.
    """

    mean: FloatArray
    own: FloatArray
    cross: FloatArray
    alpha: float = 0.0
    entry: IntArray | None = None
    halves: Callable[[Prior], tuple[FloatArray, FloatArray]] | None = None

    def condition(
        self,
        prior: Prior,
        innovation: FloatArray,
        noise: FloatArray,
        verdict: Verdict | None,
        solved: Solved | None = None,
    ) -> Posterior:
        """Condition on an innovation, with the noise that a verdict leaves; see `Predicted`.

        What is ``solved`` already need not be given, and is not solved again.

        Notes
        -----
        With S = L Lᵀ and X = C L⁻ᵀ: K η = X (L⁻¹η) and P - K S Kᵀ = P - X Xᵀ, a symmetric product.
        Noise added to few rows F makes that P - X Xᵀ + Z Zᵀ, Z = X Y, see `_relaxation`.
        """
        solved = solved or self.solved(innovation, noise)
        variance, white = solved.variance, solved.white
        inflation, relaxed = np.zeros(len(noise)), None
        if verdict is not None:
            root = Root(solved.chol_S, self._known(solved, prior, noise))
            inflation = verdict(InnovationStats(innovation, variance, noise, white, root))
        wrong = np.flatnonzero(inflation)
        if FEW * len(wrong) > len(noise):
            solved = self.solved(innovation, noise + inflation * noise)
            white = solved.white
        nis = float(white @ white)
        if 0 < FEW * len(wrong) <= len(noise):
            relaxed = _relaxation(root.columns(wrong), (inflation * noise)[wrong])
            through = white @ relaxed
            white = white - relaxed @ through
            nis -= float(through @ through)
        believed = noise + inflation * noise
        if (believed >= EXACT * variance).all():
            P = solved.reduced(prior.P, relaxed)
            if (np.diagonal(P) >= LEFT * np.diagonal(prior.P)).all():
                return Posterior(prior.s + solved.X @ white, P, variance, inflation, nis)
        return self._absorbed(prior, innovation, believed, variance, inflation)

    def _absorbed(
        self,
        prior: Prior,
        innovation: FloatArray,
        noise: FloatArray,
        variance: FloatArray,
        inflation: FloatArray,
    ) -> Posterior:
        """The same by a root of P, for measurements that leave next to nothing of a variance."""
        odd, rest = (self.halves or self._halves)(prior)
        rest.flat[:: len(rest) + 1] += np.maximum(noise, ROUNDING * np.diagonal(self.own))
        moved, root, nis = absorbed(prior.chol_P, odd, cholesky(rest), innovation)
        P = symmetric(blas.dsyrk(1.0, root, lower=1))
        return Posterior(prior.s + moved, P, variance, inflation, nis)

    def _halves(self, prior: Prior) -> tuple[FloatArray, FloatArray]:
        """D and the rest of ``own``, which rounding must not make indefinite."""
        odd = solve(prior.chol_P, self.cross).T
        value, vector = np.linalg.eigh(symmetric(self.own) - odd @ odd.T)
        half = vector * np.sqrt(np.maximum(value, 0.0))
        return odd, half @ half.T

    def solved(self, innovation: FloatArray, noise: FloatArray) -> Solved:
        """S of an innovation with the diagonal of R, factorised.

        Raises
        ------
        numpy.linalg.LinAlgError
            If S is not positive definite.
        """
        own = np.diagonal(self.own)
        # Where a covariance and a noise far below it meet, rounding decides: it counts as noise.
        variance = own + np.maximum(noise, ROUNDING * own)
        chol_S = factor(self.own, variance)
        return Solved(chol_S, solve(chol_S, innovation), variance, self.cross)

    def _known(
        self, solved: Solved, prior: Prior, noise: FloatArray
    ) -> Callable[[], FloatArray] | None:
        """Diagonal of S⁻¹ for measurements that read an entry of s.

        With noise R of its own and the posterior variance P⁺ of what it reads it is (R - P⁺)/R².
        """
        entry = self.entry
        if entry is None:
            return None
        own, before = noise[: len(entry)], np.diagonal(prior.P)

        def known() -> FloatArray:
            after = (before - np.einsum("ij,ij->i", solved.X, solved.X))[entry]
            # Rounding must not take it beyond what it can be.
            return np.asarray(np.clip((own - after) / own, own / (own + before[entry]), 1.0) / own)

        return known


class Solved:
    """An innovation η with its covariance S = L Lᵀ, and what it says about a state.

    Parameters
    ----------
    chol_S : (m, m) ndarray
        L; what stands above the diagonal does not count.
    white : (m,) ndarray
        L⁻¹ η.
    variance : (m,) ndarray
        S_ii.
    cross : (N, m) ndarray
        C, covariance of the state and the measurements.
    """

    def __init__(
        self, chol_S: FloatArray, white: FloatArray, variance: FloatArray, cross: FloatArray
    ) -> None:
        self.chol_S, self.white, self.variance = chol_S, white, variance
        self._cross = cross

    @property
    def nis(self) -> float:
        """ηᵀS⁻¹η."""
        return float(self.white @ self.white)

    @property
    def sigma(self) -> FloatArray:
        """√S_ii. (m,)"""
        return np.asarray(np.sqrt(self.variance))

    @cached_property
    def X(self) -> FloatArray:
        """C L⁻ᵀ. (N, m)"""
        return np.asarray(blas.dtrsm(1.0, self.chol_S, self._cross, side=1, lower=1, trans_a=1))

    def correction(self) -> FloatArray:
        """K η = C S⁻¹ η, without X. (N,)"""
        return np.asarray(self._cross @ weighted(self.chol_S, self.white))

    def reduced(self, P: FloatArray, relaxed: FloatArray | None = None) -> FloatArray:
        """P - X Xᵀ + Z Zᵀ with Z = X Y of `_relaxation`. (N, N)"""
        # A product with its own transpose is exactly symmetric.
        left = P - self.X @ self.X.T
        if relaxed is not None:
            lost = blas.dgemm(1.0, self.X, relaxed)
            left += lost @ lost.T
        return np.asarray(left)


def weighted(chol_S: FloatArray, white: FloatArray) -> FloatArray:
    """S⁻¹ η from S = L Lᵀ and L⁻¹ η. (m,)"""
    return np.asarray(blas.dtrsv(chol_S, white, lower=1, trans=1))


def misfit(chol_S: FloatArray, white: FloatArray, sigma: FloatArray) -> float:
    """Largest residual of measurements that are all believed, in units of its σ.

    Notes
    -----
    z - h(x̂) = η - H K η = R S⁻¹η. Unlike an innovation it shows a wrong measurement where the
    forecast knows less than the others.
    """
    return float(np.abs(sigma * weighted(chol_S, white)).max(initial=0.0))


def _relaxation(V: FloatArray, added: FloatArray) -> FloatArray:
    """Y of Lᵀ(S + U diag(a) Uᵀ)⁻¹L = I - Y Yᵀ, for S = L Lᵀ, few rows U of the identity, V = L⁻¹U.

    It spares a second factorisation.
    """
    core = blas.dsyrk(1.0, V, trans=1, lower=1)
    core[np.diag_indices_from(core)] += 1.0 / added
    return np.asarray(blas.dtrsm(1.0, cholesky(core.T), V, side=1, lower=1, trans_a=1))


def block(rows: Rows, columns: Rows) -> tuple[Rows, Rows]:
    """Index of a block of a matrix."""
    if isinstance(rows, slice) or isinstance(columns, slice):
        return rows, columns
    return rows[:, None], columns[None, :]
