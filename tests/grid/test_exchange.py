"""Claim: a grid taken over from pandapower has the same power flow, or is refused by name."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pse_analysis.errors import GridError
from pse_analysis.grid.exchange import from_pandapower
from pse_analysis.grid.power_flow import solve

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    pp = pytest.importorskip("pandapower")

pytestmark = pytest.mark.filterwarnings("ignore")


def feeder() -> Any:
    """A supply and three buses in a row, each but the first with a load."""
    net = pp.create_empty_network(sn_mva=10.0)
    for _ in range(4):
        pp.create_bus(net, 20.0)
    pp.create_ext_grid(net, 0, vm_pu=1.02)
    for k in range(3):
        pp.create_line_from_parameters(net, k, k + 1, 3.0, 0.2, 0.35, 200.0, 0.3)
        pp.create_load(net, k + 1, 1.0 + k, 0.4)
    return net


def constant_impedance(net: Any) -> None:
    net.load["const_z_p_percent"], net.load["const_z_q_percent"] = 60.0, 30.0


ELEMENTS: dict[str, Callable[[Any], object]] = {
    "storage": lambda net: pp.create_storage(net, 2, 0.5, 1.0, q_mvar=0.1),
    "ward": lambda net: pp.create_ward(net, 2, 0.5, 0.1, 0.2, 0.1),
    "motor": lambda net: pp.create_motor(net, 2, 0.5, 0.9),
    "asymmetric load": lambda net: pp.create_asymmetric_load(net, 2, 0.1, 0.2, 0.3, 0.1),
    "asymmetric sgen": lambda net: pp.create_asymmetric_sgen(net, 2, 0.1, 0.2, 0.3, 0.1),
    "sgen": lambda net: pp.create_sgen(net, 2, 0.5, scaling=0.5),
    "gen": lambda net: pp.create_gen(net, 2, 0.5, vm_pu=1.01),
    "shunt": lambda net: pp.create_shunt(net, 2, q_mvar=-1.0, p_mw=0.1),
    "constant impedance": constant_impedance,
    "no more": lambda net: None,
}


@pytest.mark.parametrize("element", ELEMENTS)
def test_power_flow_is_that_of_pandapower(element: str) -> None:
    net = feeder()
    ELEMENTS[element](net)
    network = from_pandapower(net, name="taken")
    flow = solve(network)
    np.testing.assert_allclose(flow.vm, net.res_bus.vm_pu, atol=1e-7)
    np.testing.assert_allclose(np.rad2deg(flow.theta), net.res_bus.va_degree, atol=1e-5)
    p = network.buses.p_gen_mw[0] - network.buses.p_load_mw[0]
    assert p == pytest.approx(float(net.res_ext_grid.p_mw.iloc[0]))


def change(table: str, column: str, value: object) -> Callable[[Any], object]:
    return lambda net: net[table].__setitem__(column, value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda net: pp.create_dcline(net, 1, 3, 0.1, 1, 0.01, 1.0, 1.0), "1 rows of net.dcline"),
        (lambda net: pp.create_xward(net, 2, 0.1, 0, 0, 0, 0.1, 0.1, 1.0), "1 rows of net.xward"),
        (lambda net: pp.create_ext_grid(net, 3), "received ext_grid at buses 0, 3: make all but"),
        (change("ext_grid", "va_degree", 30.0), "va_degree must be 0, .*received 30"),
        (change("load", "const_i_p_percent", 50.0), "loads of constant current"),
        (change("load", "p_mw", 5000.0), "does not solve the net .*did not converge"),
        (lambda net: pp.create_switch(net, 1, 2, "b"), "switches join the buses 1, 2: merge"),
        (lambda net: pp.create_switch(net, 1, 1, "l", closed=False), "without supply: 2, 3; drop"),
        (lambda net: pp.create_switch(net, 3, 2, "l", closed=False), "without supply: 3; drop"),
        (change("line", "in_service", [True, True, False]), "without supply: 3; drop"),
        (change("bus", "in_service", [True, True, True, False]), "without supply: 3; drop"),
    ],
)
def test_what_has_no_counterpart_is_refused_by_name(
    spoil: Callable[[Any], object], message: str
) -> None:
    net = feeder()
    spoil(net)
    with pytest.raises(GridError, match=message):
        from_pandapower(net, name="refused")


def test_an_open_end_is_refused() -> None:
    net = feeder()
    pp.create_line_from_parameters(net, 1, 3, 1.0, 0.2, 0.35, 200.0, 0.3)
    pp.create_switch(net, 1, 3, "l", closed=False)
    with pytest.raises(GridError, match="1 open ends of branches"):
        from_pandapower(net, name="refused")


def test_every_bus_needs_a_name() -> None:
    with pytest.raises(GridError, match=r"expected 4 bus_names, .*received 3"):
        from_pandapower(feeder(), name="refused", bus_names=["a", "b", "c"])
