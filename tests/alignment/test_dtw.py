"""Claim: recovered stamps beat arrival and usual delay where delays vary, and know how sure."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.special import ndtr

from pse_analysis.alignment import dtw
from pse_analysis.alignment.dtw import DTW, NONE, XCORR, Reference, Stamps, TimeParams
from pse_analysis.errors import ParameterError

SEED = 4
DAY = 86400.0
SETTLED = 0.4 * DAY
PMU_S = 10.0
PERIOD_S = 60.0
BAND_S = 240.0
PARAMS = TimeParams(largest_delay_s=BAND_S)
INSTANTS = np.arange(0.0, DAY + 1.0, 300.0)


class Device(NamedTuple):
    """Arrivals, values, σ, delays and the partner of a device in series with a phasor unit."""

    arrival: np.ndarray
    value: np.ndarray
    sigma: np.ndarray
    late: np.ndarray
    reference: Reference


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


@cache
def device(seed: int = SEED, kind: str = "drifting", noise: float = 0.005) -> Device:
    """A current that moves by 10 % in a quarter of an hour, and a delay of one of three kinds."""
    rng = np.random.default_rng(seed)
    minute = np.arange(0.0, DAY + 60.0, 60.0)
    level = np.exp(np.cumsum(rng.normal(0, 0.1 / np.sqrt(15.0), len(minute))))
    time = np.arange(0.0, DAY, PMU_S)
    phasor = np.interp(time, minute, level) * (1 + rng.normal(0, 0.005, len(time)))
    taken = np.arange(7.0, DAY - 600, 300.0 if kind == "independent" else PERIOD_S)
    if kind == "drifting":
        # Ornstein–Uhlenbeck, half an hour, averaged over ten minutes: smooth, and in order.
        drawn = rng.standard_normal(len(taken) + 9)
        slow = np.empty(len(drawn))
        for k, step in enumerate(drawn):
            slow[k] = step if k == 0 else np.exp(-1 / 30) * slow[k - 1] + 0.256 * step
        slow = np.convolve(slow, np.full(10, 0.1), mode="valid")
        late = 20.0 + 180.0 * ndtr(slow) + rng.uniform(0.0, 10.0, len(taken))
    else:
        late = {
            "constant": np.full(len(taken), 95.0),
            "independent": rng.uniform(10.0, 230.0, len(taken)),
        }[kind]
    value = 0.7 * np.interp(taken, minute, level) * (1 + rng.normal(0, noise, len(taken)))
    reference = Reference.of(time, time + 0.3, phasor)
    return Device(taken + late, value, noise * value, late, reference)


def recover(made: Device, method: dtw.Method = "dtw") -> Stamps:
    arrival, value, sigma, _, reference = made
    return dtw.recover(arrival, value, sigma, reference, INSTANTS, PARAMS, method)


@cache
def recovered(seed: int = SEED, kind: str = "drifting", method: dtw.Method = "dtw") -> Stamps:
    return recover(device(seed, kind), method)


@pytest.mark.parametrize("seed", [4, 5])
@pytest.mark.parametrize(
    ("kind", "share", "gain"), [("drifting", 0.8, 0.5), ("independent", 0.2, 0.9)]
)
def test_confident_stamps_beat_arrival_and_usual_delay_when_delays_vary(
    seed: int, kind: str, share: float, gain: float
):
    made, match = device(seed, kind), recovered(seed, kind)
    usual = recovered(seed, kind, "xcorr")
    settled = made.arrival > SETTLED
    sure = settled & (match.method == DTW)
    assert sure.sum() >= share * settled.sum()
    found, plain = rms((match.delay - made.late)[sure]), rms((usual.delay - made.late)[sure])
    assert found < gain * plain
    assert found < 0.5 * rms(made.late[sure])


@pytest.mark.parametrize("seed", [4, 5])
def test_with_constant_delay_it_is_no_worse_than_the_usual_delay_by_a_phasor_sample(seed: int):
    settled = device(seed, "constant").arrival > SETTLED
    dtw_error, usual_error = (
        rms((recovered(seed, "constant", method).delay - 95.0)[settled])
        for method in ("dtw", "xcorr")
    )
    assert dtw_error <= usual_error + PMU_S


@pytest.mark.parametrize(("kind", "expected"), [("constant", XCORR), ("drifting", DTW)])
def test_a_delay_that_varies_is_told_from_one_that_does_not(kind: str, expected: int):
    settled = device(kind=kind).arrival > SETTLED
    assert (recovered(kind=kind).method[settled] == expected).mean() > 0.95


def test_error_grows_as_confidence_falls():
    sure, error = [], []
    for seed in (4, 5):
        for kind in ("drifting", "independent"):
            made, found = device(seed, kind), recovered(seed, kind)
            settled = made.arrival > SETTLED
            sure.append(found.confidence[settled])
            error.append((found.delay - made.late)[settled])
    order = np.argsort(-np.concatenate(sure), kind="stable")
    fifths = [rms(part) for part in np.array_split(np.concatenate(error)[order], 5)]
    assert fifths == sorted(fifths)
    assert fifths[-1] > 3 * fifths[0]


def test_the_spread_behind_the_confidence_is_the_spread_of_the_errors():
    made, found = device(), recovered()
    sure = (found.method == DTW) & (made.arrival > SETTLED)
    claimed = (1.0 - found.confidence[sure]) * BAND_S / np.sqrt(12.0)
    assert 0.6 < rms((found.delay - made.late)[sure]) / rms(claimed) < 1.3


def test_a_flat_signal_is_left_to_the_usual_delay_or_alone():
    made = device()
    rng = np.random.default_rng(SEED)
    times = made.reference.time
    flat = Reference(times, made.reference.known, 1 + rng.normal(0, 0.005, times.size))
    still = 0.7 * (1 + rng.normal(0, 0.005, made.value.size))
    found = recover(made._replace(value=still, sigma=0.005 * still, reference=flat))
    assert (found.method == DTW).mean() < 0.01
    alone = found.method == NONE
    assert (found.delay[alone] == 0).all()
    assert (found.confidence[alone] == 0).all()


def test_where_the_current_rests_for_hours_confidence_falls_and_comes_back():
    made = device()
    rest = (0.6 * DAY, 0.8 * DAY)
    times = made.reference.time
    taken = made.arrival - made.late

    def resting(time: np.ndarray, value: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(SEED).normal(1.0, 0.005, len(value))
        held = value[np.searchsorted(time, rest[0])] * noise
        return np.where((time > rest[0]) & (time < rest[1]), held, value)

    found = recover(
        made._replace(
            value=resting(taken, made.value),
            reference=Reference(times, times + 0.3, resting(times, made.reference.value)),
        )
    )
    confidence = {
        name: np.median(found.confidence[(taken > begin * DAY) & (taken < end * DAY)])
        for name, begin, end in (("before", 0.5, 0.6), ("rest", 0.7, 0.8), ("after", 0.85, 0.95))
    }
    assert confidence["rest"] < 0.5 * confidence["before"]
    assert confidence["after"] > 0.7 * confidence["before"]


def test_too_few_samples_are_left_alone():
    made = device()
    few = Device(*(part[:12] for part in made[:4]), made.reference)
    found = recover(few)
    assert (found.method == NONE).all()
    assert not found.confidence.any()


def test_a_spike_moves_no_stamp_beside_it():
    made = device()
    at = np.flatnonzero(made.arrival > SETTLED)[50::150]
    value = made.value.copy()
    value[at] *= 1.3
    found, before = recover(made._replace(value=value)), recovered()
    beside = np.setdiff1d((at[:, None] + np.arange(-3, 4)).ravel(), at)
    moved = np.abs(found.delay - before.delay)[beside]
    assert np.median(moved) < 0.5 * PMU_S
    assert rms((found.delay - made.late)[beside]) < 1.3 * rms((before.delay - made.late)[beside])


def test_lost_phasor_values_cost_confidence_and_not_honesty():
    made = device()
    rng = np.random.default_rng(SEED)
    times, values = made.reference.time, made.reference.value
    gap = (times > 0.7 * DAY) & (times < 0.7 * DAY + 1800.0)
    kept = (rng.random(len(times)) > 0.1) & ~gap
    found = recover(
        made._replace(reference=Reference.of(times[kept], times[kept] + 0.3, values[kept]))
    )
    settled = made.arrival > SETTLED
    sure = settled & (found.method == DTW)
    assert sure.sum() >= 0.5 * settled.sum()
    claimed = (1.0 - found.confidence[sure]) * BAND_S / np.sqrt(12.0)
    assert rms((found.delay - made.late)[sure]) < 1.3 * rms(claimed)
    blind = (made.arrival > 0.7 * DAY + 1200.0) & (made.arrival < 0.7 * DAY + 1800.0)
    assert np.median(found.confidence[blind]) < np.median(found.confidence[settled])


def test_a_sample_without_a_current_is_dated_by_its_neighbours():
    made = device()
    lost = np.random.default_rng(SEED).random(len(made.value)) < 0.1
    value = np.where(lost, np.nan, made.value)
    found = recover(made._replace(value=value))
    lost &= made.arrival > SETTLED
    sure = lost & (found.method == DTW)
    assert sure.sum() > 0.5 * lost.sum()
    usual = recovered(method="xcorr")
    assert rms((found.delay - made.late)[sure]) < 0.6 * rms((usual.delay - made.late)[sure])


def test_no_delay_leaves_the_causal_band():
    for kind in ("drifting", "independent"):
        found = recovered(kind=kind)
        assert found.delay.min() >= 0
        assert found.delay.max() <= BAND_S + PMU_S


@pytest.mark.parametrize("method", ["dtw", "xcorr"])
def test_what_comes_later_changes_no_stamp(method: dtw.Method):
    made = device()
    now = 0.6 * DAY
    rng = np.random.default_rng(SEED)
    value = np.where(made.arrival > now, rng.permutation(made.value), made.value)
    times, known, values, held = (
        made.reference.time,
        made.reference.known,
        made.reference.value,
        made.reference.held,
    )
    later = Reference(times, known, np.where(known > now, rng.permutation(values), values), held)
    whole = recovered(method=method)
    changed = recover(made._replace(value=value, reference=later), method)
    past = made.arrival <= np.floor(now / 300.0) * 300.0
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


@pytest.mark.parametrize("penalty", [0.0, 0.7])
def test_the_path_costs_what_a_plain_dynamic_program_finds(penalty: float):
    rng = np.random.default_rng(SEED)
    time = np.arange(0.0, 1200.0, PMU_S)
    level = np.cumsum(rng.normal(0, 1.0, len(time)))
    arrival = time[12::3] + 0.0
    params = TimeParams(largest_delay_s=BAND_S, warp_penalty=penalty)
    made = dtw.match_window(arrival, level[:-12:3], Reference(time, time, level), 1190.0, params)
    apart = np.abs(made.device[:, None] - made.reference[None, :])
    n, radius = len(apart), round(0.5 * BAND_S / PMU_S)
    cost = np.full((n, n), np.inf)
    for i in range(n):
        for j in range(max(0, i - radius), min(n, i + radius + 1)):
            before = [
                cost[i - 1, j - 1] if i and j else np.inf,
                cost[i - 1, j] + penalty if i else np.inf,
                cost[i, j - 1] + penalty if j else np.inf,
            ]
            cost[i, j] = apart[i, j] + (0.0 if i == j == 0 else min(before))
    steps = np.diff(made.path, axis=0)
    along = apart[tuple(made.path.T)].sum() + penalty * (steps.sum(axis=1) == 1).sum()
    assert along == pytest.approx(cost[-1, -1])


def test_xcorr_says_what_it_rests_on():
    found = recovered(kind="constant", method="xcorr")
    assert set(found.method[device(kind="constant").arrival > SETTLED]) == {XCORR}
    assert not recovered(kind="constant", method="none").delay.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"window_s": 300.0, "largest_delay_s": 240.0}, "at least twice"),
        ({"warp_penalty": -1.0}, "warp_penalty must not be negative"),
        ({"lag_window_s": 0.0}, "lag_window_s must be positive"),
        ({"lenders": 1}, "lenders = 0 or at least 2"),
    ],
)
def test_parameters_that_cannot_be_are_refused(change: dict[str, float], message: str):
    with pytest.raises(ParameterError, match=message):
        TimeParams(**change)
