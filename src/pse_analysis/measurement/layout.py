"""Which quantity each row of a measurement vector measures, and the boundary to users' units."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import sparse

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.vocabulary import UNITS, Aggregation, Quantity, SigmaKind

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
        _check_units(channels)
        position, side, factor = (
            _in_machine(channels, model)
            if isinstance(model, Machine)
            else _in_network(channels, model)
        )
        relative = (channels["sigma_kind"] == SigmaKind.RELATIVE).to_numpy()
        mean = (channels["aggregation"] == Aggregation.MEAN).to_numpy()
        return cls(
            channel=tuple(channels["channel"]),
            quantity=np.array(
                [QUANTITIES.index(Quantity(q)) for q in channels["quantity"]], dtype=np.int64
            ),
            position=position,
            side=side,
            scale=factor * channels["sign"].to_numpy(dtype=float),
            sigma=np.where(relative, 1.0, factor) * channels["sigma"].to_numpy(dtype=float),
            relative=relative,
            window_s=np.where(mean, channels["period_s"].to_numpy(dtype=float), 0.0),
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

    def joined(self, other: SensorLayout) -> SensorLayout:
        """The layout with the rows of another one after its own."""
        columns: dict[str, Any] = {}
        for f in fields(self):
            mine, theirs = getattr(self, f.name), getattr(other, f.name)
            together = mine + theirs if isinstance(mine, tuple) else np.concatenate([mine, theirs])
            columns[f.name] = together
        return SensorLayout(**columns)

    @cached_property
    def angular(self) -> npt.NDArray[np.bool_]:
        """Rows that are angles of voltages or currents, whose differences must be folded. (m,)"""
        return np.isin(self.quantity, (VA, IA))

    @property
    def has_angle(self) -> bool:
        """Whether any row fixes the angle against an outside reference."""
        return bool(self.angular.any())


def _check_units(channels: pd.DataFrame) -> None:
    for channel, q, unit in zip(
        *(channels[c] for c in ("channel", "quantity", "unit")), strict=True
    ):
        if unit not in UNITS[Quantity(q)]:
            raise TableError(
                f"channels: unit {unit!r} of {channel!r} does not fit {q}: expected "
                f"{' or '.join(UNITS[Quantity(q)])}"
            )


def _in_network(channels: pd.DataFrame, network: Network) -> tuple[IntArray, IntArray, FloatArray]:
    """Position, side and per-unit factor of every channel of a grid."""
    position, side = (np.zeros(len(channels), dtype=np.int64) for _ in range(2))
    factor = np.ones(len(channels))
    columns = (channels[c] for c in ("channel", "quantity", "element", "side", "unit"))
    for i, (channel, q, element, end, unit) in enumerate(zip(*columns, strict=True)):
        kind, _, name = element.partition("/")
        side[i] = _SIDES[end]
        if (kind == "bus") != (side[i] == BUS):
            raise TableError(
                f"channels: {channel!r} measures {element!r} at side {end!r}: expected '' "
                "for a bus, 'from' or 'to' for a branch"
            )
        if side[i] != BUS and QUANTITIES.index(Quantity(q)) in (VM, VA):
            raise TableError(
                f"channels: {channel!r} measures {q} of a branch: voltages belong to buses"
            )
        position[i] = network.bus(name) if kind == "bus" else network.branch(name)
        factor[i] = per_unit_factor(network, unit, int(metered_bus(network, position[i], side[i])))
    return position, side, factor


def _in_machine(channels: pd.DataFrame, machine: Machine) -> tuple[IntArray, IntArray, FloatArray]:
    """The same of a machine, which has one place and its units in p.u. and rad."""
    foreign = channels[channels["element"] != machine.element]
    if len(foreign):
        raise TableError(
            f"channels: {foreign['channel'].iloc[0]!r} stands at "
            f"{foreign['element'].iloc[0]!r}: expected {machine.element!r}"
        )
    m = len(channels)
    return np.zeros(m, dtype=np.int64), np.full(m, BUS, dtype=np.int64), np.ones(m)


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


def metered_bus(network: Network, position: npt.ArrayLike, side: npt.ArrayLike) -> IntArray:
    position, side = np.atleast_1d(position), np.atleast_1d(side)
    metered = np.array(position, dtype=np.int64)
    for end, buses in ((FROM, network.branches.from_bus), (TO, network.branches.to_bus)):
        metered[side == end] = buses[position[side == end]]
    return metered if metered.size != 1 else metered[0]


class Terminals:
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
        self.metered = np.atleast_1d(metered_bus(network, position, side))
        self.entry_row = np.repeat(np.arange(len(places)), np.diff(self.y.indptr))
        self.entry_col = self.y.indices.astype(np.int64)
        own = np.flatnonzero(self.entry_col == self.metered[self.entry_row])
        self.own_entry = own  # one per terminal, in order, because rows store their metered bus
