"""The one measurement model: h(x), its Jacobian, and the boundary between units and per unit.

State of the polar model: x = [θ; |V|], 2N rows [rad; p.u.]. State of the rectangular model:
x = [e; f] with V = e + jf. Both read a `SensorLayout`, whose rows follow the channels table.

Everything but |V| and θ is a function of a *terminal current* c = y·V, where y is a row of Y-bus
(injection) or of the branch admittances (flow), and of the voltage V_m at the metered bus:
S = V_m c*, so P, Q, |I| and ∠I at every place share one formula.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import sparse

from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.vocabulary import UNITS, Aggregation, Quantity, SigmaKind

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

Model = Network | Machine
"""What a case is about: its channels measure a grid, or a machine."""

QUANTITIES = tuple(Quantity)
VM, VA, P, Q, IM, IA, DELTA_M, ROTOR_ANGLE, ROTOR_SPEED = range(9)
BUS, FROM, TO = range(3)
_SIDES = {"": BUS, "from": FROM, "to": TO}

RELATIVE_FLOOR_PU = 1e-3
"""Magnitude below which a relative σ no longer shrinks with the value. [p.u.]"""


def standard_deviation(
    value_pu: npt.ArrayLike, sigma: npt.ArrayLike, relative: npt.ArrayLike
) -> FloatArray:
    """σ of a value, absolute or as a fraction of its magnitude.

    Parameters
    ----------
    value_pu : (...,) array_like
        Value in p.u. or rad.
    sigma : (...,) array_like
        σ in p.u. or rad where absolute, a fraction where relative.
    relative : (...,) array_like of bool
        Which of the two.

    Returns
    -------
    (...,) ndarray
        σ in p.u. or rad; the magnitude counts as at least `RELATIVE_FLOOR_PU`.
    """
    magnitude = np.maximum(np.abs(value_pu), RELATIVE_FLOOR_PU)
    return np.where(relative, np.asarray(sigma) * magnitude, sigma)


def wrap(angle: FloatArray) -> FloatArray:
    """Angles folded into [-π, π). [rad]"""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True, eq=False)
class SensorLayout:
    """Which quantity each row of a measurement vector measures, and where.

    Attributes
    ----------
    channel : tuple of str, length m
        Channel of each row.
    quantity, position, side : (m,) ndarray of int
        Index into `QUANTITIES`; position of the bus or branch; `BUS`, `FROM` or `TO`.
    scale : (m,) ndarray
        per-unit value = scale · value in the channel's unit; holds the channel's sign.
    sigma, relative : (m,) ndarray
        σ in p.u. or rad, or a fraction where ``relative``.
    window_s : (m,) ndarray
        Length of the interval that a sample averages; 0 for instantaneous values. [s]
    source : tuple of str, length m
        Source of each row; magnitude and angle, or P and Q, of one source at one place belong
        together.
    """

    channel: tuple[str, ...]
    quantity: IntArray
    position: IntArray
    side: IntArray
    scale: FloatArray
    sigma: FloatArray
    relative: npt.NDArray[np.bool_]
    window_s: FloatArray
    source: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.channel)

    @classmethod
    def from_channels(cls, channels: pd.DataFrame, model: Model) -> SensorLayout:
        """Layout of a channels table; a machine's quantities are per unit and rad already.

        Raises
        ------
        GridError
            If an element is not in the grid.
        TableError
            If a unit does not fit its quantity, or a side its element.
        """
        if isinstance(model, Machine):
            return cls._of_machine(channels, model)
        network = model
        names = tuple(channels["channel"])
        m = len(names)
        quantity, position, side = (np.zeros(m, dtype=np.int64) for _ in range(3))
        factor = np.ones(m)
        for i, (channel, q, element, end, unit) in enumerate(
            zip(
                names,
                channels["quantity"],
                channels["element"],
                channels["side"],
                channels["unit"],
                strict=True,
            )
        ):
            kind, _, name = element.partition("/")
            quantity[i] = QUANTITIES.index(Quantity(q))
            side[i] = _SIDES[end]
            if (kind == "bus") != (side[i] == BUS):
                raise TableError(
                    f"channels: {channel!r} measures {element!r} at side {end!r}: expected '' "
                    "for a bus, 'from' or 'to' for a branch"
                )
            if side[i] != BUS and quantity[i] in (VM, VA):
                raise TableError(
                    f"channels: {channel!r} measures {q} of a branch: voltages belong to buses"
                )
            if unit not in UNITS[Quantity(q)]:
                raise TableError(
                    f"channels: unit {unit!r} of {channel!r} does not fit {q}: expected "
                    f"{' or '.join(UNITS[Quantity(q)])}"
                )
            position[i] = network.bus(name) if kind == "bus" else network.branch(name)
            metered = _metered_bus(network, position[i], side[i])
            factor[i] = per_unit_factor(network, unit, int(metered))
        relative = (channels["sigma_kind"] == SigmaKind.RELATIVE).to_numpy()
        return cls(
            channel=names,
            quantity=quantity,
            position=position,
            side=side,
            scale=factor * channels["sign"].to_numpy(dtype=float),
            sigma=np.where(relative, 1.0, factor) * channels["sigma"].to_numpy(dtype=float),
            relative=relative,
            window_s=np.where(
                channels["aggregation"] == Aggregation.MEAN,
                channels["period_s"].to_numpy(dtype=float),
                0.0,
            ),
            source=tuple(channels["source"]),
        )

    @classmethod
    def _of_machine(cls, channels: pd.DataFrame, machine: Machine) -> SensorLayout:
        m = len(channels)
        foreign = channels[channels["element"] != machine.element]
        if len(foreign):
            raise TableError(
                f"channels: {foreign['channel'].iloc[0]!r} stands at "
                f"{foreign['element'].iloc[0]!r}: expected {machine.element!r}"
            )
        for channel, q, unit in zip(
            *(channels[c] for c in ("channel", "quantity", "unit")), strict=True
        ):
            if unit not in UNITS[Quantity(q)]:
                raise TableError(
                    f"channels: unit {unit!r} of {channel!r} does not fit {q}: expected "
                    f"{' or '.join(UNITS[Quantity(q)])}"
                )
        return cls(
            channel=tuple(channels["channel"]),
            quantity=np.array([QUANTITIES.index(Quantity(q)) for q in channels["quantity"]]),
            position=np.zeros(m, dtype=np.int64),
            side=np.full(m, BUS, dtype=np.int64),
            scale=channels["sign"].to_numpy(dtype=float),
            sigma=channels["sigma"].to_numpy(dtype=float),
            relative=(channels["sigma_kind"] == SigmaKind.RELATIVE).to_numpy(),
            window_s=np.where(
                channels["aggregation"] == Aggregation.MEAN,
                channels["period_s"].to_numpy(dtype=float),
                0.0,
            ),
            source=tuple(channels["source"]),
        )

    @classmethod
    def of(cls, network: Network, *rows: tuple[int, IntArray, int]) -> SensorLayout:
        """Layout in per unit without channels: each row block is (quantity, positions, side)."""
        quantity = np.concatenate([np.full(len(p), q) for q, p, _ in rows]).astype(np.int64)
        position = np.concatenate([p for _, p, _ in rows]).astype(np.int64)
        side = np.concatenate([np.full(len(p), s) for _, p, s in rows]).astype(np.int64)
        m = len(quantity)
        names = tuple(
            f"{QUANTITIES[q]}@{('bus', 'from', 'to')[s]}/{p}"
            for q, p, s in zip(quantity, position, side, strict=True)
        )
        return cls(
            channel=names,
            quantity=quantity,
            position=position,
            side=side,
            scale=np.ones(m),
            sigma=np.ones(m),
            relative=np.zeros(m, dtype=bool),
            window_s=np.zeros(m),
            source=("",) * m,
        )

    def to_per_unit(self, values: FloatArray) -> FloatArray:
        """Values of the channels, (m, …), in p.u. and rad and this project's sign convention."""
        return values * self.scale.reshape(-1, *([1] * (np.ndim(values) - 1)))

    def from_per_unit(self, values_pu: FloatArray) -> FloatArray:
        """Inverse of `to_per_unit`."""
        return values_pu / self.scale.reshape(-1, *([1] * (np.ndim(values_pu) - 1)))

    def sigma_pu(self, value_pu: FloatArray) -> FloatArray:
        """σ of one value per row, (m,). [p.u., rad]"""
        return standard_deviation(value_pu, self.sigma, self.relative)

    def take(self, rows: npt.NDArray[np.generic]) -> SensorLayout:
        """The layout of some of its rows."""
        names = [f.name for f in fields(self)]
        columns: dict[str, Any] = {name: np.asarray(getattr(self, name))[rows] for name in names}
        for name in ("channel", "source"):
            columns[name] = tuple(map(str, columns[name]))
        return SensorLayout(**columns)

    @property
    def has_angle(self) -> bool:
        """Whether any row fixes the angle against an outside reference."""
        return bool(np.isin(self.quantity, (VA, IA)).any())


