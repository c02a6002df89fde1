"""Claim: the machine on load settles where its droop says, and its noise has the stated density."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from pse_analysis.errors import ParameterError
from pse_analysis.machine import Densities, Machine, sample
from pse_analysis.simulation.machine import (
    GovernorParams,
    LoadStepParams,
    band_limited_white_noise,
    disturb,
    load_step,
)

MACHINE = Machine(200.0, 6.4, 0.032, u_kv=13.8)
TIME = np.arange(0.0, 40.0, 0.01)


def test_machine_rests_until_the_step_and_then_falls_at_the_rate_of_its_inertia() -> None:
    motion = load_step(MACHINE, LoadStepParams(), GovernorParams(), TIME)
    before = motion.time_s < 5.0
    assert np.abs(motion.x[before]).max() == 0.0
    assert np.abs(motion.delta_m[before]).max() == 0.0
    at = int(np.searchsorted(TIME, 5.0))
    assert motion.delta_m[at] == pytest.approx(-10.0 / 200.0)
    fall = (motion.x[at + 1, 1] - motion.x[at, 1]) / 0.01
    assert fall == pytest.approx(-0.05 * MACHINE.omega0 / MACHINE.t_j_s, rel=0.01)


def test_proportional_governor_leaves_the_deviation_of_its_droop() -> None:
    """Power balance at rest: p₀ - k_p s - K_d s (1+s) = (p₀ + Δp)(1 + k_f s)."""
    motion = load_step(MACHINE, LoadStepParams(), GovernorParams(), TIME)
    s = motion.x[-1, 1] / MACHINE.omega0
    mechanical = 0.75 - 20.0 * s
    electrical = 0.80 * (1.0 + s)
    assert mechanical - electrical == pytest.approx(MACHINE.k_d_pu * s * (1 + s), abs=1e-7)
    assert s == pytest.approx(-0.05 / 20.8, rel=1e-2)


def test_linear_machine_driven_by_the_torques_moves_as_the_rotor_does() -> None:
    """With the step before the first sample ΔM is smooth, and straight pieces follow it."""
    time = np.arange(0.0, 20.0, 0.002)
    motion = load_step(MACHINE, LoadStepParams(step_at_s=0.0), GovernorParams(), time)
    step = sample(MACHINE, Densities(0, 0, 0), 0.002)
    x = motion.x[0]
    for u, after in zip(motion.delta_m, motion.delta_m[1:], strict=False):
        x = step.F @ x + step.G0[:, 0] * u + step.G1[:, 0] * after
    np.testing.assert_allclose(x, motion.x[-1], rtol=1e-5)


def test_step_outside_the_record_and_between_samples_are_both_solved() -> None:
    late = load_step(MACHINE, LoadStepParams(step_at_s=99.0), GovernorParams(), TIME[:50])
    assert np.abs(late.x).max() == 0.0
    between = load_step(MACHINE, LoadStepParams(step_at_s=0.105), GovernorParams(), TIME[:50])
    exact = load_step(MACHINE, LoadStepParams(step_at_s=0.1), GovernorParams(), TIME[:50] - 0.005)
    np.testing.assert_allclose(between.x, exact.x, atol=1e-9)


@pytest.mark.parametrize("step_s", [0.001, 0.01])
def test_noise_has_the_stated_density_whatever_its_sample_time(step_s: float) -> None:
    rng = np.random.default_rng(11)
    noise = band_limited_white_noise(0.005, step_s, (400_000,), rng)
    assert noise.var() == pytest.approx(0.005 / step_s, rel=0.01)
    frequency, one_sided = signal.welch(noise, 1.0 / step_s, nperseg=1024)
    assert (one_sided[5:-5] / 2.0).mean() == pytest.approx(0.005, rel=0.02)
    assert frequency[-1] == pytest.approx(0.5 / step_s)


def test_disturbed_machine_spreads_as_van_loan_says() -> None:
    densities = Densities(0.005, 0.005, 0.0001)
    drawn = disturb(MACHINE, densities, 0.1, 20, 20_000, np.random.default_rng(12), every=10)
    assert (drawn.x[0] == 0).all()
    expected = sample(MACHINE, densities, 2.0).Q
    np.testing.assert_allclose(np.cov(drawn.x[-1]), expected, rtol=0.03)
    assert drawn.noise.var() == pytest.approx(0.0001 / 0.1, rel=0.02)


def test_same_seed_gives_the_same_record() -> None:
    densities = Densities(0.005, 0.005, 0.0001)
    one, two = (
        disturb(MACHINE, densities, 0.01, 50, 2, np.random.default_rng(1)) for _ in range(2)
    )
    assert (one.x == two.x).all()
    assert (one.noise == two.noise).all()


def test_impossible_parameters_are_refused() -> None:
    with pytest.raises(ParameterError, match="does not fit a machine of 200 MVA"):
        load_step(MACHINE, LoadStepParams(load_mw=195.0), GovernorParams(), TIME)
    with pytest.raises(ParameterError, match="increasing"):
        load_step(MACHINE, LoadStepParams(), GovernorParams(), [1.0, 0.5])
    with pytest.raises(ParameterError, match="time_constant_s > 0"):
        GovernorParams(time_constant_s=0.0)
    with pytest.raises(ParameterError, match="density ≥ 0"):
        band_limited_white_noise(-1.0, 0.01, (3,), np.random.default_rng(0))
