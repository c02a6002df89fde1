"""h(x) and its sparse Jacobian in polar coordinates, for many states at once."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pse_analysis.arrays import ComplexArray, FloatArray, IntArray
from pse_analysis.grid.network import Network
from pse_analysis.measurement.layout import IA, IM, VA, VM, P, Q, SensorLayout, Terminals, wrap

VANISHED = 1e-10
"""Current, in units of the sum of its terms, whose direction is next to nothing but rounding."""


class MeasurementModel:
    """h(x) and its sparse Jacobian in polar coordinates, for a fixed layout.

    Built once: the sparsity pattern never changes, and states are evaluated many at a time.

    Parameters
    ----------
    network : Network
    layout : SensorLayout
        m rows.
    columns : (n,) array_like of int, optional
        Columns of the Jacobian, as positions in x = [θ; |V|]; all 2N by default.
    """

    def __init__(
        self, network: Network, layout: SensorLayout, columns: npt.ArrayLike | None = None
    ) -> None:
        self.network = network
        self.layout = layout
        n2 = 2 * network.n_bus
        self.columns = np.arange(n2) if columns is None else np.asarray(columns, dtype=np.int64)
        self._terminals = Terminals(network, layout)
        self._rows = {q: np.flatnonzero(layout.quantity == q) for q in range(6)}
        self._gross = np.asarray(abs(self._terminals.y).sum(axis=1)).ravel()
        self._compile()

    @property
    def shape(self) -> tuple[int, int]:
        """(m, n) of the Jacobian."""
        return len(self.layout), len(self.columns)

    @cached_property
    def gross(self) -> FloatArray:
        """Sum of the sizes of the terms of h(x) at rated voltage. (m,)"""
        terminal = self._terminals.of_row
        return np.where(terminal >= 0, np.append(self._gross, 1.0)[terminal], 1.0)

    @cached_property
    def _currents(self) -> tuple[IntArray, sparse.csr_array, FloatArray]:
        """Rows of currents, the admittances that give them, and the least that is not rounding."""
        rows = np.concatenate([self._rows[IM], self._rows[IA]])
        terminal = self._terminals.of_row[rows]
        return rows, self._terminals.y[terminal], VANISHED * self._gross[terminal]

    def without_tangent(self, x: FloatArray) -> npt.NDArray[np.bool_] | None:
        """Rows of currents that vanish at a state, so that they have no derivative there.

        Parameters
        ----------
        x : (2N,) ndarray

        Returns
        -------
        (m,) ndarray of bool or None
            None if there is no such row.
        """
        rows, admittance, least = self._currents
        if not len(rows):
            return None
        vanished = np.abs(admittance @ self._voltage(x)) <= least
        if not vanished.any():
            return None
        out = np.zeros(len(self.layout), dtype=np.bool_)
        out[rows] = vanished
        return out

    def _compile(self) -> None:
        n = self.network.n_bus
        t = self._terminals
        count = np.diff(t.y.indptr)
        rows, cols = [], []
        self._entries: dict[int, IntArray] = {}
        for q in (P, Q, IM, IA):
            z = self._rows[q]
            terminal = t.of_row[z]
            if len(z):
                span = count[terminal]
                start = np.repeat(t.y.indptr[terminal] - np.cumsum(span) + span, span)
                entries = start + np.arange(span.sum())
            else:
                span = entries = np.zeros(0, dtype=np.int64)
            self._entries[q] = entries
            for shift in (0, n):
                rows.append(np.repeat(z, span))
                cols.append(t.entry_col[entries] + shift)
        for q, shift in ((VM, n), (VA, 0)):
            rows.append(self._rows[q])
            cols.append(self.layout.position[self._rows[q]] + shift)
        row, col = np.concatenate(rows), np.concatenate(cols)
        place = np.full(2 * n, -1, dtype=np.int64)
        place[self.columns] = np.arange(len(self.columns))
        kept = np.flatnonzero(place[col] >= 0)
        numbered = sparse.coo_array(
            (kept + 1.0, (row[kept], place[col[kept]])), shape=self.shape
        ).tocsr()
        numbered.sort_indices()
        self._order = numbered.data.astype(np.int64) - 1
        self.indices = numbered.indices
        self.indptr = numbered.indptr
        self.row_of_entry = np.repeat(np.arange(len(self.layout)), np.diff(self.indptr))

    def _voltage(self, x: FloatArray) -> ComplexArray:
        n = self.network.n_bus
        voltage = np.empty((n, *x.shape[1:]), dtype=np.complex128)
        # Half the time of a complex exponential, which is most of h at many states.
        np.multiply(x[n:], np.cos(x[:n]), out=voltage.real)
        np.multiply(x[n:], np.sin(x[:n]), out=voltage.imag)
        return voltage

    def h(self, x: FloatArray) -> FloatArray:
        """Measurements of one or many states.

        Parameters
        ----------
        x : (2N,) or (2N, n_points) ndarray
            [θ; |V|]. [rad; p.u.]

        Returns
        -------
        (m,) or (m, n_points) ndarray
            Rows follow the layout. [p.u., rad]
        """
        n, t = self.network.n_bus, self._terminals
        out = np.empty((len(self.layout), *x.shape[1:]))
        for q, block in ((VA, x[:n]), (VM, x[n:])):
            out[self._rows[q]] = block[self.layout.position[self._rows[q]]]
        if len(t.metered):
            voltage = self._voltage(x)
            current = t.y @ voltage
            power = voltage[t.metered] * current.conj()
            for q, part in ((P, power.real), (Q, power.imag)):
                out[self._rows[q]] = part[t.of_row[self._rows[q]]]
            for q, function in ((IM, np.abs), (IA, np.angle)):
                if len(self._rows[q]):
                    out[self._rows[q]] = function(current[t.of_row[self._rows[q]]])
        return out

    def jacobian_data(self, x: FloatArray) -> FloatArray:
        """Stored entries of ∂h/∂x at one or many states, in the order of the CSR pattern.

        Parameters
        ----------
        x : (2N,) or (2N, n_points) ndarray

        Returns
        -------
        (nnz,) or (nnz, n_points) ndarray
        """
        t = self._terminals
        voltage = self._voltage(x)
        magnitude = x[self.network.n_bus :]
        points = x.shape[1:]
        y = t.y.data.reshape(-1, *([1] * len(points)))
        part = y * voltage[t.entry_col]  # the entry's share of the terminal current
        current = t.y @ voltage
        parts = []
        if len(self._entries[P]) or len(self._entries[Q]):
            own, metered = t.own_entry, t.metered
            power = voltage[metered] * current.conj()
            share = voltage[metered[t.entry_row]] * part.conj()
            by_angle = -1j * share
            by_angle[own] += 1j * power
            by_magnitude = share / magnitude[t.entry_col]
            by_magnitude[own] += power / magnitude[metered]
        else:
            by_angle = by_magnitude = part
        for q, name in ((P, "real"), (Q, "imag")):
            parts.append(getattr(by_angle, name)[self._entries[q]])
            parts.append(getattr(by_magnitude, name)[self._entries[q]])
        if len(self._entries[IM]) or len(self._entries[IA]):
            size = np.abs(current)
            # |I| has no derivative at I = 0 and ∠I no value: such rows get zeros and so no weight.
            least = VANISHED * self._gross.reshape(-1, *([1] * len(points)))
            inverse = np.divide(
                current.conj(), size**2, out=np.zeros_like(current), where=size > least
            )
            relative = part * inverse[t.entry_row]  # d(log I)/d(log V_k)
            size = size[t.entry_row]
            over = magnitude[t.entry_col]
            blocks = {
                IM: (-relative.imag * size, relative.real * size / over),
                IA: (relative.real, relative.imag / over),
            }
            for q in (IM, IA):
                parts.extend(block[self._entries[q]] for block in blocks[q])
        parts.append(np.ones((len(self._rows[VM]) + len(self._rows[VA]), *points)))
        return np.asarray(np.concatenate(parts)[self._order])

    def matrix(self, data: FloatArray) -> sparse.csr_array:
        """CSR matrix with this model's pattern and the given entries."""
        return sparse.csr_array((data, self.indices, self.indptr), shape=self.shape)

    def jacobian(self, x: FloatArray) -> sparse.csr_array:
        """∂h/∂x at one state, (m, n): rows follow the layout, columns ``columns``."""
        return self.matrix(self.jacobian_data(x))

    def gram(self, data: FloatArray) -> FloatArray:
        """Lower triangle of JᵀJ, for entries of J in the order of the CSR pattern. (n, n)

        Column by column, as LAPACK reads it.
        """
        n = self.shape[1]
        left, right, place = self._products
        lower = np.bincount(place, data[left] * data[right], n * n)
        return lower.astype(np.float64, copy=False).reshape(n, n).T

    @cached_property
    def _products(self) -> tuple[IntArray, IntArray, IntArray]:
        """Pairs of entries that share a row, and where in JᵀJ their products go."""
        count = np.diff(self.indptr)[self.row_of_entry]
        left = np.repeat(np.arange(len(self.indices)), count)
        first = np.repeat(self.indptr[self.row_of_entry] - np.cumsum(count) + count, count)
        right = first + np.arange(len(left))
        row, column = self.indices[left], self.indices[right].astype(np.int64)
        lower = row >= column
        return left[lower], right[lower], (column * self.shape[1] + row)[lower]

    @property
    def angular(self) -> npt.NDArray[np.bool_]:
        """Rows that are angles, whose differences must be folded. (m,)"""
        return self.layout.angular

    def residual(self, z: FloatArray, x: FloatArray) -> FloatArray:
        """Residual z - h(x) with angle differences folded into [-π, π). (m,)"""
        r = z - self.h(x)
        r[self.angular] = wrap(r[self.angular])
        return r
