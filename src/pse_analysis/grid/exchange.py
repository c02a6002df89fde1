"""Grids of other tools, translated at the door.

Needs the extra ``pse-analysis[grids]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.errors import GridError
from pse_analysis.grid.network import Network

# Columns of pandapower's internal per-unit tables, which follow MATPOWER's case format.
_TYPE, _GS, _BS, _BASE_KV = 1, 4, 5, 9
_FROM, _TO, _R, _X, _B, _TAP, _SHIFT, _STATUS, _G = 0, 1, 2, 3, 4, 8, 9, 10, 23
_ASYMMETRIC = (21, 22, 24, 25)


def from_pandapower(net: Any, *, name: str, bus_names: Sequence[str] | None = None) -> Network:
    """Network of a balanced pandapower net.

    Parameters
    ----------
    net : pandapowerNet
        It is solved here with ``runpp``, which makes pandapower's per-unit tables.
    name : str
        Name of the result.
    bus_names : sequence of str, optional
        A name for each row of ``net.bus``; its index by default.

    Returns
    -------
    Network
        Loads and static generators are summed at their buses, branches are in the order of lines,
        then transformers. The slack's generation is what ``runpp`` finds, so that the nominal
        injections balance.

    Raises
    ------
    GridError
        If the net has buses that are joined by a closed switch or out of service, an asymmetric
        branch, or a three-winding transformer, none of which has a counterpart here.
    """
    import pandapower

    if len(net.trafo3w):
        raise GridError(f"{name}: three-winding transformers have no counterpart: split them")
    pandapower.runpp(net, tolerance_mva=1e-10, numba=False)
    inner = net._ppc
    bus, branch, base = inner["bus"].real, inner["branch"].real, float(inner["baseMVA"])
    order = net._pd2ppc_lookups["bus"][net.bus.index.to_numpy()]
    n = len(net.bus)
    if len(bus) != n or len(np.unique(order)) != n:
        raise GridError(
            f"{name}: {n} buses became {len(bus)} in power flow: merge the buses that closed "
            "switches join, split open ends off, and drop buses that are out of service"
        )
    if (np.abs(branch[:, _ASYMMETRIC]) > 0).any():
        raise GridError(f"{name}: a branch has other values at its two ends: expected a π-model")
    labels = [str(b) for b in (net.bus.index if bus_names is None else bus_names)]
    label = np.empty(n, dtype=object)
    label[order] = labels

    def per_bus(frame: pd.DataFrame, column: str) -> npt.NDArray[np.float64]:
        closed = frame[frame.in_service]
        values = np.zeros(n)
        scaling = closed.get("scaling", 1.0)
        np.add.at(values, net.bus.index.get_indexer(closed.bus), closed[column] * scaling)
        return values

    vm_set, q_min, q_max = np.ones(n), np.full(n, -np.inf), np.full(n, np.inf)
    for frame in (net.gen[net.gen.in_service], net.ext_grid[net.ext_grid.in_service]):
        at = net.bus.index.get_indexer(frame.bus)
        vm_set[at] = frame.vm_pu
        for target, column in ((q_min, "min_q_mvar"), (q_max, "max_q_mvar")):
            if column in frame:
                limit = frame[column].to_numpy(dtype=float)
                target[at] = np.where(np.isnan(limit), target[at], limit)
    buses = pd.DataFrame(
        {
            "name": labels,
            "kind": bus[order, _TYPE].astype(int),
            "vn_kv": bus[order, _BASE_KV],
            "p_load_mw": per_bus(net.load, "p_mw") - per_bus(net.sgen, "p_mw"),
            "q_load_mvar": per_bus(net.load, "q_mvar") - per_bus(net.sgen, "q_mvar"),
            "p_gen_mw": per_bus(net.gen, "p_mw"),
            "vm_set_pu": vm_set,
            "q_min_mvar": q_min,
            "q_max_mvar": q_max,
            "g_shunt_pu": bus[order, _GS] / base,
            "b_shunt_pu": bus[order, _BS] / base,
        }
    )
    slack = net.bus.index.get_indexer(net.ext_grid.bus[net.ext_grid.in_service])
    buses.loc[slack, "p_gen_mw"] += net.res_ext_grid.p_mw[net.ext_grid.in_service].to_numpy()
    branches = pd.DataFrame(
        {
            "from_bus": label[branch[:, _FROM].astype(int)],
            "to_bus": label[branch[:, _TO].astype(int)],
            "r_pu": branch[:, _R],
            "x_pu": branch[:, _X],
            "g_pu": branch[:, _G],
            "b_pu": branch[:, _B],
            "tap": np.where(branch[:, _TAP] == 0, 1.0, branch[:, _TAP]),
            "shift_rad": np.deg2rad(branch[:, _SHIFT]),
            "in_service": branch[:, _STATUS].astype(bool),
        }
    )
    return Network.from_tables(pd.DataFrame({"name": [name], "base_mva": [base]}), buses, branches)
