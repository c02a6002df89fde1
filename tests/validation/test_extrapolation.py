"""k_opt is the autocorrelation, the gain is its square, and the predicted error rates come true."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from pse_analysis.validation import extrapolation, thresholds
from pse_analysis.validation.block import Criteria, screen
from pse_analysis.validation.increments import learn
from pse_analysis.validation.motion import Motion, gap_variance

RHO = 0.5


def load(shape: tuple[int, int], seed: int, rho: float = RHO) -> np.ndarray:
    """Series whose increments are AR(1) with unit variance; (n, n_channel)."""
    rng = np.random.default_rng(seed)
    drawn = rng.standard_normal(shape)
    # The first increment has the stationary law: no run-up.
    drawn[1:] *= math.sqrt(1.0 - rho**2)
    return np.cumsum(lfilter([1.0], [1.0, -rho], drawn, axis=0), axis=0)


def steps(x: np.ndarray) -> np.ndarray:
    return np.arange(len(x), dtype=float)[:, None]


def moments(x: np.ndarray, n_lag: int = 8) -> np.ndarray:
    return learn(x, steps(x), robust=False, n_lag=n_lag).variance


def criteria(kind: str, k_gamma: float, n: int, rho: float = RHO) -> Criteria:
    structure = gap_variance(1.0, rho ** np.arange(1, 9), 8)
    off, on = np.full(n, np.inf), np.full(n, k_gamma)
    optimal = kind == "extrapolation"
    motion = Motion(
        np.tile(structure, (n, 1)),
        np.full(n, rho if optimal else 0.0),
        off if optimal else on,
        on if optimal else off,
        np.full(n, 2),
    )
    return Criteria(off, off, motion, np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool))


def last_row(kind: str, k_gamma: float, x: np.ndarray) -> np.ndarray:
    """Flags of the third of three rows whose first two are taken as references whatever they are.

    One column is one draw: the predicted rates hold given good reference samples.
    """
    scale = np.array([[1e9], [1e9], [1.0]])
    checked = criteria(kind, k_gamma, x.shape[1])
    return screen(x, np.arange(3), checked, scale=scale, detail=False).reasons[2] != 0


def test_generated_load_has_the_published_coefficient_and_gain() -> None:
    x = load((100_001, 1), 2018)
    k, variance = extrapolation.scan(x, np.linspace(-1.0, 2.0, 151))
    gain = extrapolation.gain_percent(variance[50], variance.min(axis=0))
    assert k[0] == pytest.approx(0.5, abs=0.02)
    assert gain[0] == pytest.approx(25.0, abs=2.0)


@pytest.mark.parametrize("m", [1, 2, 3, 5])
@pytest.mark.parametrize("rho", [0.5, -0.3, 0.85])
def test_scan_equals_the_closed_form(m: int, rho: float) -> None:
    x = load((40_000, 1), 7, rho)
    closed = extrapolation.closed_form(moments(x), m)
    scanned, variance = extrapolation.scan(x, np.linspace(-1.0, 4.5, 551), m)
    np.testing.assert_allclose(scanned, closed, atol=0.006 + 0.002 * m)
    at = extrapolation.error_variance(moments(x), scanned, m)
    np.testing.assert_allclose(variance.min(axis=0), at, rtol=0.01)


def test_gain_is_the_square_of_the_autocorrelation_on_any_series() -> None:
    rng = np.random.default_rng(4)
    n = 5_000
    series = {
        "random walk": load((n, 1), 1, 0.0),
        "autocorrelated": load((n, 1), 2, 0.7),
        "measurement noise": load((n, 1), 3) + rng.normal(0.0, 1.0, (n, 1)),
        "white": rng.standard_normal((n, 1)),
        "heavy tails": np.cumsum(rng.standard_t(3, (n, 1)), axis=0),
        "daily": 30.0 * np.sin(np.arange(n) / 96.0 * 2.0 * np.pi)[:, None] + load((n, 1), 5),
    }
    for name, x in series.items():
        k, variance = extrapolation.scan(x, np.linspace(-1.0, 1.0, 401))
        d = np.diff(x[:, 0])
        rho = np.sum(d[1:] * d[:-1]) / np.sum(d**2)
        naive = np.mean(d[1:] ** 2)
        gain = extrapolation.gain_percent(naive, variance.min())
        assert gain == pytest.approx(100.0 * rho**2, abs=0.1), name
        assert k[0] == pytest.approx(rho, abs=3e-3), name


def test_measurement_noise_makes_the_coefficient_negative() -> None:
    noise = np.random.default_rng(8).standard_normal((50_000, 1))
    assert extrapolation.closed_form(moments(noise))[0] == pytest.approx(-0.5, abs=0.02)
    assert extrapolation.scan(noise)[0][0] == pytest.approx(-0.5, abs=0.02)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.05])
def test_sigma_and_coefficient_survive_gross_errors_in_the_history(share: float) -> None:
    x = load((5_000, 20), 21)
    rng = np.random.default_rng(22)
    y = x + (rng.random(x.shape) < share) * rng.uniform(-6.0, 6.0, x.shape)
    found = learn(y, steps(y))
    assert found.sigma.mean() == pytest.approx(1.0, abs=0.04)
    assert found.autocorrelation[:, 0].mean() == pytest.approx(0.5, abs=0.08)
    if share == 0.05:
        plain = learn(y, steps(y), robust=False)
        assert plain.sigma.mean() > 1.4
        assert plain.autocorrelation[:, 0].mean() < 0.1


def test_sigma_follows_the_time_of_day_where_asked() -> None:
    d = np.diff(load((5_000, 8), 23), axis=0, prepend=0.0)
    bins = (np.arange(5_000) % 96 // 48)[:, None]
    x = np.cumsum(d * np.where(bins == 1, 3.0, 1.0), axis=0)
    found = learn(x, steps(x), bins=bins, n_bin=2)
    assert found.scale is not None
    sigma = (found.sigma * found.scale).mean(axis=1)
    np.testing.assert_allclose(sigma, [1.0, 3.0], rtol=0.06)


@pytest.mark.parametrize("kind", ["increment", "extrapolation"])
@pytest.mark.parametrize(("q", "ratio"), [(0.05, 1.0), (0.05, 5.0), (0.2, 2.0)])
def test_predicted_rates_come_true_given_good_references(kind: str, q: float, ratio: float) -> None:
    n, amplitude = 150_000, 6.0
    sigma = 1.0 if kind == "increment" else math.sqrt(1.0 - RHO**2)
    answer = thresholds.bayes(q, ratio, amplitude / sigma)
    x = load((3, n), 31)
    rng = np.random.default_rng(32)
    bad = rng.random(n) < q
    x[2] += np.where(bad, rng.uniform(-amplitude, amplitude, n), 0.0)
    flagged = last_row(kind, float(answer.k), x)
    for drawn, predicted, count in (
        (flagged[~bad].mean(), float(answer.false_alarm), (~bad).sum()),
        ((~flagged)[bad].mean(), float(answer.miss), bad.sum()),
    ):
        error = math.sqrt(predicted * (1.0 - predicted) / count)
        assert abs(drawn - predicted) <= 3.0 * error


@pytest.mark.parametrize("kind", ["increment", "extrapolation"])
def test_no_other_threshold_has_a_lower_realised_risk(kind: str) -> None:
    n, amplitude, q, ratio = 100_000, 6.0, 0.05, 2.0
    sigma = 1.0 if kind == "increment" else math.sqrt(1.0 - RHO**2)
    best = float(thresholds.bayes(q, ratio, amplitude / sigma).k)
    x = load((3, n), 41)
    rng = np.random.default_rng(42)
    bad = rng.random(n) < q
    x[2] += np.where(bad, rng.uniform(-amplitude, amplitude, n), 0.0)

    def cost(k: float) -> np.ndarray:
        found = last_row(kind, k, x)
        return np.where(bad, ratio * ~found, 1.0 * found)

    own = cost(best)
    clearly_worse = 0
    for factor in (0.5, 0.75, 1.25, 1.5):
        excess = cost(factor * best) - own
        error = excess.std() / math.sqrt(n)
        assert excess.mean() >= -2.0 * error, factor
        clearly_worse += excess.mean() > 2.0 * error
    assert clearly_worse == 4


@pytest.mark.parametrize("rho", [0.5, -0.4])
def test_extrapolation_finds_more_errors_at_the_same_realised_false_alarm_rate(rho: float) -> None:
    x = load((2_000, 100), 51, rho)
    rng = np.random.default_rng(52)
    bad = rng.random(x.shape) < 0.01
    y = x + np.where(bad, rng.uniform(-6.0, 6.0, x.shape), 0.0)

    def flags(kind: str, k: float) -> np.ndarray:
        checked = criteria(kind, k, 100, rho=rho)
        return screen(y, np.arange(len(y)), checked, detail=False).reasons != 0

    sharp = flags("extrapolation", 3.0)
    # The first-increment check gets the larger false-alarm rate of two that enclose it.
    low, high = 2.0, 4.0
    assert flags("increment", low)[~bad].mean() >= sharp[~bad].mean()
    for _ in range(7):
        middle = 0.5 * (low + high)
        more = flags("increment", middle)[~bad].mean() >= sharp[~bad].mean()
        low, high = (middle, high) if more else (low, middle)
    plain = flags("increment", low)
    assert plain[~bad].mean() >= sharp[~bad].mean()
    gain = sharp[bad].astype(int) - plain[bad].astype(int)
    assert gain.mean() > 3.0 * gain.std() / math.sqrt(len(gain))


@pytest.mark.parametrize("tails", ["gaussian", "heavy"])
def test_no_gain_is_claimed_without_autocorrelation(tails: str) -> None:
    rng = np.random.default_rng(61)
    shape = (2_000, 100)
    drawn = rng.standard_normal(shape) if tails == "gaussian" else rng.standard_t(3, shape)
    x = np.cumsum(drawn, axis=0)
    assert extrapolation.gains(learn(x, steps(x))).mean() <= 0.01
    related = load(shape, 62, 0.3)
    assert extrapolation.gains(learn(related, steps(related))).mean() >= 0.99
