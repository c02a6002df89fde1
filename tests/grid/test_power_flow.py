"""Claim: power flow solves what it says it solves, many states at once, or says where it failed."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import GRIDS

from pse_analysis.errors import GridError, NotConverged
from pse_analysis.grid import Branches, Buses, BusKind, Network, library
from pse_analysis.grid.exchange import from_pandapower
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, MeasurementModel, P, Q, SensorLayout

SEED = 118


@pytest.mark.parametrize("grid", GRIDS)
def test_solved_state_meets_every_given_injection_and_voltage(grid: str) -> None:
    network = library.load(grid)
    flow = solve(network)
    kind = network.buses.kind
    load, source = kind == BusKind.PQ, kind == BusKind.SLACK
    np.testing.assert_allclose(flow.p_pu[~source], network.p_nominal_pu[~source], atol=1e-10)
    np.testing.assert_allclose(flow.q_pu[load], network.q_nominal_pu[load], atol=1e-10)
    np.testing.assert_array_equal(flow.vm[~load], network.buses.vm_set_pu[~load])
    assert flow.theta[network.slack] == 0.0
    assert flow.iterations <= 6


@pytest.mark.parametrize("grid", GRIDS)
def test_many_states_equal_one_at_a_time(grid: str) -> None:
    network = library.load(grid)
    rng = np.random.default_rng(SEED)
    scale = rng.uniform(0.5, 1.1, (network.n_bus, 70))
    p, q = network.p_nominal_pu[:, None] * scale, network.q_nominal_pu[:, None] * scale
    vm = network.buses.vm_set_pu[:, None] + rng.uniform(-0.01, 0.01, (network.n_bus, 70))
    together = solve(network, p, q, vm)
    for k in (0, 33, 63, 64, 69):
        alone = solve(network, p[:, k], q[:, k], vm[:, k])
        np.testing.assert_allclose(together.x[:, k], alone.x, atol=1e-9)
        np.testing.assert_allclose(together.q_pu[:, k], alone.q_pu, atol=1e-8)


@settings(max_examples=10, deadline=None, derandomize=True)
@given(factor=st.floats(0.05, 1.4), volt=st.floats(0.97, 1.05))
def test_power_that_enters_a_feeder_is_load_and_loss(factor: float, volt: float) -> None:
    network = library.load("ieee33")
    flow = solve(
        network,
        factor * network.p_nominal_pu,
        factor * network.q_nominal_pu,
        np.full(network.n_bus, volt),
    )
    voltage = flow.vm * np.exp(1j * flow.theta)
    b = network.branches
    closed = b.in_service
    drop = voltage[b.from_bus[closed]] - voltage[b.to_bus[closed]]
    loss = np.abs(drop) ** 2 * (1 / (b.r_pu[closed] + 1j * b.x_pu[closed])).real
    assert flow.p_pu.sum() == pytest.approx(loss.sum(), abs=1e-9)
    assert loss.sum() > 0


def test_a_day_of_the_feeder_takes_less_than_two_seconds() -> None:
    import time

    network = library.load("ieee33")
    scale = np.random.default_rng(SEED).uniform(0.2, 1.2, (network.n_bus, 288))
    begun = time.perf_counter()
    solve(network, network.p_nominal_pu[:, None] * scale, network.q_nominal_pu[:, None] * scale)
    assert time.perf_counter() - begun < 2.0


def test_start_at_the_solution_takes_no_iteration() -> None:
    network = library.load("ieee118")
    flow = solve(network)
    assert solve(network, start=flow.x).iterations == 0


def test_overload_names_state_bus_and_mismatch() -> None:
    network = library.load("ieee33")
    scale = np.array([1.0, 8.0, 0.5])
    with pytest.raises(NotConverged) as caught:
        solve(network, network.p_nominal_pu[:, None] * scale, network.q_nominal_pu[:, None] * scale)
    message = str(caught.value)
    assert "power flow of ieee33 did not converge in" in message
    assert "1 of 3 states" in message
    assert "(state 1)" in message
    assert "p.u. at bus '" in message
    assert "lower the load" in message


def test_states_that_would_converge_are_not_counted_among_the_open() -> None:
    network = library.load("ieee33")
    scale = np.array([1.0, 400.0, 0.5])
    with pytest.raises(NotConverged, match="1 of 3 states are open"):
        solve(network, network.p_nominal_pu[:, None] * scale, network.q_nominal_pu[:, None] * scale)


def test_part_without_a_source_names_its_buses() -> None:
    network = library.load("ieee33").open_branch("17-18").open_branch("24-25")
    with pytest.raises(GridError, match=r"2 buses have no path to the slack bus \(18, 25\)"):
        solve(network)


def test_injection_that_is_not_finite_names_its_bus() -> None:
    network = library.load("ieee14")
    p = network.p_nominal_pu.copy()
    p[4] = np.nan
    with pytest.raises(GridError, match="p_pu must be finite, received nan at bus '5', state 0"):
        solve(network, p)


def test_open_branch_carries_nothing() -> None:
    network = library.load("ieee14").open_branch("2-4")
    flow = solve(network)
    voltage = flow.vm * np.exp(1j * flow.theta)
    assert (network.y_from @ voltage)[network.branch("2-4")] == 0
    assert np.abs(flow.theta - solve(library.load("ieee14")).theta).max() > 1e-3


def test_reactive_limit_is_kept_and_its_bus_gives_up_its_voltage() -> None:
    network = library.load("ieee118")
    free, kept = solve(network), solve(network, enforce_q_limits=True)
    generation = (kept.q_pu - network.q_nominal_pu) * network.base_mva
    pv = network.buses.kind == BusKind.PV
    before = (free.q_pu - network.q_nominal_pu) * network.base_mva
    assert (before[pv] > network.buses.q_max_mvar[pv] + 1e-6).any()
    assert (generation[pv] <= network.buses.q_max_mvar[pv] + 1e-6).all()
    assert (generation[pv] >= network.buses.q_min_mvar[pv] - 1e-6).all()
    assert kept.limited.any()
    held = pv & ~kept.limited
    np.testing.assert_array_equal(kept.vm[held], network.buses.vm_set_pu[held])
    moved = np.abs(kept.vm - network.buses.vm_set_pu)[kept.limited]
    assert (moved > 1e-6).all()


def test_limits_of_one_state_do_not_bind_another() -> None:
    network = library.load("ieee118")
    scale = np.array([1.0, 0.6])
    load = network.q_nominal_pu[:, None] * scale
    p = network.p_nominal_pu[:, None] * scale
    both = solve(network, p, load, enforce_q_limits=True)
    for k in range(2):
        alone = solve(network, p[:, k], load[:, k], enforce_q_limits=True)
        np.testing.assert_array_equal(both.limited[:, k], alone.limited)
        np.testing.assert_allclose(both.vm[:, k], alone.vm, atol=1e-9)
    assert (both.limited[:, 0] != both.limited[:, 1]).any()


def on_base(network: Network, base_mva: float) -> Network:
    """The same grid in other units."""
    factor = base_mva / network.base_mva
    branch, bus = network.branches, network.buses
    return dataclasses.replace(
        network,
        base_mva=base_mva,
        branches=dataclasses.replace(
            branch,
            r_pu=branch.r_pu * factor,
            x_pu=branch.x_pu * factor,
            b_pu=branch.b_pu / factor,
            g_pu=branch.g_pu / factor,
        ),
        buses=dataclasses.replace(
            bus, g_shunt_pu=bus.g_shunt_pu / factor, b_shunt_pu=bus.b_shunt_pu / factor
        ),
    )


@pytest.mark.parametrize("base_mva", [1e-3, 1.0, 10.0, 37.0, 100.0])
@pytest.mark.parametrize("grid", [*GRIDS, "ieee57", "ieee300"])
def test_base_power_changes_the_units_and_nothing_else(grid: str, base_mva: float) -> None:
    network = library.load(grid)
    flow, same = solve(network), solve(on_base(network, base_mva))
    np.testing.assert_allclose(same.x, flow.x, atol=1e-10)
    gross = abs(network.y_bus).sum(axis=1) * network.base_mva
    np.testing.assert_allclose(
        same.p_pu * base_mva / gross, flow.p_pu * network.base_mva / gross, atol=1e-11
    )


def test_reactive_limits_bind_the_same_buses_on_any_base_power() -> None:
    network = library.load("ieee118")
    flow = solve(network, enforce_q_limits=True)
    for base_mva in (1e-3, 1.0):
        same = solve(on_base(network, base_mva), enforce_q_limits=True)
        np.testing.assert_array_equal(same.limited, flow.limited)
        np.testing.assert_allclose(same.x, flow.x, atol=1e-9)


def test_grid_on_a_base_of_one_mva_converges_as_pandapower_does() -> None:
    pandapower = pytest.importorskip("pandapower")
    networks = pytest.importorskip("pandapower.networks")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        net = networks.create_cigre_network_hv()
        pandapower.runpp(net, tolerance_mva=1e-9, numba=False)
        network = from_pandapower(net, name="cigre_hv")
    assert network.base_mva == 1.0
    flow = solve(network)
    assert flow.iterations <= 6
    np.testing.assert_allclose(flow.vm, net.res_bus.vm_pu, atol=1e-9)
    turned = np.exp(1j * (flow.theta - np.deg2rad(net.res_bus.va_degree.to_numpy())))
    np.testing.assert_allclose(turned, 1.0, atol=1e-9)


def test_dc_angles_start_what_a_flat_start_does_not() -> None:
    """Phase shifters in the loops of ieee57: no flat start fits them all. 12 draws."""
    network = library.load("ieee57")
    flat = np.concatenate([np.zeros(57), np.ones(57)])
    lost = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        some = rng.random(network.n_branch) < 0.2
        shift = np.where(some, 0.26 * rng.normal(size=network.n_branch), 0.0)
        turned = dataclasses.replace(
            network, branches=dataclasses.replace(network.branches, shift_rad=shift)
        )
        flow = solve(turned)
        others = np.arange(57) != network.slack
        np.testing.assert_allclose(flow.p_pu[others], network.p_nominal_pu[others], atol=1e-9)
        try:
            solve(turned, start=flat, max_iterations=10)
        except NotConverged:
            lost += 1
    assert lost >= 3


def test_halved_steps_lead_where_full_steps_run_away() -> None:
    """Newton's full steps, in textbook form, beside `solve` from starts far off. 40 draws."""
    network = library.load("ieee14")
    solution, n = solve(network).x, network.n_bus
    angle, size = np.arange(1, n), np.flatnonzero(network.buses.kind == BusKind.PQ)
    columns = np.concatenate([angle, n + size])
    layout = SensorLayout.of(network, (P, angle, BUS), (Q, size, BUS))
    model = MeasurementModel(network, layout, columns)
    target = np.concatenate([network.p_nominal_pu[angle], network.q_nominal_pu[size]])
    found = {"full": 0, "halved": 0}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        x = solution.copy()
        x[angle] += 0.25 * rng.normal(size=n - 1)
        x[n + size] += 0.08 * rng.normal(size=len(size))
        with contextlib.suppress(NotConverged):
            found["halved"] += np.abs(solve(network, start=x).x - solution).max() < 1e-9
        for _ in range(30):
            step = np.linalg.solve(model.jacobian(x).toarray(), model.h(x) - target)
            x[columns] -= np.clip(step, -1e6, 1e6)
        found["full"] += np.abs(x - solution).max() < 1e-9
    assert found["halved"] >= 2 * found["full"] > 0


