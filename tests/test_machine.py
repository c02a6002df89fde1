"""Claim: the machine's model has the units it states, and its sampling is exact."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from pse_analysis.errors import ParameterError, TableError
from pse_analysis.machine import Densities, Machine, sample

MACHINE = Machine(200.0, 6.4, 0.032, u_kv=13.8)
NOISE = Densities(0.005, 0.004, 0.0001)


def test_rated_torque_brings_the_rotor_to_nominal_speed_in_the_starting_time() -> None:
    free = Machine(200.0, 6.4)
    step = sample(free, NOISE, free.t_j_s)
    reached = (step.G0 + step.G1)[1, 0] * 1.0
    assert reached == pytest.approx(2 * np.pi * 50.0, rel=1e-12)


def test_input_gain_follows_from_newtons_law_in_si_units() -> None:
    poles, torque_pu = 64, 0.05
    inertia = MACHINE.t_j_s * 200e6 / (MACHINE.omega0 / (poles / 2)) ** 2  # J = T_j S / Ω₀²
    torque = torque_pu * 200e6 / (MACHINE.omega0 / (poles / 2))
    electrical = torque / inertia * poles / 2
    assert MACHINE.B[1, 0] * torque_pu == pytest.approx(electrical, rel=1e-12)


def test_damping_is_torque_per_unit_of_speed_per_unit() -> None:
    """At ω = 1 rad/s the damping torque is K_d/ω₀ p.u.: that ΔM keeps the speed."""
    omega = 1.0
    balance = MACHINE.A @ [0.0, omega] + MACHINE.B[:, 0] * (MACHINE.k_d_pu * omega / MACHINE.omega0)
    assert balance[1] == pytest.approx(0.0, abs=1e-15)


def test_sampling_equals_quadrature() -> None:
    h = 0.7
    step = sample(MACHINE, NOISE, h)

    def power(s: float) -> np.ndarray:
        d = MACHINE.k_d_pu / MACHINE.t_j_s
        return np.array([[1.0, (1 - np.exp(-d * s)) / d], [0.0, np.exp(-d * s)]])

    noise = integrate.quad_vec(lambda s: power(s) @ NOISE.Q @ power(s).T, 0, h)[0]
    begin = integrate.quad_vec(lambda s: power(s) @ MACHINE.B * (s / h), 0, h)[0]
    end = integrate.quad_vec(lambda s: power(s) @ MACHINE.B * (1 - s / h), 0, h)[0]
    np.testing.assert_allclose(step.F, power(h), rtol=1e-12)
    np.testing.assert_allclose(step.Q, noise, rtol=1e-9)
    np.testing.assert_allclose(step.G0, begin, rtol=1e-9)
    np.testing.assert_allclose(step.G1, end, rtol=1e-9)
    assert step.R[0, 0] == pytest.approx(NOISE.angle / h)


def test_machine_survives_its_table() -> None:
    assert Machine.from_table(MACHINE.to_table()) == MACHINE
    with pytest.raises(TableError, match="expected one row with columns name"):
        Machine.from_table(MACHINE.to_table().drop(columns="t_j_s"))


def test_impossible_plates_and_steps_are_refused() -> None:
    with pytest.raises(ParameterError, match=r"t_j_s must be above 0.*T_j = 2H"):
        Machine(200.0, 0.0)
    with pytest.raises(ParameterError, match="above 0 s, received 0"):
        sample(MACHINE, NOISE, 0.0)
