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
import numpy.typing as npt
from scipy import linalg, sparse
from scipy.linalg import blas

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

FORGOTTEN = 1.0
"""σ of a voltage of which nothing is known but its rating. [p.u., rad]"""
LARGEST_SHARE = 0.5
"""Share of the measurements that may be left out; beyond it there is no telling who is wrong."""


class Standing(NamedTuple):
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
        Columns of M; each is asked for once.
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
        self._ask = columns
        self._place = np.full(len(weighted), -1)
        self._known = np.empty((len(weighted), 0))

    def _columns(self, out: IntArray) -> FloatArray:
        new = out[self._place[out] < 0]
        if len(new):
            self._place[new] = self._known.shape[1] + np.arange(len(new))
            self._known = np.hstack([self._known, self._ask(new)])
        return self._known[:, self._place[out]]

    def without(self, left_out: BoolArray) -> Standing:
        """Standing of every measurement when some are left out. (m,)"""
        out = np.flatnonzero(left_out)
        weighted, diagonal, rest = self._weighted, self._diagonal, self._total
        error, variance = np.zeros_like(weighted), np.full_like(weighted, np.inf)
        if len(out):
            across = self._columns(out)
            own = np.linalg.inv(across[out])
            error[out] = own @ self._weighted[out]
            variance[out] = np.diagonal(own)
            rest = rest - float(self._weighted[out] @ error[out])
            weighted = weighted - across @ error[out]
            diagonal = diagonal - np.einsum("ij,ij->i", across @ own, across)
        seen = ~left_out & (diagonal > self._floor)
        error[seen] = weighted[seen] / diagonal[seen]
        variance[seen] = 1.0 / diagonal[seen]
        return Standing(error, variance, rest)

    def search(
        self, start: BoolArray, price: float, most: float = LARGEST_SHARE
    ) -> tuple[BoolArray, Standing]:
        """Leave out and take back, one at a time, what helps most.

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
        left_out : (m,) ndarray of bool
        standing : Standing

        Notes
        -----
        Descends ηᵀMη of the kept ones + price × number left out, the likelihood of errors of any
        size that are rare, until no single move helps.
        """
        out = start.copy()
        if out.sum() > most * len(out):
            out[:] = False
        while True:
            found = self.without(out)
            ratio = found.ratio
            worst = int(np.where(out, -np.inf, ratio).argmax())
            best = int(np.where(out, ratio, np.inf).argmin())
            gain = -np.inf if out[worst] or out.sum() >= most * len(out) else ratio[worst] - price
            back = price - ratio[best] if out[best] else -np.inf
            # What rounding makes of a tie must not be moved to and fro.
            if max(gain, back) <= 1e-9 * price:
                return out, found
            if gain >= back:
                out[worst] = True
            else:
                out[best] = False


def of_snapshot(
    H: sparse.csr_array, deviation: FloatArray, noise: FloatArray, among: IntArray
) -> Deletion:
    """What the measurements of one snapshot say about some of them, without any forecast.

    Parameters
    ----------
    H : (m, n) sparse array
        ∂h/∂x.
    deviation : (m,) ndarray
        z - h(x).
    noise : (m,) ndarray
        Diagonal of R.
    among : (k,) ndarray of int
        Rows that may be left out; the others are kept.

    Returns
    -------
    Deletion
        Of the k rows. Its M = R⁻¹ - R⁻¹H G⁻¹HᵀR⁻¹ knows each voltage to `FORGOTTEN` around x, which
        keeps G regular whatever is left out, and says next to nothing.
    """
    # Dense: for a few hundred rows the sparse products cost more in their making.
    root = 1.0 / np.sqrt(noise)
    whitened = H.toarray() * root[:, None]
    gain = blas.dsyrk(1.0, whitened.T, lower=1)
    gain[np.diag_indices_from(gain)] += FORGOTTEN**-2
    factor = linalg.cholesky(gain, lower=True, overwrite_a=True, check_finite=False)
    own, scale = whitened[among], root[among]
    half = linalg.solve_triangular(factor, own.T, lower=True, check_finite=False)
    white = root * deviation
    moved = linalg.cho_solve((factor, True), white @ whitened, check_finite=False)

    def columns(rows: IntArray) -> FloatArray:
        out = -(half.T @ half[:, rows])
        out[rows, np.arange(len(rows))] += 1.0
        return np.asarray(scale[:, None] * out * scale[rows])

    said = scale * (white[among] - own @ moved)
    diagonal = scale**2 * (1.0 - np.einsum("ij,ij->j", half, half))
    return Deletion(said, diagonal, columns, float(deviation[among] @ said))
