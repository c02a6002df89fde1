"""Claim: what is lent is what one more device may have, and nothing where others cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.alignment.lag import FEWEST
from pse_analysis.alignment.lending import Lender, lend

SEED = 51
IGNORANT_S = 80.0
INSTANT = 60.0 * FEWEST


def steady(delay: float, spread: float = 0.0, count: int = FEWEST) -> Lender:
    """One delay, a sample a minute."""
    return Lender(60.0 * np.arange(1, count + 1), np.full(count, delay), np.full(count, spread))


def lent(lenders: list[Lender], at: float = INSTANT, window_s: float = 1e6) -> tuple[float, float]:
    delay, sigma = lend(lenders, np.array([at]), window_s, IGNORANT_S, 3)
    return float(delay[0]), float(sigma[0])


def test_three_steady_delays_lend_their_mean_and_the_spread_of_a_fourth():
    # 80, 95 and 110 s lie 15 s apart, and the mean of three is uncertain itself: 15²·(1 + 1/3).
    assert lent([steady(80.0), steady(95.0), steady(110.0)]) == pytest.approx((95.0, 300.0**0.5))


def test_delays_that_vary_and_doubt_about_them_add_to_the_spread():
    swinging = Lender(
        60.0 * np.arange(1, FEWEST + 1),
        np.tile([70.0, 110.0], FEWEST // 2),
        np.full(FEWEST, 30.0),
    )
    assert lent([swinging] * 3) == pytest.approx((90.0, 1300.0**0.5))


def test_a_device_of_many_samples_counts_no_more_than_another():
    lenders = [steady(80.0, count=10 * FEWEST), steady(95.0), steady(110.0)]
    assert lent(lenders, at=10 * INSTANT)[0] == pytest.approx(95.0)


@pytest.mark.parametrize(
    "lenders",
    [
        [],
        [steady(90.0)] * 2,
        [steady(90.0), steady(90.0), steady(90.0, count=FEWEST - 1)],
        [steady(20.0), steady(130.0), steady(250.0)],
        [steady(90.0, spread=IGNORANT_S)] * 3,
    ],
    ids=["none", "two", "one_with_too_few_samples", "disagreeing", "knowing_nothing"],
)
def test_nothing_is_lent_by(lenders: list[Lender]):
    assert np.isnan(lent(lenders)).all()


def test_only_what_came_in_the_window_before_an_instant_counts():
    arrival = 60.0 * np.arange(1, 2 * FEWEST + 1)
    changed = np.where(arrival <= INSTANT, 90.0, 30.0)
    moved = [Lender(arrival, changed, np.zeros(len(arrival)))] * 3
    assert lent(moved)[0] == pytest.approx(90.0)
    assert lent(moved, at=2 * INSTANT, window_s=INSTANT - 1.0)[0] == pytest.approx(30.0)
    assert np.isnan(lent(moved, at=INSTANT - 1.0)).all()


def test_the_spread_covers_the_delays_of_one_more_device():
    rng = np.random.default_rng(SEED)
    error, claimed = [], []
    for _ in range(2000):
        usual = rng.normal(120.0, 15.0, 5)
        lenders = [
            Lender(60.0 * np.arange(1, 101), rng.normal(m, 20.0, 100), np.zeros(100))
            for m in usual[:4]
        ]
        delay, sigma = lent(lenders, at=6000.0)
        error.append(rng.normal(usual[4], 20.0) - delay)
        claimed.append(sigma)
    apart = np.abs(error) / np.array(claimed)
    assert np.sqrt(np.mean(np.square(error))) == pytest.approx(
        np.sqrt(np.mean(np.square(claimed))), rel=0.05
    )
    assert 0.92 < np.mean(apart < 2.0) < 0.98
