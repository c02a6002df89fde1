"""Claim: what corrects a voltage across its direction turns it, and does not lengthen it."""

from __future__ import annotations

import numpy as np

from pse_analysis.estimation.filters.augmented_state import AugmentedState, Belief
from pse_analysis.estimation.process.dynamics import local_trend, random_walk

SEED = 81


def of(voltage: np.ndarray) -> np.ndarray:
    return np.concatenate([voltage.real, voltage.imag])


def test_one_volt_that_is_corrected_by_a_tenth_across_turns_by_a_tenth() -> None:
    """Added, 0.1j would lengthen 1∠0 by 0.5 %; its covariance turns by 0.1 rad as well."""
    lagged = AugmentedState(2, 0, random_walk())
    P = np.diag([4.0, 1.0])
    found = lagged.turned(Belief(np.array([1.0, 0.0]), P, None), np.array([1.0, 0.1]), P)
    c, s = np.cos(0.1), np.sin(0.1)
    turn = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(found.x, [c, s], atol=1e-15)
    np.testing.assert_allclose(found.P, turn @ P @ turn.T, atol=1e-15)


def test_a_correction_along_a_voltage_is_added() -> None:
    lagged = AugmentedState(2, 0, random_walk())
    before = of(0.9 * np.exp(np.array([0.3j])))
    found = lagged.turned(Belief(before, np.eye(2), None), 1.02 * before, np.eye(2))
    np.testing.assert_allclose(found.x, of(0.918 * np.exp(np.array([0.3j]))), atol=1e-15)
    np.testing.assert_allclose(found.P, 1.02**2 * np.eye(2), atol=1e-15)


def test_present_and_past_are_turned_each_by_its_own_correction() -> None:
    """Two buses at two instants with slopes behind: sizes, angles and P of every one."""
    rng = np.random.default_rng(SEED)
    lagged = AugmentedState(4, 2, local_trend())
    before = rng.uniform(0.9, 1.1, (2, 2)) * np.exp(1j * rng.uniform(-1, 1, (2, 2)))
    along, across = 0.02 * rng.standard_normal((2, 2, 2))
    after = before * (1 + along + 1j * across)
    slopes = rng.standard_normal(4)
    root = rng.standard_normal((12, 12))
    P = root @ root.T
    belief = Belief(np.concatenate([*map(of, before), slopes]), P, "memory")
    found = lagged.turned(belief, np.concatenate([*map(of, after), slopes]), P)
    factor = (1 + along) * np.exp(1j * across)
    expected = np.concatenate([*map(of, before * factor), slopes])
    np.testing.assert_allclose(found.x, expected, atol=1e-14)
    whole = np.eye(12)
    for k in range(2):
        inside = slice(4 * k, 4 * k + 4)
        real, imaginary = np.diag(factor[k].real), np.diag(factor[k].imag)
        whole[inside, inside] = np.block([[real, -imaginary], [imaginary, real]])
    np.testing.assert_allclose(found.P, whole @ P @ whole.T, atol=1e-12)
    np.testing.assert_array_equal(found.P, found.P.T)
    assert found.memory == "memory"


def test_small_corrections_are_added_to_first_order() -> None:
    rng = np.random.default_rng(SEED + 1)
    lagged = AugmentedState(8, 0, random_walk())
    before = rng.standard_normal(8) + 2.0
    small = 1e-6 * rng.standard_normal(8)
    found = lagged.turned(Belief(before, np.eye(8), None), before + small, np.eye(8))
    np.testing.assert_allclose(found.x, before + small, atol=1e-11)
    np.testing.assert_array_equal(found.P, np.eye(8))
