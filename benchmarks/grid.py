"""Power flow beside pandapower's Newton, from a flat start, to the same mismatch."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from benchmarks.timing import Row, alternate
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import PowerFlow, solve

SEED = 288
STATES = 288
TOLERANCE = 1e-8  # p.u.


def pandapower_case(grid: str) -> Any:
    """Pandapower's copy of a grid, mended; what it warns of on import is not ours to mend."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pse_analysis.grid.tables.from_pandapower import net_of
    return net_of(grid)


def runpp(net: Any, base_mva: float) -> None:
    """Pandapower's power flow as a user calls it, without numba."""
    import pandapower

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pandapower.runpp(net, init="flat", tolerance_mva=TOLERANCE * base_mva, numba=False)


def one_state() -> Row:
    """Power flow of ieee118."""
    network, net = library.load("ieee118"), pandapower_case("ieee118")
    ours, peer = alternate(
        lambda: solve(network, tolerance=TOLERANCE), lambda: runpp(net, network.base_mva), 9
    )
    difference = np.abs(solve(network).vm - net.res_bus.vm_pu.to_numpy()).max()
    return Row("power flow, ieee118", ours, peer, "pandapower", f"|V| differ by {difference:.0e}")


def many_states() -> Row:
    """A day of the feeder in steps of five minutes."""
    network, net = library.load("ieee33"), pandapower_case("ieee33")
    scale = np.random.default_rng(SEED).uniform(0.3, 1.2, (network.n_bus, STATES))
    p, q = network.p_nominal_pu[:, None] * scale, network.q_nominal_pu[:, None] * scale
    load = net.load[["p_mw", "q_mvar"]].to_numpy()
    found = np.empty((network.n_bus, STATES))

    def ours() -> PowerFlow:
        return solve(network, p, q, tolerance=TOLERANCE)

    def peer() -> None:
        for k in range(STATES):
            net.load[["p_mw", "q_mvar"]] = load * scale[net.load.bus, k, None]
            runpp(net, network.base_mva)
            found[:, k] = net.res_bus.vm_pu

    seconds = alternate(ours, peer, 1)
    difference = np.abs(ours().vm - found).max()
    note = f"one call against {STATES}; |V| differ by {difference:.0e}"
    return Row(f"power flow, {STATES} states of ieee33", *seconds, "pandapower", note)


def run() -> list[Row]:
    """All comparisons of this file."""
    return [one_state(), many_states()]
