"""Claim: process noise follows the grid's own sensitivities, whatever was asked before."""

from __future__ import annotations

import numpy as np
import pytest
from reference import central_differences

from pse_analysis.estimation.process.load_noise import (
    LoadStatistics,
    Sensitivity,
    load_noise,
    scalar_noise,
    to_polar,
    to_rectangular,
)
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve

SEED = 4321
MIDNIGHT = np.datetime64("2016-06-06T00:00:00", "us")


@pytest.mark.parametrize("grid", ["ieee14", "ieee33"])
def test_sensitivities_equal_differences_of_the_power_flow(grid: str) -> None:
    network = library.load(grid)
    n = network.n_bus
    sensitivity = Sensitivity(network)
    x = solve(network).x
    voltage = x[n:] * np.exp(1j * x[:n])
    by_input, by_voltage = (to_polar(voltage) @ moved for moved in sensitivity.at(voltage))

    def from_injections(s: np.ndarray) -> np.ndarray:
        return solve(network, s[:n], s[n:], tolerance=1e-12).x

    def from_held(v: np.ndarray) -> np.ndarray:
        vm = network.buses.vm_set_pu.copy()
        vm[sensitivity.held] = v
        return solve(network, vm_set_pu=vm, tolerance=1e-12).x

    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    numeric = central_differences(from_injections, nominal, 1e-5)
    np.testing.assert_allclose(by_input, numeric[:, sensitivity.inputs], atol=1e-6)
    rest = np.delete(numeric, sensitivity.inputs, axis=1)
    np.testing.assert_allclose(rest, 0.0, atol=1e-6)
    numeric = central_differences(from_held, network.buses.vm_set_pu[sensitivity.held], 1e-5)
    np.testing.assert_allclose(by_voltage, numeric, atol=1e-6)


def test_polar_and_rectangular_derivatives_are_inverse_and_right() -> None:
    rng = np.random.default_rng(SEED)
    x = np.concatenate([rng.normal(0, 1, 5), rng.uniform(0.5, 1.5, 5)])

    def rectangular(at: np.ndarray) -> np.ndarray:
        voltage = at[5:] * np.exp(1j * at[:5])
        return np.concatenate([voltage.real, voltage.imag])

    voltage = x[5:] * np.exp(1j * x[:5])
    numeric = central_differences(rectangular, x)
    np.testing.assert_allclose(to_rectangular(voltage), numeric, atol=1e-8)
    np.testing.assert_allclose(to_polar(voltage) @ to_rectangular(voltage), np.eye(10), atol=1e-12)


def test_scalar_noise_is_the_same_everywhere_and_always() -> None:
    noise = scalar_noise(library.load("ieee14"), 2e-6)
    np.testing.assert_array_equal(noise(np.ones(14, dtype=complex), MIDNIGHT), 2e-6 * np.eye(28))


def test_load_noise_follows_the_slot_of_the_day() -> None:
    network = library.load("ieee33")
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    deviation = np.array([0.01, 0.03])[:, None] * nominal
    statistics = LoadStatistics(deviation, np.eye(66), 0.0, 43200.0)
    noise = load_noise(network, statistics)
    voltage = np.ones(33, dtype=complex)
    night, day = (noise(voltage, MIDNIGHT + np.timedelta64(h, "h")) for h in (3, 15))
    np.testing.assert_allclose(day, 9 * night, rtol=1e-9, atol=1e-20)


def test_load_noise_does_not_depend_on_where_it_was_asked_before() -> None:
    network = library.load("ieee33")
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    statistics = LoadStatistics(0.01 * nominal[None, :], np.eye(66), 1e-3, 86400.0)
    flow = solve(network)
    here = flow.vm * np.exp(1j * flow.theta)
    there = 0.97 * here
    used, new = load_noise(network, statistics), load_noise(network, statistics)
    used(there, MIDNIGHT)
    np.testing.assert_allclose(used(here, MIDNIGHT), new(here, MIDNIGHT), rtol=1e-12)
    assert np.abs(new(there, MIDNIGHT) - new(here, MIDNIGHT)).max() > 1e-9


def test_sensitivities_of_a_cut_grid_are_those_of_power_flow_in_each_part() -> None:
    network = library.load("ieee33").open_branch("6-7")
    assert len(np.unique(network.islands())) == 2

    def rectangular(p: np.ndarray) -> np.ndarray:
        flow = solve(network, p, own_references=True)
        voltage = flow.vm * np.exp(1j * flow.theta)
        return np.concatenate([voltage.real, voltage.imag])

    p = network.p_nominal_pu.copy()
    at = rectangular(p)
    sensitivity = Sensitivity(network)
    by_input, _ = sensitivity.at(at[:33] + 1j * at[33:])
    for bus in (3, 12):  # one of the part with the slack, one of the other
        step = 1e-5 * np.eye(33)[bus]
        found = (rectangular(p + step) - rectangular(p - step)) / 2e-5
        own = by_input[:, np.flatnonzero(sensitivity.inputs == bus)[0]]
        assert np.abs(own).max() > 1e-3
        np.testing.assert_allclose(own, found, atol=1e-6)
