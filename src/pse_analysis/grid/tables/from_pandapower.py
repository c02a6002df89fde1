"""Make the tables of the grid library from pandapower's copies of the IEEE and Baran-Wu grids.

Run once by a developer: ``python src/pse_analysis/grid/tables/from_pandapower.py``. pandapower
solves each grid, and its internal per-unit tables are written down with the literature's numbers.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pandapower
import pandapower.networks
import pandas as pd

HERE = Path(__file__).parent
GRIDS = {
    "ieee14": "case14",
    "ieee30": "case_ieee30",
    "ieee33": "case33bw",
    "ieee118": "case118",
}
# Columns of pandapower's internal tables, which follow MATPOWER's case format.
BUS_TYPE, GS, BS, BASE_KV = 1, 4, 5, 9
F_BUS, T_BUS, BR_R, BR_X, BR_B, TAP, SHIFT, BR_STATUS = 0, 1, 2, 3, 4, 8, 9, 10
BR_G = 23


def tables(grid: str, function: str) -> dict[str, pd.DataFrame]:
    """Library tables of one grid."""
    net = getattr(pandapower.networks, function)()
    pandapower.runpp(net, tolerance_mva=1e-10, numba=False)
    inner = net._ppc
    bus, branch = inner["bus"].real, inner["branch"].real
    base = float(inner["baseMVA"])
    order = net._pd2ppc_lookups["bus"][net.bus.index.to_numpy()]
    number = np.arange(1, len(order) + 1)
    of_row = np.empty(len(order), dtype=int)
    of_row[order] = number
    n = len(order)

    def per_bus(frame: pd.DataFrame, column: str, start: float = 0.0) -> np.ndarray:
        values = np.full(n, start)
        closed = frame[frame.in_service]
        positions = net.bus.index.get_indexer(closed.bus)
        np.add.at(values, positions, closed[column].to_numpy(dtype=float))
        return values

    vm_set = np.ones(n)
    q_min, q_max = np.full(n, -np.inf), np.full(n, np.inf)
    for frame in (net.gen, net.ext_grid):
        at = net.bus.index.get_indexer(frame.bus)
        vm_set[at] = frame.vm_pu
        for target, column in ((q_min, "min_q_mvar"), (q_max, "max_q_mvar")):
            if column in frame:
                limit = frame[column].to_numpy(dtype=float)
                target[at] = np.where(np.isnan(limit), target[at], limit)
    slack = net.bus.index.get_indexer(net.ext_grid.bus)
    buses = pd.DataFrame(
        {
            "name": number,
            "kind": bus[order, BUS_TYPE].astype(int),
            "vn_kv": bus[order, BASE_KV],
            "p_load_mw": per_bus(net.load, "p_mw") - per_bus(net.sgen, "p_mw"),
            "q_load_mvar": per_bus(net.load, "q_mvar") - per_bus(net.sgen, "q_mvar"),
            "p_gen_mw": per_bus(net.gen, "p_mw"),
            "vm_set_pu": vm_set,
            "q_min_mvar": q_min,
            "q_max_mvar": q_max,
            "g_shunt_pu": bus[order, GS] / base,
            "b_shunt_pu": bus[order, BS] / base,
        }
    )
    # The slack's share of generation is a result, kept so that the nominal injections balance.
    buses.loc[slack, "p_gen_mw"] += net.res_ext_grid.p_mw.to_numpy()
    ends = of_row[branch[:, [F_BUS, T_BUS]].astype(int)]
    names: list[str] = []
    for f, t in ends:
        copies = sum(existing.split("#")[0] == f"{f}-{t}" for existing in names)
        names.append(f"{f}-{t}" if copies == 0 else f"{f}-{t}#{copies + 1}")
    branches = pd.DataFrame(
        {
            "name": names,
            "from_bus": ends[:, 0],
            "to_bus": ends[:, 1],
            "r_pu": branch[:, BR_R],
            "x_pu": branch[:, BR_X],
            "g_pu": branch[:, BR_G],
            "b_pu": branch[:, BR_B],
            "tap": np.where(branch[:, TAP] == 0, 1.0, branch[:, TAP]),
            "shift_rad": np.deg2rad(branch[:, SHIFT]),
            "in_service": branch[:, BR_STATUS].astype(bool),
        }
    )
    network = pd.DataFrame({"name": [grid], "base_mva": [base]})
    return {"network": network, "buses": buses, "branches": branches}


def main() -> None:
    """Write every grid's tables beside this file."""
    logging.basicConfig(level=logging.INFO)
    for grid, function in GRIDS.items():
        folder = HERE / grid
        folder.mkdir(exist_ok=True)
        for table, frame in tables(grid, function).items():
            frame.to_csv(folder / f"{table}.csv", index=False, float_format="%.15g")
        logging.info("wrote %s", folder)


if __name__ == "__main__":
    main()
