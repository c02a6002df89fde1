"""Claim: every injected fault is recorded, does what its kind says, and leaves no other trace."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pytest
from simulated_case import FAULTS, PARAMS, SENSORS, case, make

from pse_analysis.errors import ParameterError
from pse_analysis.simulation.settings import FaultParams

KEY = ["trial", "channel", "seq"]
PMU_ONLY = dataclasses.replace(PARAMS, sensors=SENSORS[:1], trials=1, faults=())


def joined(raw, kind: str) -> pd.DataFrame:
    """Faults of a kind beside the sample and its truth."""
    faults = raw.faults[raw.faults.kind == kind].astype({"seq": "int64"})
    truth = raw.sample_truth.rename(columns={"time_utc": "true_time", "value": "true_value"})
    return faults.merge(raw.telemetry.drop(columns="time_utc"), on=KEY).merge(truth, on=KEY)


def test_seq_counts_arrivals_without_gaps():
    for _, part in case().telemetry.groupby(["trial", "channel"]):
        np.testing.assert_array_equal(part.seq, np.arange(len(part)))
        assert part.arrival_utc.is_monotonic_increasing


def test_the_shares_are_those_asked_for():
    raw = case()
    n = len(raw.telemetry)
    share = raw.faults.groupby("kind").size() / n
    for fault in FAULTS:
        if fault.kind == "stale":
            n_scada = raw.telemetry.channel.str.startswith("scada").sum()
            assert share["stale"] * n / n_scada == pytest.approx(0.02, rel=0.9)
        else:
            assert share[fault.kind] == pytest.approx(fault.rate, rel=0.25)
    assert raw.faults.groupby(["trial", "channel", "kind"]).size().max() < 60


def test_a_sample_has_one_fault_at_most():
    seq = case().faults.dropna(subset="seq")
    assert not seq.duplicated(KEY).any()


def test_spikes_add_their_size_and_are_larger_than_the_noise():
    clean, spiked = make(PMU_ONLY), make(PMU_ONLY, faults=FAULTS[:1])
    spikes = joined(spiked, "spike").merge(
        clean.telemetry[[*KEY, "value"]], on=KEY, suffixes=("", "_clean")
    )
    np.testing.assert_allclose(spikes.value - spikes.value_clean, spikes["size"], rtol=1e-9)
    assert (spikes["size"].abs() / 0.005).between(10, 40).all()
    assert {True, False} == set(spikes["size"] > 0)
    rest = spiked.telemetry.merge(spiked.faults[KEY].astype({"seq": "int64"}), how="left", on=KEY,
                                  indicator=True)  # fmt: skip
    good = rest._merge == "left_only"
    np.testing.assert_array_equal(rest.value[good], clean.telemetry.value[good.to_numpy()])


def test_relative_spikes_at_one_place_and_time():
    start, end = datetime(2016, 6, 9, 10, tzinfo=UTC), datetime(2016, 6, 9, 10, 30, tzinfo=UTC)
    bias = FaultParams(
        "spike", 1.0, (0.05, 0.05), relative=True, at=("bus/6",), start=start, end=end
    )
    raw = make(PMU_ONLY, faults=(bias,))
    spikes = joined(raw, "spike")
    assert len(spikes) == 30
    assert set(spikes.channel) == {"pmu:bus/6:vm_pu"}
    np.testing.assert_allclose(spikes["size"].abs(), 0.05 * spikes.true_value, rtol=1e-12)
    assert spikes.true_time.min() == pd.Timestamp(start)


def test_stale_values_repeat_the_last_good_one_and_state_its_age():
    raw = case()
    stale = joined(raw, "stale")
    assert len(stale) > 10
    assert stale.channel.str.startswith("scada").all()
    by_time = raw.sample_truth.merge(raw.telemetry[[*KEY, "value"]], on=KEY, suffixes=("", "_read"))
    origin = stale.assign(
        origin=stale.true_time - pd.to_timedelta(stale["size"], unit="s").dt.as_unit("us")
    ).merge(
        by_time, left_on=["trial", "channel", "origin"], right_on=["trial", "channel", "time_utc"]
    )
    assert len(origin) == len(stale)
    np.testing.assert_array_equal(origin.value_x, origin.value_read)
    assert (stale["size"] <= 900).all()


def test_lost_samples_have_no_row_and_no_seq():
    raw = case()
    lost = raw.faults[raw.faults.kind == "lost"]
    assert lost.seq.isna().all()
    arrived = raw.sample_truth.merge(
        lost, on=["trial", "channel", "time_utc"], how="inner", suffixes=("", "_f")
    )
    assert arrived.empty
    assert raw.faults.seq.notna().sum() == len(raw.faults) - len(lost)


def test_duplicates_repeat_value_and_stamp_and_come_later():
    raw = case()
    copies = joined(raw, "duplicated")
    first = raw.telemetry.merge(
        copies[["trial", "channel", "time_utc", "seq", "value", "arrival_utc", "size"]],
        on=["trial", "channel", "time_utc", "value"],
        suffixes=("", "_copy"),
    )
    first = first[first.seq != first.seq_copy]
    assert len(first) == len(copies)
    assert (first.seq < first.seq_copy).all()
    late = (first.arrival_utc_copy - first.arrival_utc).dt.total_seconds()
    np.testing.assert_allclose(late, first["size"], atol=2e-6)


def test_delayed_samples_may_arrive_after_younger_ones():
    raw = case()
    delayed = joined(raw, "delayed")
    late = (delayed.arrival_utc - delayed.true_time).dt.total_seconds()
    assert (late >= 120).all()
    pmu = raw.telemetry[raw.telemetry.channel.str.startswith("pmu")]
    backward = pmu.groupby(["trial", "channel"]).time_utc.diff() < pd.Timedelta(0)
    assert backward.any()


def test_the_truth_and_the_noise_do_not_depend_on_the_faults():
    clean, faulty = make(PMU_ONLY), make(PMU_ONLY, faults=FAULTS[4:])
    pd.testing.assert_frame_equal(clean.truth, faulty.truth)
    key = ["trial", "channel", "time_utc"]
    a, b = (r.telemetry.sort_values(key, ignore_index=True).value for r in (clean, faulty))
    pd.testing.assert_series_equal(a, b)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("stuck", 0.1), "kind in spike, stale, lost"),
        (("lost", 1.5), "rate in 0 … 1"),
        (("spike", 0.1), r"size = \[low, high\]"),
        (("spike", 0.1, (1.0, np.inf)), r"0 < low ≤ high ≤ 1e\+06 for 'spike', received .*inf"),
        (("spike", 0.1, (np.nan, 2.0)), r"size = \[low, high\]"),
        (("delayed", 0.1, (1.0, np.inf)), r"high ≤ 1e\+09 for 'delayed'"),
        (("stale", 0.1, (1e300, 1e300)), r"high ≤ 1e\+09 for 'stale'"),
        (("duplicated", 0.1, (1.0, 1e10)), r"high ≤ 1e\+09 for 'duplicated'"),
        (("lost", 0.1, (0.0, 0.0), False, "../x"), "source in scada, pmu"),
        (("lost", 0.1, (0.0, 0.0), False, "", ("vm",)), "quantities in vm_pu, va_degree"),
        (("lost", np.nan), "rate in 0 … 1"),
    ],
)
def test_parameters_out_of_range_are_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        FaultParams(*arguments)