def per_unit_factor(network: Network, unit: str, bus: int) -> float:
    """Per-unit (or rad) value of one ``unit`` at a bus."""
    factors = {
        "pu": 1.0,
        "rad": 1.0,
        "degree": np.pi / 180.0,
        "kv": 1.0 / network.buses.vn_kv[bus],
        "mw": 1.0 / network.base_mva,
        "mvar": 1.0 / network.base_mva,
        "kw": 1e-3 / network.base_mva,
        "kvar": 1e-3 / network.base_mva,
        "ka": 1.0 / network.base_ka[bus],
        "a": 1e-3 / network.base_ka[bus],
    }
    return float(factors[unit])


def _metered_bus(network: Network, position: npt.ArrayLike, side: npt.ArrayLike) -> IntArray:
    position, side = np.atleast_1d(position), np.atleast_1d(side)
    metered = np.array(position, dtype=np.int64)
    for end, buses in ((FROM, network.branches.from_bus), (TO, network.branches.to_bus)):
        metered[side == end] = buses[position[side == end]]
    return metered if metered.size != 1 else metered[0]


class _Terminals:
    """Distinct terminal currents that a layout reads, with the sparse rows that give them."""

    def __init__(self, network: Network, layout: SensorLayout) -> None:
        offset = np.array([0, network.n_bus, network.n_bus + network.n_branch])
        place = layout.position + offset[layout.side]
        electric = layout.quantity >= P
        places, first, inverse = np.unique(place[electric], return_index=True, return_inverse=True)
        self.of_row = np.full(len(layout), -1, dtype=np.int64)
        self.of_row[electric] = inverse
        stacked = sparse.vstack([network.y_bus, network.y_from, network.y_to]).tocsr()
        self.y = sparse.csr_array(stacked[places])
        self.y.sort_indices()
        position, side = layout.position[electric][first], layout.side[electric][first]
        self.metered = np.atleast_1d(_metered_bus(network, position, side))
        self.entry_row = np.repeat(np.arange(len(places)), np.diff(self.y.indptr))
        self.entry_col = self.y.indices.astype(np.int64)
        own = np.flatnonzero(self.entry_col == self.metered[self.entry_row])
        self.own_entry = own  # one per terminal, in order, because rows store their metered bus


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
        self._terminals = _Terminals(network, layout)
        self._rows = {q: np.flatnonzero(layout.quantity == q) for q in range(6)}
        self._compile()

    @property
    def shape(self) -> tuple[int, int]:
        """(m, n) of the Jacobian."""
        return len(self.layout), len(self.columns)

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
            inverse = np.divide(
                current.conj(), size**2, out=np.zeros_like(current), where=size > 1e-12
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

    @cached_property
    def angular(self) -> npt.NDArray[np.bool_]:
        """Rows that are angles, whose differences must be folded. (m,)"""
        return np.isin(self.layout.quantity, (VA, IA))

    def residual(self, z: FloatArray, x: FloatArray) -> FloatArray:
        """Residual z - h(x) with angle differences folded into [-π, π). (m,)"""
        r = z - self.h(x)
        r[self.angular] = wrap(r[self.angular])
        return r


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
        t = _Terminals(network, layout)
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
