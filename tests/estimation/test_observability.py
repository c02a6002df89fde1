"""Claim: what the measurements leave open is left open, and the rest is estimated as ever."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import conventional, snapshot
from scipy import sparse

from pse_analysis.errors import Unobservable
from pse_analysis.estimation.core.normal import equilibrated
from pse_analysis.estimation.static.observability import closing_rows, open_states
from pse_analysis.estimation.static.tracking import tracking_wls
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.grid import library
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, IM, VA, VM, MeasurementModel, P, Q, SensorLayout

SEED = 12


def dense_null_space(jacobian: sparse.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """How much of each state lies in the null space, and the singular values that are not zero."""
    scaled, _, _ = equilibrated(jacobian)
    _, singular, vectors = np.linalg.svd(scaled.toarray(), full_matrices=True)
    rank = int((singular > 1e-12).sum())
    return np.linalg.norm(vectors[rank:], axis=0), singular[:rank]


def without(network: Network, layout: SensorLayout, *buses: str) -> np.ndarray:
    """Rows that see none of some buses."""
    place = [network.bus(name) for name in buses]
    branch = network.branches
    near = np.isin(branch.from_bus, place) | np.isin(branch.to_bus, place)
    hidden = np.where(near)[0]
    linked = np.unique(np.concatenate([branch.from_bus[hidden], branch.to_bus[hidden]]))
    injection = np.isin(layout.quantity, (P, Q))
    at_bus = np.isin(layout.position, place) | (injection & np.isin(layout.position, linked))
    return np.where(layout.side == BUS, ~at_bus, ~np.isin(layout.position, hidden))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    share=st.floats(0.2, 0.6),
    grid=st.sampled_from(["ieee14", "ieee33"]),
)
def test_open_states_are_those_of_the_jacobians_null_space(
    seed: int, share: float, grid: str
) -> None:
    rng, network = np.random.default_rng(seed), library.load(grid)
    n, layout = network.n_bus, conventional(network)
    model = MeasurementModel(network, layout, np.delete(np.arange(2 * n), network.slack))
    rows = rng.random(len(layout)) < share
    J = model.jacobian(solve(network).x)[np.flatnonzero(rows)]
    open_, (part, singular) = open_states(J), dense_null_space(J)
    assert open_[part > 1e-3].all()
    # What is determined only through a factor of a million is as good as open.
    if singular.min() > 1e-6:
        assert not open_[part < 1e-9].any()


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), decades=st.floats(0.0, 9.0))
def test_observability_does_not_depend_on_how_rows_are_weighed(seed: int, decades: float) -> None:
    rng, network = np.random.default_rng(seed), library.load("ieee14")
    layout = conventional(network)
    model = MeasurementModel(network, layout, np.delete(np.arange(28), network.slack))
    rows = np.flatnonzero(rng.random(len(layout)) < 0.4)
    J = model.jacobian(solve(network).x)[rows]
    weighed = sparse.diags_array(10.0 ** rng.uniform(0.0, decades, len(rows))) @ J
    np.testing.assert_array_equal(open_states(sparse.csr_array(weighed)), open_states(J))


def test_rows_that_close_a_gap_are_as_many_as_it_has_dimensions() -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    columns = np.delete(np.arange(28), network.slack)
    J = MeasurementModel(network, layout, columns).jacobian(solve(network).x)
    few, offered = J[::7], J[: 3 * 14]
    rank = np.linalg.matrix_rank(few.toarray())
    assert rank < 27
    closing = closing_rows(few, offered)
    whole = sparse.csr_array(sparse.vstack([few, offered[closing]]))
    assert len(closing) == 27 - rank
    assert np.linalg.matrix_rank(whole.toarray()) == 27


def test_two_buses_without_any_meter_take_nothing_from_the_others() -> None:
    """Known states and their σ are those of the pseudo-inverse, which leaves the open ones out."""
    network = library.load("ieee33")
    layout = conventional(network)
    rows = without(network, layout, "17", "18")
    truth = solve(network).x
    rng = np.random.default_rng(SEED)
    sigma = np.where(layout.quantity == VM, 0.004, 0.01)
    z = MeasurementModel(network, layout).h(truth) + sigma * rng.normal(size=len(layout))
    got = WeightedLeastSquares(network, layout).solve(z, sigma, rows, partial=True)
    names = [network.buses.name[k % 33] for k in np.flatnonzero(got.open)]
    assert names == ["17", "18"] * 2
    columns = np.delete(np.arange(66), network.slack)
    H = MeasurementModel(network, layout, columns).jacobian(got.x).toarray()[rows]
    H /= sigma[rows, None]
    known = ~got.open[columns]
    textbook = np.linalg.pinv(H.T @ H, rcond=1e-12)
    ours = got.covariance()[np.ix_(columns, columns)]
    np.testing.assert_allclose(
        ours[np.ix_(known, known)], textbook[np.ix_(known, known)], rtol=1e-6, atol=1e-14
    )
    assert np.isnan(np.diagonal(ours)[~known]).all()
    residual = MeasurementModel(network, layout).residual(z, got.x)[rows] / sigma[rows]
    np.testing.assert_allclose((H.T @ residual)[known], 0.0, atol=1e-5)
    error = np.abs(got.x - truth)[columns][known]
    assert (error < 4.5 * np.sqrt(np.diagonal(ours)[known])).all()
    with pytest.raises(Unobservable, match="angles of buses 17, 18 and the magnitudes"):
        WeightedLeastSquares(network, layout).solve(z, sigma, rows)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), share=st.floats(0.3, 0.6))
def test_exact_readings_give_the_truth_of_whatever_they_determine(seed: int, share: float) -> None:
    rng, network = np.random.default_rng(seed), library.load("ieee14")
    layout = conventional(network)
    truth = solve(network).x
    rows = rng.random(len(layout)) < share
    z = MeasurementModel(network, layout).h(truth)
    try:
        got = WeightedLeastSquares(network, layout).solve(
            z, np.full(len(layout), 0.01), rows, partial=True
        )
    except Unobservable:
        return
    assert got.converged
    known = ~got.open
    np.testing.assert_allclose(got.x[known], truth[known], atol=1e-7)
    assert got.objective < 1e-8


def islanded() -> tuple[Network, np.ndarray]:
    """ieee33 without the branches that hold a lateral, and its state: two grids of their own."""
    network = library.load("ieee33").open_branch("6-26")
    return network, solve(network, own_references=True).x


def test_each_island_is_estimated_against_a_reference_of_its_own() -> None:
    network, truth = islanded()
    assert len(np.unique(network.references)) == 2
    layout = conventional(network)
    z = MeasurementModel(network, layout).h(truth)
    got = WeightedLeastSquares(network, layout).solve(z, np.full(len(layout), 0.01))
    assert got.converged
    np.testing.assert_allclose(got.x, truth, atol=1e-8)
    zero = np.flatnonzero(np.diagonal(got.covariance()) == 0.0)
    assert zero.tolist() == np.unique(network.references).tolist()


def test_an_island_without_meters_is_open_and_the_other_one_is_not() -> None:
    network, truth = islanded()
    layout = conventional(network)
    here = network.islands() == network.islands()[network.slack]
    at = np.where(
        layout.side == BUS, layout.position, network.branches.from_bus[layout.position % 37]
    )
    rows = here[at]
    z = MeasurementModel(network, layout).h(truth)
    got = WeightedLeastSquares(network, layout).solve(
        z, np.full(len(layout), 0.01), rows, partial=True
    )
    reference = np.unique(network.references)
    expected = np.concatenate([~here, ~here])
    expected[reference] = False
    np.testing.assert_array_equal(got.open, expected)
    known = np.concatenate([here, here])
    np.testing.assert_allclose(got.x[known], truth[known], atol=1e-8)


@pytest.mark.parametrize("tiny", [1e-4, 1e-6, 1e-9])
def test_transit_buses_of_tiny_sigma_are_the_constraints_of_the_textbook(tiny: float) -> None:
    """Equality-constrained least squares by Lagrange's multipliers, dense."""
    network = library.load("ieee14")
    layout = conventional(network)
    truth = solve(network).x
    power = np.isin(layout.quantity, (P, Q)) & (layout.side == BUS)
    transit = power & (layout.position == network.bus("7"))
    assert transit.sum() == 2
    rng = np.random.default_rng(SEED)
    sigma = np.where(transit, tiny, 0.01)
    z = MeasurementModel(network, layout).h(truth) + np.where(transit, 0.0, 0.01) * rng.normal(
        size=len(layout)
    )
    got = WeightedLeastSquares(network, layout).solve(z, sigma)
    assert got.converged
    columns = np.delete(np.arange(28), network.slack)
    model = MeasurementModel(network, layout, columns)
    x = truth.copy()
    for _ in range(20):
        H, r = model.jacobian(x).toarray(), model.residual(z, x)
        A, C = H[~transit] / 0.01, H[transit]
        system = np.block([[A.T @ A, C.T], [C, np.zeros((2, 2))]])
        x[columns] += np.linalg.solve(
            system, np.concatenate([A.T @ (r[~transit] / 0.01), r[transit]])
        )[:27]
    covariance = np.linalg.inv(system)[:27, :27]
    np.testing.assert_allclose(got.x, x, atol=10 * tiny**2 + 1e-9)
    np.testing.assert_allclose(
        np.diagonal(got.covariance())[columns],
        np.diagonal(covariance),
        rtol=1e-4 if tiny < 1e-5 else 1e-1,
    )
    assert np.abs(got.residual[transit]).max() < 10 * tiny


