"""Make the tables of the grid library from pandapower's copies of the IEEE and Baran-Wu grids.

Run once by a developer: ``python src/pse_analysis/grid/tables/from_pandapower.py``. Buses get the
literature's numbers, which start at 1.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pandapower
import pandapower.networks

from pse_analysis.grid.exchange import from_pandapower

HERE = Path(__file__).parent
GRIDS = {
    "ieee14": "case14",
    "ieee30": "case_ieee30",
    "ieee33": "case33bw",
    "ieee118": "case118",
}
# IEEE's r, x and b [p.u.] of the branches that pandapower's copy of the 118 buses made
# transformers, whose charging can only be inductive there.
CHARGED = {
    (65, 68): (0.00138, 0.016, 0.638),
    (68, 81): (0.00175, 0.0202, 0.808),
    (86, 87): (0.02828, 0.2074, 0.0445),
    (68, 116): (0.00034, 0.00405, 0.164),
}
# Rated voltages [kV] by MATPOWER 8.1; with the copy's 161 and 345 two lines became transformers.
RATED = {68: 345.0, 116: 138.0}


def net_of(grid: str) -> Any:
    """Pandapower's net of a grid, with the faults mended that its copy has."""
    net = getattr(pandapower.networks, GRIDS[grid])()
    if grid == "ieee118":
        _mend_charging(net)
    return net


def _mend_charging(net: Any) -> None:
    """Put lines, which keep capacitive charging, where the transformers of ``CHARGED`` stood."""
    at = {int(name): index for index, name in net.bus.name.items()}
    sides = list(zip(net.trafo.hv_bus, net.trafo.lv_bus, strict=True))
    pairs = [{at[f], at[t]} for f, t in CHARGED]
    net.trafo = net.trafo.drop(index=net.trafo.index[[set(side) in pairs for side in sides]])
    net.trafo = net.trafo.reset_index(drop=True)
    for number, kv in RATED.items():
        net.bus.loc[at[number], "vn_kv"] = kv
        net.trafo.loc[net.trafo.hv_bus == at[number], "vn_hv_kv"] = kv
    for (start, end), (r, x, b) in CHARGED.items():
        ohm = net.bus.vn_kv[at[start]] ** 2 / net.sn_mva
        pandapower.create_line_from_parameters(
            net,
            at[start],
            at[end],
            length_km=1.0,
            r_ohm_per_km=r * ohm,
            x_ohm_per_km=x * ohm,
            c_nf_per_km=b / ohm / (2 * np.pi * net.f_hz) * 1e9,
            max_i_ka=99999.0,
        )


def main() -> None:
    """Write every grid's tables beside this file."""
    logging.basicConfig(level=logging.INFO)
    for grid in GRIDS:
        net = net_of(grid)
        numbers = [str(i + 1) for i in range(len(net.bus))]
        network = from_pandapower(net, name=grid, bus_names=numbers)
        folder = HERE / grid
        folder.mkdir(exist_ok=True)
        for table, frame in network.to_tables().items():
            frame.to_csv(folder / f"{table}.csv", index=False, float_format="%.15g")
        logging.info("wrote %s", folder)


if __name__ == "__main__":
    main()
