"""Make the tables of ieee57 and ieee300 from MATPOWER's case files, which keep IEEE's branch ends.

Run once by a developer: ``python src/pse_analysis/grid/tables/from_matpower.py <data folder>``,
where the folder holds ``case57.m`` and ``case300.m``.
"""

from __future__ import annotations

import argparse
import logging
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.grid.network import Network

HERE = Path(__file__).parent
GRIDS = {"ieee57": "case57", "ieee300": "case300"}
# IEEE's own file has this phase shifter, type 4 in its branch data; the conversion lost its angle.
SHIFTERS = {("ieee300", 196, 2040): -11.4}
# The archive names no voltages for the 57 buses; its stations stood in a 138 kV grid.
UNSTATED_KV = 138.0


def _rows(text: str, table: str) -> npt.NDArray[np.float64]:
    found = re.search(rf"mpc\.{table}\s*=\s*\[(.*?)\];", text, re.DOTALL)
    if found is None:
        raise ValueError(f"expected a table mpc.{table}")
    lines = (line.split("%")[0].replace(";", " ").split() for line in found[1].splitlines())
    return np.array([[float(value) for value in line] for line in lines if line])


def network(text: str, grid: str) -> Network:
    """The grid of a case file's text."""
    bus, gen, branch = (_rows(text, table) for table in ("bus", "gen", "branch"))
    stated = re.search(r"mpc\.baseMVA\s*=\s*([\d.]+)", text)
    if stated is None:
        raise ValueError("expected mpc.baseMVA")
    base = float(stated[1])
    number = bus[:, 0].astype(int)
    at = pd.Index(number).get_indexer(gen[:, 0].astype(int))
    p_gen = np.zeros(len(bus))
    vm_set, q_min, q_max = np.ones(len(bus)), p_gen - np.inf, p_gen + np.inf
    p_gen[at], q_max[at], q_min[at], vm_set[at] = gen[:, [1, 3, 4, 5]].T
    ends = branch[:, :2].astype(int)
    shift = [branch[k, 9] + SHIFTERS.get((grid, *ends[k]), 0.0) for k in range(len(branch))]
    return Network.from_tables(
        pd.DataFrame({"name": [grid], "base_mva": [base]}),
        pd.DataFrame(
            {
                "name": number.astype(str),
                "kind": bus[:, 1].astype(int),
                "vn_kv": np.where(bus[:, 9] == 0, UNSTATED_KV, bus[:, 9]),
                "p_load_mw": bus[:, 2],
                "q_load_mvar": bus[:, 3],
                "p_gen_mw": p_gen,
                "vm_set_pu": vm_set,
                "q_min_mvar": q_min,
                "q_max_mvar": q_max,
                "g_shunt_pu": bus[:, 4] / base,
                "b_shunt_pu": bus[:, 5] / base,
            }
        ),
        pd.DataFrame(
            {
                "from_bus": ends[:, 0].astype(str),
                "to_bus": ends[:, 1].astype(str),
                "r_pu": branch[:, 2],
                "x_pu": branch[:, 3],
                "g_pu": 0.0,
                "b_pu": branch[:, 4],
                "tap": np.where(branch[:, 8] == 0, 1.0, branch[:, 8]),
                "shift_rad": np.deg2rad(shift),
                "in_service": branch[:, 10] > 0,
            }
        ),
    )


def main() -> None:
    """Write both grids' tables beside this file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder with case57.m and case300.m")
    data = parser.parse_args().data
    logging.basicConfig(level=logging.INFO)
    for grid, case in GRIDS.items():
        folder = HERE / grid
        folder.mkdir(exist_ok=True)
        text = (data / f"{case}.m").read_text(encoding="utf-8")
        for table, frame in network(text, grid).to_tables().items():
            frame.to_csv(folder / f"{table}.csv", index=False, float_format="%.15g")
        logging.info("wrote %s", folder)


if __name__ == "__main__":
    main()
