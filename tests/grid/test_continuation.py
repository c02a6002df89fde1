"""Claim: continuation finds the largest load that a grid carries, and how that limit is reached."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pse_analysis.errors import GridError, NotConverged, ParameterError
from pse_analysis.grid import BusKind, Network, library
from pse_analysis.grid.continuation import (
    ContinuationParams,
    EndKind,
    Loading,
    continuation,
)
from pse_analysis.grid.continuation.base import UPPER
from pse_analysis.grid.power_flow import solve

FREE = ContinuationParams(enforce_q_limits=False)
GRIDS = ("ieee14", "ieee30", "ieee57", "ieee118")


def growth(network: Network) -> Loading:
    """Every load and generation grows; the slack bus takes up the rest, as in plain power flow."""
    return Loading.of_all(network, balance={network.buses.name[network.slack]: 1.0})


def largest_load(network: Network, loading: Loading, *, limits: bool, resolution: float) -> float:
    """The largest λ at which a plain power flow converges, by bisection from a flat start."""
    d = loading.direction(network)
    low, high = 0.0, 8.0
    while high - low > resolution:
        middle = 0.5 * (low + high)
        p = network.p_nominal_pu + middle * d.p_pu
        q = network.q_nominal_pu - middle * d.q_load_pu
        try:
            solve(network, p, q, enforce_q_limits=limits)
            low = middle
        except NotConverged:
            high = middle
    return 0.5 * (low + high)


def two_buses(r: float, x: float, p_mw: float, q_mvar: float) -> Network:
    """A source at 1 p.u. behind one line to a load, on 100 MVA."""
    return Network.from_tables(
        pd.DataFrame({"name": ["line"], "base_mva": [100.0]}),
        pd.DataFrame(
            {
                "name": ["a", "b"],
                "kind": [3, 1],
                "vn_kv": [110.0, 110.0],
                "p_load_mw": [0.0, p_mw],
                "q_load_mvar": [0.0, q_mvar],
            }
        ),
        pd.DataFrame({"from_bus": ["a"], "to_bus": ["b"], "r_pu": [r], "x_pu": [x]}),
    )


def largest_over_line(r: float, x: float, p: float, q: float) -> float:
    """λ at which |V|⁴ + (2(rP + xQ) - 1)|V|² + |z|²|S|² = 0 has one root, S = (1 + λ)(p + jq)."""
    a, b = r * p + x * q, np.hypot(r, x) * np.hypot(p, q)
    # (1 - 2 k a)² = 4 k² b²  at  k = 1 + λ
    return float(1.0 / (2.0 * (a + b)) - 1.0)


@pytest.mark.parametrize("grid", GRIDS)
def test_nose_is_the_largest_load_at_which_a_plain_power_flow_converges(grid: str) -> None:
    network = library.load(grid)
    curve = continuation(network, growth(network), FREE)
    plain = largest_load(network, growth(network), limits=False, resolution=2e-3)
    assert curve.limit == pytest.approx(plain, abs=2e-3 + 0.001 * plain)
    assert curve.end == EndKind.SADDLE_NODE


@pytest.mark.parametrize("grid", ["ieee14", "ieee30"])
def test_reactive_limits_end_it_where_bisection_with_the_same_limits_ends(grid: str) -> None:
    network = library.load(grid)
    curve = continuation(network, growth(network))
    plain = largest_load(network, growth(network), limits=True, resolution=1e-3)
    assert curve.limit == pytest.approx(plain, abs=1.5e-3)
    assert curve.limit < continuation(network, growth(network), FREE).limit
    assert (curve.status[curve.nose] == UPPER).any()


def random_loading(network: Network, rng: np.random.Generator) -> Loading:
    """A few loads that change, some of them down, and a few generators that rise."""
    names, size = network.buses.name, network.n_bus
    loads = rng.choice(size, rng.integers(1, 8), replace=False)
    sources = np.flatnonzero(network.buses.kind != BusKind.PQ)
    rising = rng.choice(sources, rng.integers(0, 4), replace=False)
    return Loading(
        "random",
        p_gen_mw={names[k]: float(rng.uniform(0, 1)) for k in rising},
        p_load_mw={names[k]: float(rng.uniform(-0.3, 1)) for k in loads},
        q_load_mvar={names[k]: float(rng.uniform(-0.2, 0.6)) for k in loads},
        balance={names[network.slack]: 1.0},
    )


@pytest.mark.parametrize(
    ("grid", "seed"), [*(("ieee14", seed) for seed in range(8)), ("ieee57", 0), ("ieee57", 1)]
)
def test_along_any_loading_power_flow_converges_below_the_limit_and_not_above(
    grid: str, seed: int
) -> None:
    network = library.load(grid)
    loading = random_loading(network, np.random.default_rng([seed, 13]))
    d, limit = loading.direction(network), continuation(network, loading).limit

    def solvable(factor: float) -> bool:
        p = network.p_nominal_pu + factor * d.p_pu
        q = network.q_nominal_pu - factor * d.q_load_pu
        try:
            solve(network, p, q, enforce_q_limits=True)
        except NotConverged:
            return False
        return True

    assert solvable(0.998 * limit)
    assert not solvable(1.002 * limit)


def test_generator_that_returns_from_its_limit_within_a_step_does_not_end_the_curve() -> None:
    # Bus 3 comes to its lower limit, and its voltage falls back at once, far below the nose.
    network = library.load("ieee57")
    loading = Loading(
        "relief",
        p_load_mw={"43": -0.291, "23": 0.024},
        q_load_mvar={"43": 0.051, "23": -0.05},
        balance={"1": 1.0},
    )
    curve = continuation(network, loading)
    touched = curve.event.index("bus 3 at its lower reactive limit")
    assert "bus 3 holds its voltage again" in curve.event[touched:]
    assert curve.limit > 1.5 * curve.loading[touched]
    d = loading.direction(network)
    p = network.p_nominal_pu + 0.99 * curve.limit * d.p_pu
    q = network.q_nominal_pu - 0.99 * curve.limit * d.q_load_pu
    assert not solve(network, p, q, enforce_q_limits=True).limited[network.bus("3")]


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    r=st.floats(0.0, 0.1), x=st.floats(0.05, 0.5), p=st.floats(1.0, 60.0), q=st.floats(-10.0, 30.0)
)
def test_nose_of_a_line_is_the_closed_form(r: float, x: float, p: float, q: float) -> None:
    expected = largest_over_line(r, x, p / 100, q / 100)
    network = two_buses(r, x, p, q)
    if expected <= 0.01:
        return
    curve = continuation(network, Loading.of_all(network))
    assert curve.limit == pytest.approx(expected, rel=1e-8)
    assert curve.end == EndKind.SADDLE_NODE


def test_lossless_line_ends_at_half_the_short_circuit_power_and_seventy_per_cent_voltage() -> None:
    # P = 1/(2x) = 2.5 p.u. at |V| = 1/√2 and 45°, unity power factor.
    network = two_buses(0.0, 0.2, 100.0, 0.0)
    curve = continuation(network, Loading.of_all(network))
    assert 1.0 + curve.limit == pytest.approx(2.5, rel=1e-9)
    assert curve.vm[1, curve.nose] == pytest.approx(np.sqrt(0.5), rel=1e-4)
    assert curve.theta[1, curve.nose] == pytest.approx(-np.pi / 4, rel=1e-4)


@pytest.mark.parametrize("grid", GRIDS)
def test_least_singular_value_tends_to_zero_at_a_saddle_node(grid: str) -> None:
    network = library.load(grid)
    curve = continuation(network, growth(network), FREE)
    least = [
        np.linalg.svd(curve.jacobian(k), compute_uv=False)[-1]
        for k in (0, curve.nose - 2, curve.nose - 1, curve.nose)
    ]
    assert least[0] > least[1] > least[2] > least[3]
    assert least[3] < 1e-9 * least[0]


@pytest.mark.parametrize("grid", ["ieee14", "ieee118"])
@pytest.mark.parametrize("limits", [False, True])
def test_every_point_is_a_solution_and_the_slope_turns_once(grid: str, limits: bool) -> None:
    network = library.load(grid)
    loading = growth(network)
    curve = continuation(network, loading, ContinuationParams(enforce_q_limits=limits))
    d, n = loading.direction(network), network.n_bus
    voltage = curve.vm * np.exp(1j * curve.theta)
    power = voltage * (network.y_bus @ voltage).conj()
    p = curve.grid.base.p_pu[:, None] + d.p_pu[:, None] * curve.loading
    p = p + d.share[:, None] * curve.y[2 * n]
    np.testing.assert_allclose(power.real, p, atol=1e-8)
    load = network.buses.kind == BusKind.PQ
    q = (network.q_nominal_pu[:, None] - d.q_load_pu[:, None] * curve.loading)[load]
    np.testing.assert_allclose(power.imag[load], q, atol=1e-8)
    assert (curve.slope[: curve.nose] > 0).all()
    assert (curve.slope[curve.nose + 1 :] < 0).all()
    assert len(curve.slope) > curve.nose + 2
    assert (np.diff(curve.loading[: curve.nose + 1]) >= 0).all()
    assert (np.diff(curve.loading[curve.nose :]) <= 0).all()


@pytest.mark.parametrize("grid", ["ieee14", "ieee57", "ieee118"])
def test_generators_stand_at_their_limit_or_at_their_voltage(grid: str) -> None:
    network = library.load(grid)
    curve = continuation(network, growth(network))
    buses, mva = network.buses, network.base_mva
    pv = buses.kind == BusKind.PV
    voltage = curve.vm * np.exp(1j * curve.theta)
    q_load = -network.q_nominal_pu[:, None] * (1.0 + curve.loading)
    q = (voltage * (network.y_bus @ voltage).conj()).imag + q_load
    assert (q[pv] <= buses.q_max_mvar[pv, None] / mva + 1e-6).all()
    assert (q[pv] >= buses.q_min_mvar[pv, None] / mva - 1e-6).all()
    above = curve.vm[pv] > buses.vm_set_pu[pv, None] + 1e-6
    below = curve.vm[pv] < buses.vm_set_pu[pv, None] - 1e-6
    at_upper = np.abs(q[pv] - buses.q_max_mvar[pv, None] / mva) < 1e-6
    at_lower = np.abs(q[pv] - buses.q_min_mvar[pv, None] / mva) < 1e-6
    assert (at_upper | ~below).all()
    assert (at_lower | ~above).all()


def test_generator_takes_its_voltage_up_again_where_load_falls() -> None:
    # Base reactive load far beyond the generator's limit; the loading takes it away.
    network = library.load("ieee14")
    buses = network.buses
    heavy = dataclasses.replace(
        network,
        buses=dataclasses.replace(
            buses, q_load_mvar=np.where(np.array(buses.name) == "3", 60.0, buses.q_load_mvar)
        ),
    )
    assert solve(heavy, enforce_q_limits=True).limited[heavy.bus("3")]
    loading = Loading("relief", p_load_mw={"9": 10.0}, q_load_mvar={"3": -20.0}, balance={"1": 1.0})
    curve = continuation(heavy, loading)
    assert "bus 3 holds its voltage again" in curve.event
    at = curve.event.index("bus 3 holds its voltage again")
    assert curve.vm[heavy.bus("3"), at] == pytest.approx(1.01, abs=1e-9)
    flow = solve(
        heavy,
        heavy.p_nominal_pu + (curve.loading[at] + 0.2) * loading.direction(heavy).p_pu,
        heavy.q_nominal_pu - (curve.loading[at] + 0.2) * loading.direction(heavy).q_load_pu,
        enforce_q_limits=True,
    )
    assert not flow.limited[heavy.bus("3")]


def test_limit_induced_end_is_told_from_a_saddle_node() -> None:
    network = library.load("ieee118")
    curve = continuation(network, growth(network))
    assert curve.end == EndKind.LIMIT_INDUCED
    assert network.buses.name[curve.nose_bus] == "10"
    # The Jacobian is regular on both sides, and the slope jumps from + to -.
    least = np.linalg.svd(curve.jacobian(curve.nose), compute_uv=False)[-1]
    assert least > 1e-3
    assert curve.nose_tangent[-1] > 0 > curve.slope[curve.nose]
    # A little more reactive range at that bus carries the curve on.
    q_max = network.buses.q_max_mvar.copy()
    q_max[curve.nose_bus] += 20.0
    wider = dataclasses.replace(network, buses=dataclasses.replace(network.buses, q_max_mvar=q_max))
    assert continuation(wider, growth(wider)).limit > curve.limit


def test_imbalance_is_shared_as_asked() -> None:
    network = library.load("ieee14")
    loading = Loading("south", p_load_mw={"14": 1.0, "13": 1.0}, balance={"2": 3.0, "3": 1.0})
    curve = continuation(network, loading)
    k = curve.nose
    injected = curve.grid.model.h(curve.x[:, k])[: network.n_bus]
    rise = (injected - curve.grid.base.p_pu) * network.base_mva
    assert rise[network.bus("2")] == pytest.approx(3 * rise[network.bus("3")], rel=1e-6)
    assert rise[network.bus("1")] == pytest.approx(0.0, abs=1e-6)
    assert rise[network.bus("13")] == pytest.approx(-curve.limit, rel=1e-6)


def test_scale_of_the_loading_vector_is_only_a_scale() -> None:
    network = library.load("ieee30")
    one = growth(network)
    thousandth = Loading(
        "small",
        **{
            key: {bus: 1e-3 * value for bus, value in getattr(one, key).items()}
            for key in ("p_gen_mw", "p_load_mw", "q_load_mvar")
        },
        balance=one.balance,
    )
    limits = [continuation(network, loading).limit for loading in (one, thousandth)]
    assert limits[1] == pytest.approx(1e3 * limits[0], rel=1e-6)


def test_solved_state_as_estimate_gives_the_same_curve_as_the_tables() -> None:
    network = library.load("ieee118")
    state = solve(network, enforce_q_limits=True).x
    own = continuation(network, growth(network))
    given_ = continuation(network, growth(network), state=state)
    assert given_.limit == pytest.approx(own.limit, rel=1e-7)
    assert given_.end == own.end


def test_state_at_a_loading_is_that_of_a_plain_power_flow() -> None:
    network = library.load("ieee57")
    loading = growth(network)
    curve = continuation(network, loading, FREE)
    d = loading.direction(network)
    found = curve.at(0.5)
    assert found is not None
    flow = solve(
        network, network.p_nominal_pu + 0.5 * d.p_pu, network.q_nominal_pu - 0.5 * d.q_load_pu
    )
    np.testing.assert_allclose(found.y[: 2 * network.n_bus], flow.x, atol=1e-7)
    assert curve.at(curve.limit * 1.01) is None


@pytest.mark.parametrize(("grid", "limits"), [("ieee14", True), ("ieee30", True), ("ieee118", True),
                                              ("ieee57", False)])  # fmt: skip
def test_sensitivity_of_the_nose_equals_finite_differences(grid: str, limits: bool) -> None:
    network = library.load(grid)
    loading = growth(network)
    params = ContinuationParams(enforce_q_limits=limits)
    n = network.n_bus
    x = solve(network, enforce_q_limits=limits).x
    curve = continuation(network, loading, params, state=x)
    located = curve.at_nose()
    last = np.zeros(2 * n + 2)
    last[-1] = 1.0
    gradients = [located.sensitivity(last)]
    k = int(np.argmin(curve.vm[:, curve.nose]))
    voltage = np.zeros(2 * n + 2)
    voltage[n + k] = 1.0
    gradients.append(located.sensitivity(voltage))
    rng = np.random.default_rng(13)
    free = np.flatnonzero(np.abs(gradients[0]) > 0)
    for column in rng.choice(free, 3, replace=False):
        step = np.zeros(2 * n)
        step[column] = 1e-5
        after, before = (
            continuation(network, loading, params, state=x + sign * step) for sign in (1, -1)
        )
        change = [
            (after.limit - before.limit) / 2e-5,
            (after.vm[k, after.nose] - before.vm[k, before.nose]) / 2e-5,
        ]
        for gradient, numeric in zip(gradients, change, strict=True):
            assert gradient[column] == pytest.approx(
                numeric, rel=2e-3, abs=2e-4 * np.abs(gradient).max()
            )


def test_loading_that_sums_to_nothing_is_refused_with_a_remedy() -> None:
    network = library.load("ieee14")
    with pytest.raises(GridError, match=r"'none' sums to nothing.*Loading\.of_all"):
        continuation(network, Loading("none", p_load_mw={"4": 0.0}))


def test_numbers_and_buses_of_a_loading_are_checked() -> None:
    network = library.load("ieee14")
    with pytest.raises(GridError, match=r"ieee14 has no bus '144': did you mean 14"):
        continuation(network, Loading("far", p_load_mw={"144": 1.0}))
    with pytest.raises(GridError, match=r"p_load_mw must be finite, received nan at bus '4'"):
        continuation(network, Loading("no", p_load_mw={"4": float("nan")}))
    with pytest.raises(GridError, match=r"balance must not be negative, received -1 at bus '2'"):
        continuation(network, Loading("no", p_load_mw={"4": 1.0}, balance={"2": -1.0}))


def test_loading_that_only_the_slack_feels_is_refused() -> None:
    network = library.load("ieee14")
    loading = Loading("own", p_gen_mw={"1": 10.0}, balance={"1": 1.0})
    with pytest.raises(GridError, match=r"sums to nothing in ieee14.*set balance"):
        continuation(network, loading)


def test_base_case_without_solution_names_the_remedy() -> None:
    network = two_buses(0.0, 0.2, 300.0, 0.0)
    with pytest.raises(NotConverged, match=r"base case of line has no solution.*lower its load"):
        continuation(network, Loading.of_all(network))


def test_area_without_reserve_names_the_remedy() -> None:
    network = library.load("ieee14")
    with pytest.raises(GridError, match=r"sending area \(2 buses\) has no generation.*reserve_mw"):
        Loading.transfer(network, "t", ["13", "14"], ["4"], by_load=True)
    with pytest.raises(GridError, match=r"has no reserve that could rise"):
        Loading.transfer(network, "t", ["1"], ["4"], by_load=True, reserve_mw={"1": 0.0})
    with pytest.raises(GridError, match=r"receiving area .* has no generation.*by_load=True"):
        Loading.transfer(network, "t", ["1"], ["4"])
    with pytest.raises(GridError, match=r"bus '1' is in the sending and in the receiving area"):
        Loading.transfer(network, "t", ["1", "2"], ["1"])


def test_transfer_moves_one_megawatt() -> None:
    network = library.load("ieee14")
    loading = Loading.transfer(network, "t", ["1", "2"], ["9", "14"], by_load=True)
    assert sum(loading.p_gen_mw.values()) == pytest.approx(1.0)
    assert sum(loading.p_load_mw.values()) == pytest.approx(1.0)
    assert loading.q_load_mvar["9"] / loading.p_load_mw["9"] == pytest.approx(16.6 / 29.5)
    reserve = Loading.transfer(
        network, "t", ["1", "2"], ["9"], by_load=True, reserve_mw={"2": 30.0, "1": 10.0}
    )
    assert reserve.p_gen_mw == pytest.approx({"1": 0.25, "2": 0.75})


def test_loading_that_relieves_the_grid_has_no_limit() -> None:
    network = two_buses(0.0, 0.2, 0.0, 0.0)
    loading = Loading("shunt", q_load_mvar={"b": -1.0})
    with pytest.raises(NotConverged, match=r"no limit within 40 points.*turn its sign"):
        continuation(network, loading, ContinuationParams(max_points=40))


def test_state_that_does_not_fit_is_refused() -> None:
    network = library.load("ieee14")
    with pytest.raises(GridError, match=r"must have 28 values \[θ; \|V\|\], received shape \(3,\)"):
        continuation(network, growth(network), state=np.ones(3))
    x = solve(network).x
    x[20] = np.nan
    with pytest.raises(GridError, match=r"\|V\| = nan p\.u\. at bus '7'"):
        continuation(network, growth(network), state=x)


def test_parameters_out_of_range_are_refused() -> None:
    with pytest.raises(ParameterError, match="0 < first_step ≤ largest_step"):
        ContinuationParams(first_step=0.5)
    with pytest.raises(ParameterError, match="tolerance must lie in"):
        ContinuationParams(tolerance=1.0)