def test_a_link_of_a_hundred_thousand_per_unit_is_observable() -> None:
    network = library.load("ieee14")
    k = 0
    branch = dataclasses.replace(
        network.branches,
        r_pu=np.where(np.arange(20) == k, 0.0, network.branches.r_pu),
        x_pu=np.where(np.arange(20) == k, 1e-5, network.branches.x_pu),
    )
    network = Network("linked", network.base_mva, network.buses, branch)
    layout = conventional(network)
    truth = solve(network).x
    z = MeasurementModel(network, layout).h(truth)
    got = WeightedLeastSquares(network, layout).solve(z, np.full(len(layout), 0.01))
    assert got.converged
    assert not got.open.any()
    np.testing.assert_allclose(got.x, truth, atol=1e-8)


def test_no_redundancy_has_a_sigma_and_says_that_nothing_is_checked() -> None:
    network = library.load("ieee14")
    bus = np.arange(14)
    pq = np.flatnonzero(bus != network.slack)
    layout = SensorLayout.of(
        network, (VM, np.array([network.slack]), BUS), (P, pq, BUS), (Q, pq, BUS)
    )
    truth = solve(network).x
    z, sigma = MeasurementModel(network, layout).h(truth), np.full(len(layout), 0.01)
    method = tracking_wls("wls", network, layout)
    state, info = method.init(snapshot(z, sigma))
    assert (info.status, info.dof) == ("ok", 0)
    assert "no redundancy" in info.detail
    estimate = method.read(state)
    assert estimate is not None
    columns = np.delete(np.arange(28), network.slack)
    H = MeasurementModel(network, layout, columns).jacobian(truth).toarray()
    np.testing.assert_allclose(
        np.diagonal(estimate.covariance)[columns],
        np.diagonal(np.linalg.inv(H.T @ H)) * 1e-4,
        rtol=1e-6,
    )


