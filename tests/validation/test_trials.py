"""Trials know what is true: they recover the injected errors, the predicted rates and the gain."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pse_analysis.validation import thresholds, trials
from pse_analysis.validation.increments import Structure, learn
from pse_analysis.validation.motion import gap_variance


def known(n_channel: int, rho: float = 0.5) -> Structure:
    variance = np.tile(gap_variance(1.0, rho ** np.arange(1, 9), 8), (n_channel, 1))
    return Structure(variance, np.full(n_channel, 10_000), np.zeros(n_channel))


def test_generated_load_has_the_increments_it_was_asked_for() -> None:
    x = trials.generated_load(50_000, np.random.default_rng(1), rho=0.5, sigma=3.0, level=80.0)
    found = learn(x, np.arange(50_000.0)[:, None], robust=False)
    assert found.sigma[0] == pytest.approx(3.0, rel=0.02)
    np.testing.assert_allclose(found.autocorrelation[0, :3], [0.5, 0.25, 0.125], atol=0.02)


def test_errors_are_recorded_as_they_are_made() -> None:
    rng = np.random.default_rng(2)
    x = trials.generated_load(20_000, rng)
    faulty = trials.with_errors(x, rng, share=0.05, largest=6.0)
    np.testing.assert_allclose(faulty.value - faulty.size, x, rtol=0.0, atol=1e-11)
    np.testing.assert_array_equal(faulty.bad, faulty.size != 0.0)
    assert faulty.bad.mean() == pytest.approx(0.05, abs=3.0 * math.sqrt(0.05 * 0.95 / 20_000))
    assert np.abs(faulty.size).max() <= 6.0


def test_rates_and_costs_count_what_they_say() -> None:
    bad = np.array([True, True, False, False, False])
    flags = np.array([True, False, True, False, False])
    found = trials.rates(flags, bad)
    assert (found.false_alarm, found.miss) == (pytest.approx(1 / 3), 0.5)
    assert found.miss_error == pytest.approx(math.sqrt(0.125))
    assert trials.cost(flags, bad, 4.0).tolist() == [0.0, 4.0, 1.0, 0.0, 0.0]


def test_unconditional_false_alarms_exceed_the_predicted_ones() -> None:
    rng = np.random.default_rng(3)
    faulty = trials.with_errors(
        trials.generated_load(20_000, rng, n_channel=10), rng, share=0.05, largest=6.0
    )
    answer = thresholds.bayes(0.05, 1.0, 6.0 / math.sqrt(0.75))
    found = trials.rates(
        trials.flagged(faulty.value, trials.criteria("extrapolation", float(answer.k), known(10))),
        faulty.bad,
    )
    assert found.false_alarm > float(answer.false_alarm) + 5.0 * found.false_alarm_error
    assert found.false_alarm < 0.03


def test_roc_falls_with_the_threshold_and_extrapolation_lies_above() -> None:
    rng = np.random.default_rng(4)
    faulty = trials.with_errors(
        trials.generated_load(10_000, rng, n_channel=10), rng, share=0.01, largest=6.0
    )
    bounds = {1.0: (-40.0, 40.0), 2.0: (-400.0, 400.0)}
    table = trials.roc(faulty, known(10), [2.5, 3.0, 3.5], limits=bounds)
    assert table["check"].value_counts().to_dict() == {
        "limits": 2, "increment": 3, "extrapolation": 3, "combination": 3,
    }  # fmt: skip
    curve = table.set_index(["check", "quantile"])
    for check in ("increment", "extrapolation"):
        assert curve.loc[check].diff().dropna().lt(0.0).all(axis=None)
    sharp, plain = curve.loc["extrapolation"], curve.loc["increment"]
    at_equal = np.interp(
        sharp["false_alarm"][::-1], plain["false_alarm"][::-1], plain["detection"][::-1]
    )
    inside = (sharp["false_alarm"][::-1] <= plain["false_alarm"].max()).to_numpy()
    assert inside.any()
    assert (sharp["detection"][::-1].to_numpy()[inside] > at_equal[inside]).all()
    assert curve.loc[("limits", 2.0), "detection"] < curve.loc[("increment", 3.5), "detection"]
