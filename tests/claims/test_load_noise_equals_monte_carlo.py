"""Claim: load noise is the covariance of power-flow solutions under small changes of load."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.estimation.process.load_noise import LoadStatistics, load_noise
from pse_analysis.grid import BusKind, library
from pse_analysis.grid.power_flow import solve

SEED = 99
DRAWS = 3000


@pytest.mark.parametrize("grid", ["ieee33", "ieee14"])
def test_load_noise_equals_covariance_of_power_flow_solutions(grid: str) -> None:
    network = library.load(grid)
    n = network.n_bus
    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    correlation = 0.6 * np.eye(2 * n) + 0.4
    deviation = 0.01 * np.abs(nominal)
    source = 5e-4
    statistics = LoadStatistics(deviation[None, :], correlation, source, 86400.0)
    rng = np.random.default_rng(SEED)
    change = deviation[:, None] * (
        np.linalg.cholesky(correlation) @ rng.normal(size=(2 * n, DRAWS))
    )
    held = (network.buses.kind != BusKind.PQ)[:, None]
    vm = network.buses.vm_set_pu[:, None] + held * source * rng.normal(size=(n, DRAWS))
    injection = nominal[:, None] + change
    flow = solve(network, injection[:n], injection[n:], vm, start=solve(network).x)
    voltage = flow.vm * np.exp(1j * flow.theta)
    got = np.cov(np.concatenate([voltage.real, voltage.imag]))

    base = solve(network)
    noise = load_noise(network, statistics)
    at = base.vm * np.exp(1j * base.theta)
    expected = noise(at, np.datetime64("2016-06-09T12:00:00", "us"))
    size = np.diagonal(expected)
    error = np.sqrt((np.outer(size, size) + expected**2) / (DRAWS - 1))
    moving = np.sqrt(size) > 1e-9
    both = np.outer(moving, moving)
    assert moving.sum() >= 2 * n - 1 - np.count_nonzero(held)
    # 4.5 standard errors of the draws, and 2 % for the curvature of the power flow.
    allowed = 4.5 * error + 0.02 * np.sqrt(np.outer(size, size))
    assert (np.abs(got - expected)[both] < allowed[both]).all()
    assert np.abs(got[~both]).max() < 1e-12
    # A diagonal of the same variances is far away: voltages of a grid move together.
    assert (np.abs(got - np.diag(size))[both] > allowed[both]).mean() > 0.5
