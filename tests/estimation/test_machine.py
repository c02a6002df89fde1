"""Claim: gains and stationary errors of the machine's observers are those of theory and print."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.machine import (
    Poles,
    continuous_covariance,
    continuous_gain,
    discrete_covariance,
    discrete_gain,
    findings,
    gain_without_damping,
    model_error,
    require_solvable,
    rms,
    tune,
)
from pse_analysis.machine import Densities, Machine

MACHINE = Machine(200.0, 6.4, 0.032, u_kv=13.8)  # K_d/T_j = 0.005 1/s
TRUE = Densities(0.005, 0.005, 0.0001)
PRINTED = {
    (1000.0, 0.001): (-1001.0, None),  # the second entry, -1012, is a misprint
    (0.01, 100.0): (-0.14, -0.01),
    (5.0, 1.0): (-3.07, -2.22),
}
STATIONARY = {
    (1000.0, 0.001): (0.224, 0.233),
    (0.01, 100.0): (1.334, 0.225),
    (5.0, 1.0): (0.037, 0.078),
    (0.005, 0.0001): (0.028, 0.075),
}


def digits(value: float) -> int:
    return len(str(value).partition(".")[2]) if value % 1 else 0


@pytest.mark.parametrize(("case", "printed"), PRINTED.items(), ids=str)
def test_gains_are_the_printed_ones(
    case: tuple[float, float], printed: tuple[float, float | None]
) -> None:
    gain = continuous_gain(MACHINE, Densities(case[0], case[0], case[1])).ravel()
    for ours, theirs in zip(gain, printed, strict=True):
        if theirs is not None:
            assert round(ours, digits(theirs)) == theirs


def test_misprinted_gain_is_minus_995_and_print_would_need_negative_damping() -> None:
    case = Densities(1000.0, 1000.0, 0.001)
    assert round(continuous_gain(MACHINE, case)[1, 0]) == -995
    undamped = continuous_gain(Machine(200.0, 6.4, 0.0), case)[1, 0]
    assert undamped == pytest.approx(-1000.0)  # damping of either size only takes away from that
    driven = continuous_gain(Machine(200.0, 6.4, -0.012 * 6.4), case)[1, 0]
    assert driven == pytest.approx(-1012.0, abs=0.5)


@pytest.mark.parametrize("q", [0.01, 5.0, 1000.0])
@pytest.mark.parametrize("ratio", [1e-4, 5.0, 50.0, 1e6])
def test_closed_form_without_damping_depends_on_the_ratio_only(q: float, ratio: float) -> None:
    gain = continuous_gain(Machine(200.0, 6.4), Densities(q, q, q / ratio))
    np.testing.assert_allclose(gain, gain_without_damping(ratio), rtol=1e-9)


def test_five_to_one_is_not_the_ratio_of_the_densities() -> None:
    assert TRUE.omega / TRUE.angle == pytest.approx(50.0)
    np.testing.assert_allclose(gain_without_damping(50.0).ravel(), [-8.009, -7.071], atol=5e-4)


@pytest.mark.parametrize(("case", "expected"), STATIONARY.items(), ids=str)
def test_stationary_errors_are_the_re_computed_ones(
    case: tuple[float, float], expected: tuple[float, float]
) -> None:
    tuning = Densities(case[0], case[0], case[1])
    np.testing.assert_allclose(rms(MACHINE, tuning, TRUE), expected, atol=6e-4)


@pytest.mark.parametrize(("step_s", "theta"), [(0.001, 0.215), (0.01, 0.100)])
def test_first_case_sampled_by_its_poles_has_the_re_computed_error(
    step_s: float, theta: float
) -> None:
    L = continuous_gain(MACHINE, Densities(1000.0, 1000.0, 0.001))
    mapped = Poles(tuple(linalg.eigvals(MACHINE.A + L @ MACHINE.C)))
    assert rms(MACHINE, mapped, TRUE, step_s)[0] == pytest.approx(theta, abs=5e-4)


def test_first_case_by_euler_diverges_at_ten_milliseconds() -> None:
    L = continuous_gain(MACHINE, Densities(1000.0, 1000.0, 0.001))
    euler = np.eye(2) + 0.01 * (MACHINE.A + L @ MACHINE.C)
    assert np.abs(linalg.eigvals(euler)).max() > 1.0


@pytest.mark.parametrize("tuning", [TRUE, Densities(5.0, 5.0, 1.0), Poles((-20.0, -25.0))])
def test_discrete_observer_tends_to_the_continuous_one_at_first_order(
    tuning: Densities | Poles,
) -> None:
    L = continuous_gain(MACHINE, tuning)
    steps = 0.004 / 2.0 ** np.arange(4)
    error = [np.abs(discrete_gain(MACHINE, tuning, h) / h + L).max() for h in steps]
    order = np.log2(np.array(error[:-1]) / error[1:])
    np.testing.assert_allclose(order, 1.0, atol=0.1)
    spread = [
        np.abs(
            discrete_covariance(MACHINE, discrete_gain(MACHINE, tuning, h), TRUE, h)
            - continuous_covariance(MACHINE, L, TRUE)
        ).max()
        for h in steps
    ]
    np.testing.assert_allclose(np.log2(np.array(spread[:-1]) / spread[1:]), 1.0, atol=0.1)


def test_poles_of_the_kalman_bucy_filter_give_its_gain() -> None:
    for tuning in (TRUE, Densities(5.0, 5.0, 1.0), Densities(0.01, 0.01, 100.0)):
        L = continuous_gain(MACHINE, tuning)
        poles = linalg.eigvals(MACHINE.A + L @ MACHINE.C)
        np.testing.assert_allclose(continuous_gain(MACHINE, Poles(tuple(poles))), L, rtol=1e-8)


def test_riccati_covariance_is_the_lyapunov_covariance_of_the_matched_gain() -> None:
    P = continuous_covariance(MACHINE, continuous_gain(MACHINE, TRUE), TRUE)
    np.testing.assert_allclose(
        P, linalg.solve_continuous_are(MACHINE.A.T, MACHINE.C.T, TRUE.Q, TRUE.R), rtol=1e-9
    )


@pytest.mark.parametrize("step_s", [None, 0.01, 0.1])
def test_error_is_least_at_the_true_ratio(step_s: float | None) -> None:
    ratios = 50.0 * np.geomspace(1e-4, 1e4, 33)
    alpha = tune(MACHINE, TRUE, ratios, step_s)
    assert alpha.ratio == pytest.approx(50.0)
    for of_state in alpha.rms.T:
        assert ratios[np.argmin(of_state)] == pytest.approx(50.0)
    assert (alpha.cost[np.arange(33) != 16] > 0).all()
    assert alpha.cost[16] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(alpha.gains[16], alpha.gain, rtol=1e-9)


def test_checks_say_which_condition_fails_why_and_what_to_do() -> None:
    A, C, Q, R = MACHINE.A, MACHINE.C, TRUE.Q, TRUE.R
    undamped = Machine(200.0, 6.4).A
    assert findings(A, C, Q, R) == []
    cases = {
        "(C, A) detectable": ((A, np.array([[0.0, 1.0]]), Q, R), "measure the rotor angle"),
        "(A, Q^½) stabilisable": ((undamped, C, np.diag([1.0, 0.0]), R), "Q[1, 1] > 0"),
        "Q ⪰ 0": ((A, C, np.diag([1.0, -1.0]), R), "non-negative densities"),
        "R ≻ 0": ((A, C, Q, np.zeros((1, 1))), "positive densities"),
    }  # fmt: skip
    for condition, (matrices, remedy) in cases.items():
        found = findings(*matrices)
        assert condition in [f.condition for f in found]
        with pytest.raises(ParameterError, match="no stabilising observer gain") as caught:
            require_solvable(*matrices)
        assert condition in str(caught.value)
        assert remedy in str(caught.value)


def test_damping_makes_an_undisturbed_speed_admissible() -> None:
    assert findings(MACHINE.A, MACHINE.C, np.diag([1.0, 0.0]), TRUE.R) == []


def test_unplaceable_poles_and_unstable_gains_say_so() -> None:
    with pytest.raises(ParameterError, match="move them apart"):
        continuous_gain(MACHINE, Poles((-2.0, -2.0)))
    with pytest.raises(ParameterError, match="negative real parts"):
        continuous_gain(MACHINE, Poles((-2.0, 1.0)))
    with pytest.raises(ParameterError, match="is not stable"):
        continuous_covariance(MACHINE, [[1.0], [1.0]], TRUE)
    with pytest.raises(ParameterError, match=r"not stable at a step of 0\.01"):
        discrete_covariance(MACHINE, [[-0.1], [0.0]], TRUE, 0.01)
    with pytest.raises(ParameterError, match="must be above 0"):
        tune(MACHINE, TRUE, [1.0, -1.0])


def test_model_error_is_nothing_with_the_true_machine_and_grows_with_the_wrong_one() -> None:
    L = continuous_gain(MACHINE, TRUE)
    exact = model_error(MACHINE, MACHINE, L, TRUE, omega=-0.75, acceleration=-1.0)
    np.testing.assert_allclose(exact.rms, rms(MACHINE, TRUE, TRUE), rtol=1e-9)
    for wrong in (Machine(200.0, 7.0, 0.032), Machine(200.0, 6.4, 0.064)):
        worse = model_error(MACHINE, wrong, L, TRUE, omega=-0.75, acceleration=-1.0)
        assert (worse.rms > exact.rms).all()
    with pytest.raises(ParameterError, match="no damping"):
        model_error(Machine(200.0, 6.4), MACHINE, L, TRUE)
