"""Claim: the filter over delays equals the textbook's where there is one, and sees when blind."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.alignment import delays
from pse_analysis.alignment.delays import Belief, Walk

SEED = 11
LAGS = np.arange(0.0, 241.0, 10.0)
UNIFORM = np.full(len(LAGS), 1.0 / len(LAGS))
SURE_OFFSET = 1e-14


def belief(n_drift: int = 1, n_noise: int = 1) -> Belief:
    """Any delay, and an offset that is known to be zero."""
    shape = (n_drift, len(LAGS), n_noise)
    return Belief(np.full(shape, 1.0 / len(LAGS)), np.zeros(shape), np.full(shape, SURE_OFFSET))


def drawn_law() -> np.ndarray:
    law = np.random.default_rng(SEED).random(len(LAGS)) + 0.1
    return np.asarray(law / law.sum())


def test_a_walk_far_from_its_ends_has_the_stated_variance():
    walk = Walk.of(LAGS, UNIFORM)
    start = np.zeros((2, len(LAGS), 1))
    start[:, 12, 0] = 1.0
    for weight, variance in zip(
        walk.forward(start, np.array([9.0, 400.0]))[:, :, 0], (9.0, 400.0), strict=True
    ):
        assert weight.sum() == pytest.approx(1.0)
        assert weight @ LAGS == pytest.approx(120.0)
        assert weight @ (LAGS - 120.0) ** 2 == pytest.approx(variance, rel=1e-6)


def test_a_walk_leaves_its_law_as_it_is_and_ends_in_it():
    law = drawn_law()
    walk = Walk.of(LAGS, law)
    np.testing.assert_allclose(walk.forward(law[None, :, None], np.array([70.0]))[0, :, 0], law)
    start = np.eye(len(LAGS))[None, :, :1]
    np.testing.assert_allclose(walk.forward(start, np.array([1e7]))[0, :, 0], law, atol=1e-9)


def test_forward_and_backward_steps_are_each_others_transpose():
    walk = Walk.of(LAGS, drawn_law())
    whole = np.eye(len(LAGS))[None]
    step = np.array([150.0])
    np.testing.assert_allclose(
        walk.forward(whole, step)[0], walk.backward(whole, step)[0].T, atol=1e-14
    )
    np.testing.assert_allclose(walk.backward(whole, step)[0].sum(axis=1), 1.0)


def test_with_a_known_offset_filter_and_smoother_equal_the_forward_backward_algorithm(monkeypatch):
    monkeypatch.setattr(delays, "OUTLIERS", 0.0)
    rng = np.random.default_rng(SEED)
    walk = Walk.of(LAGS, drawn_law())
    step, noise, count = np.array([300.0]), 0.04, 6
    apart = rng.normal(0, 0.5, (count, len(LAGS)))
    now, filtered, predicted, evidence = belief(), [], [], 0.0
    for row in apart:
        now = delays.predict(now, walk, step, np.zeros(1))
        predicted.append(now.weight)
        now, spoken = delays.update(now, row, np.array([noise]), 1.0)
        filtered.append(now.weight)
        evidence += float(spoken[0, 0])
    smoothed = delays.smooth(filtered, predicted, walk, [step] * count)

    transition = walk.backward(np.eye(len(LAGS))[None], step)[0]
    likelihood = np.exp(-0.5 * apart**2 / noise) / np.sqrt(noise)
    forward = [UNIFORM @ transition * likelihood[0]]
    for row in likelihood[1:]:
        forward.append(forward[-1] @ transition * row)
    backward = [np.ones(len(LAGS))]
    for row in likelihood[:0:-1]:
        backward.insert(0, transition @ (row * backward[0]))
    for k in range(count):
        expected = forward[k] * backward[k]
        np.testing.assert_allclose(
            smoothed[k][0, :, 0], expected / expected.sum(), rtol=1e-6, atol=1e-10
        )
    assert evidence == pytest.approx(np.log(forward[-1].sum()), rel=1e-9)


def test_with_a_known_delay_the_offset_is_the_kalman_filters(monkeypatch):
    monkeypatch.setattr(delays, "OUTLIERS", 0.0)
    rng = np.random.default_rng(SEED)
    walk = Walk.of(LAGS, UNIFORM)
    shape = (1, len(LAGS), 1)
    now = Belief(np.full(shape, 1.0 / len(LAGS)), np.zeros(shape), np.full(shape, 4.0))
    mean, variance, load, noise = 0.0, 4.0, 0.3, 0.5
    for measured in rng.normal(2.0, 1.0, 8):
        now = delays.predict(now, walk, np.array([1e-9]), np.array([load]))
        now, _ = delays.update(now, np.full(len(LAGS), measured), np.array([noise]), 1.0)
        variance += load
        gain = variance / (variance + noise)
        mean, variance = mean + gain * (measured - mean), (1 - gain) * variance
        np.testing.assert_allclose(now.offset, mean, rtol=1e-6)
        np.testing.assert_allclose(now.variance, variance, rtol=1e-6)


def test_a_spike_is_forgotten_and_a_switched_load_is_learnt():
    walk = Walk.of(LAGS, UNIFORM)
    calm, noise, load = np.zeros(len(LAGS)), np.array([0.01]), np.array([1e-4])

    def after(values: list[float]) -> Belief:
        now = belief()
        for value in values:
            now = delays.predict(now, walk, np.array([25.0]), load)
            now, _ = delays.update(now, calm + value, noise, 100.0)
        return now

    np.testing.assert_allclose(after([0.0] * 10 + [8.0] + [0.0] * 3).offset, 0.0, atol=0.2)
    np.testing.assert_allclose(after([0.0] * 10 + [8.0] * 4).offset, 8.0, atol=0.2)


def test_where_all_delays_fit_alike_nothing_is_learnt():
    walk = Walk.of(LAGS, UNIFORM)
    now = delays.predict(belief(), walk, np.array([100.0]), np.array([0.01]))
    after, _ = delays.update(now, np.full(len(LAGS), 0.3), np.array([0.04]), 1.0)
    np.testing.assert_allclose(after.weight, now.weight)
