"""Claim: confident stamps of the qi2025 case are most, honest, and better than both baselines.

A day of its telecontrol and phasor currents, after half a day of history, on a seed of its own.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from functools import cache

import numpy as np
import pandas as pd
from simulated_case import curves, feeder

from pse_analysis.alignment import fusion, stamps
from pse_analysis.alignment.dtw import DTW, METHODS
from pse_analysis.alignment.stamps import LENT
from pse_analysis.measurement import SensorLayout
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.stages import check_case
from pse_analysis.simulation import simulate
from pse_analysis.validation import validate

SEED = 402
PHASOR_S = 10.0
LATERAL = ("scada:branch/19-20", "scada:branch/21-22")
CONSTANT = {"delay_s": 95.0, "jitter_s": 0.0, "wander_s": 0.0}


def rms(errors: pd.Series) -> float:
    return float(np.sqrt(np.mean(errors**2)))


@cache
def recovered(constant: bool = False) -> pd.DataFrame:
    """Every telecontrol sample of the day with its errors and doubt [s], confidence and method."""
    case = check_case(load_case("qi2025"))
    end = case.study.start + timedelta(hours=6 if constant else 24)
    study = replace(case.study, history_s=43200.0, end=end)
    sensors = tuple(
        replace(group, **CONSTANT) if constant and group.source == "scada" else group
        for group in case.simulate.sensors
        if group.source == "scada" or "i_ka" in group.quantities
    )
    raw = simulate(
        feeder(), curves(), study, replace(case.simulate, seed=SEED, sensors=sensors, faults=())
    )
    validated = validate(raw.telemetry, raw.channels, case.validate, history_end=study.start)
    layout = SensorLayout.from_channels(raw.channels, feeder())
    source = raw.channels["source"].to_numpy(dtype=object)
    instants, start = fusion.instants_of(study), fusion.start_of(study)
    key = ["trial", "channel", "seq"]
    table = validated[[*key, "arrival_utc"]]
    for how in METHODS:
        found = stamps.sampling_times(
            validated, layout, source, feeder(), instants, start, case.align.time, how
        )
        table = table.assign(**{how: pd.to_datetime(found.time, unit="us", utc=True)})
    table = table.assign(confidence=found.confidence, doubt=found.doubt, method=found.method)
    table = table[table["channel"].str.startswith("scada")]
    table = table[table["arrival_utc"] >= study.start]
    table = table.merge(raw.sample_truth[[*key, "time_utc"]], on=key)
    for how in METHODS:
        table[how] = (table[how] - table["time_utc"]).dt.total_seconds()
    return table


def test_half_of_all_stamps_are_confident_and_beat_arrival_and_usual_delay():
    table = recovered()
    sure = table[table["method"] == DTW]
    assert len(sure) >= 0.5 * len(table)
    assert rms(sure["dtw"]) < 0.75 * rms(sure["xcorr"])
    assert rms(sure["dtw"]) < 0.4 * rms(sure["none"])
    by_device = sure.groupby(sure["channel"].str.rsplit(":", n=1).str[0])
    assert (by_device["dtw"].apply(rms) < by_device["xcorr"].apply(rms)).all()


def test_error_grows_as_confidence_falls_and_is_as_large_as_it_says():
    table = recovered()
    seen = table[table["confidence"] > 0].sort_values("confidence", ascending=False)
    parts = np.array_split(np.arange(len(seen)), 4)
    errors = [rms(seen["dtw"].iloc[part]) for part in parts]
    assert errors == sorted(errors)
    sure = seen[seen["method"] == DTW]
    assert 0.7 < rms(sure["dtw"]) / rms(sure["doubt"]) < 1.3


def test_a_lateral_without_a_phasor_unit_in_series_borrows_the_delay_of_the_others():
    table = recovered()
    apart = table[table["channel"].str.startswith(LATERAL)]
    assert (apart["method"] == LENT).all()
    assert not apart["confidence"].any()
    assert rms(apart["dtw"]) < 0.5 * rms(apart["none"])
    assert 0.8 < rms(apart["dtw"]) / rms(apart["doubt"]) < 1.25
    assert (apart["dtw"].abs() <= 2 * apart["doubt"]).mean() > 0.93


def test_with_a_constant_delay_it_is_no_worse_than_the_usual_delay_by_a_phasor_sample():
    table = recovered(constant=True)
    table = table[~table["channel"].str.startswith(LATERAL)]
    assert rms(table["xcorr"]) < PHASOR_S
    assert rms(table["dtw"]) <= rms(table["xcorr"]) + PHASOR_S
    borrowed = recovered(constant=True)
    borrowed = borrowed[borrowed["method"] == LENT]
    assert len(borrowed)
    assert rms(borrowed["dtw"]) < PHASOR_S