def test_islands_with_references_of_their_own_are_grids_of_their_own() -> None:
    """Two copies of ieee14 without a branch between them, one of which has no slack."""
    one = library.load("ieee14")

    def twice(table: Any) -> dict[str, Any]:
        return {
            f.name: np.concatenate([getattr(table, f.name)] * 2)
            for f in dataclasses.fields(table)
            if f.name != "name"
        }

    bus, branch = twice(one.buses), twice(one.branches)
    bus["kind"][14] = BusKind.PV
    branch["from_bus"][one.n_branch :] += 14
    branch["to_bus"][one.n_branch :] += 14
    two = Network(
        "two",
        one.base_mva,
        Buses(name=tuple(str(i) for i in range(28)), **bus),
        Branches(name=tuple(str(i) for i in range(2 * one.n_branch)), **branch),
    )
    assert set(two.references) == {0, 14}
    with pytest.raises(GridError, match="14 buses have no path to the slack bus"):
        solve(two)
    flow, alone = solve(two, own_references=True), solve(one)
    for half in (slice(0, 14), slice(14, 28)):
        np.testing.assert_allclose(flow.theta[half], alone.theta, atol=1e-10)
        np.testing.assert_allclose(flow.vm[half], alone.vm, atol=1e-10)


@pytest.mark.parametrize("degrees", [30.0, 150.0, 180.0, -120.0])
def test_a_phase_shifter_turns_what_lies_behind_it_and_nothing_else(degrees: float) -> None:
    network = library.load("ieee33")
    shift = np.zeros(network.n_branch)
    shift[0] = np.deg2rad(degrees)  # the branch from the slack, behind which everything lies
    turned = dataclasses.replace(
        network, branches=dataclasses.replace(network.branches, shift_rad=shift)
    )
    plain, found = (solve(n).x[:, None].reshape(2, -1) for n in (network, turned))
    np.testing.assert_allclose(found[1], plain[1], atol=1e-9)
    np.testing.assert_allclose(found[0, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[0, 1:], plain[0, 1:] - shift[0], atol=1e-9)


def test_limits_are_tried_one_at_a_time_where_together_they_leave_no_solution() -> None:
    # While all generators hold their voltages, 3 absorbs more than it may. At that limit, with 2, 6
    # and 8 at theirs, nothing converges; but once these have given in, 3 has to generate.
    network = library.load("ieee14")
    p, q = network.p_nominal_pu.copy(), network.q_nominal_pu.copy()
    for name, rise_mw in (("2", 282.0), ("3", 423.0), ("8", 94.0), ("5", -94.0)):
        p[network.bus(name)] += rise_mw / network.base_mva
    q[network.bus("5")] -= 188.0 / network.base_mva
    flow = solve(network, p, q, enforce_q_limits=True)
    pv = network.buses.kind == BusKind.PV
    generation = (flow.q_pu - q) * network.base_mva
    assert flow.limited.any()
    assert (generation[pv] <= network.buses.q_max_mvar[pv] + 1e-6).all()
    assert (generation[pv] >= network.buses.q_min_mvar[pv] - 1e-6).all()
    full = np.abs(generation - network.buses.q_max_mvar) < 1e-6
    assert (flow.vm <= network.buses.vm_set_pu + 1e-9)[flow.limited & full].all()
    held = pv & ~flow.limited
    np.testing.assert_array_equal(flow.vm[held], network.buses.vm_set_pu[held])
    np.testing.assert_allclose(flow.p_pu[1:], p[1:], atol=1e-9)
    # With one state that cannot be solved at all, the message is the usual one.
    with pytest.raises(NotConverged, match="1 of 2 states are open"):
        solve(
            network,
            np.stack([p, 20.0 * p], axis=1),
            np.stack([q, 20.0 * q], axis=1),
            enforce_q_limits=True,
        )
