"""Which buses hang together, which of them stand for the angle, and angles without load."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.grid.elements import BusKind

if TYPE_CHECKING:
    from pse_analysis.grid.network import Network


def connections(network: Network) -> sparse.csr_array:
    """Returns which buses the branches in service connect. (n_bus, n_bus)"""
    branch = network.branches
    closed = branch.in_service
    return sparse.csr_array(
        (np.ones(int(closed.sum())), (branch.from_bus[closed], branch.to_bus[closed])),
        shape=(network.n_bus, network.n_bus),
    )


def islands(network: Network) -> npt.NDArray[np.int32]:
    """Returns the label of the connected component of each bus. (n_bus,)"""
    return np.asarray(sparse.csgraph.connected_components(connections(network), directed=False)[1])


def references(network: Network) -> IntArray:
    """Returns the bus that stands for the angle of each bus's island. (n_bus,)

    It is the slack in the slack's own island, elsewhere the voltage-controlled bus of the largest
    nominal generation, or the first bus where there is none.
    """
    bus, island = network.buses, islands(network)
    rank = np.where(bus.kind == BusKind.SLACK, 2.0, np.where(bus.kind == BusKind.PV, 1.0, 0.0))
    # The last sort key counts most; the first bus of every island then stands for it.
    order = np.lexsort((np.arange(len(island)), -bus.p_gen_mw * (rank == 1.0), -rank, island))
    _, first = np.unique(island[order], return_index=True)
    return np.asarray(order[first][island], dtype=np.int64)


def resting_angles(network: Network) -> FloatArray:
    """Returns the angles without load, which phase shifters turn. (n_bus,) [rad]

    They count from the reference of each island, along one tree of branches in service, and are
    folded into [-π, π); around a loop shifts may disagree.
    """
    branch = network.branches
    angle = np.zeros(network.n_bus)
    if not (branch.in_service & (branch.shift_rad != 0)).any():
        return angle
    # V_from = a e^{jφ} V_to without current.
    shift = {}
    for k in np.flatnonzero(branch.in_service):
        begin, end = int(branch.from_bus[k]), int(branch.to_bus[k])
        shift[begin, end], shift[end, begin] = -branch.shift_rad[k], branch.shift_rad[k]
    linked = connections(network)
    for root in np.unique(references(network)):
        order, before = sparse.csgraph.breadth_first_order(linked, root, directed=False)
        for bus in order[1:]:
            angle[bus] = angle[before[bus]] + shift[int(before[bus]), int(bus)]
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
