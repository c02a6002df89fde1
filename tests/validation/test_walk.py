"""The block kernel equals a plain loop over samples, whatever its chunks, gaps and faults."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pse_analysis.validation.block import Criteria, screen
from pse_analysis.validation.motion import SNAP, Motion, extrapolating, gap_variance, given
from pse_analysis.vocabulary import Reason

ROWS, CHANNELS = 400, 6
RHO = 0.5 ** np.arange(1, 9)


def criteria(motion: Motion, stuck: int = 0) -> Criteria:
    n = len(motion.k)
    return Criteria(
        np.full(n, -80.0), np.full(n, np.nan), motion, np.full(n, stuck), np.zeros(n, dtype=bool)
    )


def motion(kind: str, n: int = CHANNELS) -> Motion:
    off = np.full(n, np.inf)
    quantile = np.full(n, 3.0)
    rho1 = np.linspace(-0.4, 0.7, n)
    structure = np.stack([gap_variance(1.0, r ** np.arange(1, 9), 8) for r in rho1])
    return Motion(
        structure,
        rho1 if kind != "increment" else np.zeros(n),
        off if kind == "extrapolation" else quantile,
        off if kind == "increment" else quantile,
        np.array([1, 2, 3, 2, 1, 4])[:n],
    )


def faulty_block(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.standard_normal((ROWS, CHANNELS)), axis=0)
    hit = rng.random(x.shape) < 0.06
    x[hit] += rng.uniform(-12.0, 12.0, hit.sum())
    x[rng.random(x.shape) < 0.05] = np.nan
    x[200:, 2] += 40.0
    x[300:, 3] -= 200.0
    x[100:112, 4] = x[100, 4]
    x[0, 5] += 50.0
    x[50:90, 1] = np.nan
    return x


def variance(m: Motion, lane: int, periods: float) -> float:
    n = max(periods, 1.0)
    last = m.structure.shape[1] - 1
    v = float(np.interp(n, np.arange(last + 1), m.structure[lane]))
    if n > last:
        v += (n - last) * max(m.structure[lane, -1] - m.structure[lane, -2], 0.0)
    return max(v, float(m.one_step_variance[lane]))


def snapped(periods: float) -> float:
    whole = float(np.rint(periods))
    return whole if whole >= 1.0 and abs(periods - whole) <= SNAP else periods


def plain_loop(
    x: np.ndarray,
    time: np.ndarray,
    m: Motion,
    lane: int,
    scale: np.ndarray,
    backward: np.ndarray,
) -> tuple[list[int], list[float], list[float]]:
    """The rules of the kernel, one sample at a time."""
    reference = lead = span = None
    reference_time = math.nan
    waiting: tuple[float, float, int] | None = None
    bits, statistics, limits = [], [], []
    k1, one = float(m.k[lane]), float(m.one_step_variance[lane])
    sharp_on, plain_on = math.isfinite(m.extrapolation[lane]), math.isfinite(m.increment[lane])
    for value, t, factor, old in zip(x, time, scale, backward, strict=True):
        if math.isnan(value):
            bits.append(0)
            statistics.append(math.nan)
            limits.append(math.nan)
            continue
        if reference is None:
            bits.append(0)
            statistics.append(math.nan)
            limits.append(math.nan)
            if not old:
                reference, reference_time = value, t
            continue
        elapsed = snapped(abs(t - reference_time))
        v = variance(m, lane, elapsed)
        change = value - reference
        predicted, error = 0.0, v
        if sharp_on and k1 != 0.0 and lead is not None and not old:
            v_span = variance(m, lane, span)
            k = 0.5 * (variance(m, lane, elapsed + span) - v - v_span) / v_span
            error = max(v - k * k * v_span, one)
            if elapsed == 1.0 and span == 1.0:
                k, error = k1, one
            predicted = k * lead * min(elapsed, 1.0)
        surprise = abs(change - predicted)
        plain = m.increment[lane] * math.sqrt(v) * factor
        sharp = m.extrapolation[lane] * math.sqrt(error) * factor
        over_plain, over_sharp = abs(change) > plain, surprise > sharp
        found = Reason.INCREMENT * over_plain + Reason.EXTRAPOLATION * over_sharp
        by_sharp = sharp_on and (over_sharp or not over_plain)
        statistics.append(surprise if by_sharp else abs(change))
        limits.append(sharp if by_sharp else plain)
        assert sharp_on or plain_on
        if old:
            bits.append(found)
            continue
        if not found:
            lead, span, reference, reference_time = change, elapsed, value, t
            waiting = None
            bits.append(0)
            continue
        count = 0
        if waiting is not None:
            waited = snapped(abs(t - waiting[1]))
            near = min(m.increment[lane], m.extrapolation[lane])
            near *= math.sqrt(variance(m, lane, waited)) * factor
            count = waiting[2] + 1 if abs(value - waiting[0]) <= near else 0
            if count >= m.confirm[lane]:
                lead, span, reference, reference_time = value - waiting[0], waited, value, t
                waiting = None
                bits.append(int(Reason.STEP_ACCEPTED))
                continue
        waiting = (value, t, count)
        bits.append(found)
    return bits, statistics, limits


@pytest.mark.parametrize("kind", ["increment", "extrapolation", "both"])
@pytest.mark.parametrize("stamps", ["even", "jittered", "irregular", "per channel"])
def test_kernel_equals_a_plain_loop(kind: str, stamps: str) -> None:
    rng = np.random.default_rng(7)
    x = faulty_block(5)
    time = np.arange(ROWS, dtype=float)[:, None]
    if stamps == "jittered":
        time = time + rng.uniform(-0.1, 0.1, time.shape)
    elif stamps == "irregular":
        time = np.cumsum(rng.exponential(1.0, time.shape), axis=0)
    elif stamps == "per channel":
        time = np.cumsum(np.where(rng.random(x.shape) < 0.1, 3.0, 1.0), axis=0)
        late = rng.integers(20, ROWS, CHANNELS)
        time[late, np.arange(CHANNELS)] -= 7.0
    backward = time < np.maximum.accumulate(time, axis=0)
    scale = rng.choice([0.7, 1.0, 1.6], time.shape)
    m = motion(kind)
    found = screen(x, time, criteria(m), scale=scale, backward=backward)
    for lane in range(CHANNELS):
        column = lane if time.shape[1] > 1 else 0
        inside = np.where(x[:, lane] < -80.0, np.nan, x[:, lane])
        bits, statistic, limit = plain_loop(
            inside, time[:, column], m, lane, scale[:, column], backward[:, column]
        )
        moved = found.reasons[:, lane] & ~np.int32(Reason.LIMIT | Reason.NOT_FINITE)
        np.testing.assert_array_equal(moved, bits)
        judged = ~np.isnan(inside)
        np.testing.assert_allclose(
            found.statistic[judged, lane], np.array(statistic)[judged], rtol=1e-9, atol=1e-12
        )
        np.testing.assert_allclose(
            found.threshold[judged, lane], np.array(limit)[judged], rtol=1e-9, atol=1e-12
        )
    flagged = (found.reasons & (Reason.INCREMENT | Reason.EXTRAPOLATION)) != 0
    assert 20 < flagged.sum() < 0.5 * x.size
    assert (found.reasons & Reason.STEP_ACCEPTED).any()


@pytest.mark.parametrize("chunk", [1, 7, 60, 101])
def test_chunks_change_nothing(chunk: int) -> None:
    x, time = faulty_block(6), np.arange(ROWS)
    whole = screen(x, time, criteria(motion("both"), stuck=5))
    parts = screen(x, time, criteria(motion("both"), stuck=5), chunk_samples=chunk * CHANNELS)
    np.testing.assert_array_equal(parts.reasons, whole.reasons)
    np.testing.assert_array_equal(parts.statistic, whole.statistic)
    np.testing.assert_array_equal(parts.threshold, whole.threshold)
    assert (whole.reasons & Reason.STUCK).any()


def test_channels_do_not_see_each_other() -> None:
    x, time, m = faulty_block(8), np.arange(ROWS), motion("both")
    together = screen(x, time, criteria(m)).reasons
    for lane in range(CHANNELS):
        one = Motion(
            m.structure[lane : lane + 1],
            m.k[lane : lane + 1],
            m.increment[lane : lane + 1],
            m.extrapolation[lane : lane + 1],
            m.confirm[lane : lane + 1],
        )
        alone = screen(x[:, lane : lane + 1], time, criteria(one)).reasons
        np.testing.assert_array_equal(alone[:, 0], together[:, lane])


def test_changing_the_future_changes_nothing_before_it() -> None:
    rng = np.random.default_rng(9)
    x, time, cut = faulty_block(9), np.arange(ROWS), 230
    y = x.copy()
    y[cut:] = rng.permutation(y[cut:], axis=0)
    one = screen(x, time, criteria(motion("both"), stuck=5))
    two = screen(y, time, criteria(motion("both"), stuck=5))
    np.testing.assert_array_equal(one.reasons[:cut], two.reasons[:cut])
    np.testing.assert_array_equal(one.statistic[:cut], two.statistic[:cut])
    np.testing.assert_array_equal(one.threshold[:cut], two.threshold[:cut])
    assert (one.reasons[cut:] != two.reasons[cut:]).any()


@pytest.mark.parametrize("kind", ["increment", "extrapolation"])
@pytest.mark.parametrize("width", [1, 2])
def test_good_samples_after_a_spike_are_not_flagged(kind: str, width: int) -> None:
    rng = np.random.default_rng(10)
    d = np.zeros(200)
    for i in range(1, 200):
        d[i] = 0.5 * d[i - 1] + math.sqrt(0.75) * rng.standard_normal()
    x = np.clip(np.cumsum(d), -70.0, None)[:, None]
    m = given(6.0, 1, confirm=width + 1) if kind == "increment" else extrapolating(6.0, 0.5, 1, 3)
    assert not screen(x, np.arange(200), criteria(m)).reasons.any()
    for at in range(20, 180, 7):
        y = x.copy()
        y[at : at + width] += 30.0
        flagged = np.flatnonzero(screen(y, np.arange(200), criteria(m)).reasons)
        assert flagged.tolist() == list(range(at, at + width))


def test_gap_variance_follows_the_autocorrelation() -> None:
    rng = np.random.default_rng(12)
    n = 400_000
    from scipy.signal import lfilter

    x = np.cumsum(lfilter([math.sqrt(0.75)], [1.0, -0.5], rng.standard_normal(n)))
    v = gap_variance(1.0, RHO, 8)
    drawn = np.array([np.mean((x[m:] - x[:-m]) ** 2) for m in range(1, 9)])
    np.testing.assert_allclose(drawn, v[1:], rtol=0.02)
    assert not np.allclose(v[8], 8.0, rtol=0.5), "elapsed time alone would give another spread"


def test_naive_extrapolation_is_the_first_increment_check() -> None:
    x, time = faulty_block(13), np.arange(ROWS)
    increments = screen(x, time, criteria(given(3.0, CHANNELS)))
    naive = screen(x, time, criteria(extrapolating(3.0, 0.0, CHANNELS)))
    np.testing.assert_array_equal(
        (increments.reasons & Reason.INCREMENT) != 0, (naive.reasons & Reason.EXTRAPOLATION) != 0
    )
    np.testing.assert_array_equal(increments.statistic, naive.statistic)
