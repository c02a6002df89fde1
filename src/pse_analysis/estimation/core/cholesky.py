"""Triangular roots of covariances, and what is made of them without ever inverting one.

LAPACK writes to the terminal what it cannot work with, so that nothing empty and nothing that is
not finite is given to it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.linalg import blas, lapack

from pse_analysis.arrays import BoolArray, FloatArray, IntArray

SMALL = 128
"""Rows up to which LAPACK inverts a triangle faster than two halves of it are."""
BLOCK = 16
"""Columns that LAPACK reflects at once."""


class Columns:
    """Columns of a matrix that are made when they are first asked for.

    Parameters
    ----------
    rows : int
        Length of a column.
    make : (k,) ndarray of int -> (rows, k) ndarray
    """

    def __init__(self, rows: int, make: Callable[[IntArray], FloatArray]) -> None:
        self._make = make
        self._place = np.full(rows, -1)
        self._known = np.empty((rows, 0))

    def __call__(self, asked: IntArray) -> FloatArray:
        """The columns of some places. (rows, k)"""
        place = self._place
        new = asked[place[asked] < 0]
        if len(new):
            place[new] = self._known.shape[1] + np.arange(len(new))
            made = self._make(new)
            if not self._known.shape[1]:
                self._known = made
                return made
            self._known = np.hstack([self._known, made])
        return self._known[:, place[asked]]


class Root:
    """L of a covariance S = L Lᵀ.

    Parameters
    ----------
    chol : (m, m) ndarray
        L; what stands above the diagonal does not count.
    precision : () -> (k,) ndarray, optional
        Diagonal of S⁻¹ for the first k rows, where it is known from elsewhere.

    Attributes
    ----------
    columns, precision_columns : Columns
        Of L⁻¹ and of S⁻¹.
    """

    def __init__(self, chol: FloatArray, precision: Callable[[], FloatArray] | None = None) -> None:
        self.chol = chol
        self._precision = precision
        self.columns = Columns(len(chol), self._of_inverse)
        self.precision_columns = Columns(len(chol), self._of_precision)

    def _of_inverse(self, rows: IntArray) -> FloatArray:
        unit = np.zeros((len(self.chol), len(rows)), order="F")
        unit[rows, np.arange(len(rows))] = 1.0
        return _solve(self.chol, unit, 0)

    def _of_precision(self, rows: IntArray) -> FloatArray:
        return _solve(self.chol, self.columns(rows), 1)

    def precision(self) -> FloatArray:
        """Diagonal of S⁻¹. (m,)

        Notes
        -----
        The squared columns of L⁻¹, of which those behind the first k are the columns of the inverse
        of the last block of L alone.
        """
        if self._precision is None:
            return squared_inverse(self.chol)
        first = self._precision()
        return np.concatenate([first, squared_inverse(self.chol[len(first) :, len(first) :])])


def squared_inverse(chol: FloatArray) -> FloatArray:
    """Sums of squares of the columns of L⁻¹. (m,)"""
    m = len(chol)
    if not m:
        return np.zeros(0)
    if m <= SMALL:
        return _squares(_triangle(chol))
    h = m // 2
    first, last = _triangle(chol[:h, :h]), _triangle(chol[h:, h:])
    below = blas.dtrmm(1.0, last, chol[h:, :h], lower=1)
    below = blas.dtrmm(1.0, first, below, side=1, lower=1, overwrite_b=1)
    return np.concatenate([_squares(first) + _squares(below), _squares(last)])


def _solve(chol: FloatArray, right: FloatArray, transposed: int) -> FloatArray:
    """L⁻¹ or L⁻ᵀ times few vectors."""
    if right.shape[1] == 1:
        # Half the time of a product of matrices.
        one = blas.dtrsv(chol, right[:, 0], lower=1, trans=transposed)
        return np.asarray(one[:, None])
    return np.asarray(blas.dtrsm(1.0, chol, right, lower=1, trans_a=transposed))


def _triangle(chol: FloatArray) -> FloatArray:
    """Inverse of a lower triangle. (m, m)"""
    found, _ = lapack.dtrtri(chol.copy(order="F"), lower=1, overwrite_c=1)
    return cleaned(np.asarray(found))


def _squares(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ij,ij->j", matrix, matrix))


def cholesky(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a covariance that rounding may have made a little indefinite.

    Above the diagonal the result is zero. If the factorisation fails, the diagonal is raised by the
    smallest of 1e-14, 1e-12, … 1e-6 of itself that mends it, and what is certain by so much of a
    millionth of the largest.

    Parameters
    ----------
    matrix : (n, n) ndarray
        Symmetric.

    Raises
    ------
    numpy.linalg.LinAlgError
        If not even that helps.
    """
    if not len(matrix):
        return matrix.copy()
    # Its transpose is itself, in the order that LAPACK reads.
    found, failed = lapack.dpotrf(matrix.T, lower=1, clean=1)
    for power in (-14, -12, -10, -8, -6):
        if not failed:
            return np.asarray(found)
        diagonal = np.diagonal(matrix)
        floor = np.maximum(diagonal, 1e-6 * diagonal.max(initial=0.0))
        raised = matrix + np.diag(10.0**power * floor)
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
    if not len(own):
        return own
    S = own.copy(order="F")
    S.reshape(-1, order="A")[:: len(S) + 1] = diagonal
    found, failed = lapack.dpotrf(S, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the innovation's covariance is not positive definite")
    return np.asarray(found)


def absorbed(
    chol_P: FloatArray, odd: FloatArray, chol_V: FloatArray, innovation: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Correction and root of a covariance that takes measurements in without a difference.

    Parameters
    ----------
    chol_P : (N, N) ndarray
        L of P = L Lᵀ, lower triangular.
    odd : (m, n) ndarray
        D: the covariance of the state and the measurements is L Dᵀ with the first n columns of L.
    chol_V : (m, m) ndarray
        Lower triangular V of V Vᵀ = S - D Dᵀ.
    innovation : (m,) ndarray
        η.

    Returns
    -------
    correction : (N,) ndarray
    chol_P : (N, N) ndarray
        Root of the posterior covariance, lower triangular.
    nis : float
        ηᵀS⁻¹η.

    Notes
    -----
    See `pse_analysis.estimation.filters.square_root`.
    """
    m, n = odd.shape
    right = np.empty((m, n + 1), order="F")
    right[:, :-1], right[:, -1] = odd[:, ::-1], innovation
    start = np.zeros((n + 1, n + 1), order="F")
    np.fill_diagonal(start[:-1, :-1], 1.0)
    found = reflect(start, solve(chol_V, right), 0)
    # Turned round again, the factor is G⁻¹.
    G_inverse = np.asfortranarray(found[-2::-1, -2::-1])
    root = chol_P.copy(order="F")
    root[:, :n] = blas.dtrsm(1.0, G_inverse, root[:, :n], side=1, lower=1)
    return root[:, :n] @ found[-2::-1, -1], root, float(found[-1, -1]) ** 2


def reflect(upper: FloatArray, below: FloatArray, shape: int) -> FloatArray:
    """Triangular factor of an upper triangular matrix stacked on another one.

    ``shape`` is the number of last rows of the latter that are upper triangular too.
    """
    if not len(below):
        return upper
    found, *_ = lapack.dtpqrt(shape, min(BLOCK, len(upper)), upper, below)
    return np.asarray(np.triu(found))


def solve(chol: FloatArray, right: FloatArray) -> FloatArray:
    """L⁻¹ times one or many vectors, for a lower triangular L."""
    if not len(chol):
        return right
    found, _ = lapack.dtrtrs(chol, right, lower=1)
    return np.asarray(found)


def symmetric(lower: FloatArray) -> FloatArray:
    """The symmetric matrix of a lower triangle."""
    out = lower.copy(order="C")
    np.copyto(out, lower.T, where=_above(len(lower)))
    return out


def cleaned(chol: FloatArray) -> FloatArray:
    """A lower triangle with zeros above its diagonal, in its place."""
    np.copyto(chol, 0.0, where=_above(len(chol)))
    return chol


@cache
def _above(n: int) -> BoolArray:
    """Where a matrix of n rows is above its diagonal."""
    return np.triu(np.ones((n, n), dtype=np.bool_), 1)
