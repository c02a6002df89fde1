"""Claim: recovered stamps beat arrival and usual delay where delays vary, and know how sure."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from pse_analysis.alignment import dtw
from pse_analysis.alignment.dtw import DTW, NONE, XCORR, Reference, Stamps, TimeParams
from pse_analysis.errors import ParameterError

SEED = 4
DAY = 86400.0
PMU_S = 10.0
BAND_S = 240.0
PARAMS = TimeParams(largest_delay_s=BAND_S)
INSTANTS = np.arange(0.0, 2 * DAY, 300.0)


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


@cache
def curve(seed: int = SEED):
    """Current that moves by 10 % in a quarter of an hour, every 10 s for two days."""
    rng = np.random.default_rng(seed)
    minute = np.arange(0.0, 2 * DAY + 60.0, 60.0)
    walk = np.cumsum(rng.normal(0, 0.1 / np.sqrt(15.0), len(minute)))
    return minute, np.exp(walk)


def device(
    delay: tuple[float, float], *, seed: int = SEED, period: float = 300.0, noise: float = 0.005
):
    """Arrivals, values, σ, delays and the partner of a device in series with a phasor unit."""
    rng = np.random.default_rng(seed)
    minute, level = curve(seed)
    time = np.arange(0.0, 2 * DAY, PMU_S)
    reference = np.interp(time, minute, level) * (1 + rng.normal(0, 0.005, len(time)))
    taken = np.arange(7.0, 2 * DAY - 600, period)
    late = rng.uniform(*delay, len(taken))
    value = 0.7 * np.interp(taken, minute, level) * (1 + rng.normal(0, noise, len(taken)))
    return taken + late, value, noise * value, late, Reference.of(time, time + 0.3, reference)


def recovered(made, method: dtw.Method, params: TimeParams = PARAMS) -> Stamps:
    arrival, value, sigma, _, reference = made
    return dtw.recover(arrival, value, sigma, reference, INSTANTS, params, method)


@pytest.mark.parametrize("seed", [4, 5])
def test_confident_stamps_are_most_and_beat_arrival_and_usual_delay_when_delays_vary(seed: int):
    made = device((10.0, 230.0), seed=seed)
    arrival, late = made[0], made[3]
    settled = arrival > DAY
    match, usual = recovered(made, "dtw"), recovered(made, "xcorr")
    sure = settled & (match.method == DTW)
    assert sure.sum() >= 0.5 * settled.sum()
    found, plain = rms((match.delay - late)[sure]), rms((usual.delay - late)[sure])
    assert found < 0.85 * plain
    assert found < 0.5 * rms(late[sure])


@pytest.mark.parametrize("seed", [4, 5])
def test_with_constant_delay_it_is_no_worse_than_the_usual_delay_by_a_phasor_sample(seed: int):
    made = device((95.0, 95.0), seed=seed)
    settled = made[0] > DAY
    errors = {
        method: rms((recovered(made, method).delay - 95.0)[settled])  # type: ignore[arg-type]
        for method in ("dtw", "xcorr")
    }
    assert errors["dtw"] <= errors["xcorr"] + PMU_S


def test_error_grows_as_confidence_falls():
    late, sure, error = [], [], []
    for seed in (4, 5):
        made = device((10.0, 230.0), seed=seed)
        settled = made[0] > DAY
        found = recovered(made, "dtw")
        late.append(made[3][settled])
        sure.append(found.confidence[settled])
        error.append((found.delay - made[3])[settled])
    order = np.argsort(-np.concatenate(sure), kind="stable")
    thirds = [rms(part) for part in np.array_split(np.concatenate(error)[order], 3)]
    assert thirds[0] < 0.8 * thirds[1] < thirds[1] < 1.1 * thirds[2]


def test_a_flat_signal_is_left_to_the_usual_delay_or_alone():
    arrival, value, _, _, reference = device((10.0, 230.0))
    rng = np.random.default_rng(SEED)
    flat = Reference(reference.time, reference.known, 1 + rng.normal(0, 0.005, reference.time.size))
    still = 0.7 * (1 + rng.normal(0, 0.005, value.size))
    found = dtw.recover(arrival, still, 0.005 * still, flat, INSTANTS, PARAMS, "dtw")
    assert (found.method == DTW).mean() < 0.01
    alone = found.method == NONE
    assert (found.delay[alone] == 0).all()
    assert (found.confidence[alone] == 0).all()


def test_too_few_samples_are_left_alone():
    made = tuple(part[:12] for part in device((10.0, 230.0))[:4])
    reference = device((10.0, 230.0))[4]
    found = dtw.recover(*made[:3], reference, INSTANTS, PARAMS, "dtw")
    assert (found.method == NONE).all()
    assert not found.confidence.any()


def test_no_delay_leaves_the_causal_band():
    found = recovered(device((10.0, 230.0)), "dtw")
    assert found.delay.min() >= 0
    assert found.delay.max() <= BAND_S + PMU_S


def test_what_comes_later_changes_no_stamp():
    arrival, value, sigma, _, reference = device((10.0, 230.0))
    whole = dtw.recover(arrival, value, sigma, reference, INSTANTS, PARAMS, "dtw")
    now = 1.3 * DAY
    rng = np.random.default_rng(SEED)
    other = np.where(arrival > now, rng.permutation(value), value)
    later = Reference(
        reference.time,
        reference.known,
        np.where(reference.known > now, rng.permutation(reference.value), reference.value),
    )
    changed = dtw.recover(arrival, other, sigma, later, INSTANTS, PARAMS, "dtw")
    past = arrival <= np.floor(now / 300.0) * 300.0
    for name in ("delay", "confidence", "method"):
        np.testing.assert_array_equal(getattr(whole, name)[past], getattr(changed, name)[past])


def test_a_clean_match_recovers_the_delay_and_stays_in_order():
    rng = np.random.default_rng(SEED)
    time = np.arange(0.0, 3600.0, PMU_S)
    level = np.cumsum(rng.normal(0, 1.0, len(time)))
    arrival = time[12:] + 0.0
    made = dtw.match_window(arrival, level[:-12], Reference(time, time, level), 3590.0, PARAMS)
    delay = arrival - made.matched
    inside = np.isfinite(delay) & (arrival > 600) & (arrival < 3000)
    assert abs(np.median(delay[inside]) - 120.0) <= PMU_S
    assert (np.diff(made.path, axis=0) >= 0).all()


def test_xcorr_says_what_it_rests_on():
    made = device((95.0, 95.0))
    found = recovered(made, "xcorr")
    assert set(found.method[made[0] > DAY]) == {XCORR}
    assert not recovered(made, "none").delay.any()


def test_a_window_too_short_for_the_band_is_refused():
    with pytest.raises(ParameterError, match="at least twice"):
        TimeParams(window_s=300.0, largest_delay_s=240.0)
