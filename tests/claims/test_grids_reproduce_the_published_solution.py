"""Claim: ieee57 and ieee300 have the solution that IEEE prints, and a mended peer copy's."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve

PRINTED = Path(__file__).parents[1] / "grid" / "published"
WRONG_ENDS = {"ieee57": 15, "ieee300": 16}


@pytest.mark.parametrize(
    ("grid", "volt", "degree"), [("ieee57", 1e-3, 0.06), ("ieee300", 4e-4, 0.05)]
)
def test_voltages_are_those_printed_by_ieee(grid: str, volt: float, degree: float) -> None:
    """Both are a few units of the last digit that is printed."""
    network = library.load(grid)
    flow = solve(network)
    printed = pd.read_csv(PRINTED / f"{grid}.csv", dtype={"bus": str}).set_index("bus")
    assert tuple(printed.index) == network.buses.name
    # The row of bus 46, where nothing is injected, contradicts its branches by 46 MW.
    sound = ~((grid == "ieee57") & (printed.index == "46"))
    np.testing.assert_allclose(flow.vm[sound], printed.vm_pu[sound], atol=volt, rtol=0)
    theta = np.rad2deg(flow.theta)
    np.testing.assert_allclose(theta[sound], printed.va_degree[sound], atol=degree, rtol=0)


def test_row_of_bus_46_breaks_its_own_power_balance() -> None:
    network = library.load("ieee57")
    printed = pd.read_csv(PRINTED / "ieee57.csv")
    voltage = (printed.vm_pu * np.exp(1j * np.deg2rad(printed.va_degree))).to_numpy()
    power = voltage * (network.y_bus @ voltage).conj()
    at = network.bus("46")
    assert network.p_nominal_pu[at] == network.q_nominal_pu[at] == 0.0
    assert power[at].real == pytest.approx(-0.458, abs=1e-3)


def without_shifter(network: Network) -> Network:
    tables = copy.deepcopy(network.to_tables())
    tables["branches"]["shift_rad"] = 0.0
    return Network.from_tables(**tables)


@pytest.mark.parametrize("grid", ["ieee57", "ieee300"])
def test_voltages_equal_pandapowers_once_its_transformers_are_turned(grid: str) -> None:
    """Its copies put taps at the wrong end, make charging inductive, and lose the shifter."""
    network = library.load(grid)
    b, names = network.branches, network.buses.name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pandapower
        import pandapower.networks

        net = getattr(pandapower.networks, grid.replace("ieee", "case"))()
        label = net.bus.name.astype(str)
        assert tuple(label) == names
        position = {str(name): at for at, name in label.items()}
        ends = zip(b.from_bus, b.to_bus, strict=True)
        starts = {frozenset((names[f], names[t])): names[f] for f, t in ends}
        sides = list(zip(label[net.trafo.hv_bus], label[net.trafo.lv_bus], strict=True))
        turned = np.array([starts[frozenset(pair)] == pair[1] for pair in sides])
        turned &= net.trafo.tap_pos.abs().gt(0).to_numpy()
        net.trafo.loc[turned, "tap_side"] = "lv"
        net.trafo["i0_percent"] = 0.0
        for k in np.flatnonzero(b.b_pu):
            if frozenset((names[b.from_bus[k]], names[b.to_bus[k]])) in map(frozenset, sides):
                for bus, ratio in ((b.from_bus[k], b.tap[k]), (b.to_bus[k], 1.0)):
                    half = -0.5 * b.b_pu[k] * network.base_mva / ratio**2
                    pandapower.create_shunt(net, position[names[bus]], q_mvar=half)
        pandapower.runpp(net, tolerance_mva=1e-9, numba=False)
    assert turned.sum() == WRONG_ENDS[grid]
    flow = solve(without_shifter(network))
    np.testing.assert_allclose(flow.vm, net.res_bus.vm_pu, atol=1e-8)
    degree = net.res_bus.va_degree.to_numpy()
    np.testing.assert_allclose(flow.theta, np.deg2rad(degree - degree[network.slack]), atol=1e-8)
