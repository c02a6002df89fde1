"""Claim: forecasts of slow meters know their error at every horizon, and nothing of the future."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import simulated_case
from simulated_case import STUDY, feeder

from pse_analysis.alignment import AlignParams, Variant, align, pseudo_measurements
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.snapshots import record
from pse_analysis.measurement import SensorLayout
from pse_analysis.validation import validate

SEED = 8
METHODS = ("hold", "holt", "profile", "ar")
DAY = 96


def readings(days: int = 6, meters: int = 4, seed: int = SEED) -> np.ndarray:
    """Loads with a daily curve, a slow level and noise."""
    rng = np.random.default_rng(seed)
    slot = np.arange(days * DAY)[:, None]
    curve = 1.0 - 0.4 * np.cos(2 * np.pi * slot / DAY + np.arange(meters))
    level = np.cumsum(rng.normal(0, 0.005, (len(slot), meters)), axis=0)
    return -(curve + level + rng.normal(0, 0.01, (len(slot), meters)))


@pytest.mark.parametrize("method", METHODS)
def test_sigma_is_the_error_that_the_study_then_shows(method: str):
    values = readings(days=10)
    history = 7 * DAY
    made = pseudo_measurements.forecast(values, history, method, noise=np.full(4, 0.01))
    for ahead in (1, 2, 3):
        error = values[history + ahead :] - made.value[history:-ahead, ahead]
        assert np.sqrt(np.mean(error**2)) == pytest.approx(made.sigma[ahead].mean(), rel=0.25)


@pytest.mark.parametrize("method", METHODS)
def test_sigma_grows_with_the_horizon_from_that_of_the_meter(method: str):
    made = pseudo_measurements.forecast(readings(), 4 * DAY, method, noise=np.full(4, 0.01))
    np.testing.assert_array_equal(made.sigma[0], 0.01)
    assert (np.diff(made.sigma, axis=0) >= 0).all()


@pytest.mark.parametrize("method", ["holt", "profile", "ar"])
def test_a_daily_curve_is_forecast_better_than_held(method: str):
    values = readings()
    history = 4 * DAY
    rms = {
        name: pseudo_measurements.forecast(values, history, name, noise=np.full(4, 0.01)).sigma[3]
        for name in ("hold", method)
    }
    assert (rms[method] < rms["hold"]).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_forecast_does_not_look_ahead(method: str):
    values = readings()
    history, now = 4 * DAY, 4 * DAY + 40
    other = values.copy()
    other[now + 1 :] = np.random.default_rng(SEED).permutation(other[now + 1 :])
    one, two = (
        pseudo_measurements.forecast(v, history, method, noise=np.full(4, 0.01))
        for v in (values, other)
    )
    np.testing.assert_array_equal(one.value[: now + 1], two.value[: now + 1])
    np.testing.assert_array_equal(one.sigma, two.sigma)


def test_a_fraction_of_a_period_lies_between_the_whole_ones():
    made = pseudo_measurements.forecast(readings(), 4 * DAY, "holt", noise=np.full(4, 0.01))
    k, meter = np.array([400]), np.array([2])
    value, sigma = made.at(k, np.array([0.25]), meter)
    assert value[0] == pytest.approx(0.75 * made.value[400, 0, 2] + 0.25 * made.value[400, 1, 2])
    assert sigma[0] ** 2 == pytest.approx(0.75 * 0.01**2 + 0.25 * made.sigma[1, 2] ** 2)


def test_missing_readings_are_taken_as_the_ones_before():
    values = readings()
    values[100:103, 1] = np.nan
    made = pseudo_measurements.forecast(values, 4 * DAY, "hold", noise=np.full(4, 0.01))
    np.testing.assert_array_equal(made.value[102, :, 1], values[99, 1])
    assert np.isfinite(made.value).all()


def test_an_unknown_method_is_refused():
    with pytest.raises(ParameterError, match="holt"):
        pseudo_measurements.forecast(readings(), 96, "arima", noise=np.full(4, 0.01))  # type: ignore[arg-type]


def aligned(*variants: Variant) -> pd.DataFrame:
    raw = simulated_case.make(trials=1, faults=())
    validated = validate(raw.telemetry, raw.channels, history_end=STUDY.start)
    return align(validated, raw.channels, feeder(), STUDY, AlignParams(variants=variants))


def test_variants_share_all_but_what_they_name():
    table = aligned(Variant("held"), Variant("pseudo", pseudo="holt"))
    key = ["trial", "time_utc", "channel"]
    held, pseudo = (table[table["variant"] == v].set_index(key) for v in ("held", "pseudo"))
    assert held.index.equals(pseudo.index)
    forecast = pseudo["origin"] == "pseudo"
    assert forecast.any()
    assert pseudo.index[forecast].get_level_values("channel").str.startswith("ami:").all()
    assert (held["age_s"][forecast] > 300).all()
    assert (pseudo["age_s"][forecast] == 0).all()
    pd.testing.assert_frame_equal(
        held[~forecast].drop(columns="variant"), pseudo[~forecast].drop(columns="variant")
    )


def test_a_filter_sees_forecasts_as_news_of_every_instant():
    table = aligned(Variant("pseudo", pseudo="hold"))
    layout = SensorLayout.from_channels(simulated_case.case().channels, feeder())
    fresh = record(table, layout).fresh
    meters = np.array([name.startswith("ami:") for name in layout.channel])
    assert fresh[-1, meters].all()


def test_a_name_of_a_variant_stands_once():
    with pytest.raises(ParameterError, match="stands twice"):
        AlignParams(variants=(Variant("a"), Variant("a")))
