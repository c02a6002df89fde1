"""Claim: DC power flow solves B'θ = P - P_shift, in every island against its own reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from reference import GRIDS

from pse_analysis.grid import library
from pse_analysis.grid.dc import DcPowerFlow
from pse_analysis.grid.power_flow import solve

SEED = 3


@pytest.mark.parametrize("grid", GRIDS)
def test_flows_of_the_angles_add_up_to_the_injections(grid: str) -> None:
    network = library.load(grid)
    rng = np.random.default_rng(SEED)
    shift = np.where(rng.random(network.n_branch) < 0.2, 0.3 * rng.normal(size=network.n_branch), 0)
    branch = dataclasses.replace(network.branches, shift_rad=shift)
    network = dataclasses.replace(network, branches=branch)
    p = rng.normal(size=(network.n_bus, 3))
    angle = DcPowerFlow(network).angles(p)
    left = p.copy()
    for k in np.flatnonzero(branch.in_service):
        f, t = branch.from_bus[k], branch.to_bus[k]
        susceptance = branch.x_pu[k] / (branch.r_pu[k] ** 2 + branch.x_pu[k] ** 2) / branch.tap[k]
        flow = susceptance * (angle[f] - angle[t] - shift[k])
        left[f] -= flow
        left[t] += flow
    others = np.arange(network.n_bus) != network.slack
    np.testing.assert_allclose(left[others], 0.0, atol=1e-9)
    np.testing.assert_array_equal(angle[network.slack], 0.0)
    np.testing.assert_allclose(DcPowerFlow(network).angles(p[:, 1]), angle[:, 1], atol=1e-12)


def test_small_injections_give_the_angles_of_the_full_power_flow() -> None:
    network = library.load("ieee30")
    branch = dataclasses.replace(
        network.branches,
        r_pu=np.zeros(network.n_branch),
        tap=np.ones(network.n_branch),
        b_pu=np.zeros(network.n_branch),
    )
    flat = dataclasses.replace(
        network.buses,
        vm_set_pu=np.ones(network.n_bus),
        b_shunt_pu=np.zeros(network.n_bus),
        g_shunt_pu=np.zeros(network.n_bus),
    )
    network = dataclasses.replace(network, branches=branch, buses=flat)
    p = 1e-4 * np.random.default_rng(SEED).normal(size=network.n_bus)
    flow = solve(network, p, np.zeros(network.n_bus))
    np.testing.assert_allclose(DcPowerFlow(network).angles(p), flow.theta, atol=1e-7)


def test_a_lone_bus_and_a_branch_without_reactance_are_no_obstacle() -> None:
    network = library.load("ieee33").open_branch("17-18")
    reactance = network.branches.x_pu.copy()
    reactance[3] = 0.0
    branch = dataclasses.replace(network.branches, x_pu=reactance)
    angle = DcPowerFlow(dataclasses.replace(network, branches=branch)).angles(network.p_nominal_pu)
    assert np.isfinite(angle).all()
    assert angle[network.bus("18")] == 0.0
