"""The linear least-squares problem of one Gauss-Newton step, solved in two ways.

`NormalEquations` factorises the gain JᵀR⁻¹J, which is small and fast but squares what the rows
differ in. `AugmentedEquations` keeps rows and states apart (Hachtel's form), so that a σ of 1e-9
beside one of 0.01, or a link of a hundred thousand p.u., costs no digits.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.measurement import MeasurementModel

DOUBTFUL = 1e-10
"""Smallest pivot of the gain, scaled to a unit diagonal, that still leaves half of the digits."""


class Pins(NamedTuple):
    """States that are held where they are: reference angles that no measurement moves.

    Attributes
    ----------
    columns : (k,) ndarray of int
        Places among the model's columns.
    sigma : (k,) ndarray
        How well each of them is known. [rad, p.u.]
    """

    columns: IntArray
    sigma: FloatArray

    @classmethod
    def none(cls) -> Pins:
        """No state is held."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0))


class Factor(Protocol):
    """Factorised equations of one state."""

    def step(self, whitened: FloatArray, residual: FloatArray) -> FloatArray:
        """Returns the step that fits whitened residuals (m,) best, (n,)."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Returns (JᵀR⁻¹J)⁻¹ times one or many right-hand sides, (n,) or (n, k)."""

    def inverse(self) -> FloatArray:
        """Returns the covariance (JᵀR⁻¹J)⁻¹, (n, n)."""


