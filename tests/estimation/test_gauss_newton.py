"""Claim: steps of least squares never raise the objective, and lead there from where grids are."""

from __future__ import annotations

import dataclasses
import warnings
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import conventional, random_state, snapshot

from pse_analysis.estimation.core.normal import Pins
from pse_analysis.estimation.static.gauss_newton import GaussNewton, Problem
from pse_analysis.estimation.static.tracking import tracking_wls
from pse_analysis.estimation.static.wls import WeightedLeastSquares, state_columns
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import (
    BUS,
    FROM,
    IM,
    TO,
    VA,
    VM,
    MeasurementModel,
    P,
    Q,
    SensorLayout,
)

SEED = 6


@cache
def british_grid() -> Network:
    """Pandapower's reduced grid of Great Britain: from a flat start full steps lead nowhere."""
    from pse_analysis.grid.exchange import from_pandapower

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pandapower.networks

        return from_pandapower(pandapower.networks.GBreducednetwork(), name="gb")


def with_currents(network: Network) -> SensorLayout:
    bus, closed = np.arange(network.n_bus), np.flatnonzero(network.branches.in_service)
    return SensorLayout.of(network, *[(q, bus, BUS) for q in (VM, P, Q)], (IM, closed, FROM))


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), kind=st.sampled_from(["powers", "currents"]))
def test_the_objective_never_rises_from_one_step_to_the_next(seed: int, kind: str) -> None:
    rng, network = np.random.default_rng(seed), library.load("ieee14")
    layout = conventional(network) if kind == "powers" else with_currents(network)
    model = MeasurementModel(network, layout, state_columns(network, layout))
    z = model.h(solve(network).x) + 0.01 * rng.normal(size=len(layout))
    problem = Problem(z, np.full(len(layout), 100.0), np.ones(len(layout), dtype=bool))
    start = random_state(network, rng)
    start[: network.n_bus] -= start[network.slack]
    cost = [problem.cost(model.residual(z, start))]
    for count in range(1, 8):
        done = GaussNewton(model, 1e-8, count).descend(start, problem, Pins.none())
        cost.append(problem.cost(model.residual(z, done.x)))
    assert (np.diff(cost) <= 1e-9 * np.array(cost[:-1])).all()
    assert cost[-1] < cost[0]


@pytest.mark.parametrize("load", [1.0, 0.6])
@pytest.mark.parametrize("sigma_power", [0.01, 1.0])
def test_exact_readings_of_a_steep_grid_return_its_power_flow(
    load: float, sigma_power: float
) -> None:
    network = british_grid()
    flow = solve(network, load * network.p_nominal_pu, load * network.q_nominal_pu)
    layout = conventional(network)
    z = MeasurementModel(network, layout).h(flow.x)
    sigma = np.where(layout.quantity == VM, 0.004, sigma_power)
    wls = WeightedLeastSquares(network, layout)
    for start in (None, wls.flat_start()):
        got = wls.solve(z, sigma, start=start)
        assert got.converged
        np.testing.assert_allclose(got.x, flow.x, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_meters_of_current_size_on_a_large_grid_lead_to_a_stationary_point(seed: int) -> None:
    """The gradient of the textbook vanishes there: HᵀR⁻¹(z - h(x)) = 0."""
    network = library.load("ieee300")
    layout = with_currents(network)
    truth = solve(network).x
    rng = np.random.default_rng(SEED + seed)
    sigma = np.where(layout.quantity == VM, 0.004, 0.01)
    z = MeasurementModel(network, layout).h(truth) + sigma * rng.normal(size=len(layout))
    got = WeightedLeastSquares(network, layout).solve(z, sigma)
    assert got.converged
    assert got.objective < got.dof + 5.0 * np.sqrt(2.0 * got.dof)
    model = MeasurementModel(network, layout, np.delete(np.arange(600), network.slack))
    H = model.jacobian(got.x).toarray() / sigma[:, None]
    z[layout.quantity == IM] = np.maximum(z[layout.quantity == IM], 0.0)
    step = np.linalg.lstsq(H, (z - model.h(got.x)) / sigma, rcond=None)[0]
    assert np.abs(step).max() < 1e-6


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    turn=st.floats(-np.pi, np.pi),
    grid=st.sampled_from(["ieee14", "ieee30", "ieee33", "ieee118"]),
    every=st.integers(1, 5),
)
def test_phasors_that_count_from_gps_are_a_start_for_wattmeters(
    turn: float, grid: str, every: int
) -> None:
    network = library.load(grid)
    bus = np.arange(network.n_bus)
    layout = SensorLayout.of(
        network, (VM, bus[::every], BUS), (VA, bus[::every], BUS), (P, bus, BUS), (Q, bus, BUS)
    )
    truth = solve(network).x
    truth[: network.n_bus] += turn
    z = MeasurementModel(network, layout).h(truth)
    got = WeightedLeastSquares(network, layout).solve(z, np.full(len(layout), 0.01))
    assert got.converged
    off = got.x - truth
    off[: network.n_bus] = np.angle(np.exp(1j * off[: network.n_bus]))
    assert np.abs(off).max() < 1e-7


