"""Claim: the observer on samples errs as the Lyapunov equation says, through gaps and spikes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.interface import Info, Snapshot
from pse_analysis.estimation.machine import (
    ObserverState,
    Poles,
    Tuning,
    discrete_covariance,
    discrete_gain,
    observe,
    observer,
    simulated_rms,
)
from pse_analysis.machine import Densities, Machine
from pse_analysis.simulation.machine import (
    GovernorParams,
    LoadStepParams,
    Motion,
    disturb,
    load_step,
)
from pse_analysis.vocabulary import Status

MACHINE = Machine(200.0, 6.4, 0.032, u_kv=13.8)
TRUE = Densities(0.005, 0.005, 0.0001)
STEP_S = 0.01
OBSERVERS: dict[str, Tuning] = {
    "case_1": Densities(1000.0, 1000.0, 0.001),
    "case_2": Densities(0.01, 0.01, 100.0),
    "case_3": Densities(5.0, 5.0, 1.0),
    "matched": TRUE,
    "luenberger": Poles((-20.0, -25.0)),
}


def test_simulated_error_is_the_discrete_lyapunov_prediction_for_all_observers() -> None:
    """48 starts from the stationary law, then 60 s each through plant and observer."""
    found = simulated_rms(
        MACHINE, OBSERVERS, TRUE, STEP_S, duration_s=60.0, trials=48, seed=20250803
    )
    assert list(found) == list(OBSERVERS)
    for name, (rms, standard_error, theory) in found.items():
        assert (np.abs(rms - theory) < 3.0 * standard_error).all(), name
        assert (standard_error < 0.1 * theory).all(), name


def test_simulated_error_is_least_at_the_true_ratio() -> None:
    trials, steps = 32, 3000
    rng = np.random.default_rng(50)
    drawn = disturb(MACHINE, TRUE, STEP_S, steps, trials, rng)
    quiet, y = np.zeros((steps + 1, 1)), drawn.x[1:, 0] + drawn.noise[1:]
    power = []
    for ratio in (5.0, 50.0, 500.0):
        K = discrete_gain(MACHINE, Densities(ratio, ratio, 1.0), STEP_S)
        error = observe(MACHINE, K, STEP_S, y, quiet, np.zeros((2, trials))) - drawn.x[1:]
        power.append((error[1000:] ** 2).mean(axis=(0, 2)))
    assert np.argmin(power, axis=0).tolist() == [1, 1]


@pytest.fixture(scope="module")
def record() -> tuple[Motion, np.ndarray, np.ndarray]:
    """20 s with the load step: motion, true state and measured angle."""
    motion = load_step(
        MACHINE, LoadStepParams(), GovernorParams(), np.arange(2001) * STEP_S, (0.8, 0.5)
    )
    drawn = disturb(MACHINE, TRUE, STEP_S, 2000, 1, np.random.default_rng(6))
    x = motion.x + drawn.x[:, :, 0]
    return motion, x, x[:, 0] + drawn.noise[:, 0]


def snapshots(motion: Motion, y: np.ndarray) -> list[Snapshot]:
    one, zero = np.ones(1), np.zeros(1)
    return [
        Snapshot(
            np.datetime64("2025-08-12T00:00:00", "us") + np.timedelta64(round(t * 1e6), "us"),
            np.array([value]),
            one * np.sqrt(TRUE.angle / STEP_S),
            zero,
            one > 0,
            one > 0,
            zero,
            inputs=np.array([u]),
        )
        for t, value, u in zip(motion.time_s, y, motion.delta_m, strict=True)
    ]


def run(
    tuning: Tuning, shots: list[Snapshot], **options: object
) -> tuple[np.ndarray, list[Info], list[ObserverState]]:
    method = observer("m", MACHINE, tuning, STEP_S, **({"belief": TRUE} | options))  # type: ignore[arg-type]
    state, info = method.init(shots[0])
    states, infos = [state], [info]
    for shot in shots[1:]:
        state, info = method.step(state, shot)
        states.append(state)
        infos.append(info)
    return np.array([s.x for s in states]), infos, states


@pytest.mark.parametrize("name", OBSERVERS)
def test_estimator_takes_the_steps_of_the_vectorised_observer(
    name: str, record: tuple[Motion, np.ndarray, np.ndarray]
) -> None:
    motion, _, y = record
    x, _, _ = run(OBSERVERS[name], snapshots(motion, y))
    K = discrete_gain(MACHINE, OBSERVERS[name], STEP_S)
    together = observe(MACHINE, K, STEP_S, y[1:, None], motion.delta_m[:, None], x[0][:, None])[
        :, :, 0
    ]
    np.testing.assert_allclose(x[1:], together, atol=1e-9)


def test_recursive_gain_is_the_kalman_filter_and_settles_on_the_constant_one(
    record: tuple[Motion, np.ndarray, np.ndarray],
) -> None:
    motion, true, y = record
    x, infos, states = run(TRUE, snapshots(motion, y), gain="recursive")
    K = discrete_gain(MACHINE, TRUE, STEP_S)
    P = discrete_covariance(MACHINE, K, TRUE, STEP_S)
    np.testing.assert_allclose(states[-1].P, P, rtol=1e-6)
    nis = np.array([i.nis for i in infos[1:]])
    assert nis.mean() == pytest.approx(1.0, abs=3 * np.sqrt(2 / len(nis)))
    inside = np.abs(x - true) < 2.0 * np.sqrt([np.diagonal(s.P) for s in states])
    assert (inside.mean(axis=0) > 0.8).all()


def test_gap_is_predicted_and_the_error_stays_inside_its_bounds(
    record: tuple[Motion, np.ndarray, np.ndarray],
) -> None:
    motion, true, y = record
    shots = snapshots(motion, y)
    gap = range(900, 1000)
    for k in gap:
        shots[k] = dataclasses.replace(shots[k], z=np.zeros(1), available=np.zeros(1, dtype=bool))
    x, infos, states = run(TRUE, shots)
    assert {infos[k].status for k in gap} == {Status.PREDICTED}
    sigma = np.sqrt([np.diagonal(s.P) for s in states])
    assert (np.diff(sigma[900:1000], axis=0) > 0).all()
    assert (np.abs(x - true)[400:] < 4.5 * sigma[400:]).all()
    np.testing.assert_allclose(sigma[-1], sigma[899], rtol=1e-3)


def test_snapshots_left_out_altogether_are_the_same_as_predictions(
    record: tuple[Motion, np.ndarray, np.ndarray],
) -> None:
    """A longer step and many predicted ones agree where ΔM runs straight."""
    motion, _, y = record
    flat = motion._replace(delta_m=np.full_like(motion.delta_m, 0.01))
    shots = snapshots(flat, y)
    blind = [
        dataclasses.replace(s, available=np.zeros(1, dtype=bool)) if 900 <= k < 1000 else s
        for k, s in enumerate(shots)
    ]
    x, _, states = run(TRUE, blind)
    shorter, _, fewer = run(TRUE, shots[:900] + shots[1000:])
    np.testing.assert_allclose(shorter[-1], x[-1], rtol=1e-9)
    np.testing.assert_allclose(fewer[-1].P, states[-1].P, rtol=1e-9)


@pytest.mark.parametrize("name", OBSERVERS)
def test_spike_that_slips_through_dies_out_with_the_poles(
    name: str, record: tuple[Motion, np.ndarray, np.ndarray]
) -> None:
    motion, _, y = record
    clean, _, _ = run(OBSERVERS[name], snapshots(motion, y))
    spiked = y.copy()
    spiked[800] += 5.0
    x, _, _ = run(OBSERVERS[name], snapshots(motion, spiked))
    K = discrete_gain(MACHINE, OBSERVERS[name], STEP_S)
    np.testing.assert_allclose((x - clean)[800], 5.0 * K[:, 0], atol=1e-9)
    assert np.abs((x - clean)[800:]).max() <= 5.0 * np.abs(K).max() + 1e-9
    if name != "case_2":  # whose time constant of 15 s outlasts the record
        assert np.abs((x - clean)[-1]).max() < 1e-3


def test_flagged_spike_leaves_the_estimate_where_a_missing_sample_does(
    record: tuple[Motion, np.ndarray, np.ndarray],
) -> None:
    motion, true, y = record
    shots = snapshots(motion, y)
    shots[800] = dataclasses.replace(
        shots[800], z=shots[800].z + 5.0, available=np.zeros(1, dtype=bool)
    )
    x, infos, states = run(TRUE, shots)
    assert infos[800].status is Status.PREDICTED
    sigma = np.sqrt(np.diagonal(states[-1].P))
    assert (np.abs(x - true)[795:] < 4.5 * sigma * 1.2).all()


def test_without_input_it_says_what_it_needs(
    record: tuple[Motion, np.ndarray, np.ndarray],
) -> None:
    motion, _, y = record
    shots = [dataclasses.replace(s, inputs=None) for s in snapshots(motion, y)[:3]]
    method = observer("m", MACHINE, TRUE, STEP_S)
    state, info = method.init(shots[0])
    assert state is None
    assert info.status is Status.UNOBSERVABLE
    for words in ("M_mech - M_el", "200 MVA", "delta_m_pu at machine/1"):
        assert words in info.detail


def test_single_missing_input_is_held_and_reported(
    record: tuple[Motion, np.ndarray, np.ndarray],
) -> None:
    motion, _, y = record
    shots = snapshots(motion, y)[:700]
    whole, _, _ = run(TRUE, shots)
    shots[650] = dataclasses.replace(shots[650], inputs=None)
    x, infos, _ = run(TRUE, shots)
    assert "last value is held" in infos[650].detail
    assert np.abs(x - whole).max() < 1e-3


def test_observer_by_poles_needs_densities_for_its_sigma() -> None:
    poles = OBSERVERS["luenberger"]
    with pytest.raises(ParameterError, match="give `belief`"):
        observer("m", MACHINE, poles, STEP_S)
    with pytest.raises(ParameterError, match="gain by poles is constant"):
        observer("m", MACHINE, poles, STEP_S, belief=TRUE, gain="recursive")


def test_backward_time_and_unfit_shapes_are_refused(
    record: tuple[Motion, np.ndarray, np.ndarray],
) -> None:
    motion, _, y = record
    shots = snapshots(motion, y)[:3]
    with pytest.raises(ParameterError, match="follow each other in time"):
        run(TRUE, [shots[1], shots[0]])
    with pytest.raises(ParameterError, match="input at the start as well"):
        observe(MACHINE, np.ones((2, 1)), STEP_S, y[:5, None], np.zeros((5, 1)), np.zeros((2, 1)))
