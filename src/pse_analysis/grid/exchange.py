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
_TYPE, _PD, _QD, _GS, _BS, _BASE_KV = 1, 2, 3, 4, 5, 9
_FROM, _TO, _R, _X, _B, _TAP, _SHIFT, _STATUS, _G = 0, 1, 2, 3, 4, 8, 9, 10, 23
_ASYMMETRIC = (21, 22, 24, 25)
_ISOLATED = 4
# Elements without a counterpart here, where any of them is in service.
_FOREIGN = (
    "trafo3w", "xward", "dcline", "svc", "ssc", "tcsc", "vsc", "vsc_stacked", "vsc_bipolar",
    "line_dc", "load_dc", "source_dc",
)  # fmt: skip


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
        What draws or feeds constant power at a bus (loads, static generators, storage, motors,
        wards, the three phases of an asymmetric load) is summed there as `runpp` does; constant
        impedances (shunts, those of wards, such shares of loads) are shunts. Branches are in the
        order of pandapower's own branch table: lines, then transformers. The slack's generation is
        what ``runpp`` finds, so that the nominal injections balance.

    Raises
    ------
    GridError
        If ``runpp`` fails, or the net has what has no counterpart here: buses that are joined by a
        closed switch, out of service or isolated, several slack buses or one that is turned, an
        asymmetric branch, loads of constant current, three-winding transformers, extended wards,
        direct current or power electronics.
    """
    import pandapower

    labels = [str(b) for b in (net.bus.index if bus_names is None else bus_names)]
    n = len(net.bus)
    if len(labels) != n:
        raise GridError(
            f"{name}: expected {n} bus_names, one for each row of net.bus, received {len(labels)}"
        )
    _refuse_foreign(net, name)
    try:
        pandapower.runpp(net, tolerance_mva=1e-10, numba=False)
    except Exception as error:
        raise GridError(
            f"{name}: pandapower does not solve the net ({error}): mend it until "
            "pandapower.runpp(net) converges"
        ) from error
    inner = net._ppc
    bus, branch, base = inner["bus"].real, inner["branch"].real, float(inner["baseMVA"])
    order = net._pd2ppc_lookups["bus"][net.bus.index.to_numpy()]
    _refuse_merged(net, name, labels, order, bus)
    if (np.abs(branch[:, _ASYMMETRIC]) > 0).any():
        raise GridError(f"{name}: a branch has other values at its two ends: expected a π-model")
    label = np.empty(n, dtype=object)
    label[order] = labels

    def per_bus(frame: pd.DataFrame, values: Any) -> npt.NDArray[np.float64]:
        closed = frame.in_service.to_numpy(dtype=bool)
        sums = np.zeros(n)
        at = net.bus.index.get_indexer(frame.bus[closed])
        np.add.at(sums, at, np.asarray(values * frame.get("scaling", 1.0))[closed])
        return sums

    vm_set, q_min, q_max = np.ones(n), np.full(n, -np.inf), np.full(n, np.inf)
    for frame in (net.gen[net.gen.in_service], net.ext_grid[net.ext_grid.in_service]):
        at = net.bus.index.get_indexer(frame.bus)
        vm_set[at] = frame.vm_pu
        for target, column in ((q_min, "min_q_mvar"), (q_max, "max_q_mvar")):
            if column in frame:
                limit = frame[column].to_numpy(dtype=float)
                target[at] = np.where(np.isnan(limit), target[at], limit)
    load = net.load
    g_load = per_bus(load, load.p_mw * load.get("const_z_p_percent", 0.0) / 100.0)
    b_load = per_bus(load, load.q_mvar * load.get("const_z_q_percent", 0.0) / 100.0)
    buses = pd.DataFrame(
        {
            "name": labels,
            "kind": bus[order, _TYPE].astype(int),
            "vn_kv": bus[order, _BASE_KV],
            "p_load_mw": bus[order, _PD] - g_load,
            "q_load_mvar": bus[order, _QD] - b_load,
            "p_gen_mw": per_bus(net.gen, net.gen.p_mw),
            "vm_set_pu": vm_set,
            "q_min_mvar": q_min,
            "q_max_mvar": q_max,
            "g_shunt_pu": (bus[order, _GS] + g_load) / base,
            "b_shunt_pu": (bus[order, _BS] - b_load) / base,
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


def _refuse_foreign(net: Any, name: str) -> None:
    """Refuse what pandapower models and a `Network` does not."""
    for table in _FOREIGN:
        frame = net.get(table)
        if frame is not None and len(frame) and frame.get("in_service", pd.Series(True)).any():
            raise GridError(
                f"{name}: {len(frame)} rows of net.{table} have no counterpart: put their powers "
                "into net.load, or split them into lines and two-winding transformers"
            )
    current = [c for c in net.load if c.startswith("const_i")]
    if (net.load[current] != 0).any(axis=None):
        raise GridError(
            f"{name}: loads of constant current ({', '.join(current)}) have no counterpart: "
            "share them between constant power and constant impedance"
        )
    feeding = net.ext_grid[net.ext_grid.in_service]
    if feeding.bus.nunique() > 1:
        raise GridError(
            f"{name}: expected one slack bus, received ext_grid at buses "
            f"{', '.join(map(str, feeding.bus.unique()))}: make all but one of them gen"
        )
    if (feeding.va_degree != 0).any():
        raise GridError(
            f"{name}: ext_grid.va_degree must be 0, since angles count from the slack here; "
            f"received {feeding.va_degree.iloc[0]:g}: set it to 0 and turn measured angles by it"
        )


def _refuse_merged(
    net: Any,
    name: str,
    labels: Sequence[str],
    order: npt.NDArray[np.int64],
    bus: npt.NDArray[np.float64],
) -> None:
    """Refuse buses that pandapower's power flow merges, adds or leaves out."""
    n = len(order)
    off = [b for b, closed in zip(labels, net.bus.in_service, strict=True) if not closed]
    off += [b for b, at in zip(labels, order, strict=True) if bus[at, _TYPE] == _ISOLATED]
    if off:
        raise GridError(
            f"{name}: buses without supply: {', '.join(dict.fromkeys(off))}; drop them from the "
            "net, e.g. with pandapower.drop_buses"
        )
    joined = [b for b, at in zip(labels, order, strict=True) if (order == at).sum() > 1]
    if joined:
        raise GridError(
            f"{name}: closed switches join the buses {', '.join(joined)}: merge them, e.g. with "
            "pandapower.fuse_buses"
        )
    if len(bus) != n:
        raise GridError(
            f"{name}: {len(bus) - n} open ends of branches become buses in power flow: take those "
            "branches out of service, or give each open end a bus"
        )