@pytest.mark.parametrize("reading", [-0.02, 0.0, 1e-6])
def test_a_current_near_zero_breaks_nothing(reading: float) -> None:
    """A branch to a bus without load: the noise of its ammeter is larger than what flows."""
    network = library.load("ieee33")
    end = network.bus("18")
    p, q = network.p_nominal_pu.copy(), network.q_nominal_pu.copy()
    p[end] = q[end] = 0.0
    truth = solve(network, p, q).x
    last = np.flatnonzero(network.branches.to_bus == end)[:1]
    layout = conventional(network).joined(
        SensorLayout.of(network, (IM, last, FROM), (IM, last, TO))
    )
    z = MeasurementModel(network, layout).h(truth)
    z[-2:] = reading
    sigma = np.full(len(layout), 0.01)
    got = WeightedLeastSquares(network, layout).solve(z, sigma)
    assert got.converged
    np.testing.assert_allclose(got.x, truth, atol=2e-3)
    # The residual is that of the reading as it came.
    np.testing.assert_allclose(got.residual[-2:], reading, atol=2e-3)


def test_a_negative_reading_of_a_size_asks_for_none() -> None:
    network = library.load("ieee14")
    layout = with_currents(network)
    z = MeasurementModel(network, layout).h(solve(network).x)
    row = int(np.flatnonzero(layout.quantity == IM)[4])
    sigma = np.full(len(layout), 0.01)
    below, none = z.copy(), z.copy()
    below[row], none[row] = -0.05, 0.0
    wls = WeightedLeastSquares(network, layout)
    np.testing.assert_allclose(wls.solve(below, sigma).x, wls.solve(none, sigma).x, atol=1e-12)


def test_contradictions_without_any_solution_are_no_meters_fault() -> None:
    """Not every set of readings has a minimum nearby: the message accuses nobody."""
    network = library.load("ieee14")
    layout = conventional(network)
    z = MeasurementModel(network, layout).h(solve(network).x)
    z[layout.quantity == Q] -= 30.0
    state, info = tracking_wls("wls", network, layout).init(snapshot(z, np.full(len(z), 0.01)))
    if state is None:
        assert info.status == "not_converged"
        assert info.detail.startswith("no convergence in")
        assert not any(name in info.detail for name in layout.channel)
    else:
        assert info.status == "inconsistent"


@pytest.mark.parametrize("base_mva", [100.0, 1.0, 0.01])
def test_the_base_power_makes_no_difference(base_mva: float) -> None:
    network = library.load("ieee30")
    share = network.base_mva / base_mva
    bus, branch = network.buses, network.branches
    rebased = Network(
        network.name,
        base_mva,
        dataclasses.replace(
            bus, g_shunt_pu=bus.g_shunt_pu * share, b_shunt_pu=bus.b_shunt_pu * share
        ),
        dataclasses.replace(
            branch,
            r_pu=branch.r_pu / share,
            x_pu=branch.x_pu / share,
            g_pu=branch.g_pu * share,
            b_pu=branch.b_pu * share,
        ),
    )
    layout = conventional(rebased)
    truth = solve(network).x
    z = MeasurementModel(rebased, layout).h(truth)
    sigma = np.where(layout.quantity == VM, 0.004, 0.01 * share)
    got = WeightedLeastSquares(rebased, layout).solve(z, sigma)
    assert got.converged
    np.testing.assert_allclose(got.x, truth, atol=1e-8)
