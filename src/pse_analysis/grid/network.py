"""An immutable grid model with its admittance matrices.

Branches are π-models with a complex tap at the *from* end, as in MATPOWER:

    [I_f]   [(y + y_c/2)/t²        -y/(t e^{-jφ})] [V_f]
    [I_t] = [-y/(t e^{jφ})          y + y_c/2    ] [V_t],    y = 1/(r + jx),  y_c = g + jb

All impedances are in per unit on the system base. Bus shunts are constant admittances and belong to
Y-bus, so an injection never includes them.
"""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import sparse

from pse_analysis.arrays import ComplexArray, FloatArray, IntArray
from pse_analysis.errors import GridError
from pse_analysis.grid import topology
from pse_analysis.grid.elements import Branches, Buses, BusKind, freeze
from pse_analysis.grid.plausibility import check_plausible
from pse_analysis.grid.reading import read_tables

BASE_MVA = (1e-6, 1e9)
"""Base powers from that of a toy to that of all grids together. [MVA]"""


@dataclass(frozen=True, eq=False)
class Network:
    """A balanced grid in per unit; every change returns a new one.

    Parameters
    ----------
    name
        For messages and figures.
    base_mva
        Three-phase base power. [MVA]
    buses, branches
        The tables.

    Raises
    ------
    GridError
        On repeated names, an end bus that does not exist, a zero series impedance, a value that is
        not finite or cannot be in its unit (`pse_analysis.grid.plausibility`), or anything but one
        slack bus.
    """

    name: str
    base_mva: float
    buses: Buses
    branches: Branches

    def __post_init__(self) -> None:
        freeze(self.buses)
        freeze(self.branches)
        bus, branch = self.buses, self.branches
        if not BASE_MVA[0] <= self.base_mva <= BASE_MVA[1]:
            raise GridError(
                f"{self.name}: base_mva must be positive and finite, received {self.base_mva}; "
                f"expected {BASE_MVA[0]:g} … {BASE_MVA[1]:g} MVA"
            )
        for table, names in (("buses", bus.name), ("branches", branch.name)):
            if len(set(names)) != len(names):
                repeated = next(n for n in names if names.count(n) > 1)
                raise GridError(
                    f"{self.name}: {table} must have distinct names, {repeated!r} repeats"
                )
        ends = np.concatenate([branch.from_bus, branch.to_bus])
        if ends.size and (ends.min() < 0 or ends.max() >= self.n_bus):
            raise GridError(
                f"{self.name}: branch ends must lie in 0…{self.n_bus - 1}, received "
                f"{ends.min()}…{ends.max()}"
            )
        loops = branch.from_bus == branch.to_bus
        if loops.any():
            culprit = branch.name[int(np.argmax(loops))]
            raise GridError(
                f"{self.name}: branch {culprit!r} ends at the bus where it begins: leave it out, "
                "or mend its ends"
            )
        check_plausible(self.name, bus, branch)
        slacks = int((bus.kind == BusKind.SLACK).sum())
        if slacks != 1:
            raise GridError(f"{self.name}: expected one slack bus, received {slacks}")

    # ------------------------------------------------------------------------------- look-ups

    @property
    def n_bus(self) -> int:
        """Number of buses, N."""
        return len(self.buses.name)

    @property
    def n_branch(self) -> int:
        """Number of branches, in service or not."""
        return len(self.branches.name)

    @property
    def slack(self) -> int:
        """Position of the slack bus."""
        return int(np.argmax(self.buses.kind == BusKind.SLACK))

    @cached_property
    def _bus_position(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.buses.name)}

    @cached_property
    def _branch_position(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.branches.name)}

    def bus(self, name: str) -> int:
        """Position of a bus.

        Raises
        ------
        GridError
            With the closest names, if there is none.
        """
        return self._position("bus", name, self._bus_position)

    def branch(self, name: str) -> int:
        """Position of a branch.

        Raises
        ------
        GridError
            With the closest names, if there is none.
        """
        return self._position("branch", name, self._branch_position)

    def _position(self, kind: str, name: str, position: dict[str, int]) -> int:
        if name in position:
            return position[name]
        close = difflib.get_close_matches(str(name), position, n=3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"it has {len(position)} of them"
        raise GridError(f"{self.name} has no {kind} {name!r}: {hint}")

    # ----------------------------------------------------------------------------- admittance

    @cached_property
    def base_ka(self) -> FloatArray:
        """Base current of each bus. [kA], (n_bus,)"""
        return np.asarray(self.base_mva / (np.sqrt(3.0) * self.buses.vn_kv))

    @cached_property
    def _two_port(self) -> tuple[ComplexArray, ...]:
        """Entries (ff, ft, tf, tt) of each branch; zero where it is out of service."""
        b = self.branches
        closed = b.in_service
        impedance = np.where(closed, b.r_pu + 1j * b.x_pu, 1.0)
        series = np.where(closed, 1.0 / impedance, 0.0)
        half = np.where(closed, 0.5 * (b.g_pu + 1j * b.b_pu), 0.0)
        tap = b.tap * np.exp(1j * b.shift_rad)
        own = series + half
        entries = (own / b.tap**2, -series / tap.conj(), -series / tap, own)
        return tuple(np.asarray(entry, dtype=np.complex128) for entry in entries)

    def _end_matrix(self, at_from: ComplexArray, at_to: ComplexArray) -> sparse.csr_array:
        rows = np.arange(self.n_branch)
        return sparse.csr_array(
            (
                np.concatenate([at_from, at_to]),
                (
                    np.concatenate([rows, rows]),
                    np.concatenate([self.branches.from_bus, self.branches.to_bus]),
                ),
            ),
            shape=(self.n_branch, self.n_bus),
        )

    @cached_property
    def y_from(self) -> sparse.csr_array:
        """Current into each branch at its from end is ``y_from @ V``. (n_branch, n_bus) [p.u.]"""
        ff, ft, _, _ = self._two_port
        return self._end_matrix(ff, ft)

    @cached_property
    def y_to(self) -> sparse.csr_array:
        """Current into each branch at its to end is ``y_to @ V``. (n_branch, n_bus) [p.u.]"""
        _, _, tf, tt = self._two_port
        return self._end_matrix(tf, tt)

    @cached_property
    def y_bus(self) -> sparse.csr_array:
        """Injected current is ``y_bus @ V``, every diagonal stored. (n_bus, n_bus) [p.u.]"""
        ff, ft, tf, tt = self._two_port
        f, t = self.branches.from_bus, self.branches.to_bus
        own = np.arange(self.n_bus)
        shunt = self.buses.g_shunt_pu + 1j * self.buses.b_shunt_pu
        matrix = sparse.coo_array(
            (
                np.concatenate([ff, ft, tf, tt, shunt]),
                (np.concatenate([f, f, t, t, own]), np.concatenate([f, t, f, t, own])),
            ),
            shape=(self.n_bus, self.n_bus),
        ).tocsr()
        matrix.sum_duplicates()
        return matrix

    @property
    def p_nominal_pu(self) -> FloatArray:
        """Nominal net injection, generation minus load. (n_bus,) [p.u.]"""
        return np.asarray((self.buses.p_gen_mw - self.buses.p_load_mw) / self.base_mva)

    @property
    def q_nominal_pu(self) -> FloatArray:
        """Nominal net reactive injection of the loads. (n_bus,) [p.u.]"""
        return np.asarray(-self.buses.q_load_mvar / self.base_mva)

    # -------------------------------------------------------------------------------- topology

    def open_branch(self, name: str) -> Network:
        """The same grid with one branch out of service."""
        in_service = self.branches.in_service.copy()
        in_service[self.branch(name)] = False
        return dataclasses.replace(
            self, branches=dataclasses.replace(self.branches, in_service=in_service)
        )

    @cached_property
    def resting_angle_rad(self) -> FloatArray:
        """Angles without load: what phase shifters turn a bus. (n_bus,) [rad]

        They count from the reference of its island; around a loop shifts may disagree.
        """
        return topology.resting_angles(self)

    def islands(self) -> npt.NDArray[np.int32]:
        """Label of the connected component of each bus. (n_bus,)"""
        return topology.islands(self)

    @cached_property
    def references(self) -> IntArray:
        """Bus that stands for the angle of each bus's island, the slack in its own. (n_bus,)"""
        return topology.references(self)

    # ---------------------------------------------------------------------------------- tables

    def to_tables(self) -> dict[str, pd.DataFrame]:
        """The grid as tables ``network``, ``buses`` and ``branches``; branch ends by name."""
        buses = pd.DataFrame(
            {f.name: getattr(self.buses, f.name) for f in dataclasses.fields(Buses)}
        )
        branches = pd.DataFrame(
            {f.name: getattr(self.branches, f.name) for f in dataclasses.fields(Branches)}
        )
        for end in ("from_bus", "to_bus"):
            branches[end] = [self.buses.name[i] for i in branches[end]]
        network = pd.DataFrame({"name": [self.name], "base_mva": [float(self.base_mva)]})
        return {"network": network, "buses": buses, "branches": branches}

    @classmethod
    def from_tables(
        cls, network: pd.DataFrame, buses: pd.DataFrame, branches: pd.DataFrame
    ) -> Network:
        """The grid from the tables that `to_tables` describes.

        Parameters
        ----------
        network : DataFrame
            One row: ``name`` and ``base_mva``.
        buses : DataFrame
            ``name``, ``kind`` and ``vn_kv``; other columns of `Buses` where they are not what
            `OPTIONAL` says.
        branches : DataFrame
            ``from_bus`` and ``to_bus`` by name, ``r_pu`` and ``x_pu``; other columns of `Branches`
            likewise. Without ``name`` branches are called ``from-to``, parallel ones ``from-to#2``.

        Raises
        ------
        GridError
            On a missing or misspelt column, a value that is no number, or a branch that ends at an
            unknown bus.
        """
        return cls(*read_tables(network, buses, branches))
