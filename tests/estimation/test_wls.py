"""Claim: weighted least squares finds the state that was measured, and says when it cannot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import GRIDS, conventional, every_quantity, measured, snapshot

from pse_analysis.errors import Unobservable
from pse_analysis.estimation.static.tracking import tracking_wls
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import (
    BUS,
    FROM,
    IA,
    IM,
    VA,
    VM,
    MeasurementModel,
    P,
    Q,
    SensorLayout,
)
from pse_analysis.vocabulary import Status

SEED = 14


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("kind", ["conventional", "everything"])
def test_noise_free_data_give_the_truth_from_a_flat_start(grid: str, kind: str) -> None:
    network = library.load(grid)
    layout = conventional(network) if kind == "conventional" else every_quantity(network)
    truth = solve(network).x
    z = measured(network, layout, truth)
    if kind == "everything":  # the angle of a current that does not flow carries nothing
        places = zip(layout.quantity, layout.position, layout.side, z, strict=True)
        idle = {(p, s) for q, p, s, size in places if q == IM and size < 1e-6}
        places = zip(layout.quantity, layout.position, layout.side, strict=True)
        rows = [i for i, (q, p, s) in enumerate(places) if q not in (IM, IA) or (p, s) not in idle]
        layout, z = layout.take(np.array(rows)), z[rows]
    solution = WeightedLeastSquares(network, layout).solve(z, np.full(len(layout), 0.01))
    assert solution.converged
    np.testing.assert_allclose(solution.x, truth, atol=1e-9)
    assert solution.objective < 1e-12


def test_phasors_alone_give_the_truth() -> None:
    network = library.load("ieee33")
    branch = np.flatnonzero(network.branches.in_service)
    layout = SensorLayout.of(
        network, (VM, np.array([0]), BUS), (VA, np.array([0]), BUS), (IM, branch, FROM),
        (IA, branch, FROM),
    )  # fmt: skip
    truth = solve(network).x
    z = MeasurementModel(network, layout).h(truth)
    wls = WeightedLeastSquares(network, layout)
    solution = wls.solve(z, np.full(len(z), 1e-3), start=truth + 1e-3)
    np.testing.assert_allclose(solution.x, truth, atol=1e-9)


def test_solution_satisfies_the_textbooks_normal_equations() -> None:
    network = library.load("ieee30")
    layout = conventional(network)
    rng = np.random.default_rng(SEED)
    sigma = rng.uniform(0.005, 0.02, len(layout))
    model = MeasurementModel(network, layout)
    z = model.h(solve(network).x) + sigma * rng.normal(size=len(layout))
    solution = WeightedLeastSquares(network, layout).solve(z, sigma)
    J = np.delete(model.jacobian(solution.x).toarray(), network.slack, axis=1)
    W = np.diag(1 / sigma**2)
    residual = z - measured(network, layout, solution.x)
    np.testing.assert_allclose(J.T @ W @ residual, 0, atol=1e-3)
    assert np.abs(J.T @ W @ (z - model.h(solve(network).x))).max() > 100
    assert solution.objective == pytest.approx(residual @ W @ residual)
    free = np.delete(np.arange(60), network.slack)
    np.testing.assert_allclose(
        solution.covariance()[np.ix_(free, free)],
        np.linalg.inv(J.T @ W @ J),
        rtol=1e-6,
        atol=1e-12,
    )
    assert not solution.covariance()[network.slack].any()


def test_objective_and_errors_have_their_distributions() -> None:
    """J follows χ²(m-n), and the errors have the covariance that is given. 300 draws."""
    network = library.load("ieee14")
    layout = conventional(network)
    rng = np.random.default_rng(SEED)
    sigma = np.full(len(layout), 1e-3)
    truth = solve(network).x
    exact = MeasurementModel(network, layout).h(truth)
    wls = WeightedLeastSquares(network, layout)
    solutions = [wls.solve(exact + sigma * rng.normal(size=len(sigma)), sigma) for _ in range(300)]
    dof = len(layout) - 27
    objective = np.array([s.objective for s in solutions])
    assert objective.mean() == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / 300))
    error = np.array([s.x for s in solutions]) - truth
    expected = np.sqrt(np.diagonal(solutions[0].covariance()))
    free = expected > 0
    ratio = error[:, free].std(axis=0) / expected[free]
    assert np.abs(ratio - 1).max() < 4.5 / np.sqrt(2 * 300)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), share=st.floats(0.5, 1.0))
def test_available_rows_alone_count(seed: int, share: float) -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    rng = np.random.default_rng(seed)
    rows = rng.random(len(layout)) < share
    rows[:14] = True
    sigma = np.full(len(layout), 0.01)
    z = MeasurementModel(network, layout).h(solve(network).x)
    z += sigma * rng.normal(size=len(z))
    spoilt = np.where(rows, z, 1e6)
    try:
        part = WeightedLeastSquares(network, layout.take(rows)).solve(z[rows], sigma[rows])
    except Unobservable:
        with pytest.raises(Unobservable):
            WeightedLeastSquares(network, layout).solve(spoilt, sigma, rows)
        return
    whole = WeightedLeastSquares(network, layout).solve(spoilt, sigma, rows)
    np.testing.assert_allclose(whole.x, part.x, atol=1e-7)
    assert np.isnan(whole.residual[~rows]).all()


@pytest.mark.parametrize("grid", GRIDS)
def test_verdict_on_observability_is_that_of_the_jacobians_rank(grid: str) -> None:
    network = library.load(grid)
    rng = np.random.default_rng(SEED)
    truth = solve(network).x
    bus, branch = np.arange(network.n_bus), np.flatnonzero(network.branches.in_service)
    verdicts = []
    for share in np.linspace(0.35, 0.95, 15 if grid == "ieee118" else 40):
        pick = rng.permutation(bus)[: int(share * len(bus))]
        flow = rng.permutation(branch)[: int(share * len(branch))]
        rows = [
            (VM, bus[:1], BUS),
            (P, pick, BUS),
            (Q, pick, BUS),
            (P, flow, FROM),
            (Q, flow, FROM),
        ]
        layout = SensorLayout.of(network, *rows)
        wls = WeightedLeastSquares(network, layout)
        J = wls.model.jacobian(truth).toarray()
        full = np.linalg.matrix_rank(J / np.maximum(np.linalg.norm(J, axis=0), 1e-9), 1e-9)
        expected = full == wls.model.shape[1]
        z = MeasurementModel(network, layout).h(truth)
        try:
            wls.solve(z, np.full(len(z), 0.01), start=truth)
            verdicts.append(True)
        except Unobservable:
            verdicts.append(False)
        assert verdicts[-1] == expected
    assert 0 < sum(verdicts) < len(verdicts)


def test_unobservable_grid_names_the_buses_and_a_remedy() -> None:
    network = library.load("ieee33")
    reached = np.arange(17)  # all but bus 18 and the laterals
    layout = SensorLayout.of(
        network, (VM, np.array([0]), BUS), (P, reached[1:17], BUS), (Q, reached[1:17], BUS)
    )
    with pytest.raises(Unobservable) as caught:
        WeightedLeastSquares(network, layout).solve(np.zeros(33), np.ones(33))
    message = str(caught.value)
    assert message.startswith("ieee33 is not observable")
    assert "33 measurements leave 32 of 65 states open" in message
    assert "the angles of buses" in message
    assert "the magnitudes of buses" in message
    assert "add a P and Q injection" in message


def test_only_the_bus_that_is_not_reached_is_named() -> None:
    network = library.load("ieee33")
    bus = np.array([b for b in range(33) if network.buses.name[b] not in ("17", "18")])
    layout = SensorLayout.of(network, (VM, bus[:1], BUS), (P, bus, BUS), (Q, bus, BUS))
    z = MeasurementModel(network, layout).h(solve(network).x)
    with pytest.raises(
        Unobservable, match=r"the angles of buses 18 and the magnitudes of buses 18:"
    ):
        WeightedLeastSquares(network, layout).solve(z, np.full(len(z), 0.01))


def test_no_measurement_at_all_is_unobservable_too() -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    nothing = np.zeros(len(layout), dtype=bool)
    wls = WeightedLeastSquares(network, layout)
    with pytest.raises(Unobservable, match="0 measurements leave 27 of 27 states open"):
        wls.solve(np.zeros(len(layout)), np.ones(len(layout)), nothing)


def test_contradictory_data_end_without_convergence_and_say_so() -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    z = MeasurementModel(network, layout).h(solve(network).x)
    z[layout.quantity == VM] = -3.0
    solution = WeightedLeastSquares(network, layout).solve(z, np.full(len(z), 0.01))
    assert not solution.converged
    state, info = tracking_wls("wls", network, layout).init(snapshot(z, np.full(len(z), 0.01)))
    assert state is None
    assert info.status is Status.NOT_CONVERGED


def test_tracking_starts_from_the_last_estimate_and_owes_it_nothing() -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    rng = np.random.default_rng(SEED)
    sigma = np.full(len(layout), 0.01)
    z = MeasurementModel(network, layout).h(solve(network).x) + sigma * rng.normal(size=len(sigma))
    wls = tracking_wls("wls", network, layout)
    first, cold = wls.init(snapshot(z, sigma))
    second, warm = wls.step(first, snapshot(z, sigma))
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(wls.read(second).x, wls.read(first).x, atol=1e-8)
    assert cold.dof == len(layout) - 27
    assert cold.nis == pytest.approx(cold.dof, abs=4 * np.sqrt(2 * cold.dof))


def test_normalised_residuals_have_unit_variance() -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    rng = np.random.default_rng(SEED)
    sigma = np.full(len(layout), 2e-3)
    exact = MeasurementModel(network, layout).h(solve(network).x)
    wls = tracking_wls("wls", network, layout)
    white = []
    for _ in range(200):
        _, info = wls.init(snapshot(exact + sigma * rng.normal(size=len(sigma)), sigma))
        white.append(info.innovation / info.sigma_innovation)
    # A row that alone fixes a state has next to no residual; the rest are standard normal.
    ratio = np.array(white).std(axis=0)
    assert np.abs(ratio - 1).max() < 4.5 / np.sqrt(2 * 200)


@pytest.mark.parametrize("grid", GRIDS)
def test_few_voltage_phasors_and_current_phasors_suffice_from_a_flat_start(grid: str) -> None:
    network = library.load(grid)
    branch = np.flatnonzero(network.branches.in_service)
    layout = SensorLayout.of(
        network,
        *[(q, np.array([0, network.n_bus // 2]), BUS) for q in (VM, VA)],
        *[(q, branch, FROM) for q in (IM, IA)],
    )
    names = tuple(
        f"d{p}.{s}:{q}"
        for p, s, q in zip(layout.position, layout.side, layout.quantity, strict=True)
    )
    layout = dataclasses.replace(layout, channel=names)
    rng = np.random.default_rng(SEED)
    truth = solve(network).x
    sigma = np.full(len(layout), 1e-4)
    z = MeasurementModel(network, layout).h(truth) + sigma * rng.normal(size=len(sigma))
    solution = WeightedLeastSquares(network, layout).solve(z, sigma)
    assert solution.converged
    assert np.abs(solution.x - truth).max() < 0.02


def test_a_flat_start_knows_what_phase_shifters_turn() -> None:
    network = library.load("ieee33")
    shift = np.zeros(network.n_branch)
    shift[0] = np.deg2rad(150.0)
    network = dataclasses.replace(
        network, branches=dataclasses.replace(network.branches, shift_rad=shift)
    )
    for layout in (conventional(network), every_quantity(network)):
        truth = solve(network).x
        solution = WeightedLeastSquares(network, layout).solve(
            measured(network, layout, truth), np.full(len(layout), 0.01), layout.quantity < IM
        )
        assert solution.converged
        np.testing.assert_allclose(solution.x, truth, atol=1e-9)


def test_shifters_in_series_turn_by_less_than_a_full_turn() -> None:
    network = library.load("ieee33")
    shift = np.zeros(network.n_branch)
    shift[:3] = np.deg2rad(150.0)
    turned = dataclasses.replace(
        network, branches=dataclasses.replace(network.branches, shift_rad=shift)
    )
    expected = np.deg2rad([-150.0, 60.0, -90.0])  # -150, -300 and -450
    np.testing.assert_allclose(turned.resting_angle_rad[1:4], expected, atol=1e-12)


def test_without_the_angles_of_a_layout_the_slack_is_the_reference() -> None:
    network = library.load("ieee14")
    bus = np.arange(network.n_bus)
    angle = (VA, np.array([2, 5]), BUS)
    layout = SensorLayout.of(network, (VM, bus, BUS), (P, bus, BUS), (Q, bus, BUS), angle)
    silent = layout.quantity != VA
    rng = np.random.default_rng(SEED)
    sigma = np.full(len(layout), 0.01)
    z = measured(network, layout, solve(network).x) + sigma * rng.normal(size=len(layout))
    with_angles, without = (
        WeightedLeastSquares(network, layout),
        layout.take(np.flatnonzero(silent)),
    )
    found = with_angles.solve(z, sigma, silent)
    plain = WeightedLeastSquares(network, without).solve(z[silent], sigma[silent])
    assert found.pinned
    assert not plain.pinned
    np.testing.assert_allclose(found.x, plain.x, atol=1e-8)
    # A tracking filter stays where the reference last was, and comes back to it.
    tracking = tracking_wls("wls", network, layout)
    turned = np.where(layout.quantity == VA, z + 0.3, z)
    state, _ = tracking.init(snapshot(turned, sigma))
    last = tracking.read(state).x[network.slack]
    state, info = tracking.step(state, snapshot(turned, sigma, silent, 1))
    assert info.status is Status.OK
    assert "no angle" in info.detail
    assert tracking.read(state).x[network.slack] == pytest.approx(last, abs=1e-9)
    state, info = tracking.step(state, snapshot(turned, sigma, step=2))
    assert tracking.read(state).x[network.slack] == pytest.approx(last, abs=1e-6)
    assert info.detail == ""
