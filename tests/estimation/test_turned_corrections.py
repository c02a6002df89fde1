"""Claim: what corrects a voltage across its direction turns it, and does not lengthen it."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.estimation.filters.augmented_state import MOST_SIGMAS, AugmentedState
from pse_analysis.estimation.process.dynamics import local_trend, random_walk

SEED = 81


def of(voltage: np.ndarray) -> np.ndarray:
    return np.concatenate([voltage.real, voltage.imag])


def test_one_volt_that_is_corrected_by_a_tenth_across_turns_by_a_tenth() -> None:
    """Added, 0.1j would lengthen 1∠0 by 0.5 %."""
    lagged = AugmentedState(2, 0, random_walk())
    found = lagged.turned(np.array([1.0, 0.0]), np.array([1.0, 0.1]), np.eye(2))
    np.testing.assert_allclose(found, [np.cos(0.1), np.sin(0.1)], atol=1e-15)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_voltage_that_is_told_exactly_keeps_its_length(share: float) -> None:
    """|1 + 0.1j| - 1 = 4.99e-3: turned while `MOST_SIGMAS` of its σ are more, added beyond."""
    lagged = AugmentedState(2, 0, random_walk())
    sigma = 4.99e-3 / MOST_SIGMAS / share
    after = np.array([1.0, 0.1])
    turn = np.array([[1.0, -0.1], [0.1, 1.0]]) / np.hypot(1.0, 0.1)
    P = turn @ np.diag([sigma**2, 1.0]) @ turn.T
    found = lagged.turned(np.array([1.0, 0.0]), after, P)
    expected = [np.cos(0.1), np.sin(0.1)] if share < 1 else after
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_a_correction_along_a_voltage_is_added() -> None:
    lagged = AugmentedState(2, 0, random_walk())
    before = of(0.9 * np.exp(np.array([0.3j])))
    found = lagged.turned(before, 1.02 * before, np.eye(2))
    np.testing.assert_allclose(found, of(0.918 * np.exp(np.array([0.3j]))), atol=1e-15)


def test_present_and_past_are_turned_each_by_its_own_correction() -> None:
    """Two buses at two instants with slopes behind: sizes and angles of every one."""
    rng = np.random.default_rng(SEED)
    lagged = AugmentedState(4, 2, local_trend())
    before = rng.uniform(0.9, 1.1, (2, 2)) * np.exp(1j * rng.uniform(-1, 1, (2, 2)))
    along, across = 0.02 * rng.standard_normal((2, 2, 2))
    after = before * (1 + along + 1j * across)
    slopes = rng.standard_normal(4)
    given = (np.concatenate([*map(of, each), slopes]) for each in (before, after))
    found = lagged.turned(*given, np.eye(12))
    expected = before * (1 + along) * np.exp(1j * across)
    np.testing.assert_allclose(found, np.concatenate([*map(of, expected), slopes]), atol=1e-14)


def test_small_corrections_are_added_to_first_order() -> None:
    rng = np.random.default_rng(SEED + 1)
    lagged = AugmentedState(8, 0, random_walk())
    before = rng.standard_normal(8) + 2.0
    small = 1e-6 * rng.standard_normal(8)
    found = lagged.turned(before, before + small, np.eye(8))
    np.testing.assert_allclose(found, before + small, atol=1e-11)
