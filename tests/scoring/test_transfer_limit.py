"""Claim: the maximum allowed power flow is what plain power flows at its six criteria say."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pandas as pd
import pytest
from reference import conventional
from scipy import optimize

from pse_analysis.errors import GridError, NotConverged, ParameterError, TableError
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.grid import Network, library
from pse_analysis.grid.continuation import (
    ContinuationParams,
    LoadedGrid,
    Loading,
    continuation,
    trace,
)
from pse_analysis.grid.continuation.base import BaseState
from pse_analysis.grid.power_flow import PowerFlow, solve
from pse_analysis.pipeline.processes import each
from pse_analysis.scoring.transfer_limit import (
    BranchEnd,
    Contingency,
    Section,
    TransferLimit,
    TransferLimitParams,
    sampled_limit,
    transfer_limit,
)

SENDING = ("1", "2", "3", "5")
RECEIVING = ("4", "9", "10", "11", "12", "13", "14")
WEST = tuple(str(i) for i in (*range(1, 24), *range(25, 33), 113, 114, 115, 117))
SEED = 2023


@cache
def grid14() -> Network:
    return library.load("ieee14")


def section14() -> Section:
    return Section.around(grid14(), "I", SENDING)


def plain() -> Loading:
    """A transfer that the slack bus balances, as in plain power flow."""
    loading = Loading.transfer(grid14(), "plain", SENDING, RECEIVING, by_load=True)
    return Loading(
        "plain", loading.p_gen_mw, loading.p_load_mw, loading.q_load_mvar, balance={"1": 1.0}
    )


# ------------------------------------------------- plain power flows, written from the definition


def flow_at(network: Network, factor: float) -> PowerFlow:
    d = plain().direction(network)
    p = network.p_nominal_pu + factor * d.p_pu
    q = network.q_nominal_pu - factor * d.q_load_pu
    return solve(network, p, q, enforce_q_limits=True)


def power_of(network: Network, flow: PowerFlow) -> float:
    """Power over 2-4, 3-4, 4-5 and 5-6 from the sending area, by hand."""
    voltage = flow.vm * np.exp(1j * flow.theta)
    branch, total = network.branches, 0.0
    for name, matrix, ends in (
        ("2-4", network.y_from, branch.from_bus),
        ("3-4", network.y_from, branch.from_bus),
        ("4-5", network.y_to, branch.to_bus),
        ("5-6", network.y_from, branch.from_bus),
    ):
        k = network.branch(name)
        total += (voltage[ends[k]] * (matrix[[k]] @ voltage).conj()[0]).real
    return float(total * network.base_mva)


def switch_point(holds: Callable[[float], bool], high: float = 400.0) -> float:
    """Where a condition that holds at 0 MW ends, by bisection."""
    low = 0.0
    for _ in range(34):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def solvable(network: Network, factor: float) -> bool:
    try:
        flow_at(network, factor)
    except NotConverged:
        return False
    return True


def largest_factor(network: Network) -> float:
    return switch_point(lambda factor: solvable(network, factor))


def lowest_margin(flow: PowerFlow, share: float) -> float:
    """Least of |V| - U_cr/share over load buses, U_cr = max(0.7, 0.75 U_normal)."""
    buses = grid14().buses
    load = (buses.p_load_mw != 0) | (buses.q_load_mvar != 0)
    critical = np.maximum(0.7, 0.75 * flow_at(grid14(), 0.0).vm)
    return float((flow.vm - critical / share)[load].min())


def end_current_ka(network: Network, flow: PowerFlow, name: str) -> float:
    voltage = flow.vm * np.exp(1j * flow.theta)
    k, branch = network.branch(name), network.branches
    ends = [
        np.abs((network.y_from[[k]] @ voltage)[0]) * network.base_ka[branch.from_bus[k]],
        np.abs((network.y_to[[k]] @ voltage)[0]) * network.base_ka[branch.to_bus[k]],
    ]
    return float(max(ends))


def row(limit: TransferLimit, criterion: str, contingency: str = "") -> pd.Series:
    table = limit.table
    found = table[(table["criterion"] == criterion) & (table["contingency"] == contingency)]
    assert len(found) == 1
    return found.iloc[0]


@cache
def limit14() -> TransferLimit:
    params = TransferLimitParams(
        continuous_ka={"2-4": 0.45, "1-2": 5.0}, emergency_ka={"2-4": 0.5, "4-5": 0.6}
    )
    return transfer_limit(
        grid14(), section14(), [plain()], params, contingencies=["3-4", "2-4", "5-6"]
    )


def test_first_criterion_is_a_share_of_the_largest_power() -> None:
    factor = largest_factor(grid14())
    power = power_of(grid14(), flow_at(grid14(), factor))
    assert row(limit14(), "stability")["power_mw"] == pytest.approx(0.8 * power, rel=1e-3)
    assert row(limit14(), "stability")["loading_factor"] == pytest.approx(factor, rel=1e-5)


def test_second_criterion_is_where_the_first_load_bus_lacks_voltage() -> None:
    factor = switch_point(
        lambda f: solvable(grid14(), f) and lowest_margin(flow_at(grid14(), f), 0.85) > 0
    )
    found = row(limit14(), "voltage")
    assert found["loading_factor"] == pytest.approx(factor, rel=1e-6)
    assert found["power_mw"] == pytest.approx(power_of(grid14(), flow_at(grid14(), factor)), 1e-6)
    assert found["element"] == "bus/14"


@pytest.mark.parametrize("trip", ["3-4", "2-4", "5-6"])
def test_criteria_after_an_outage_count_what_flows_before_it(trip: str) -> None:
    after = grid14().open_branch(trip)
    largest = power_of(after, flow_at(after, largest_factor(after)))
    factor = switch_point(
        lambda f: solvable(after, f) and power_of(after, flow_at(after, f)) < 0.92 * largest
    )
    found = row(limit14(), "stability_after_outage", trip)
    assert found["power_mw"] == pytest.approx(
        power_of(grid14(), flow_at(grid14(), factor)), rel=2e-3
    )
    factor = switch_point(
        lambda f: solvable(after, f) and lowest_margin(flow_at(after, f), 0.9) > 0
    )
    found = row(limit14(), "voltage_after_outage", trip)
    assert found["power_mw"] == pytest.approx(
        power_of(grid14(), flow_at(grid14(), factor)), rel=1e-6
    )


def test_current_limits_are_met_at_the_end_that_reaches_them_first() -> None:
    factor = switch_point(
        lambda f: (
            solvable(grid14(), f) and end_current_ka(grid14(), flow_at(grid14(), f), "2-4") < 0.45
        )
    )
    found = row(limit14(), "current")
    assert found["element"] == "branch/2-4"
    assert found["power_mw"] == pytest.approx(
        power_of(grid14(), flow_at(grid14(), factor)), rel=1e-6
    )
    after = grid14().open_branch("3-4")

    def holds(f: float) -> bool:
        if not solvable(after, f):
            return False
        flow = flow_at(after, f)
        return end_current_ka(after, flow, "2-4") < 0.5 and end_current_ka(after, flow, "4-5") < 0.6

    found = row(limit14(), "current_after_outage", "3-4")
    assert found["power_mw"] == pytest.approx(
        power_of(grid14(), flow_at(grid14(), switch_point(holds))), rel=1e-6
    )


def test_lowest_criterion_less_irregular_oscillations_is_the_limit() -> None:
    limit, buses = limit14(), grid14().buses
    inside = np.isin(buses.name, SENDING)
    one, other = buses.p_load_mw[inside].sum(), buses.p_load_mw[~inside].sum()
    assert limit.irregular_mw == pytest.approx(1.5 * np.sqrt(one * other / (one + other)))
    found = limit.table[limit.table["state"] == "found"]
    assert limit.mapf_mw == pytest.approx(found["power_mw"].min() - limit.irregular_mw)
    binding = limit.table[limit.table["binding"]]
    assert len(binding) == 1
    for key in ("criterion", "contingency", "loading", "element"):
        assert binding[key].iloc[0] == getattr(limit, key)
    assert limit.base_mw == pytest.approx(power_of(grid14(), flow_at(grid14(), 0.0)), rel=1e-6)
    assert len(limit.table) == 3 + 3 * 3
    assert np.isnan(limit.sigma_mw)


def test_margins_are_parameters() -> None:
    params = TransferLimitParams(power_share=0.5, irregular_mw=7.0)
    limit = transfer_limit(grid14(), section14(), [plain()], params)
    usual = row(limit14(), "stability")["power_mw"]
    assert limit.criterion == "stability"
    assert limit.mapf_mw == pytest.approx(0.5 / 0.8 * usual - 7.0, rel=1e-9)
    none = TransferLimitParams(irregular_factor=0.0)
    assert transfer_limit(grid14(), section14(), [plain()], none).irregular_mw == 0.0


def test_power_rises_up_to_the_nose_on_every_curve() -> None:
    for _, curve in limit14().curves.groupby(["loading", "contingency"]):
        before = curve[curve["stable"]]
        assert (np.diff(before["p_mw"]) > 0).all()
        assert (np.diff(before["loading_factor"]) >= 0).all()
        past = curve[~curve["stable"]]
        assert len(past) >= 2
        assert (past["slope"] < 0).all()


def test_of_several_loading_vectors_the_lowest_counts_whatever_runs_them() -> None:
    network, section = grid14(), section14()
    loadings = [
        Loading.transfer(network, "all", SENDING, RECEIVING, by_load=True),
        Loading.transfer(network, "south", SENDING, ["12", "13", "14"], by_load=True),
    ]
    outages = [Contingency("both", ("2-4", "3-4")), "5-6"]
    seen: list[tuple[int, int]] = []
    together = transfer_limit(
        network,
        section,
        loadings,
        contingencies=outages,
        run=partial(each, workers=2),
        progress=lambda done, of: seen.append((done, of)),
    )
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    alone = [transfer_limit(network, section, [one], contingencies=outages) for one in loadings]
    assert together.mapf_mw == pytest.approx(min(one.mapf_mw for one in alone), rel=1e-9)
    assert together.loading == "south"
    assert together.contingency in ("both", "5-6")
    assert sorted(together.table["value_mw"].dropna()) == pytest.approx(
        sorted(np.concatenate([one.table["value_mw"].dropna() for one in alone]))
    )


def test_hundred_and_eighteen_buses_with_ten_outages_and_three_vectors_take_twenty_seconds() -> (
    None
):
    network = library.load("ieee118")
    section = Section.around(network, "west", WEST)
    assert [end.branch for end in section.ends] == ["23-24", "15-33", "19-34", "30-38"]
    rest = [bus for bus in network.buses.name if bus not in WEST]
    loadings = [
        Loading.transfer(network, "generation", WEST, rest),
        Loading.transfer(network, "load", WEST, rest, by_load=True),
        Loading.transfer(network, "near", WEST, ["33", "34", "35", "36", "39"], by_load=True),
    ]
    outages = [
        "23-24",
        "15-33",
        "19-34",
        "30-38",
        "8-5",
        "9-10",
        "26-30",
        "25-27",
        "38-65",
        "49-66",
    ]
    # Processor time, so that what else runs on the machine does not count.
    begun = time.process_time()
    limit = transfer_limit(network, section, loadings, contingencies=outages)
    assert time.process_time() - begun < 20.0
    assert (limit.loading, limit.contingency) == ("near", "30-38")
    assert limit.findings == ()
    assert not (limit.table["state"] == "unresolved").any()
    assert limit.curves.groupby(["loading", "contingency"]).ngroups == 33
    assert limit.mapf_mw > limit.base_mw


def losses_mw(network: Network, x: np.ndarray) -> float:
    """Sum of R |I|² over the branches in service."""
    n, branch = network.n_bus, network.branches
    voltage = x[n:] * np.exp(1j * x[:n])
    tap = branch.tap * np.exp(1j * branch.shift_rad)
    drop = voltage[branch.from_bus] / tap - voltage[branch.to_bus]
    current = drop / (branch.r_pu + 1j * branch.x_pu)
    loss = branch.in_service * branch.r_pu * np.abs(current) ** 2
    return float(loss.sum() * network.base_mva)


def test_outage_that_cuts_off_a_generator_leaves_its_power_to_those_that_balance() -> None:
    # 9-10 is the only way out of bus 10, which generates 450 MW.
    network = library.load("ieee118")
    loading = Loading("east", p_load_mw={"59": 1.0}, balance={"25": 1.0, "26": 3.0, "10": 5.0})
    base = BaseState.solved(network)
    grid = LoadedGrid(network.open_branch("9-10"), base, loading.direction(network))
    curve = trace(grid)
    rise = grid.model.h(curve.x[:, 0])[: network.n_bus] - base.p_pu
    by_25, by_26 = (rise[network.bus(name)] * network.base_mva for name in ("25", "26"))
    assert by_26 == pytest.approx(3 * by_25, rel=1e-6)
    more_losses = losses_mw(grid.network, curve.x[:, 0]) - losses_mw(network, base.x)
    assert by_25 + by_26 == pytest.approx(450.0 + more_losses, abs=1e-3)
    others = [k for k, name in enumerate(network.buses.name) if name not in ("10", "25", "26")]
    np.testing.assert_allclose(rise[others], 0.0, atol=1e-8)
    assert curve.limit > 0


def three_buses() -> Network:
    """A generator with a load behind a lossy line, tied to the slack bus."""
    return Network.from_tables(
        pd.DataFrame({"name": ["three"], "base_mva": [100.0]}),
        pd.DataFrame(
            {
                "name": ["gen", "load", "rest"],
                "kind": [2, 1, 3],
                "vn_kv": [110.0] * 3,
                "p_load_mw": [0.0, 50.0, 100.0],
                "p_gen_mw": [150.0, 0.0, 0.0],
            }
        ),
        pd.DataFrame(
            {
                "name": ["own", "tie"],
                "from_bus": ["gen", "gen"],
                "to_bus": ["load", "rest"],
                "r_pu": [0.1, 0.01],
                "x_pu": [0.2, 0.05],
            }
        ),
    )


OWN = Loading("own", p_gen_mw={"gen": 1.3}, p_load_mw={"load": 1.0}, balance={"rest": 1.0})


def tie_power_mw(factor: float) -> float:
    """Generation less load and loss of the own line, whose voltage solves a quadratic equation."""
    p, r, x = 0.5 + factor / 100, 0.1, 0.2
    # |V|⁴ + (2rP - 1)|V|² + (r² + x²)P² = 0 with 1 p.u. at the generator
    b, c = 2 * r * p - 1.0, (r**2 + x**2) * p**2
    square = 0.5 * (-b + np.sqrt(b**2 - 4 * c))
    return float(150 + 1.3 * factor - 100 * (p + r * p**2 / square))


def test_power_that_falls_before_the_nose_has_its_largest_value_there() -> None:
    network = three_buses()
    section = Section("tie", (BranchEnd("tie"),))
    params = TransferLimitParams(irregular_mw=0.0, power_share=1.0)
    x = solve(network).x
    limit = transfer_limit(network, section, [OWN], params, state=x, covariance=np.eye(6))
    best = optimize.minimize_scalar(
        lambda f: -tie_power_mw(f), bounds=(0.0, 120.0), method="bounded", options={"xatol": 1e-9}
    )
    found = row(limit, "stability")
    assert found["power_mw"] == pytest.approx(-best.fun, rel=1e-9)
    assert found["loading_factor"] == pytest.approx(best.x, rel=1e-4)
    assert found["element"] == "largest power"
    nose = limit.curves["loading_factor"].max()
    assert found["loading_factor"] < 0.99 * nose
    step = 1e-5 * np.random.default_rng(SEED).standard_normal(6)
    after, before = (
        transfer_limit(network, section, [OWN], params, state=x + sign * step) for sign in (1, -1)
    )
    assert after.mapf_mw - before.mapf_mw == pytest.approx(2 * limit.gradient @ step, rel=1e-5)


# --------------------------------------------------------------------------- standard error


@cache
def estimated() -> tuple[np.ndarray, np.ndarray, WeightedLeastSquares, np.ndarray, np.ndarray]:
    """Truth, covariance and estimator of a grid with conventional meters of 1 %."""
    network = grid14()
    estimator = WeightedLeastSquares(network, conventional(network))
    x = solve(network, enforce_q_limits=True).x
    exact = estimator.model.h(x)
    sigma = np.full(len(exact), 0.01)
    covariance = estimator.solve(exact, sigma, start=x).covariance()
    return x, covariance, estimator, exact, sigma


LOADINGS = (Loading.transfer(grid14(), "south", SENDING, ["11", "12", "13", "14"], by_load=True),)


@pytest.mark.parametrize(
    "params",
    [
        TransferLimitParams(power_share=0.6),
        TransferLimitParams(power_share_after=0.7),
        TransferLimitParams(),
        TransferLimitParams(continuous_ka={"4-5": 0.3}),
        TransferLimitParams(emergency_ka={"4-5": 0.33}),
        TransferLimitParams(
            power_share=0.6, continuation=ContinuationParams(enforce_q_limits=False)
        ),
    ],
)
def test_gradient_of_every_criterion_equals_finite_differences(params: TransferLimitParams) -> None:
    x, covariance, *_ = estimated()

    def of(state: np.ndarray, covariance: np.ndarray | None = None) -> TransferLimit:
        return transfer_limit(
            grid14(), section14(), LOADINGS, params, contingencies=["3-4"],
            state=state, covariance=covariance,
        )  # fmt: skip

    limit = of(x, covariance)
    rng = np.random.default_rng(SEED)
    for _ in range(2):
        step = 1e-5 * rng.standard_normal(len(x))
        after, before = of(x + step), of(x - step)
        assert after.criterion == before.criterion == limit.criterion
        change = limit.gradient @ (2 * step)
        assert after.mapf_mw - before.mapf_mw == pytest.approx(change, rel=1e-3)
    assert limit.sigma_mw == pytest.approx(np.sqrt(limit.gradient @ covariance @ limit.gradient))
    # Angles count from anywhere.
    angles = limit.gradient[: grid14().n_bus]
    assert angles.sum() == pytest.approx(0.0, abs=1e-6 * np.abs(angles).max())


def test_estimated_generation_beyond_a_reactive_limit_is_kept_and_told() -> None:
    x = solve(grid14()).x.copy()
    bus = grid14().bus("8")
    x[grid14().n_bus + bus] += 0.06  # some 30 Mvar more, of 24 that it may give
    limit = transfer_limit(grid14(), section14(), [plain()], state=x)
    (finding,) = limit.findings
    assert finding.startswith("in the base state 1 generators lie beyond their reactive limits")
    assert "buses 8" in finding
    assert np.isfinite(limit.mapf_mw)


def test_predicted_sigma_agrees_with_estimates_of_noisy_meters() -> None:
    x, covariance, estimator, exact, sigma = estimated()
    limit = transfer_limit(grid14(), section14(), LOADINGS, state=x, covariance=covariance)
    rng = np.random.default_rng(SEED)
    values = []
    for _ in range(200):
        noisy = exact + sigma * rng.standard_normal(len(exact))
        found = estimator.solve(noisy, sigma, start=x)
        values.append(transfer_limit(grid14(), section14(), LOADINGS, state=found.x).mapf_mw)
    spread = float(np.std(values, ddof=1))
    assert limit.sigma_mw == pytest.approx(spread, rel=0.15)
    sampled = sampled_limit(
        grid14(), section14(), LOADINGS, state=x, covariance=covariance, limit=limit,
        rng=np.random.default_rng(SEED + 1), count=200,
    )  # fmt: skip
    assert sampled.sigma_mw == pytest.approx(spread, rel=0.15)
    assert sampled.sigma_mw == pytest.approx(limit.sigma_mw, rel=0.15)
    assert sampled.mean_mw == pytest.approx(limit.mapf_mw, abs=3 * spread / np.sqrt(200))
    assert sampled.undetermined == 0


def test_estimates_with_several_generators_at_limits_have_one_limit_within_noise() -> None:
    # In draws 119 and 235 three stand at their limit and set-point at once, where the first change
    # alone does not tell where the curve goes.
    network = library.load("ieee118")
    layout = conventional(network)
    x = solve(network, enforce_q_limits=True).x
    estimator = WeightedLeastSquares(network, layout)
    sigma = np.full(len(layout), 0.01)
    covariance = estimator.solve(estimator.model.h(x), sigma, start=x).covariance()
    size, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    root = vectors * np.sqrt(np.maximum(size, 0.0))
    rng = np.random.default_rng(5)
    states = [x + root @ rng.standard_normal(len(x)) for _ in range(250)]
    loading = Loading.transfer(network, "p", WEST, ["33", "35", "37"], by_load=True)
    limits = [continuation(network, loading, state=states[k]).limit for k in (0, 119, 235)]
    assert limits == pytest.approx([limits[0]] * 3, abs=10.0)
    # Their sensitivities hold too, with generators held at what the estimate shows beyond a limit.
    section = Section.around(network, "west", WEST)
    found = transfer_limit(network, section, [loading], state=states[0], covariance=covariance)
    assert "3 generators lie beyond" in found.findings[0]
    step = 3e-6 * np.random.default_rng(SEED).standard_normal(len(x))
    after, before = (
        transfer_limit(network, section, [loading], state=states[0] + sign * step)
        for sign in (1, -1)
    )
    assert after.mapf_mw - before.mapf_mw == pytest.approx(2 * found.gradient @ step, rel=1e-4)


def test_sampling_sees_criteria_change_places() -> None:
    x, covariance, *_ = estimated()
    usual = transfer_limit(grid14(), section14(), LOADINGS, state=x, covariance=covariance)
    voltage, stability = row(usual, "voltage"), row(usual, "stability")
    # A share that lets both criteria allow the same power.
    share = 0.8 * voltage["power_mw"] / stability["power_mw"]
    params = TransferLimitParams(power_share=share)
    sampled = sampled_limit(
        grid14(), section14(), LOADINGS, params, state=x, covariance=covariance,
        rng=np.random.default_rng(SEED), count=40,
    )  # fmt: skip
    assert set(sampled.binding["criterion"]) == {"voltage", "stability"}
    assert sampled.binding["share"].sum() == pytest.approx(1.0)
    # The lower of two is lower than either on average.
    assert sampled.mean_mw < voltage["value_mw"]


# -------------------------------------------------------------------------------- bad input


def test_section_that_is_no_cut_names_the_way_round_it() -> None:
    section = Section("half", (BranchEnd("2-4"), BranchEnd("5-6")))
    with pytest.raises(GridError, match=r"'half' is no cut: .*'2-4' still hang together \(over 2"):
        transfer_limit(grid14(), section, [plain()])


def test_section_with_contradictory_signs_is_refused() -> None:
    ends = tuple(
        BranchEnd(end.branch, end.side, -1 if end.branch == "5-6" else 1)
        for end in section14().ends
    )
    with pytest.raises(GridError, match=r"signs contradict each other"):
        transfer_limit(grid14(), Section("I", ends), [plain()])
    with pytest.raises(GridError, match=r"'2-4' is listed more than once"):
        Section("I", (BranchEnd("2-4"), BranchEnd("2-4", "to", -1))).sending(grid14())
    with pytest.raises(GridError, match=r"has no branch ends"):
        Section("I", ()).sending(grid14())
    with pytest.raises(GridError, match=r"no branch leaves"):
        Section.around(grid14(), "I", grid14().buses.name)
    with pytest.raises(ParameterError, match=r"needs side 'from' or 'to'"):
        BranchEnd("2-4", "left")


def test_same_section_metered_at_the_other_side_is_the_same_cut() -> None:
    # Sign -1 at the receiving end: what arrives there, which is the losses less.
    other = {"from": "to", "to": "from"}
    far = Section(
        "I", tuple(BranchEnd(end.branch, other[end.side], -1) for end in section14().ends)
    )
    np.testing.assert_array_equal(far.sending(grid14()), section14().sending(grid14()))
    near_, far_ = (transfer_limit(grid14(), s, [plain()]) for s in (section14(), far))
    assert near_.base_mw - 5.0 < far_.base_mw < near_.base_mw
    assert row(far_, "voltage")["loading_factor"] == pytest.approx(
        row(near_, "voltage")["loading_factor"], rel=1e-9
    )


def test_loading_that_lowers_the_sections_power_is_refused() -> None:
    back = Loading("back", p_load_mw={"2": 1.0, "3": 1.0}, balance={"8": 1.0})
    with pytest.raises(GridError, match=r"'back' does not raise the power of section 'I'"):
        transfer_limit(grid14(), section14(), [back])


def test_outage_of_the_whole_section_is_refused() -> None:
    section = Section.around(grid14(), "8", ["8"])
    loading = Loading("8", p_gen_mw={"8": 1.0}, p_load_mw={"14": 1.0})
    with pytest.raises(ParameterError, match=r"'7-8' opens every branch of section '8'"):
        transfer_limit(grid14(), section, [loading], contingencies=["7-8"])


def with_load_at_3(p_mw: float) -> Network:
    buses = grid14().buses
    load = np.where(np.array(buses.name) == "3", p_mw, buses.p_load_mw)
    return dataclasses.replace(grid14(), buses=dataclasses.replace(buses, p_load_mw=load))


@pytest.mark.parametrize(
    ("trip", "reason"),
    [
        ("2-3", r"after 2-3 along south is undetermined: there is no state at any loading"),
        ("3-4", r"after 3-4 along south \(bus/3\) is undetermined: violated at every loading"),
    ],
)
def test_outage_that_no_loading_helps_leaves_no_limit_and_says_why(trip: str, reason: str) -> None:
    # Bus 3 stands in the sending area: less power over the section does not relieve it.
    heavy = with_load_at_3(200.0)
    limit = transfer_limit(heavy, section14(), LOADINGS, contingencies=[trip, "2-4"])
    assert np.isnan(limit.mapf_mw)
    assert not limit.table["binding"].any()
    assert limit.criterion == limit.loading == ""
    assert re.search(reason, limit.findings[0])
    least = limit.table["value_mw"].min()
    assert limit.findings[-1].startswith(
        f"the lowest of what could be determined is {least:.4g} MW"
    )
    assert np.isfinite(row(limit, "stability")["value_mw"])
    assert np.isfinite(row(limit, "stability_after_outage", "2-4")["value_mw"])


def test_base_case_without_solution_is_refused() -> None:
    with pytest.raises(NotConverged, match=r"base case of ieee14 has no solution.*lower its load"):
        transfer_limit(with_load_at_3(500.0), section14(), LOADINGS)


def test_limit_may_lie_below_what_flows_now() -> None:
    # Only 3-4 is left of the section, which cannot carry the base load.
    outage = Contingency("three", ("2-4", "4-5", "5-6"))
    limit = transfer_limit(grid14(), section14(), [plain()], contingencies=[outage])
    after = grid14()
    for branch in outage.branches:
        after = after.open_branch(branch)
    assert not solvable(after, 0.0)
    largest = switch_point(lambda f: solvable(after, f - 100.0)) - 100.0
    most = 0.92 * power_of(after, flow_at(after, largest))
    factor = switch_point(
        lambda f: solvable(after, f - 100.0) and power_of(after, flow_at(after, f - 100.0)) < most
    )
    found = row(limit, "stability_after_outage", "three")
    assert found["power_mw"] == pytest.approx(
        power_of(grid14(), flow_at(grid14(), factor - 100.0)), rel=2e-3
    )
    assert limit.mapf_mw < limit.base_mw


def test_arguments_that_do_not_fit_are_refused() -> None:
    x, covariance, *_ = estimated()
    args = (grid14(), section14())
    with pytest.raises(ParameterError, match="one loading vector at least"):
        transfer_limit(*args, [])
    with pytest.raises(ParameterError, match="'plain' repeats"):
        transfer_limit(*args, [plain(), plain()])
    with pytest.raises(ParameterError, match="'2-4' repeats"):
        transfer_limit(*args, [plain()], contingencies=["2-4", "2-4"])
    with pytest.raises(GridError, match="no branch '2-44'"):
        transfer_limit(*args, [plain()], contingencies=["2-44"])
    with pytest.raises(ParameterError, match="covariance belongs to the state"):
        transfer_limit(*args, [plain()], covariance=covariance)
    with pytest.raises(TableError, match=r"must be \(28, 28\)"):
        transfer_limit(*args, [plain()], state=x, covariance=covariance[:3])
    with pytest.raises(TableError, match="must be finite"):
        transfer_limit(*args, [plain()], state=x, covariance=np.full((28, 28), np.nan))
    with pytest.raises(TableError, match="must be symmetric"):
        transfer_limit(*args, [plain()], state=x, covariance=np.triu(np.ones((28, 28))))
    with pytest.raises(ParameterError, match="trips no branch"):
        Contingency("x", ())
    with pytest.raises(ParameterError, match="power_share must lie in"):
        TransferLimitParams(power_share=1.2)
    with pytest.raises(ParameterError, match="continuous_ka of branch '2-4' must be positive"):
        TransferLimitParams(continuous_ka={"2-4": 0.0})
    with pytest.raises(GridError, match="no branch '2-44'"):
        transfer_limit(*args, [plain()], TransferLimitParams(continuous_ka={"2-44": 1.0}))
    with pytest.raises(ParameterError, match="two samples at least"):
        sampled_limit(
            *args, [plain()], state=x, covariance=covariance, count=1,
            rng=np.random.default_rng(1),
        )  # fmt: skip
