"""Claim: a filter learns from its own innovations how much loads and source move, and no more."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import integrate

from pse_analysis.errors import ParameterError
from pse_analysis.estimation import Method
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.kalman import KalmanState, kalman_filter
from pse_analysis.estimation.process import covariance_matching
from pse_analysis.estimation.process.covariance_matching import CovarianceMatching
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, P, Q, SensorLayout

SEED = 77
STEP_S = 300.0
NETWORK = library.load("ieee33")
START = np.datetime64("2016-06-09T00:00:00", "us")


def metered() -> SensorLayout:
    bus, load = np.arange(0, 33, 4), np.arange(1, 33)
    layout = SensorLayout.of(
        NETWORK, (VM, bus, BUS), (VA, bus, BUS), (P, load, BUS), (Q, load, BUS)
    )
    power = np.isin(layout.quantity, (P, Q))
    return dataclasses.replace(layout, sigma=np.where(power, 2e-5, 3e-4))


def snapshots(levels: np.ndarray, steps: int, seed: int) -> list[Snapshot]:
    """Loads and source that walk with the given levels, read by every meter at every step."""
    layout, rng = metered(), np.random.default_rng([SEED, seed])
    nominal = np.concatenate([NETWORK.p_nominal_pu, NETWORK.q_nominal_pu])
    alone, together, source = np.sqrt(levels)
    move = nominal[:, None] * alone * rng.normal(size=(66, steps))
    move += nominal[:, None] * together * rng.normal(size=steps)
    injection = nominal[:, None] + np.cumsum(move, axis=1)
    level = 1.0 + np.cumsum(source * rng.normal(size=steps))
    held = (np.arange(33) == NETWORK.slack)[:, None]
    flow = solve(NETWORK, injection[:33], injection[33:], np.where(held, level, 1.0))
    bus = np.arange(0, 33, 4)
    z = np.concatenate([flow.vm[bus], flow.theta[bus], injection[1:33], injection[34:]])
    z = z + layout.sigma[:, None] * rng.normal(size=z.shape)
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    return [
        Snapshot(START + k * np.timedelta64(300, "s"), z[:, k], layout.sigma, zero, on, on, zero)
        for k in range(steps)
    ]


def run(made: CovarianceMatching, taken: list[Snapshot]) -> list[KalmanState]:
    estimator = kalman_filter("kf", NETWORK, metered(), made, step_s=STEP_S)
    state, _ = estimator.init(taken[0])
    states = [state]
    for snapshot in taken[1:]:
        state, _ = estimator.step(state, snapshot)
        states.append(state)
    return states


@pytest.mark.parametrize(
    "levels",
    [np.array([0.01, 0.005, 5e-4]) ** 2, np.array([0.06, 0.04, 2e-3]) ** 2],
    ids=["calm", "busy"],
)
def test_levels_of_the_truth_are_found(levels: np.ndarray) -> None:
    """σ of each shape, mean over the last hours of four histories, within a quarter."""
    found = [
        np.mean(
            [s.noise.level for s in run(covariance_matching.of_loads(NETWORK), taken)[48:]], axis=0
        )
        for taken in (snapshots(levels, 72, seed) for seed in range(4))
    ]
    ratio = np.sqrt(np.mean(found, axis=0) / levels)
    np.testing.assert_allclose(ratio, 1.0, atol=0.25)


def test_an_estimate_knows_nothing_of_later_snapshots() -> None:
    taken = snapshots(covariance_matching.START, 20, 0)
    states = run(covariance_matching.of_loads(NETWORK), taken)
    later = [dataclasses.replace(s, z=1.05 * s.z) if k > 12 else s for k, s in enumerate(taken)]
    for one, other in zip(
        states[:13], run(covariance_matching.of_loads(NETWORK), later), strict=False
    ):
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.noise.level, other.noise.level)


def test_snapshot_moves_only_the_noise_of_the_step_after_it() -> None:
    taken = snapshots(covariance_matching.START, 4, 1)
    estimator = kalman_filter(
        "kf", NETWORK, metered(), covariance_matching.of_loads(NETWORK), step_s=STEP_S
    )
    state, _ = estimator.init(taken[0])
    wrong = dataclasses.replace(taken[1], z=1.1 * taken[1].z)
    one, other = (estimator.step(state, s)[0] for s in (taken[1], wrong))
    np.testing.assert_array_equal(one.P.shape, other.P.shape)
    assert (other.noise.level > one.noise.level).any()
    nothing = dataclasses.replace(taken[1], available=np.zeros(len(taken[1].z), dtype=bool))
    assert estimator.step(state, nothing)[0].noise is state.noise


def test_levels_never_fall_to_zero() -> None:
    """Nothing moves, and the meters say so."""
    states = run(covariance_matching.of_loads(NETWORK), snapshots(np.zeros(3), 40, 2))
    for state in states:
        assert (
            state.noise.level >= 0.999 * covariance_matching.FLOOR * covariance_matching.START
        ).all()
        assert np.linalg.eigvalsh(state.P).min() > 0
    assert (states[-1].noise.level < 0.2 * covariance_matching.START).all()


def test_levels_of_known_shapes_are_found_from_innovations_alone() -> None:
    """S = I + 3 D₁ + D₂/2 without any filter: 600 draws, four standard errors of scoring."""
    rng = np.random.default_rng(SEED)
    truth, draws = np.array([3.0, 0.5]), 600
    half = rng.normal(size=(2, 8, 3))
    D = half @ half.transpose(0, 2, 1)
    root = np.linalg.cholesky(np.eye(8) + np.tensordot(truth, D, 1))
    made = CovarianceMatching(lambda _voltage: (), np.ones(2), window=1e9)
    memory = made.begin()
    for _ in range(draws):
        L = np.linalg.cholesky(np.eye(8) + np.tensordot(memory.level, D, 1))
        inverse = np.linalg.inv(L)
        response = inverse @ D @ inverse.T
        memory = made.learn(memory, response, inverse @ root @ rng.normal(size=8))
    error = np.sqrt(np.diagonal(np.linalg.inv(memory.A / 2)))
    assert (np.abs(memory.level - truth) < 4 * error).all()
    assert (error < 0.2 * truth).all()


def test_snapshots_that_tell_nothing_of_any_level_leave_them_near_the_start() -> None:
    # As where every sample is older than the step whose noise is to be told.
    matching = CovarianceMatching(lambda _voltage: (), np.array([1e-3, 2e-6]))
    memory = matching.begin()
    for _ in range(50):
        memory = matching.learn(memory, np.zeros((2, 3, 3)), np.zeros(3))
    ratio = memory.level / matching.start
    assert ratio[0] == pytest.approx(ratio[1])
    assert 0.1 < ratio[0] < 10.0


def test_a_level_that_is_not_seen_keeps_its_scale() -> None:
    """Two shapes, of which the meters see the first only: the other is known by its start alone."""
    made = CovarianceMatching(lambda _voltage: (), np.array([1.0, 4.0]))
    memory = made.begin()
    rng = np.random.default_rng(SEED)
    for _ in range(100):
        response = np.stack([np.eye(5), np.zeros((5, 5))])
        memory = made.learn(memory, response, rng.normal(size=5))
        assert 1.0 < memory.level[1] / made.start[1] < 4.0


def test_a_level_is_the_mean_of_what_it_may_be() -> None:
    """Beside an integral over the posterior of a level whose best fit lies below zero."""
    made = CovarianceMatching(lambda _voltage: (), np.array([0.5]), window=1e9)
    memory = made.begin()
    for _ in range(5):
        memory = made.learn(memory, np.full((1, 1, 1), 0.9), np.array([0.3]))
    # The start counts as one more step.
    A = memory.A[0, 0] * (1.0 + 1.0 / 5.0)
    best = (memory.b[0] + memory.A[0, 0] / 5.0 * 0.5) / A
    assert best < 0
    assert best / np.sqrt(2.0 / A) > -3.0

    def moment(power: int) -> float:
        return integrate.quad(
            lambda root: (
                root**power * np.exp(-0.25 * A * (root**2 - best) ** 2) / (1.0 + root**2 / 0.5)
            ),
            0.0,
            np.sqrt(4.5),
        )[0]

    np.testing.assert_allclose(memory.level[0], moment(2) / moment(0), rtol=1e-3)


@pytest.mark.parametrize("q", [1e-5, 1e-3, 1e-2])
def test_a_filter_with_an_estimated_level_covers_the_truth(q: float) -> None:
    """A walk of which a meter of variance 1 sees little or nothing, under a start of 0.01."""
    rng = np.random.default_rng(SEED)
    inside = []
    for _ in range(20):
        made = CovarianceMatching(lambda _voltage: (), np.array([0.01]))
        memory, x, estimate, P = made.begin(), 0.0, 0.0, 1.0
        for k in range(200):
            x += np.sqrt(q) * rng.normal()
            P += memory.level[0]
            S, eta = P + 1.0, x + rng.normal() - estimate
            memory = made.learn(memory, np.full((1, 1, 1), 1.0 / S), np.array([eta / np.sqrt(S)]))
            estimate, P = estimate + P / S * eta, P / S
            if k >= 20:
                inside.append(abs(estimate - x) < 2.0 * np.sqrt(P))
    assert np.mean(inside) > 0.93


@pytest.mark.parametrize(("start", "window"), [(np.array([0.0, 1.0]), 5), (np.ones(2), 0)])
def test_impossible_start_is_refused(start: np.ndarray, window: int) -> None:
    with pytest.raises(ParameterError, match="window ≥ 1 and levels above 0"):
        CovarianceMatching(lambda _voltage: (), start, window)


def test_only_the_kalman_filter_estimates_its_noise_from_innovations() -> None:
    assert Method.of("kf", "kalman", noise="innovation").noise == "innovation"
    with pytest.raises(
        ParameterError,
        match='noise = "innovation" has no effect here: drop it, or take filter = "kalman"',
    ):
        Method.of("f", "ukf", noise="innovation")


def test_sizes_of_loads_may_come_from_their_meters() -> None:
    buses = NETWORK.buses
    nothing = np.zeros(33)
    bare = dataclasses.replace(
        NETWORK, buses=dataclasses.replace(buses, p_load_mw=nothing, q_load_mvar=nothing)
    )
    usual = np.concatenate([NETWORK.p_nominal_pu, NETWORK.q_nominal_pu])
    voltage = np.ones(33, dtype=complex)
    expected = covariance_matching.of_loads(NETWORK).halves(voltage)
    for half, same in zip(
        covariance_matching.of_loads(bare, usual).halves(voltage), expected, strict=True
    ):
        np.testing.assert_allclose(half, same)
    # What the tables say counts more than what was read.
    for half, same in zip(
        covariance_matching.of_loads(NETWORK, 2 * usual).halves(voltage), expected, strict=True
    ):
        np.testing.assert_allclose(half, same)
    with pytest.raises(ParameterError, match="how large the loads are"):
        covariance_matching.of_loads(bare)