class NormalEquations:
    """JᵀR⁻¹J, assembled on a known pattern in an order of little fill-in, and factorised.

    Parameters
    ----------
    model : MeasurementModel
    """

    def __init__(self, model: MeasurementModel) -> None:
        _, n = model.shape
        self._n, self.model = n, model
        count = np.diff(model.indptr)
        # All pairs of entries that share a row: each adds one product to the gain.
        self._left = np.repeat(np.arange(len(model.indices)), count[model.row_of_entry])
        first = model.indptr[model.row_of_entry]
        span = count[model.row_of_entry]
        offset = np.arange(span.sum()) - np.repeat(np.cumsum(span) - span, span)
        self._right = np.repeat(first, span) + offset
        self._order = np.arange(n)
        self._lay_out(model.indices.astype(np.int64))
        # The order depends on the pattern alone, so it is found once.
        pattern = np.where(self._indices == self._column, float(n), -0.5 / n)
        self._matrix.data = pattern
        self._order = np.argsort(self._superlu("MMD_AT_PLUS_A").perm_c)
        self._place_of = np.empty(n, dtype=np.int64)
        self._place_of[self._order] = np.arange(n)
        self._lay_out(self._place_of[model.indices])

    def _lay_out(self, column_of_entry: IntArray) -> None:
        """Pattern of the gain, with every entry's row and column, and where each product goes."""
        n = self._n
        code = column_of_entry[self._right] * n + column_of_entry[self._left]
        places, self._place = np.unique(code, return_inverse=True)
        # States in no measurement keep a place on the diagonal, to be found there.
        own = np.arange(n) * (n + 1)
        every = np.union1d(places, own)
        self._place = np.searchsorted(every, places)[self._place]
        self._own = np.searchsorted(every, own)
        self._column, self._indices = every // n, (every % n).astype(np.int32)
        indptr = np.searchsorted(self._column, np.arange(n + 1)).astype(np.int32)
        self._matrix = sparse.csc_array((np.zeros(len(every)), self._indices, indptr), shape=(n, n))

    def _superlu(self, order: str) -> sparse_linalg.SuperLU:
        return sparse_linalg.splu(
            self._matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def factorise(
        self, whitened: FloatArray, pins: Pins, sign: FloatArray | None = None
    ) -> NormalFactor | None:
        """Factorise the gain of whitened Jacobian entries and of the states that are held.

        Parameters
        ----------
        whitened : (nnz,) ndarray
        pins : Pins
        sign : (m,) ndarray, optional
            -1 for rows that count against the gain.

        Returns
        -------
        NormalFactor or None
            None where a pivot is `DOUBTFUL`: the gain is singular, or too stiff for this form.
        """
        signed = whitened if sign is None else whitened * sign[self.model.row_of_entry]
        data = np.bincount(
            self._place,
            weights=whitened[self._left] * signed[self._right],
            minlength=len(self._indices),
        ).astype(float, copy=False)
        if len(pins.columns):
            data[self._own[self._place_of[pins.columns]]] += pins.sigma**-2
        diagonal = data[self._own]
        if not (diagonal > 0).all():
            return None
        # Scaled to a unit diagonal, a pivot is the share of a state that the others leave open.
        scale = 1.0 / np.sqrt(diagonal)
        self._matrix.data = data * scale[self._indices] * scale[self._column]
        try:
            factor = self._superlu("NATURAL")
        except RuntimeError:  # exactly singular
            return None
        if not factor.U.diagonal().min() > DOUBTFUL:
            return None
        return NormalFactor(self.model, factor, scale, self._order)

    def explained(self, x: FloatArray, covariance: FloatArray) -> FloatArray:
        """Returns the variance that an estimate of some covariance gives h(x) of each row.

        Parameters
        ----------
        x : (2N,) ndarray
        covariance : (n, n) ndarray
            Of the model's columns.

        Returns
        -------
        (m,) ndarray
            The diagonal of J C Jᵀ.
        """
        model = self.model
        data, column = model.jacobian_data(x), model.indices
        term = data[self._left] * data[self._right]
        term *= covariance[column[self._left], column[self._right]]
        sums = np.bincount(model.row_of_entry[self._left], term, model.shape[0])
        return sums.astype(float, copy=False)


class NormalFactor:
    """A factorised gain; the constructor's arguments come from `NormalEquations`."""

    def __init__(
        self,
        model: MeasurementModel,
        factor: sparse_linalg.SuperLU,
        scale: FloatArray,
        order: IntArray,
    ) -> None:
        self._model, self._factor, self._scale, self._order = model, factor, scale, order

    def step(self, whitened: FloatArray, residual: FloatArray) -> FloatArray:
        """Returns the step that fits whitened residuals best. (n,)"""
        model = self._model
        gradient = np.bincount(
            model.indices, whitened * residual[model.row_of_entry], model.shape[1]
        )
        return self.solve(gradient.astype(float, copy=False))

    def solve(self, right: FloatArray) -> FloatArray:
        """Returns the solution for one or many right-hand sides, in the model's own order."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        solution = np.empty_like(right)
        solution[self._order] = scale * self._factor.solve(scale * right[self._order])
        return solution

    def inverse(self) -> FloatArray:
        """Returns the covariance of the model's columns. (n, n)"""
        n = len(self._order)
        unit = np.zeros((n, n), order="F")
        unit[np.arange(n), np.arange(n)] = self._scale
        inverse = self._factor.solve(unit)
        inverse *= self._scale[:, None]
        place = np.empty(n, dtype=np.int64)
        place[self._order] = np.arange(n)
        inverse = inverse[place[:, None], place]
        inverse += inverse.T
        inverse *= 0.5
        return np.asarray(inverse)


class AugmentedFactor:
    """[R J; Jᵀ 0] with rows and columns scaled to one, factorised with pivoting.

    Parameters
    ----------
    model : MeasurementModel
    whitened : (nnz,) ndarray
        Whitened entries of its Jacobian.
    pins : Pins

    Raises
    ------
    RuntimeError
        If it is exactly singular.

    Notes
    -----
    With w the whitened residual and s the step, R̂ = diag(1/a²) for whitened rows of norm a:
    [R̂ Ĵ; Ĵᵀ 0] [λ; ŝ] = [ŵ; 0]. A row of tiny σ has R̂ = 0 but for rounding, and is then an equality
    constraint. Covariances are sums of squares, (JᵀR⁻¹J)⁻¹ = X Xᵀ where s = X w, and so never
    negative.
    """

    def __init__(self, model: MeasurementModel, whitened: FloatArray, pins: Pins) -> None:
        scaled, self._row, self._column = equilibrated(
            with_held(model.matrix(whitened), pins.columns, 1.0 / pins.sigma)
        )
        self._most = (self._row**2).max(initial=1e-300)
        self._matrix = sparse.block_array(
            [[sparse.diags_array(self._row**2 / self._most), scaled], [scaled.T, None]],
            format="csc",
        )
        self._factor = sparse_linalg.splu(self._matrix)

    def _solved(self, upper: FloatArray, lower: FloatArray) -> FloatArray:
        """Returns the states of the solution, with one step of iterative refinement."""
        right = np.concatenate([upper, lower])
        solution = self._factor.solve(right)
        solution += self._factor.solve(right - self._matrix @ solution)
        return np.asarray(solution[len(upper) :])

    def step(self, whitened: FloatArray, residual: FloatArray) -> FloatArray:
        """Returns the step that fits whitened residuals best. (n,)"""
        held = len(self._row) - len(residual)
        upper = self._row * np.concatenate([residual, np.zeros(held)])
        return np.asarray(self._column * self._solved(upper, np.zeros(len(self._column))))

    def solve(self, right: FloatArray) -> FloatArray:
        """Returns (JᵀR⁻¹J)⁻¹ times one or many right-hand sides."""
        column = self._column if right.ndim == 1 else self._column[:, None]
        upper = np.zeros((len(self._row), *right.shape[1:]))
        return np.asarray(column * self._solved(upper, -self._most * column * right))

    def inverse(self) -> FloatArray:
        """Returns the covariance of the model's columns. (n, n)"""
        n, out = len(self._column), np.zeros((len(self._column), len(self._column)))
        for first in range(0, len(self._row), _BLOCK):
            row = self._row[first : first + _BLOCK]
            upper = np.zeros((len(self._row), len(row)))
            upper[first + np.arange(len(row)), np.arange(len(row))] = row
            fit = self._column[:, None] * self._solved(upper, np.zeros((n, len(row))))
            out += fit @ fit.T
        return out


_BLOCK = 512
"""Right-hand sides solved at once; more cost memory."""


def with_held(rows: sparse.csr_array, columns: IntArray, weight: FloatArray) -> sparse.csr_array:
    """Returns rows of a Jacobian, and after them a row for each state that is held. (m + k, n)"""
    held = sparse.csr_array(
        (weight, (np.arange(len(columns)), columns)), shape=(len(columns), rows.shape[1])
    )
    return sparse.csr_array(sparse.vstack([rows, held]))


def equilibrated(matrix: sparse.csr_array) -> tuple[sparse.csr_array, FloatArray, FloatArray]:
    """Returns a matrix with rows and columns of norm near one, and what scales it to that.

    Parameters
    ----------
    matrix : (m, n) csr_array

    Returns
    -------
    scaled : (m, n) csr_array
        diag(row) · matrix · diag(column).
    row, column : (m,), (n,) ndarray
        One where a row or column holds nothing but zeros.
    """
    row, column = np.ones(matrix.shape[0]), np.ones(matrix.shape[1])
    square = matrix.multiply(matrix).tocsr()
    for _ in range(_SWEEPS):
        for scale, other, part in ((row, column, square), (column, row, square.T)):
            norm = np.sqrt(part @ other**2)
            np.divide(1.0, norm, out=scale, where=norm > 0)
    scaled = sparse.diags_array(row) @ matrix @ sparse.diags_array(column)
    return scaled.tocsr(), row, column


_SWEEPS = 3
"""Rounds in which rows and then columns are scaled to norm one."""
