"""Claim: thresholds behave as their equations say, and none latches a channel to the past."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.validation import forecasts
from pse_analysis.validation.adaptive import AdaptiveParams, AdaptiveState, screen, step

SEED = 22
KINDS = ("literal", "absolute", "scaled")
SIGMA = 0.005


def voltage(n: int = 400, m: int = 3, seed: int = SEED) -> np.ndarray:
    """Voltages about 1 p.u. that drift slowly under noise of σ = 0.005."""
    rng = np.random.default_rng(seed)
    return 1.0 + np.cumsum(rng.normal(0, 5e-4, (n, m)), axis=0) + rng.normal(0, SIGMA, (n, m))


@pytest.mark.parametrize("kind", KINDS)
def test_one_at_a_time_is_the_same_as_in_bulk(kind: str):
    params = AdaptiveParams(threshold=kind)  # type: ignore[arg-type]
    z = voltage()
    z[200:206] *= 1.05
    z[50, 1] = np.nan
    sigma = np.full(z.shape, SIGMA)
    whole = screen(z, sigma, params)
    for column in range(z.shape[1]):
        state = AdaptiveState.empty(1, params)
        for k, row in enumerate(z[:, [column]]):
            state, one = step(state, row, sigma[k, :1], np.isfinite(row), params)
            for name, alone in one._asdict().items():
                np.testing.assert_allclose(alone[0], getattr(whole, name)[k, column], rtol=1e-12)


def test_printed_threshold_is_the_textbook_expression():
    params = AdaptiveParams(threshold="literal", window=5)
    z = voltage(n=12, m=1)
    found = screen(z, SIGMA, params)
    assert not found.flagged[:11].any()
    window = z[7:12, 0]
    d = np.abs(np.diff(window))
    expected = SIGMA**2 * window.mean() / (np.sum((d - d.mean()) ** 2) / 3)
    assert found.threshold[11, 0] == pytest.approx(expected, rel=1e-12)
    assert found.statistic[11, 0] == pytest.approx(d[-1], rel=1e-12)


@pytest.mark.parametrize("window", [4, 5, 8, 12])
def test_printed_threshold_sees_a_spike_only_if_its_cube_is_large_enough(window: int):
    quiet = np.full((40, 1), 1.0)
    bound = ((window - 1) * SIGMA**2) ** (1 / 3)
    for size, seen in ((0.97 * bound, False), (1.05 * bound, True)):
        z = quiet.copy()
        z[30] += size
        params = AdaptiveParams(threshold="literal", window=window)
        # z̄ is lifted by the spike itself: one part in the window's length.
        assert screen(z, SIGMA, params).flagged[30, 0] == seen


def test_literal_threshold_condemns_a_negative_level_and_absolute_does_not():
    z = -voltage()
    share = {k: screen(z, SIGMA, AdaptiveParams(threshold=k)).flagged.mean() for k in KINDS}  # type: ignore[arg-type]
    assert share["literal"] > 0.8
    assert share["scaled"] < 0.005
    assert share["absolute"] < share["literal"]


def test_scaled_threshold_is_invariant_under_shifts_and_scales():
    z = voltage()
    z[300] += 0.06
    plain = screen(z, SIGMA).flagged
    np.testing.assert_array_equal(screen(3.0 * z - 7.0, 3.0 * SIGMA).flagged, plain)
    assert plain[300].all()


@pytest.mark.parametrize("size", [0.05, 0.08])
def test_every_sample_of_a_bad_interval_is_flagged_and_little_else(size: float):
    # 5 % is 10σ, and the mean of four values leaves a residual of 1.1σ under a threshold of 4.5σ.
    rng = np.random.default_rng(SEED)
    z = voltage(n=720, m=100)
    z[350:356] *= 1 + size * rng.choice((-1.0, 1.0), (6, 100))
    found = screen(z, SIGMA)
    assert found.flagged[350:356].mean() > 0.995
    outside = np.delete(found.flagged, np.arange(350, 356), axis=0)
    assert outside.mean() < 0.0005
    assert not found.released.any()


@pytest.mark.parametrize("share", [0.05, 0.10])
def test_injected_errors_are_found_with_precision_and_recall(share: float):
    rng = np.random.default_rng(SEED)
    z = voltage(n=720, m=40)
    bad = rng.random(z.shape) < share
    bad[:288] = False  # a clean day of history
    z = np.where(bad, z * (1 + 0.05 * rng.choice((-1.0, 1.0), z.shape)), z)
    flagged = screen(z, SIGMA).flagged
    assert (flagged & bad).sum() > 0.98 * bad.sum()
    assert (flagged & bad).sum() > 0.98 * flagged.sum()


def jumping(n: int, m: int, seed: int = SEED) -> np.ndarray:
    """Currents of customers that switch on and off every few hours, and now and then twice."""
    rng = np.random.default_rng(seed)
    switched = np.cumsum(rng.random((n, m)) < 0.06, axis=0) % 2
    return 1.0 + 0.3 * switched + rng.normal(0, SIGMA, (n, m))


def test_a_channel_that_jumps_by_itself_is_left_alone_once_that_is_known():
    z = jumping(n=1000, m=50)
    found = screen(z, SIGMA)
    assert found.flagged[:60].mean() > 0.1
    assert found.flagged[600:].mean() < 0.005


def test_a_channel_is_never_latched_for_longer_than_twice_its_patience():
    rng = np.random.default_rng(SEED)
    calm = voltage(n=100, m=20)
    wild = 3.0 + np.cumsum(rng.normal(0, 0.5, (300, 20)), axis=0)
    flagged = screen(np.concatenate([calm, wild]), SIGMA).flagged
    run = longest = np.zeros(20)
    for row in flagged:
        run = np.where(row, run + 1, 0)
        longest = np.maximum(longest, run)
    assert (longest <= 2 * AdaptiveParams().release).all()
    assert flagged[-100:].mean() < 0.02


def test_replacement_is_the_weighted_window_with_a_sigma_that_reaches_the_sample():
    z = voltage()
    z[100] += 0.06
    weight = 0.7 ** np.arange(4)[::-1]
    expected = weight @ z[96:100] / weight.sum()
    found = screen(z, SIGMA)
    assert found.flagged[100].all()
    np.testing.assert_allclose(found.value[100], expected)
    np.testing.assert_allclose(found.sigma[100], np.abs(z[100] - expected))
    assert (found.value[~found.flagged] == z[~found.flagged]).all()
    assert (found.sigma[~found.flagged] == SIGMA).all()
    printed = screen(z, SIGMA, AdaptiveParams(threshold="absolute"))
    assert printed.flagged[100].all()
    np.testing.assert_allclose(printed.sigma[100], 3 * SIGMA)


@pytest.mark.parametrize("kind", KINDS)
def test_a_ramp_does_not_latch_a_channel(kind: str):
    rng = np.random.default_rng(SEED)
    z = np.full(300, 1.0)
    z[100:200] += 0.02 * np.arange(100)  # 4σ a step
    z[200:] = z[199]
    z = (z + rng.normal(0, SIGMA, 300))[:, None]
    found = screen(z, SIGMA, AdaptiveParams(threshold=kind))  # type: ignore[arg-type]
    assert np.abs(found.value - z)[230:].max() < 0.06
    if kind == "scaled":
        assert found.flagged[100:200].mean() < 0.1


def test_a_step_is_accepted_after_more_than_six_samples_that_agree():
    z = voltage(m=2)
    z[200:, 0] += 0.05
    rng = np.random.default_rng(SEED)
    z[200:206, 1] += 0.05 * rng.choice((-1.0, 1.0), 6)
    found = screen(z, SIGMA)
    assert found.flagged[200:206, 0].all()
    assert found.released[206, 0]
    assert not found.flagged[207:230, 0].any()
    assert not found.released[:, 1].any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_window_longer_than_the_patience_still_accepts_a_step(kind: str):
    z = voltage(m=2)
    z[200:, 0] += 0.5
    found = screen(z, SIGMA, AdaptiveParams(threshold=kind, window=40))
    assert not found.flagged[300:, 0].any()
    assert np.isfinite(found.value[201:]).all()
    assert np.abs(found.value - z)[300:].max() < 0.06


def test_an_angle_that_passes_its_turn_is_no_jump():
    rng = np.random.default_rng(SEED)
    angle = np.linspace(0, 8 * np.pi, 400) + rng.normal(0, 0.002, 400)
    folded = ((angle + np.pi) % (2 * np.pi) - np.pi)[:, None]
    assert screen(folded, 0.002).flagged.any()
    assert not screen(folded, 0.002, turn=2 * np.pi).flagged.any()


def test_what_most_channels_of_a_kind_do_at_once_is_no_error():
    z = voltage(m=9)
    z[300:, :5] += 0.06
    z[300, 5] -= 0.06
    z[300, 6:8] += 0.06
    kind = np.array([0, 0, 0, 0, 0, 0, 1, 1, 1])
    apart, together = screen(z, SIGMA), screen(z, SIGMA, kind=kind)
    np.testing.assert_array_equal(apart.flagged[300], [1, 1, 1, 1, 1, 1, 1, 1, 0])
    # Five of six to one side moved; the sixth, and two of three, may be errors.
    np.testing.assert_array_equal(together.flagged[300], [0, 0, 0, 0, 0, 1, 1, 1, 0])
    assert not together.flagged[301:310, :5].any()
    np.testing.assert_array_equal(apart.flagged[:300], together.flagged[:300])


def test_flags_rest_on_the_past():
    z = voltage()
    other = z.copy()
    other[251:] = np.random.default_rng(SEED).permutation(other[251:])
    np.testing.assert_array_equal(
        screen(z, SIGMA).flagged[:251], screen(other, SIGMA).flagged[:251]
    )


def test_a_channel_without_a_sample_keeps_its_past():
    params = AdaptiveParams()
    z = voltage(n=30, m=1)
    state = AdaptiveState.empty(1, params)
    sigma = np.full(1, SIGMA)
    for row in z:
        state, _ = step(state, row, sigma, np.ones(1, dtype=bool), params)
    after, decision = step(state, np.array([9.9]), sigma, np.zeros(1, dtype=bool), params)
    assert not decision.flagged.any()
    # Only the step itself is counted: nothing was learnt from it.
    *before, newest = after.seen
    assert not (newest.present | newest.learns).any()
    assert same(tuple(before), state.seen)
    assert same(state._replace(seen=()), after._replace(seen=()))


def same(first: tuple, second: tuple) -> bool:
    """Whether all arrays of two states are equal, however deep they stand."""
    return len(first) == len(second) and all(
        same(one, other) if isinstance(one, tuple) else np.array_equal(one, other, equal_nan=True)
        for one, other in zip(first, second, strict=True)
    )


def test_an_older_state_can_be_stepped_from_again():
    params = AdaptiveParams()
    z = voltage(n=60, m=5)
    sigma, present = np.full(5, SIGMA), np.ones(5, dtype=bool)
    states = [AdaptiveState.empty(5, params)]
    for row in z:
        states.append(step(states[-1], row, sigma, present, params)[0])
    for k in (7, 30, 47):
        assert same(states[k + 1], step(states[k], z[k], sigma, present, params)[0])
        assert not same(states[k + 1], states[k])


@pytest.mark.parametrize("wrong", [{"window": 3}, {"decay": 0.0}, {"release": 4}])
def test_parameters_without_meaning_are_refused(wrong: dict[str, float]):
    with pytest.raises(ParameterError, match="expected"):
        AdaptiveParams(**wrong)  # type: ignore[arg-type]


def test_spread_of_each_forecast_is_that_of_its_design():
    line = np.column_stack([np.ones(4), np.arange(4)])
    for weights, design, ahead in zip(
        forecasts.AHEAD,
        (line, np.ones((1, 1)), np.ones((4, 1))),
        ([1.0, 4.0], [1.0], [1.0]),
        strict=True,
    ):
        own = ahead @ np.linalg.solve(design.T @ design, design.T)
        np.testing.assert_allclose(weights[-len(design) :], own, atol=1e-12)
        spread = 1 + ahead @ np.linalg.solve(design.T @ design, ahead)
        np.testing.assert_allclose(1 + weights @ weights, spread)


def test_forecasts_are_those_of_their_weights():
    past = np.random.default_rng(SEED).normal(size=(6, 50))
    z = np.arange(50.0)
    found = forecasts.deviations(past, z)
    np.testing.assert_allclose(z - found, forecasts.AHEAD @ past[-4:], rtol=1e-12, atol=1e-12)


def test_threshold_is_the_formula_of_the_forecast_that_serves_best():
    level = 1.0 + np.random.default_rng(SEED).normal(0, SIGMA, (500, 1))
    found = screen(level, SIGMA)
    # Noise about a level: the mean of four, and residuals of that spread.
    at = found.threshold[300:, 0] / (4 * SIGMA * np.sqrt(1.25))
    assert (at >= 1.0).all()
    assert np.median(at) == pytest.approx(1.0, abs=0.15)
