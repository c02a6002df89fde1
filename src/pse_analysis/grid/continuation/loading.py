"""Loading vectors: which generation and load change together, and who takes up the losses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import GridError
from pse_analysis.grid.network import Network


class Direction(NamedTuple):
    """A loading vector on the buses of a grid.

    Attributes
    ----------
    p_pu, q_load_pu : (n_bus,) ndarray
        Change of the net active injection and of the reactive load, per unit of loading. [p.u.]
    share : (n_bus,) ndarray
        Part of the imbalance of active power that each bus takes up; they sum to 1.
    """

    p_pu: FloatArray
    q_load_pu: FloatArray
    share: FloatArray


@dataclass(frozen=True)
class Loading:
    """A direction in which generation and load change together; λ counts how many times.

    Attributes
    ----------
    name : str
    p_gen_mw, p_load_mw, q_load_mvar : mapping of str to float
        Changes by bus, for λ = 1. [MW, Mvar]
    balance : mapping of str to float
        Weights with which buses take up what the changes leave open, losses above all (distributed
        slack). By default those buses whose generation rises, in proportion to it, and the slack
        bus where none does.
    """

    name: str
    p_gen_mw: Mapping[str, float] = field(default_factory=dict)
    p_load_mw: Mapping[str, float] = field(default_factory=dict)
    q_load_mvar: Mapping[str, float] = field(default_factory=dict)
    balance: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of_all(
        cls, network: Network, name: str = "all", balance: Mapping[str, float] | None = None
    ) -> Loading:
        """Returns the direction in which every load and generation grows by the same share.

        λ = 0.5 is half as much again, at constant power factor.
        """
        buses = network.buses
        return cls(
            name,
            p_gen_mw=_named(network, buses.p_gen_mw),
            p_load_mw=_named(network, buses.p_load_mw),
            q_load_mvar=_named(network, buses.q_load_mvar),
            balance=dict(balance or {}),
        )

    @classmethod
    def transfer(
        cls,
        network: Network,
        name: str,
        sending: Iterable[str],
        receiving: Iterable[str],
        *,
        reserve_mw: Mapping[str, float] | None = None,
        by_load: bool = False,
    ) -> Loading:
        """Returns the direction that moves 1 MW from the buses of one area to those of another.

        Parameters
        ----------
        network : Network
        name : str
        sending, receiving : iterable of str
            Buses of the two areas.
        reserve_mw : mapping of str to float, optional
            By how much the generation of a sending bus may rise; its share is proportional to it.
            Without it shares follow the nominal generation. [MW]
        by_load : bool
            Let the load of the receiving area rise, at constant power factor, instead of its
            generation falling.

        Raises
        ------
        GridError
            If the sending area has no reserve, or the receiving one nothing that can change.
        """
        from_, to = _members(network, sending), _members(network, receiving)
        both = from_ & to
        if both.any():
            raise GridError(
                f"loading {name!r}: bus {network.buses.name[int(np.argmax(both))]!r} is in the "
                "sending and in the receiving area: put it in one of them"
            )
        if reserve_mw is None:
            reserve, source = network.buses.p_gen_mw, "generation"
        else:
            reserve, source = _values(network, name, "reserve_mw", reserve_mw), "reserve"
        rise = np.where(from_, np.maximum(reserve, 0.0), 0.0)
        if rise.sum() <= 0:
            raise GridError(
                f"loading {name!r}: the sending area ({int(from_.sum())} buses) has no {source} "
                "that could rise: give reserve_mw for its generators, add buses that generate, or "
                "write p_gen_mw of a Loading by hand"
            )
        raised = _named(network, rise / rise.sum())
        buses = network.buses
        fall = np.where(to, np.maximum(buses.p_load_mw if by_load else buses.p_gen_mw, 0.0), 0.0)
        total = fall.sum()
        if total <= 0:
            what, instead = ("load", "by_load=False") if by_load else ("generation", "by_load=True")
            raise GridError(
                f"loading {name!r}: the receiving area ({int(to.sum())} buses) has no {what} that "
                f"could change: add such buses, or give {instead}"
            )
        if not by_load:
            return cls(name, p_gen_mw={**raised, **_named(network, -fall / total)})
        reactive = np.where(to & (fall > 0), buses.q_load_mvar, 0.0)
        return cls(
            name,
            p_gen_mw=raised,
            p_load_mw=_named(network, fall / total),
            q_load_mvar=_named(network, reactive / total),
        )

    def direction(self, network: Network) -> Direction:
        """Returns the loading vector on the buses of a grid.

        Raises
        ------
        GridError
            If nothing changes along it, a bus is not in the grid, or a number is not finite.
        """
        gen, load, reactive, weight = (
            _values(network, self.name, key, getattr(self, key))
            for key in ("p_gen_mw", "p_load_mw", "q_load_mvar", "balance")
        )
        if not (gen.any() or load.any() or reactive.any()):
            raise GridError(
                f"loading {self.name!r} sums to nothing: no bus changes its power along it; give "
                "p_gen_mw, p_load_mw or q_load_mvar, or use Loading.of_all or Loading.transfer"
            )
        if (weight < 0).any():
            at = int(np.argmin(weight))
            raise GridError(
                f"loading {self.name!r}: balance must not be negative, received {weight[at]:g} at "
                f"bus {network.buses.name[at]!r}"
            )
        if not weight.any():
            weight = np.maximum(gen, 0.0)
        if not weight.any():
            weight = np.zeros(network.n_bus)
            weight[network.slack] = 1.0
        base = network.base_mva
        return Direction((gen - load) / base, reactive / base, weight / weight.sum())


def _named(network: Network, values: FloatArray) -> dict[str, float]:
    return {network.buses.name[i]: float(values[i]) for i in np.flatnonzero(values)}


def _members(network: Network, names: Iterable[str]) -> BoolArray:
    inside = np.zeros(network.n_bus, dtype=bool)
    inside[[network.bus(name) for name in names]] = True
    return inside


def _values(network: Network, loading: str, key: str, by_name: Mapping[str, float]) -> FloatArray:
    values = np.zeros(network.n_bus)
    for name, value in by_name.items():
        if not np.isfinite(value):
            raise GridError(
                f"loading {loading!r}: {key} must be finite, received {value} at bus {name!r}"
            )
        values[network.bus(name)] += value
    return values
