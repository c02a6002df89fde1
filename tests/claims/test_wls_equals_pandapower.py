"""Claim: on the same noisy data, weighted least squares equals pandapower's to 1e-6 p.u."""

from __future__ import annotations

import numpy as np
import pytest
from reference import pandapower_wls

from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, TO, VM, MeasurementModel, P, Q, SensorLayout

SEED = 30


@pytest.mark.parametrize("grid", ["ieee14", "ieee30", "ieee118"])
def test_wls_equals_pandapower(grid: str) -> None:
    network = library.load(grid)
    bus, branch = np.arange(network.n_bus), np.arange(network.n_branch)
    layout = SensorLayout.of(
        network,
        (VM, bus, BUS),
        (P, bus, BUS),
        (Q, bus, BUS),
        (P, branch[::2], FROM),
        (Q, branch[::2], FROM),
        (P, branch[1::3], TO),
        (Q, branch[1::3], TO),
    )
    rng = np.random.default_rng(SEED)
    sigma = np.where(layout.quantity == VM, 0.004, rng.uniform(0.005, 0.02, len(layout)))
    truth = solve(network).x
    z = MeasurementModel(network, layout).h(truth) + sigma * rng.normal(size=len(layout))
    ours = WeightedLeastSquares(network, layout).solve(z, sigma)
    theirs = pandapower_wls(grid, network, layout, z, sigma)
    assert ours.converged
    np.testing.assert_allclose(ours.x, theirs, atol=1e-6)
    # The data are noisy: a method that returned the truth would fail.
    assert np.abs(ours.x - truth).max() > 1e-4
