"""Make the tables of the grid library from pandapower's copies of the IEEE and Baran-Wu grids.

Run once by a developer: ``python src/pse_analysis/grid/tables/from_pandapower.py``. Buses get the
literature's numbers, which start at 1.
"""

from __future__ import annotations

import logging
from pathlib import Path

import pandapower.networks

from pse_analysis.grid.exchange import from_pandapower

HERE = Path(__file__).parent
GRIDS = {
    "ieee14": "case14",
    "ieee30": "case_ieee30",
    "ieee33": "case33bw",
    "ieee118": "case118",
}


def main() -> None:
    """Write every grid's tables beside this file."""
    logging.basicConfig(level=logging.INFO)
    for grid, function in GRIDS.items():
        net = getattr(pandapower.networks, function)()
        numbers = [str(i + 1) for i in range(len(net.bus))]
        network = from_pandapower(net, name=grid, bus_names=numbers)
        folder = HERE / grid
        folder.mkdir(exist_ok=True)
        for table, frame in network.to_tables().items():
            frame.to_csv(folder / f"{table}.csv", index=False, float_format="%.15g")
        logging.info("wrote %s", folder)


if __name__ == "__main__":
    main()
