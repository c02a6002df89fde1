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
from scipy import sparse
from scipy.linalg import lapack

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
        return self._swept(left_out).standing(self._floor)

    def _swept(self, left_out: BoolArray) -> _Swept:
        out = np.flatnonzero(left_out)
        return _Swept(self._weighted, self._diagonal, self._total, out, self._columns(out))

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
        swept, moves = self._swept(out), 0
        while True:
            ratio = swept.ratio(self._floor)
            gain = np.where(out, price - ratio, ratio - price)
            if out.sum() >= most * len(out):
                gain[~out] = -np.inf
            row = int(gain.argmax())
            # What rounding makes of a tie must not be moved to and fro.
            if gain[row] <= 1e-9 * price:
                # Anew, so that no rounding of the moves is left in what is told.
                return out, self.without(out) if moves else swept.standing(self._floor)
            if out[row]:
                swept.take_back(row)
            else:
                swept.leave_out(row, self._columns(np.array([row]))[:, 0])
            out[row] = not out[row]
            moves += 1


class _Swept:
    """A symmetric sweep of M, bordered by Mη and ηᵀMη, over the rows that are left out.

    Between kept rows stands what is left of M, between left-out ones -(M_FF)⁻¹, and in the columns
    of these what the kept ones make of them; so one more or one less is an update of rank one.

    Parameters
    ----------
    weighted, diagonal : (m,) ndarray
    rest : float
    out : (k,) ndarray of int
    across : (m, k) ndarray
        Columns of M.
    """

    def __init__(
        self,
        weighted: FloatArray,
        diagonal: FloatArray,
        rest: float,
        out: IntArray,
        across: FloatArray,
    ) -> None:
        own = np.linalg.inv(across[out])
        error = own @ weighted[out]
        self._out, self._across = out, across
        self._swept = across @ own
        self._weighted = weighted - across @ error
        self._diagonal = diagonal - np.einsum("ij,ij->i", self._swept, across)
        self._rest = rest - float(weighted[out] @ error)
        self._swept[out], self._weighted[out], self._diagonal[out] = -own, error, -np.diagonal(own)

    def leave_out(self, row: int, column: FloatArray) -> None:
        """Leave a kept row out, given its column of M."""
        swept = column - self._across @ self._swept[row]
        swept[self._out] = self._swept[row]
        pivot = self._pivot(row, swept)
        new = swept / pivot
        new[row] = -1.0 / pivot
        self._out = np.append(self._out, row)
        self._across = np.column_stack([self._across, column])
        self._swept = np.column_stack([self._swept, new])

    def take_back(self, row: int) -> None:
        """Keep a left-out row again."""
        others = self._out != row
        swept = self._swept[:, np.flatnonzero(~others)[0]]
        self._out = self._out[others]
        self._across, self._swept = self._across[:, others], self._swept[:, others]
        self._pivot(row, swept)

    def _pivot(self, row: int, swept: FloatArray) -> float:
        pivot, weighted = float(swept[row]), float(self._weighted[row])
        across = swept[self._out] / pivot
        self._swept = self._swept - np.outer(swept, across)
        self._weighted = self._weighted - (weighted / pivot) * swept
        self._diagonal = self._diagonal - swept**2 / pivot
        self._rest -= weighted**2 / pivot
        sign = np.sign(pivot)
        self._swept[row], self._weighted[row] = sign * across, weighted / abs(pivot)
        self._diagonal[row] = -1.0 / pivot
        return pivot

    def ratio(self, floor: FloatArray) -> FloatArray:
        """`Standing.ratio` of every row, which is all that a search looks at."""
        unseen = self._diagonal <= floor
        unseen[self._out] = False
        return np.where(unseen, 0.0, self._weighted**2) / np.where(
            unseen, 1.0, np.abs(self._diagonal)
        )

    def standing(self, floor: FloatArray) -> Standing:
        """Of every row; kept ones with less than the floor are seen by nothing else."""
        known = self._diagonal > floor
        known[self._out] = False
        error, variance = np.zeros_like(floor), np.full_like(floor, np.inf)
        error[known] = self._weighted[known] / self._diagonal[known]
        variance[known] = 1.0 / self._diagonal[known]
        error[self._out], variance[self._out] = (
            self._weighted[self._out],
            -self._diagonal[self._out],
        )
        return Standing(error, variance, self._rest)


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
    root = 1.0 / np.sqrt(noise)
    weights = np.repeat(root, np.diff(H.indptr))
    whitened = sparse.csr_array((weights * H.data, H.indices, H.indptr), shape=H.shape)
    gain = (whitened.T @ whitened).toarray()
    gain[np.diag_indices_from(gain)] += FORGOTTEN**-2
    # Dense from here: sparse factors cost more in their making for a few hundred rows.
    factor, _ = lapack.dpotrf(gain.T, lower=1, clean=0, overwrite_a=1)
    dense = whitened.toarray()
    own, scale = dense[among], root[among]
    half, _ = lapack.dtrtrs(factor, own.T, lower=1)
    white = root * deviation
    moved, _ = lapack.dpotrs(factor, white @ dense, lower=1)

    def columns(rows: IntArray) -> FloatArray:
        out = -(half.T @ half[:, rows])
        out[rows, np.arange(len(rows))] += 1.0
        return np.asarray(scale[:, None] * out * scale[rows])

    said = scale * (white[among] - own @ moved)
    diagonal = scale**2 * (1.0 - np.einsum("ij,ij->j", half, half))
    return Deletion(said, diagonal, columns, float(deviation[among] @ said))
