"""The closed forms are the integrals they stand for, and the thresholds are their optima."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from pse_analysis.errors import ParameterError
from pse_analysis.validation import thresholds
from pse_analysis.validation.thresholds import Verdict

PRIORS = np.array([0.01, 0.05, 0.1, 0.2, 0.5])[:, None]
RATIOS = np.array([1.0, 2.0, 5.0, 10.0])

BAYES = {
    6.0: [
        [3.512, 3.308, 3.018, 2.778],
        [3.004, 2.763, 2.409, 2.101],
        [2.744, 2.478, 2.075, 1.709],
        [2.430, 2.126, 1.639, 1.140],
        [1.770, 1.321, 0.0, 0.0],
    ],
    3.0: [
        [3.717, 3.426, 3.023, 2.701],
        [3.005, 2.681, 2.214, 1.811],
        [2.655, 2.305, 1.776, 1.273],
        [2.242, 1.843, 1.169, 0.0],
        [1.360, 0.614, 0.0, 0.0],
    ],
}
MINIMAX = {
    6.0: ([1.256, 0.981, 0.632, 0.409], [0.685, 0.597, 0.439, 0.306]),
    3.0: ([0.984, 0.715, 0.410, 0.243], [0.601, 0.484, 0.307, 0.189]),
}


@pytest.mark.parametrize("amplitude", [6.0, 3.0])
def test_bayes_thresholds_equal_the_reference_table(amplitude: float) -> None:
    answer = thresholds.bayes(PRIORS, RATIOS, amplitude)
    np.testing.assert_allclose(answer.k, BAYES[amplitude], atol=5.001e-4)
    np.testing.assert_array_equal(
        answer.verdict == Verdict.ALWAYS_REJECT, np.array(BAYES[amplitude]) == 0.0
    )


@pytest.mark.parametrize("amplitude", [6.0, 3.0])
def test_minimax_thresholds_equal_the_reference_table(amplitude: float) -> None:
    answer = thresholds.minimax(RATIOS, amplitude)
    k, q = MINIMAX[amplitude]
    np.testing.assert_allclose(answer.k, k, atol=5.001e-4)
    np.testing.assert_allclose(answer.q, q, atol=5.001e-4)


def test_degenerate_odds_are_those_from_which_everything_is_rejected() -> None:
    np.testing.assert_allclose(thresholds.degenerate_odds([6.0, 3.0]), [4.787, 2.400], atol=5e-4)
    for amplitude in (6.0, 3.0):
        odds = float(thresholds.degenerate_odds(amplitude))
        q = np.array([0.999, 1.001]) * odds / (1.0 + np.array([0.999, 1.001]) * odds)
        verdict = thresholds.bayes(q, 1.0, amplitude).verdict
        assert verdict.tolist() == [Verdict.INTERIOR, Verdict.ALWAYS_REJECT]


@pytest.mark.parametrize("amplitude", [0.5, 3.0, 6.0, 40.0])
def test_closed_forms_equal_quadrature(amplitude: float) -> None:
    for k in (0.0, 0.1, 1.0, 2.5, amplitude, amplitude + 3.0):
        kink = [amplitude] if amplitude < k else None
        inside, _ = integrate.quad(
            lambda x: float(thresholds.error_density(x, amplitude)), 0.0, k, points=kink
        )
        beyond, _ = integrate.quad(lambda x: float(thresholds.good_density(x)), k, np.inf)
        assert thresholds.miss(k, amplitude) == pytest.approx(2.0 * inside, abs=1e-9)
        assert thresholds.false_alarm(k) == pytest.approx(2.0 * beyond, abs=1e-9)


def test_the_density_as_printed_has_half_the_mass() -> None:
    def printed(x: float) -> float:
        """Eq. (6) as printed: 1/(12σ) before arguments of 3σ."""
        return float(thresholds.error_density(x, 3.0)) * 6.0 / 12.0

    mass, _ = integrate.quad(printed, -12.0, 12.0)
    ours, _ = integrate.quad(lambda x: float(thresholds.error_density(x, 6.0)), -16.0, 16.0)
    assert mass == pytest.approx(0.5, abs=1e-9)
    assert ours == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("amplitude", [3.0, 6.0])
def test_closed_forms_equal_ten_million_draws(amplitude: float) -> None:
    rng = np.random.default_rng(2018)
    n, ks = 10_000_000, np.array([0.5, 1.256, 2.744, 3.512])
    exceeded, inside = np.zeros(4), np.zeros(4)
    for _ in range(10):
        good = rng.standard_normal(n // 10)
        bad = np.abs(good + rng.uniform(-amplitude, amplitude, n // 10))
        good = np.abs(good)
        exceeded += [(good > k).sum() for k in ks]
        inside += [(bad <= k).sum() for k in ks]
    for drawn, closed in (
        (exceeded / n, thresholds.false_alarm(ks)),
        (inside / n, thresholds.miss(ks, amplitude)),
    ):
        error = np.sqrt(closed * (1.0 - closed) / n)
        assert np.all(np.abs(drawn - closed) <= 4.0 * error)


def test_no_other_threshold_has_a_lower_bayes_risk() -> None:
    q, r, a = PRIORS[:4], RATIOS[:3], 6.0
    best = thresholds.bayes(q, r, a)
    grid = np.linspace(0.0, 8.0, 4001)
    on_grid = thresholds.risk(grid[:, None, None], q, r, a).min(axis=0)
    assert np.all(best.risk <= on_grid + 1e-12)
    assert np.all(on_grid - best.risk <= 1e-6)


def test_minimax_threshold_has_the_least_worst_risk() -> None:
    q = np.linspace(0.0, 1.0, 501)
    grid = np.linspace(0.0, 5.0, 1001)
    for r in RATIOS:
        answer = thresholds.minimax(r)
        worst = thresholds.risk(grid[:, None], q, r).max(axis=1)
        own = thresholds.risk(answer.k, q, r).max()
        assert own <= worst.min() + 1e-9
        assert thresholds.risk(answer.k, q, r).min() == pytest.approx(own, rel=1e-9)
        assert thresholds.bayes(answer.q, r).k == pytest.approx(float(answer.k), abs=1e-6)


def test_a_bounded_prior_gives_bayes_at_the_bound_and_a_loose_one_changes_nothing() -> None:
    tight = thresholds.minimax(1.0, q_max=[0.1, 0.9])
    free = thresholds.minimax(1.0)
    assert tight.k[0] == pytest.approx(float(thresholds.bayes(0.1).k), abs=1e-12)
    assert tight.k[1] == pytest.approx(float(free.k), abs=1e-12)
    q = np.linspace(0.0, 0.1, 201)
    grid = np.linspace(0.0, 6.0, 1201)
    worst = thresholds.risk(grid[:, None], q).max(axis=1)
    assert thresholds.risk(tight.k[0], q).max() <= worst.min() + 1e-9


def test_priors_of_zero_and_one_are_named_degenerate() -> None:
    answer = thresholds.bayes([0.0, 1.0])
    assert answer.verdict.tolist() == [Verdict.NEVER_REJECT, Verdict.ALWAYS_REJECT]
    assert answer.k.tolist() == [np.inf, 0.0]
    assert answer.false_alarm.tolist() == [0.0, 1.0]
    assert answer.miss.tolist() == [1.0, 0.0]
    assert answer.risk.tolist() == [0.0, 0.0]


def test_the_truncated_false_alarm_is_the_printed_integral() -> None:
    printed, _ = integrate.quad(lambda x: float(thresholds.good_density(x)), 1.5, 3.0)
    assert thresholds.false_alarm(1.5, truncate_at=3.0) == pytest.approx(2.0 * printed, abs=1e-9)
    assert thresholds.false_alarm(3.5, truncate_at=3.0) == 0.0


@pytest.mark.parametrize("q", [1e-300, 1e-30, 1e-9])
def test_rare_errors_still_have_an_interior_optimum(q: float) -> None:
    answer = thresholds.bayes(q, 1.0, [0.5, 6.0, 100.0])
    assert np.all(np.isfinite(answer.k))
    assert np.all(answer.verdict == Verdict.INTERIOR)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q": 1.5}, "q is a probability"),
        ({"q": np.nan}, "q is a probability"),
        ({"q": 0.1, "cost_ratio": 0.0}, "cost_ratio must be positive"),
        ({"q": 0.1, "amplitude": -1.0}, "amplitude must be positive"),
    ],
)
def test_parameters_outside_their_range_are_refused(
    arguments: dict[str, float], message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        thresholds.bayes(**arguments)
