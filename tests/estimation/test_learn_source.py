"""Claim: earlier telemetry teaches how far each held voltage of a transmission grid moves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.process.learn_source import USUAL_SOURCE, learn_held
from pse_analysis.estimation.process.load_noise import Sensitivity
from pse_analysis.grid import library
from pse_analysis.measurement import BUS, VM, SensorLayout

SEED = 80
STEP_S = 300.0
METER = 3e-3
NETWORK = library.load("ieee14")
HELD = Sensitivity(NETWORK).held
SLACK = int(np.flatnonzero(NETWORK.slack == HELD)[0])
LAYOUT = SensorLayout.of(NETWORK, (VM, np.arange(NETWORK.n_bus), BUS))


def history(sigma: np.ndarray, steps: int, seed: int, every: int = 1) -> Record:
    """Held voltages as random walks under the noise of their meters; the others stand still."""
    rng = np.random.default_rng([SEED, seed])
    z = np.ones((steps, NETWORK.n_bus))
    z[:, HELD] += np.cumsum(sigma * rng.normal(size=(steps, len(HELD))), axis=0)
    z += METER * rng.normal(size=z.shape)
    fresh = np.zeros(z.shape, dtype=bool)
    fresh[::every] = True
    start = np.datetime64("2016-06-06T00:00:00", "us")
    time = start + np.arange(steps) * np.timedelta64(int(STEP_S), "s")
    zero = np.zeros(z.shape)
    return Record(time, z, np.full(z.shape, METER), zero, fresh, fresh, zero)


def moving(slack: float, others: float) -> np.ndarray:
    sigma = np.full(len(HELD), others)
    sigma[SLACK] = slack
    return sigma


@pytest.mark.parametrize("every", [1, 3])
def test_every_held_voltage_is_told_by_its_own_meter(every: int) -> None:
    """Twenty histories of two days: the mean of σ within 15 %, of the slack and of the others."""
    true = moving(2e-3, 5e-4)
    found = [
        learn_held(history(true, 576, seed, every), LAYOUT, NETWORK, STEP_S) for seed in range(20)
    ]
    np.testing.assert_allclose(np.mean(found, axis=0) / true, 1.0, atol=0.15)


def test_still_voltages_are_not_taken_to_move_with_the_slack() -> None:
    """Six hours under meters of 3σ: within a factor of 3, and a third at most of what moves."""
    for seed in range(5):
        found = learn_held(history(moving(1e-3, 0.0), 72, seed), LAYOUT, NETWORK, STEP_S)
        others = np.delete(found, SLACK)
        assert 1e-3 / 3 < found[SLACK] < 3e-3
        assert (others > 0).all()
        assert (others < found[SLACK] / 3).all()


def test_one_generator_that_moves_is_seen_among_those_that_do_not() -> None:
    true = moving(1e-3, 0.0)
    true[(SLACK + 1) % len(HELD)] = 2e-3
    found = learn_held(history(true, 576, 3), LAYOUT, NETWORK, STEP_S)
    assert found[(SLACK + 1) % len(HELD)] == pytest.approx(2e-3, rel=0.3)


def test_voltages_without_a_meter_move_as_usual_or_as_the_others() -> None:
    past = history(moving(1e-3, 4e-4), 288, 4)
    fresh = past.fresh.copy()
    fresh[:, HELD[[SLACK, -1]]] = False
    found = learn_held(dataclasses.replace(past, fresh=fresh), LAYOUT, NETWORK, STEP_S)
    assert found[SLACK] == USUAL_SOURCE
    others = np.delete(found, [SLACK, len(HELD) - 1])
    assert found[-1] == pytest.approx(np.sqrt(np.mean(others**2)))


def test_without_history_all_held_voltages_move_as_a_source_usually_does() -> None:
    past = history(moving(1e-3, 0.0), 12, 5)
    found = learn_held(past, LAYOUT, NETWORK, STEP_S)
    np.testing.assert_array_equal(found, np.full(len(HELD), USUAL_SOURCE))


def test_a_given_source_is_taken_for_the_reference_alone() -> None:
    past = history(moving(1e-3, 4e-4), 288, 6)
    given = learn_held(past, LAYOUT, NETWORK, STEP_S, source=7e-4)
    learnt = learn_held(past, LAYOUT, NETWORK, STEP_S)
    assert given[SLACK] == 7e-4
    np.testing.assert_array_equal(np.delete(given, SLACK), np.delete(learnt, SLACK))


def test_meters_that_read_exactly_one_value_teach_nothing_wrong() -> None:
    """A stuck meter and one without noise: finite, and not above what the others do."""
    past = history(moving(1e-3, 0.0), 288, 7)
    z = past.z.copy()
    z[:, HELD[-1]] = 1.01
    found = learn_held(dataclasses.replace(past, z=z), LAYOUT, NETWORK, STEP_S)
    assert np.isfinite(found).all()
    assert found[-1] < 1e-3
