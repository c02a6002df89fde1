"""Measurements in the form that is linear in x = [e; f]."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pse_analysis.grid.network import Network
from pse_analysis.measurement.layout import (
    IA,
    IM,
    RELATIVE_FLOOR_PU,
    VA,
    VM,
    ComplexArray,
    FloatArray,
    IntArray,
    P,
    Q,
    SensorLayout,
    Terminals,
)


class RectangularModel:
    """Measurements that are linear in x = [e; f], one real row per channel.

    A phasor M∠φ of a complex c = y·V is two real rows of e^{-jφ}c, the one along φ with σ_M and the
    one across it with M σ_φ: in that frame their 2×2 covariance is diagonal. Powers are rows of the
    current: with the predicted voltage |V|∠θ at the metered bus, e^{-jθ}c = (P - jQ)/|V|, whose
    covariance diag(σ_P², σ_Q²)/|V|² is diagonal too. A channel that lost its partner keeps its row:
    a magnitude alone is laid along the predicted angle, an angle alone is scaled by the predicted
    magnitude.

    Parameters
    ----------
    network : Network
    layout : SensorLayout

    Notes
    -----
    The linear transform is that of [qi2025], eqs. (8)–(14), with the full Y-bus for injections,
    which eq. (14) prints without its diagonal. A rotation of a pair of rows changes neither the
    gain nor the innovation's NIS, so the frame is chosen for the diagonal covariance.
    """

    def __init__(self, network: Network, layout: SensorLayout) -> None:
        self.network = network
        self.layout = layout
        n = network.n_bus
        t = Terminals(network, layout)
        m = len(layout)
        electric = np.flatnonzero(layout.quantity >= P)
        plain = np.flatnonzero(layout.quantity < P)
        row = np.concatenate([np.repeat(electric, np.diff(t.y.indptr)[t.of_row[electric]]), plain])
        y_rows = t.y[t.of_row[electric]] if len(electric) else t.y[:0]
        col = np.concatenate([y_rows.indices, layout.position[plain]])
        value = np.concatenate([y_rows.data, np.ones(len(plain), dtype=complex)])
        order = np.lexsort((col, row))
        self._row, self._value = row[order], value[order]
        self._functional = sparse.csr_array((value, (row, col)), shape=(m, n))
        self._functional.sort_indices()
        counts = np.diff(self._functional.indptr)
        # Pattern of H: for every row its e-columns, then its f-columns.
        self.indptr = np.concatenate([[0], np.cumsum(2 * counts)])
        start = np.repeat(self.indptr[:-1], counts) + (
            np.arange(len(self._row)) - np.repeat(self._functional.indptr[:-1], counts)
        )
        self._at_e, self._at_f = start, start + np.repeat(counts, counts)
        self.indices = np.empty(2 * len(self._row), dtype=np.int64)
        self.indices[self._at_e] = self._functional.indices
        self.indices[self._at_f] = self._functional.indices + n
        self._metered = np.where(
            layout.quantity >= P,
            np.append(t.metered, 0)[t.of_row],
            layout.position,
        )
        self._partner = _partners(layout)
        self._across = np.isin(layout.quantity, (VA, IA, Q))

    def paired(self, available: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Rows that are available together with the other half of their phasor or power. (m,)"""
        return np.asarray((self._partner >= 0) & available & available[self._partner])

    def rows(
        self,
        z: FloatArray,
        sigma: FloatArray,
        available: npt.NDArray[np.bool_],
        voltage: ComplexArray,
    ) -> tuple[sparse.csr_array, FloatArray, FloatArray]:
        """H, z and σ of the linear form at a predicted voltage; rows follow the layout.

        Parameters
        ----------
        z, sigma : (m,) ndarray
            Measured values and their σ. [p.u., rad]
        available : (m,) ndarray of bool
            Rows that carry a value; the others come out finite but mean nothing.
        voltage : (N,) ndarray of complex
            Predicted voltage. [p.u.]

        Returns
        -------
        H : (m, 2N) csr_array
        z_linear : (m,) ndarray
        sigma_linear : (m,) ndarray
        """
        quantity = self.layout.quantity
        predicted = self._functional @ voltage
        partner, paired = self._partner, self.paired(available)
        angle, size = np.angle(predicted), np.abs(predicted)
        is_angle = (quantity == VA) | (quantity == IA)
        is_size = (quantity == VM) | (quantity == IM)
        is_power = (quantity == P) | (quantity == Q)
        # The frame of each row: its own or its partner's measured angle, else the predicted one.
        angle = np.where(is_angle & available, z, angle)
        angle = np.where(is_size & paired, z[partner], angle)
        size = np.where(is_angle & paired, np.abs(z[partner]), size)
        at_meter = voltage[self._metered]
        angle = np.where(is_power, np.angle(at_meter), angle)
        level = np.abs(at_meter)
        linear = np.where(is_size, z, 0.0)
        linear = np.where(quantity == P, z / level, linear)
        linear = np.where(quantity == Q, -z / level, linear)
        spread = np.where(is_angle, np.maximum(size, RELATIVE_FLOOR_PU), 1.0) * sigma
        spread = np.where(is_power, sigma / level, spread)
        # With w = e^{-jα} y: Re(w V) = Re(w)·e - Im(w)·f and Im(w V) = Im(w)·e + Re(w)·f.
        turned = self._value * np.exp(-1j * angle)[self._row]
        across = self._across[self._row]
        data = np.empty(2 * len(self._row))
        data[self._at_e] = np.where(across, turned.imag, turned.real)
        data[self._at_f] = np.where(across, turned.real, -turned.imag)
        matrix = sparse.csr_array(
            (data, self.indices, self.indptr), shape=(len(quantity), 2 * self.network.n_bus)
        )
        return matrix, linear, spread


def _partners(layout: SensorLayout) -> IntArray:
    """Row that holds the other half of each row's phasor, or -1; -1 too where several could."""
    other = {VM: VA, VA: VM, IM: IA, IA: IM, P: Q, Q: P}
    places = list(zip(layout.source, layout.position, layout.side, strict=True))
    where: dict[tuple[str, int, int, int], list[int]] = {}
    for i, (place, q) in enumerate(zip(places, layout.quantity, strict=True)):
        where.setdefault((*place, int(q)), []).append(i)
    partner = np.full(len(layout), -1, dtype=np.int64)
    for (source, position, side, q), rows in where.items():
        match = where.get((source, position, side, other[q]), [])
        if len(rows) == len(match) == 1:
            partner[rows[0]] = match[0]
    return partner
