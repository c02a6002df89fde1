"""Sections: signed lists of branch ends whose summed power is what a limit is about."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import GridError, ParameterError
from pse_analysis.grid.network import Network
from pse_analysis.grid.topology import connections
from pse_analysis.measurement import FROM, TO, MeasurementModel, P, SensorLayout


@dataclass(frozen=True)
class BranchEnd:
    """A metered end of a branch, and the sign with which its power counts.

    Attributes
    ----------
    branch : str
    side : str
        ``from`` or ``to``.
    sign : int
        +1 where power from the sending area flows into the branch at this end, -1 where the end
        lies in the receiving area.
    """

    branch: str
    side: str = "from"
    sign: int = 1

    def __post_init__(self) -> None:
        if self.side not in ("from", "to") or self.sign not in (1, -1):
            raise ParameterError(
                f"section: branch {self.branch!r} needs side 'from' or 'to' and sign +1 or -1, "
                f"received {self.side!r} and {self.sign!r}"
            )


@dataclass(frozen=True)
class Section:
    """A cut through a grid, as the branch ends that are metered along it.

    Attributes
    ----------
    name : str
    ends : tuple of BranchEnd
    """

    name: str
    ends: tuple[BranchEnd, ...]

    @classmethod
    def around(cls, network: Network, name: str, sending: Iterable[str]) -> Section:
        """Returns the section that separates some buses from the rest, metered at their side.

        Parameters
        ----------
        network : Network
        name : str
        sending : iterable of str
            Buses of the sending area.

        Raises
        ------
        GridError
            If no branch leaves them.
        """
        inside = np.zeros(network.n_bus, dtype=bool)
        inside[[network.bus(bus) for bus in sending]] = True
        branch = network.branches
        ends = []
        for k in np.flatnonzero(inside[branch.from_bus] != inside[branch.to_bus]):
            side = "from" if inside[branch.from_bus[k]] else "to"
            ends.append(BranchEnd(branch.name[k], side))
        if not ends:
            raise GridError(
                f"section {name!r}: no branch leaves the {int(inside.sum())} buses of the sending "
                "area: name some of the grid's buses, not none or all of them"
            )
        return cls(name, tuple(ends))

    def positions(self, network: Network) -> IntArray:
        """Positions of the branches. (n_end,)"""
        return np.array([network.branch(end.branch) for end in self.ends], dtype=np.int64)

    def sending(self, network: Network) -> BoolArray:
        """Returns the buses on the sending side, which the section must cut off. (N,)

        Raises
        ------
        GridError
            If the section is empty, repeats a branch, leaves a path between its two sides, or has
            signs that contradict each other.
        """
        if not self.ends:
            raise GridError(
                f"section {self.name!r} has no branch ends: list those of every branch that joins "
                "the two areas, or use Section.around"
            )
        names = [end.branch for end in self.ends]
        if len(set(names)) < len(names):
            again = next(n for n in names if names.count(n) > 1)
            raise GridError(
                f"section {self.name!r}: branch {again!r} is listed more than once: list one end "
                "of each branch"
            )
        position, branch = self.positions(network), network.branches
        at_from = np.array([(end.side == "from") == (end.sign > 0) for end in self.ends])
        sources = np.where(at_from, branch.from_bus[position], branch.to_bus[position])
        sinks = np.where(at_from, branch.to_bus[position], branch.from_bus[position])
        closed = branch.in_service.copy()
        closed[position] = False
        rest = replace(network, branches=replace(branch, in_service=closed))
        part = rest.islands()
        for source, sink, name in zip(sources, sinks, names, strict=True):
            if part[source] == part[sink]:
                raise GridError(
                    f"section {self.name!r} is no cut: with all its branches open the ends of "
                    f"{name!r} still hang together ({_path(rest, int(source), int(sink))}): add "
                    "the branches that join the two areas, or use Section.around"
                )
        both = np.intersect1d(part[sources], part[sinks])
        if len(both):
            bus = network.buses.name[int(np.flatnonzero(part == both[0])[0])]
            raise GridError(
                f"section {self.name!r}: signs contradict each other: the area of bus {bus!r} "
                "sends over one branch and receives over another; an end in the sending area "
                "counts +1, one in the receiving area -1"
            )
        return np.isin(part, part[sources])


class SectionPower:
    """The power through a section as a function of the state.

    Parameters
    ----------
    network : Network
        May have branches of the section open; these carry nothing.
    section : Section
    """

    def __init__(self, network: Network, section: Section) -> None:
        position = section.positions(network)
        from_side = np.array([end.side == "from" for end in section.ends])
        sign = np.array([end.sign for end in section.ends], dtype=float)
        self.model = MeasurementModel(
            network,
            SensorLayout.of(network, (P, position[from_side], FROM), (P, position[~from_side], TO)),
        )
        self.weight = np.concatenate([sign[from_side], sign[~from_side]]) * network.base_mva

    def power_mw(self, x: FloatArray) -> FloatArray:
        """Power of one or many states, (2N,) or (2N, k). (), (k,) [MW]"""
        return np.asarray(self.weight @ self.model.h(x))

    def gradient(self, y: FloatArray) -> FloatArray:
        """Returns the derivative by the unknowns of a loaded grid. (2N + 2,) [MW]"""
        return np.append(self.weight @ self.model.jacobian(y[:-2]), [0.0, 0.0])


def _path(network: Network, begin: int, end: int) -> str:
    """A shortest path between two buses, as text."""
    _, before = sparse.csgraph.breadth_first_order(connections(network), begin, directed=False)
    path = [end]
    while path[-1] != begin:
        path.append(int(before[path[-1]]))
    names = [network.buses.name[bus] for bus in reversed(path)]
    return "over " + " – ".join(names if len(names) <= 8 else [*names[:4], "…", *names[-3:]])
