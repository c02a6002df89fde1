"""Experiments find what theory says where theory holds, and claim nothing where it does not."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from pse_analysis.validation import experiments, trials
from pse_analysis.validation.increments import learn


def test_gain_in_resolution_is_the_square_of_the_autocorrelation() -> None:
    found = experiments.gain_by_autocorrelation([-0.6, 0.0, 0.5], np.random.default_rng(1))
    assert found.theory.tolist() == pytest.approx([36.0, 0.0, 25.0])
    # With ρ₁ = 0 the square of its estimate is left, 1/n of the variance.
    assert (np.abs(found.simulated - found.theory) <= 3 * found.error + 0.05).all()


def test_realised_rates_equal_the_predicted_ones_given_good_references_only() -> None:
    found = experiments.realised_rates([0.02, 0.1], np.random.default_rng(2), shape=(1_500, 80))
    deviation = (found.conditional - found.predicted).abs()
    assert (deviation <= 3 * found.conditional_error).all()
    alarms = found[found.rate == "false_alarm"]
    assert (alarms.unconditional > 2 * alarms.predicted).all()


@pytest.mark.parametrize("cost_ratio", [1.0, 5.0])
def test_no_other_threshold_has_a_lower_realised_risk(cost_ratio: float) -> None:
    found = experiments.risk_around_optimum(
        0.05, np.random.default_rng(3), cost_ratio=cost_ratio, n_draw=100_000
    )
    assert (found.excess >= -2 * found.error).all()
    assert found.groupby("check").factor.apply(list).tolist() == [[0.5, 0.75, 1.25, 1.5]] * 2


def test_extrapolation_lies_above_on_the_predicted_roc() -> None:
    roc = experiments.predicted_roc([2.0, 3.0, 4.0])
    plain, sharp = (roc[roc.check == name] for name in experiments.MOVING)
    np.testing.assert_array_equal(plain.false_alarm, sharp.false_alarm)
    assert (sharp.detection.to_numpy() > plain.detection.to_numpy() + 0.04).all()


@pytest.fixture(scope="module")
def margins() -> pd.DataFrame:
    rng = np.random.default_rng(4)
    n = 3_000
    curves = pd.DataFrame(
        {
            "rising": trials.generated_load(n, rng, rho=0.5)[:, 0],
            "turning": trials.generated_load(n, rng, rho=-0.5)[:, 0],
            "free": trials.generated_load(n, rng, rho=0.0)[:, 0],
            "heavy": np.cumsum(rng.standard_t(3, n)),
        }
    )
    return experiments.margins(curves, rng, n_history=1_000, repeats=20, n_bootstrap=50)


def test_more_errors_are_found_at_equal_false_alarms_where_a_gain_is_claimed(
    margins: pd.DataFrame,
) -> None:
    assert margins.claimed.to_dict() == {
        "rising": True, "turning": True, "free": False, "heavy": False,
    }  # fmt: skip
    claimed = margins[margins.claimed]
    assert (claimed.margin > 3 * claimed.error).all()
    assert (claimed.as_they_come > 0.0).all()
    assert (margins.margin[~margins.claimed].abs() < 0.02).all()


def test_margin_given_good_references_is_the_predicted_one(margins: pd.DataFrame) -> None:
    roc = experiments.predicted_roc([2.326]).set_index("check").detection
    expected = roc["extrapolation"] - roc["increment"]
    assert margins.margin["rising"] == pytest.approx(expected, abs=3 * margins.error["rising"])


def test_known_structure_is_what_a_long_history_teaches() -> None:
    x = trials.generated_load(100_000, np.random.default_rng(5), rho=0.5, sigma=2.0)
    learnt = learn(x, np.arange(len(x))[:, None], robust=False)
    known = experiments.known_structure(1, rho=0.5, sigma=2.0)
    np.testing.assert_allclose(learnt.variance, known.variance, rtol=0.03)
