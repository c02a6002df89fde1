"""Claim: a reference never knows the future, and the usual delay is where increments agree."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.alignment import lag
from pse_analysis.alignment.lag import Band, Reference

SEED = 3
LAG_S = 73.0
TIME = np.arange(0.0, 43200.0, 10.0)
LEVEL = np.cumsum(np.random.default_rng(SEED).normal(0, 1.0, len(TIME)))


def test_a_gap_holds_the_last_value_and_says_how_old_it_is():
    kept = (TIME < 600) | (TIME >= 700)
    made = Reference.of(TIME[kept], TIME[kept] + 0.3, LEVEL[kept])
    np.testing.assert_array_equal(made.time, TIME)
    gap = (TIME >= 600) & (TIME < 700)
    np.testing.assert_array_equal(made.value[gap], LEVEL[59])
    np.testing.assert_allclose(made.held[gap], 10.0 * np.arange(1, 11))
    assert not made.held[~gap].any()
    np.testing.assert_allclose(made.known[~gap], TIME[~gap] + 0.3)


def test_a_thinned_reference_is_the_mean_at_the_middle_and_known_with_its_last_value():
    made = Reference(TIME, TIME + 0.3, LEVEL).thinned(40.0)
    assert made.step == pytest.approx(40.0)
    np.testing.assert_allclose(made.value[5], LEVEL[20:24].mean())
    assert made.time[5] == pytest.approx(TIME[20:24].mean())
    assert made.known[5] == pytest.approx(TIME[23] + 0.3)
    same = Reference(TIME, TIME, LEVEL)
    assert same.thinned(15.0) is same


def test_a_band_holds_the_reference_at_every_lag_and_nothing_that_had_not_arrived():
    reference = Reference(TIME, TIME + 35.0, LEVEL)
    arrival = np.array([1000.0, 2005.0])
    band = Band.of(arrival, reference, 100.0)
    np.testing.assert_allclose(band.lags, np.arange(0.0, 101.0, 10.0))
    np.testing.assert_allclose(band.value[0, 4:], LEVEL[96:89:-1])
    # The last 35 s were not known yet: the newest value stands for them, and is that much older.
    np.testing.assert_allclose(band.value[0, :4], LEVEL[96])
    np.testing.assert_allclose(band.age[0], np.maximum(40.0 - band.lags, 0.0))
    np.testing.assert_allclose(band.value[1, 5], 0.5 * (LEVEL[195] + LEVEL[196]))


@pytest.mark.parametrize("period", [60.0, 300.0])
def test_the_usual_delay_is_found_between_the_lags(period: float):
    rng = np.random.default_rng(SEED)
    taken = np.arange(7.0, 43000.0, period)
    arrival = taken + LAG_S
    value = 0.4 * np.interp(taken, TIME, LEVEL) + rng.normal(0, 0.3, len(taken))
    band = Band.of(arrival, Reference(TIME, TIME, LEVEL), 150.0)
    usual, found = lag.usual_delay(arrival, value, band, 86400.0)
    late = arrival > 21600.0
    assert np.abs(usual[late] - LAG_S).max() < 5.0
    assert found[late].min() > 0.9


def test_while_increments_are_few_there_is_no_usual_delay():
    arrival = np.arange(100.0, 100.0 + 60.0 * 21, 60.0)
    band = Band.of(arrival, Reference(TIME, TIME, LEVEL), 150.0)
    usual, found = lag.usual_delay(arrival, np.arange(21.0), band, 86400.0)
    assert not usual.any()
    assert (found == -1.0).all()


def test_spikes_do_not_turn_the_usual_delay():
    rng = np.random.default_rng(SEED)
    taken = np.arange(7.0, 43000.0, 60.0)
    value = np.interp(taken, TIME, LEVEL)
    spiked = np.where(rng.random(len(taken)) < 0.02, 3.0 * value, value)
    band = Band.of(taken + LAG_S, Reference(TIME, TIME, LEVEL), 150.0)
    usual, _ = lag.usual_delay(taken + LAG_S, spiked, band, 86400.0)
    assert np.abs(usual[360:] - LAG_S).max() < 5.0