def test_what_stays_open_is_named_once() -> None:
    network = library.load("ieee33")
    layout = conventional(network)
    rows = without(network, layout, "18")
    z, sigma = MeasurementModel(network, layout).h(solve(network).x), np.full(len(layout), 0.01)
    method = tracking_wls("wls", network, layout)
    state, first = method.init(snapshot(z, sigma, rows))
    state, second = method.step(state, snapshot(z, sigma, rows, 1))
    state, whole = method.step(state, snapshot(z, sigma, None, 2))
    state, again = method.step(state, snapshot(z, sigma, rows, 3))
    assert [i.status for i in (first, second, whole, again)] == [
        "partly_observable", "partly_observable", "ok", "partly_observable",
    ]  # fmt: skip
    assert "buses 18" in first.detail
    assert "18" not in second.detail.replace("states", "")
    assert whole.detail == ""
    assert "buses 18" in again.detail


def test_a_current_that_vanishes_has_its_say_once_it_flows() -> None:
    """At a flat start no current flows, and yet only a current tells what bus 18 draws."""
    network = library.load("ieee33")
    branch = np.flatnonzero(network.branches.in_service)
    last = int(np.flatnonzero(network.branches.to_bus == network.bus("18"))[0])
    bus = np.flatnonzero(np.arange(33) != network.bus("18"))
    layout = SensorLayout.of(
        network, (VM, bus, BUS), (P, bus[:-1], BUS), (Q, bus, BUS), (IM, np.array([last]), FROM),
        (P, branch[branch != last], FROM), (VM, np.array([network.bus("18")]), BUS),
    )  # fmt: skip
    truth = solve(network).x
    z = MeasurementModel(network, layout).h(truth)
    wls = WeightedLeastSquares(network, layout)
    got = wls.solve(z, np.full(len(layout), 1e-3), start=wls.flat_start())
    assert got.converged
    assert got.objective < 1e-6


def test_angles_of_one_island_do_not_refer_the_other() -> None:
    """A phasor in one island, none in the other: that one keeps a reference of its own."""
    network, truth = islanded()
    layout = conventional(network)
    both = layout.joined(SensorLayout.of(network, (VA, np.array([2]), BUS)))
    turned = truth.copy()
    here = network.islands() == network.islands()[2]
    turned[:33][here] += 0.7
    z = MeasurementModel(network, both).h(turned)
    got = WeightedLeastSquares(network, both).solve(z, np.full(len(both), 0.01))
    np.testing.assert_allclose(got.x, turned, atol=1e-8)
    assert network.buses.kind[network.slack] == BusKind.SLACK
