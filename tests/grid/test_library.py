"""Claim: every grid of the library is one connected system with a power flow, by IEEE's numbers."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.grid import BusKind, library
from pse_analysis.grid.power_flow import solve

SIZES = {
    "ieee14": (14, 20),
    "ieee30": (30, 41),
    "ieee33": (33, 37),
    "ieee57": (57, 80),
    "ieee118": (118, 186),
    "ieee300": (300, 411),
}


def test_library_names_what_it_holds() -> None:
    assert set(library.GRIDS) == set(SIZES)


@pytest.mark.parametrize("grid", library.GRIDS)
def test_grid_is_whole_and_solves(grid: str) -> None:
    network = library.load(grid)
    assert (network.n_bus, network.n_branch) == SIZES[grid]
    assert network.name == grid
    flow = solve(network)
    given = network.buses.kind != BusKind.SLACK
    np.testing.assert_allclose(flow.p_pu[given], network.p_nominal_pu[given], atol=1e-9)
    assert flow.vm.min() > 0.9
    assert flow.iterations <= 6


def test_ieee300_keeps_its_numbers_and_what_makes_it_hard() -> None:
    network = library.load("ieee300")
    names = network.buses.name
    assert {"9001", "9533", "2040", "7166"} <= set(names)
    b = network.branches
    shifted = np.flatnonzero(b.shift_rad)
    assert [b.name[k] for k in shifted] == ["196-2040"]
    assert np.rad2deg(b.shift_rad[shifted[0]]) == pytest.approx(-11.4)
    assert (b.tap != 1.0).sum() == 62
    assert (b.x_pu < 0).sum() == 1
    assert "9006-9003#2" in b.name
