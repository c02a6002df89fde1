"""Claim: channels of a device share a delay, devices of a source lend one to whom none is known."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest
from simulated_case import STUDY, curves, feeder

from pse_analysis.alignment import fusion, stamps
from pse_analysis.alignment.dtw import DTW, NONE, Method, TimeParams
from pse_analysis.alignment.stamps import SamplingTimes
from pse_analysis.measurement import SensorLayout
from pse_analysis.simulation import simulate
from pse_analysis.simulation.settings import SensorParams, SimulateParams
from pse_analysis.telemetry import RawCase
from pse_analysis.validation import ValidateParams, validate

SEED = 21
PARAMS = TimeParams(largest_delay_s=240.0, window_s=1800.0)
SENSORS = (
    SensorParams(
        "pmu", ("i_ka",), ("branch/24-25", "branch/31-32"), 0.002, 10.0, sigma_kind="relative"
    ),
    SensorParams(
        "scada", ("p_mw", "q_mvar"), ("branch/24-25", "branch/19-20"), 0.005, 60.0,
        sigma_kind="relative", delay_s=20.0, jitter_s=10.0, wander_s=200.0, wander_time_s=1800.0,
        stamp="arrival",
    ),
    SensorParams("scada", ("vm_pu",), ("bus/18",), 0.005, 60.0, delay_s=5.0),
)  # fmt: skip

NETWORKED = ("branch/7-8", "branch/15-16", "branch/24-25", "branch/31-32")
LATERAL = "scada:branch/19-20"


@cache
def made() -> tuple[RawCase, pd.DataFrame]:
    raw = simulate(feeder(), curves(), STUDY, SimulateParams(SEED, SENSORS))
    return raw, validate(raw.telemetry, raw.channels, ValidateParams(), history_end=STUDY.start)


def recover(validated: pd.DataFrame, method: Method = "dtw") -> SamplingTimes:
    raw = made()[0]
    layout = SensorLayout.from_channels(raw.channels, feeder())
    return stamps.sampling_times(
        validated,
        layout,
        raw.channels["source"].to_numpy(dtype=object),
        feeder(),
        fusion.instants_of(STUDY),
        fusion.start_of(STUDY),
        PARAMS,
        method,
    )


@cache
def networked() -> tuple[RawCase, pd.DataFrame]:
    """Four devices with a phasor unit of their own and one without, on one network."""
    phasor, telecontrol, _ = SENSORS
    sensors = (
        replace(phasor, at=NETWORKED),
        replace(telecontrol, at=(*NETWORKED, "branch/19-20"), delay_s=60.0, wander_s=80.0),
    )
    raw = simulate(feeder(), curves(), STUDY, SimulateParams(SEED, sensors))
    return raw, validate(raw.telemetry, raw.channels, ValidateParams(), history_end=STUDY.start)


@cache
def lent(lenders: int = 3, other: str = "scada", until: datetime | None = None) -> SamplingTimes:
    """Stamps of `networked`, with the lateral in a source of its own if asked for."""
    raw, validated = networked()
    if until is not None:
        validated = validated[(validated["arrival_utc"] <= until).to_numpy()]
    source = raw.channels["source"].to_numpy(dtype=object)
    source = np.where(raw.channels["channel"].str.startswith(LATERAL), other, source)
    params = replace(PARAMS, sources=("scada", other), lenders=lenders)
    layout = SensorLayout.from_channels(raw.channels, feeder())
    return stamps.sampling_times(
        validated,
        layout,
        source,
        feeder(),
        fusion.instants_of(STUDY),
        fusion.start_of(STUDY),
        params,
    )


def rows(validated: pd.DataFrame, device: str) -> np.ndarray:
    return validated["channel"].str.startswith(device).to_numpy()


def test_a_device_is_matched_with_the_phasor_current_in_series_and_no_other():
    found = recover(made()[1])
    assert found.partner == {"scada:branch/24-25:from": "pmu:branch/24-25:from:i_ka"}


def test_stamps_come_nearer_to_the_truth_than_arrival_and_both_channels_share_them():
    raw, validated = made()
    found = recover(validated)
    table = validated.assign(found=found.time, method=found.method)
    table = table[rows(validated, "scada:branch/24-25") & (found.method == DTW)]
    assert (table.groupby("arrival_utc")["found"].nunique() == 1).all()
    assert table.groupby("arrival_utc").size().max() == 2
    scores = stamps.rms_errors(found, validated, raw.sample_truth, pd.Timestamp(STUDY.start))
    sure = scores.set_index("method").loc["dtw"]
    assert sure["rms_s"] < 0.5 * sure["arrival_s"]
    assert sure["count"] > 0.5 * scores["count"].sum()


def test_who_stamps_by_its_own_clock_or_has_no_partner_keeps_its_stamps():
    validated = made()[1]
    found = recover(validated)
    own = microseconds(validated)
    for device, confidence in (("pmu", 1.0), ("scada:bus/18", 1.0), ("scada:branch/19-20", 0.0)):
        mine = rows(validated, device)
        np.testing.assert_array_equal(found.time[mine], own[mine])
        assert (found.confidence[mine] == confidence).all()


def test_a_half_without_its_other_half_is_dated_by_the_samples_beside_it():
    raw, validated = made()
    q = rows(validated, "scada:branch/24-25:from:q_mvar")
    lost = q & (np.random.default_rng(SEED).random(len(validated)) < 0.2)
    kept = validated[~lost].reset_index(drop=True)
    found = recover(kept)
    partner = validated.loc[lost, "arrival_utc"]
    alone = rows(kept, "scada:branch/24-25:from:p_mw") & kept["arrival_utc"].isin(partner)
    alone &= (kept["arrival_utc"] >= STUDY.start).to_numpy() & (found.method == DTW)
    assert alone.sum() >= 10
    key = ["trial", "channel", "seq"]
    true = kept.loc[alone, key].merge(raw.sample_truth, on=key)
    error = (found.time[alone] - microseconds(true)) / 1e6
    late = (microseconds(kept[alone], "arrival_utc") - microseconds(true)) / 1e6
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(late**2))


def test_a_device_of_which_nothing_is_known_has_the_usual_delay_of_the_others():
    raw, validated = networked()
    found, alone = lent(), lent(lenders=0)
    lateral = rows(validated, LATERAL)
    settled = lateral & (validated["arrival_utc"] >= STUDY.start).to_numpy()
    assert (found.method[settled] == stamps.LENT).all()
    assert not found.confidence[lateral].any()
    scores = stamps.rms_errors(found, validated, raw.sample_truth, pd.Timestamp(STUDY.start))
    own = scores[scores["device"].str.startswith(LATERAL)].set_index("method").loc["lent"]
    assert own["rms_s"] < 0.5 * own["arrival_s"]
    assert 0.5 < own["rms_s"] / np.sqrt(np.mean(found.doubt[settled] ** 2)) < 1.5
    assert (alone.method[lateral] == NONE).all()
    sure = found.method == DTW
    assert sure.any()
    np.testing.assert_array_equal(found.time[sure], alone.time[sure])


@pytest.mark.parametrize("change", [{"other": "rtu"}, {"lenders": 5}], ids=str)
def test_nothing_changes_where_devices_share_no_source_or_too_few_are_sure(
    change: dict[str, Any],
):
    found, alone = lent(**change), lent(lenders=0)
    for name in ("time", "confidence", "doubt", "method"):
        np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))


def test_what_comes_later_changes_no_lent_stamp():
    now = STUDY.start + timedelta(hours=1)
    whole, before = lent(), lent(until=now)
    kept = (networked()[1]["arrival_utc"] <= now).to_numpy()
    assert (before.method == stamps.LENT).any()
    for name in ("time", "doubt", "method"):
        np.testing.assert_array_equal(getattr(whole, name)[kept], getattr(before, name))


def test_without_a_method_all_stamps_stay():
    validated = made()[1]
    found = recover(validated, "none")
    np.testing.assert_array_equal(found.time, microseconds(validated))


def microseconds(table: pd.DataFrame, column: str = "time_utc") -> np.ndarray:
    """Microseconds since 1970."""
    naive = table[column].dt.tz_convert("UTC").dt.tz_localize(None)
    return np.asarray(naive.to_numpy().astype("datetime64[us]").astype(np.int64))
