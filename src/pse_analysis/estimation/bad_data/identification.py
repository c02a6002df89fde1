"""What the others say about a measurement, and which measurements to leave out for it.

An innovation η with covariance S, or the residual of a least-squares estimate, weighs ηᵀMη, where M
is S⁻¹ or the projector R⁻¹ - R⁻¹H G⁻¹HᵀR⁻¹. Measurements F are off what the
rest says of them by b = (M_FF)⁻¹ (Mη)_F, with covariance (M_FF)⁻¹, and leaving them out takes
bᵀ M_FF b away. One measurement that is off by far makes its neighbours look wrong as well; given
all others, each answers for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import blas, lapack

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.estimation.core.cholesky import Columns
from pse_analysis.measurement import MeasurementModel

PRIOR_SIGMA_PU = 1.0
"""σ of a voltage of which nothing is known but its rating. [p.u., rad]"""
LARGEST_SHARE = 0.5
"""Share of the measurements that may be left out; beyond it there is no telling who is wrong."""
JITTER = 1e-9
"""Share of a precision by which its diagonal is raised where rounding made it indefinite."""


class DeletionResiduals(NamedTuple):
    """How far each measurement is off what the kept ones, without itself, say of it.

    Attributes
    ----------
    error, variance : (m,) ndarray
        Its deviation, and the variance that this should have; infinite where nothing else sees
        what it measures.
    rest : float
        ηᵀMη of the kept ones.
    """

    error: FloatArray
    variance: FloatArray
    rest: float

    @property
    def ratio(self) -> FloatArray:
        """What leaving a kept one out takes from ``rest``; what a left-out one would add to it."""
        return self.error**2 / self.variance


class Deletion:
    """Measurements that may be left out, under a precision M.

    Parameters
    ----------
    weighted : (m,) ndarray
        M η.
    diagonal : (m,) ndarray
        Of M.
    columns : (k,) ndarray of int -> (m, k) ndarray
        Columns of M.
    total : float
        ηᵀ M η.
    floor : (m,) ndarray, optional
        Diagonal entries up to which a measurement is critical: nothing else sees what it measures,
        so that it cannot be contradicted, and is never left out.
    """

    def __init__(
        self,
        weighted: FloatArray,
        diagonal: FloatArray,
        columns: Callable[[IntArray], FloatArray],
        total: float,
        floor: FloatArray | None = None,
    ) -> None:
        self._weighted, self._diagonal, self._total = weighted, diagonal, total
        self._floor = 1e-12 * diagonal if floor is None else floor
        self._columns = columns

    def without(self, left_out: BoolArray) -> DeletionResiduals:
        """Residuals of every measurement when some are left out. (m,)"""
        out = np.flatnonzero(left_out)
        rest = self._rest(out)
        known = rest.diagonal > self._floor
        known[out] = False
        error, variance = np.zeros(len(known)), np.full(len(known), np.inf)
        np.divide(rest.weighted, rest.diagonal, out=error, where=known)
        np.divide(1.0, rest.diagonal, out=variance, where=known)
        error[out], variance[out] = self.error_estimate(out)
        return DeletionResiduals(
            error, variance, self._total - float(self._weighted[out] @ error[out])
        )

    def error_estimate(self, out: IntArray) -> tuple[FloatArray, FloatArray]:
        """Error and variance of measurements that are left out together. (k,), (k,)"""
        own = _inverse(self._columns(out)[out])
        return own @ self._weighted[out], np.diagonal(own).copy()

    def search(self, start: BoolArray, price: float, most: float = LARGEST_SHARE) -> BoolArray:
        """Leave out, take back and exchange, one at a time, what helps most.

        Parameters
        ----------
        start : (m,) ndarray of bool
            Left out at first. A start that holds the gross errors keeps them from hiding each
            other; what was left out without need is taken back.
        price : float
            Least reduction of ηᵀMη that is worth a measurement.
        most : float
            Share of the measurements that may be left out. If the start already exceeds it, the
            search starts from none.

        Returns
        -------
        (m,) ndarray of bool
            Left out.

        Notes
        -----
        Descends ηᵀMη of the kept ones + price × number left out, the likelihood of errors of any
        size that are rare, until no move helps: what need not be left out is taken back, then what
        is worth it is left out, by turns, and at the end one is left out in another one's place,
        where they see nearly the same and the wrong one was accused first.
        """
        limit = most * len(start)
        out = np.flatnonzero(start)
        if len(out) > limit:
            out = out[:0]
        out = self._settled(out, price)
        seen: set[bytes] = set()
        while len(out) < len(start):
            # Where measurements see next to the same, rounding may lead back to where it was.
            here = np.sort(out).tobytes()
            if here in seen:
                break
            seen.add(here)
            more, rest = self._extended(out, price, limit)
            out = self._settled(more, price)
            if len(out) == len(more):
                other = self._exchanged(out, rest, price)
                if other is None:
                    break
                out = self._settled(other, price)
        left_out = np.zeros(len(start), dtype=np.bool_)
        left_out[out] = True
        return left_out

    def _rest(self, out: IntArray) -> _Rest:
        return _Rest(self._weighted, self._diagonal, out, self._columns(out))

    def _settled(self, out: IntArray, price: float) -> IntArray:
        """What stays left out of some measurements, when the others are taken back by turns."""
        own = _inverse(self._columns(out)[out])
        error = own @ self._weighted[out]
        stay = np.ones(len(out), dtype=np.bool_)
        while stay.any():
            ratio = np.divide(error**2, np.diagonal(own), where=stay, out=np.full(len(out), np.inf))
            row = int(ratio.argmin())
            # What rounding makes of a tie must not be moved to and fro.
            if ratio[row] >= (1.0 - JITTER) * price:
                break
            stay[row] = False
            share = own[row] / own[row, row]
            error -= error[row] * share
            own -= np.outer(own[row], share)
        return out[stay]

    def _extended(self, out: IntArray, price: float, limit: float) -> tuple[IntArray, _Rest]:
        """Those measurements and all others that are worth leaving out, the worst ones first."""
        rest = self._rest(out)
        while len(out) < limit:
            ratio = rest.ratio(out, self._floor)
            row = int(ratio.argmax())
            if ratio[row] <= price:
                break
            out = np.append(out, row)
            rest.leave_out(row, self._columns(out[-1:])[:, 0])
        return out, rest

    def _exchanged(self, out: IntArray, rest: _Rest, price: float) -> IntArray | None:
        """Those measurements with one in another one's place, or None if no exchange helps.

        With i taken back, b_i²/N_ii is added, N = (M_FF)⁻¹, and j is worth
        (w_j + a_ji b_i/N_ii)²/(d_j + a_ji²/N_ii) with a = M_:F N.
        """
        if not len(out):
            return None
        across = self._columns(out)
        inverse = _inverse(across[out])
        own, error = np.diagonal(inverse), inverse @ self._weighted[out]
        root = np.sqrt(own)
        # What is left out itself, or seen by nothing else, is worth nothing.
        weighted, diagonal = rest.weighted.copy(), rest.diagonal.copy()
        unseen = diagonal <= self._floor
        unseen[out] = True
        weighted[unseen], diagonal[unseen] = 0.0, 1.0
        swept = across @ (inverse / root)
        swept[unseen] = 0.0
        gain = swept * (error / root)
        gain += weighted[:, None]
        gain *= gain
        swept *= swept
        swept += diagonal[:, None]
        gain /= swept
        gain -= error**2 / own
        gain[unseen] = -np.inf
        j, i = divmod(int(gain.argmax()), len(out))
        if gain[j, i] <= JITTER * price:
            return None
        other = out.copy()
        other[i] = j
        return other


class _Rest:
    """Mη and the diagonal of M for the kept ones, when some measurements F are left out.

    Their M is M - Z Zᵀ, Z = M_:F L⁻ᵀ with M_FF = L Lᵀ; one more to leave out is one more column.

    Parameters
    ----------
    weighted, diagonal : (m,) ndarray
        Of all.
    out : (k,) ndarray of int
        F.
    across : (m, k) ndarray
        M_:F.
    """

    def __init__(
        self, weighted: FloatArray, diagonal: FloatArray, out: IntArray, across: FloatArray
    ) -> None:
        self.weighted, self.diagonal = weighted, diagonal
        self._count = len(out)
        self._room = np.empty((len(diagonal), 2 * len(out) + 8), order="F")
        if len(out):
            factor = _factor(across[out])
            half = blas.dtrsm(1.0, factor, across, side=1, lower=1, trans_a=1)
            self.weighted = weighted - half @ blas.dtrsv(factor, weighted[out], lower=1)
            self.diagonal = diagonal - np.einsum("ij,ij->i", half, half)
            self._room[:, : len(out)] = half

    def leave_out(self, row: int, column: FloatArray) -> None:
        """Leave one more out, given its column of M."""
        half = self._room[:, : self._count]
        new = column - half @ half[row]
        new /= np.sqrt(new[row])
        self.weighted = self.weighted - (self.weighted[row] / new[row]) * new
        self.diagonal = self.diagonal - new**2
        if self._count == self._room.shape[1]:
            self._room = np.hstack([self._room, np.empty_like(self._room)])
        self._room[:, self._count] = new
        self._count += 1

    def ratio(self, out: IntArray, floor: FloatArray) -> FloatArray:
        """`DeletionResiduals.ratio` of the kept ones, zero for the left-out and critical ones."""
        kept = self.diagonal > floor
        kept[out] = False
        ratio = np.zeros(len(kept))
        np.divide(self.weighted**2, self.diagonal, out=ratio, where=kept)
        return ratio


def _factor(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a small precision."""
    for share in (0.0, JITTER, 1e3 * JITTER, 1e6 * JITTER):
        factor, failed = lapack.dpotrf(matrix + np.diag(share * np.diagonal(matrix)), lower=1)
        if not failed:
            return np.asarray(factor)
    raise np.linalg.LinAlgError("a precision is not positive definite")


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a small precision."""
    if not len(matrix):
        return matrix
    # Above its diagonal the factor is zero, and LAPACK leaves that as it is.
    lower, _ = lapack.dpotri(_factor(matrix), lower=1, overwrite_c=1)
    whole = lower + lower.T
    whole.flat[:: len(whole) + 1] *= 0.5
    return np.asarray(whole)


def of_snapshot(
    model: MeasurementModel,
    x: FloatArray,
    rows: IntArray,
    deviation: FloatArray,
    noise: FloatArray,
    among: IntArray,
) -> Deletion:
    """What the measurements of one snapshot say about some of them, without any forecast.

    Parameters
    ----------
    model : MeasurementModel
    x : (2N,) ndarray
        [θ; |V|] about which h is linear.
    rows : (r,) ndarray of int
        Rows of the layout that report.
    deviation : (r,) ndarray
        Their z - h(x).
    noise : (r,) ndarray
        Their part of the diagonal of R.
    among : (k,) ndarray of int
        Places among these rows that may be left out; the others are kept.

    Returns
    -------
    Deletion
        Of the k rows. Its M = R⁻¹ - R⁻¹H G⁻¹HᵀR⁻¹ knows each voltage to `PRIOR_SIGMA_PU` around
        x, which keeps G regular whatever is left out, and says next to nothing.

    Raises
    ------
    numpy.linalg.LinAlgError
        If σ differ by more than working precision can tell apart.
    """
    m, n = model.shape
    root, white = np.zeros(m), np.zeros(m)
    root[rows] = 1.0 / np.sqrt(noise)
    white[rows] = root[rows] * deviation
    whitened = model.jacobian_data(x) * root[model.row_of_entry]
    gain = model.gram(whitened)
    gain.reshape(-1, order="A")[:: n + 1] += PRIOR_SIGMA_PU**-2
    # Dense from here: sparse factors cost more in their making for a few hundred rows.
    factor, failed = lapack.dpotrf(gain, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the gain is not positive definite to working precision")
    place = np.full(m, -1)
    place[rows[among]] = np.arange(len(among))
    at = place[model.row_of_entry]
    chosen = np.flatnonzero(at >= 0)
    own = np.zeros((len(among), n))
    own[at[chosen], model.indices[chosen]] = whitened[chosen]
    half, _ = lapack.dtrtrs(factor, own.T, lower=1)
    gradient = np.bincount(model.indices, whitened * white[model.row_of_entry], n)
    moved, _ = lapack.dpotrs(factor, gradient, lower=1)
    scale = root[rows[among]]

    def column(asked: IntArray) -> FloatArray:
        out = -(half.T @ half[:, asked])
        # Nothing is known so well that rounding could tell it from exact.
        out[asked, np.arange(len(asked))] += 1.0 + JITTER
        return np.asarray(scale[:, None] * out * scale[asked])

    said = scale * (white[rows[among]] - own @ moved)
    diagonal = scale**2 * (1.0 - np.einsum("ij,ij->j", half, half))
    return Deletion(said, diagonal, Columns(len(among), column), float(deviation[among] @ said))
