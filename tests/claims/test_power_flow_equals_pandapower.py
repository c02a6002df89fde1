"""Claim: voltages, flows and reactive limits equal pandapower's to 1e-8 p.u. on all grids."""

from __future__ import annotations

import numpy as np
import pytest
from reference import GRIDS, pandapower_grid

from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, IM, TO, MeasurementModel, P, Q, SensorLayout


def relative_angle(degree: np.ndarray, slack: int) -> np.ndarray:
    """Angles against the slack's, which pandapower puts at 30° on ieee118. [rad]"""
    return np.deg2rad(degree - degree[slack])


@pytest.mark.parametrize("grid", GRIDS)
def test_voltages_and_injections(grid: str) -> None:
    net, network = pandapower_grid(grid), library.load(grid)
    flow = solve(network)
    np.testing.assert_allclose(flow.vm, net.res_bus.vm_pu, atol=1e-8)
    theta = relative_angle(net.res_bus.va_degree.to_numpy(), network.slack)
    np.testing.assert_allclose(flow.theta, theta, atol=1e-8)
    # pandapower counts consumption positive and takes the shunts' share into the bus result.
    shunt = (network.buses.g_shunt_pu - 1j * network.buses.b_shunt_pu) * flow.vm**2
    drawn = (net.res_bus.p_mw + 1j * net.res_bus.q_mvar).to_numpy() / network.base_mva
    np.testing.assert_allclose(flow.p_pu + 1j * flow.q_pu, shunt - drawn, atol=1e-8)


@pytest.mark.parametrize("grid", GRIDS)
def test_branch_flows_and_currents_at_both_ends(grid: str) -> None:
    net, network = pandapower_grid(grid), library.load(grid)
    branch = np.arange(network.n_branch)
    rows = [(P, FROM, "p_from_mw", "p_hv_mw"), (Q, FROM, "q_from_mvar", "q_hv_mvar")]
    rows += [(P, TO, "p_to_mw", "p_lv_mw"), (Q, TO, "q_to_mvar", "q_lv_mvar")]
    rows += [(IM, FROM, "i_from_ka", "i_hv_ka"), (IM, TO, "i_to_ka", "i_lv_ka")]
    for quantity, side, of_line, of_trafo in rows:
        layout = SensorLayout.of(network, (quantity, branch, side))
        got = MeasurementModel(network, layout).h(solve(network).x)
        want = np.concatenate([net.res_line[of_line], net.res_trafo[of_trafo]])
        ends = network.branches.from_bus if side == FROM else network.branches.to_bus
        base = network.base_ka[ends] if quantity == IM else network.base_mva
        np.testing.assert_allclose(got, want / base, atol=1e-8)


@pytest.mark.parametrize("grid", ["ieee14", "ieee30", "ieee118"])
def test_reactive_limits(grid: str) -> None:
    net, network = pandapower_grid(grid, enforce_q_lims=True), library.load(grid)
    flow = solve(network, enforce_q_limits=True)
    np.testing.assert_allclose(flow.vm, net.res_bus.vm_pu, atol=1e-8)
    theta = relative_angle(net.res_bus.va_degree.to_numpy(), network.slack)
    np.testing.assert_allclose(flow.theta, theta, atol=1e-8)
    at_limit = np.isclose(net.res_gen.q_mvar, net.gen.max_q_mvar, atol=1e-6)
    at_limit |= np.isclose(net.res_gen.q_mvar, net.gen.min_q_mvar, atol=1e-6)
    assert set(np.flatnonzero(flow.limited)) == set(
        net.bus.index.get_indexer(net.gen.bus[at_limit])
    )


def test_a_bus_draws_its_own_load_only_where_shunts_stand() -> None:
    network = library.load("ieee14")
    flow = solve(network)
    nine = network.bus("9")
    assert network.buses.b_shunt_pu[nine] == pytest.approx(0.19)
    layout = SensorLayout.of(network, (Q, np.array([nine]), BUS))
    drawn = MeasurementModel(network, layout).h(flow.x)
    assert drawn[0] == pytest.approx(-network.buses.q_load_mvar[nine] / network.base_mva)
