"""Claim: one seed gives one case, to the byte, and each trial stands on its own."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pandas as pd
from simulated_case import PARAMS, SENSORS, STUDY, case, feeder, make

from pse_analysis import telemetry
from pse_analysis.measurement import BUS, VM, MeasurementModel, SensorLayout
from pse_analysis.parameters import build
from pse_analysis.simulation import SimulateParams
from pse_analysis.vocabulary import check


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path):
    telemetry.write_raw(tmp_path / "a", case())
    telemetry.write_raw(tmp_path / "b", make())
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    other = make(seed=PARAMS.seed + 1)
    assert not other.telemetry.value.equals(case().telemetry.value)


def test_all_tables_obey_their_schemas():
    raw = case()
    for table in ("telemetry", "channels", "truth", "sample_truth", "faults"):
        frame = getattr(raw, table)
        assert len(check(table, frame)) == len(frame) > 0
    telemetry.check_channels(raw.channels, raw.network)


def test_a_trial_does_not_depend_on_how_many_there_are():
    alone = make(trials=1)
    for table in ("telemetry", "truth", "faults"):
        two = getattr(case(), table)
        pd.testing.assert_frame_equal(
            getattr(alone, table), two[two.trial == 0].reset_index(drop=True)
        )


def test_the_noise_of_a_group_does_not_depend_on_the_groups_after_it():
    params = dataclasses.replace(PARAMS, faults=())
    alone = make(params, sensors=SENSORS[:1]).telemetry
    among = make(params).telemetry
    pd.testing.assert_frame_equal(
        alone, among[among.channel.str.startswith("pmu")].reset_index(drop=True)
    )


def test_truth_stands_at_every_instant_of_the_study_and_only_there():
    truth = case().truth
    instants = pd.date_range(STUDY.start, STUDY.end, freq="300s", inclusive="left", unit="us")
    assert list(truth.time_utc.unique()) == list(instants)
    assert len(truth) == 2 * len(instants) * 33 * 4


def test_true_values_of_samples_agree_with_the_truth_table():
    raw = case()
    vm = raw.truth[raw.truth.quantity == "vm_pu"].assign(
        channel=lambda t: "pmu:" + t.element + ":vm_pu"
    )
    both = raw.sample_truth.merge(vm, on=["trial", "channel", "time_utc"])
    assert len(both) > 100
    np.testing.assert_allclose(both.value_x, both.value_y, atol=1e-12)
    layout = SensorLayout.of(feeder(), (VM, np.array([5]), BUS))
    assert MeasurementModel(feeder(), layout).shape[0] == 1


def test_telemetry_begins_with_the_history_and_ends_with_the_study():
    sampled = case().sample_truth.time_utc
    assert sampled.min() == pd.Timestamp(STUDY.history_start)
    assert sampled.max() < pd.Timestamp(STUDY.end)


def test_a_case_file_builds_the_parameters():
    params = build(
        SimulateParams,
        {
            "seed": 1,
            "trials": 3,
            "load": {"level": 0.5, "classes": ["H0-H"], "per_bus": 1},
            "source_voltage": {"taps_per_day": 0},
            "pv": [{"bus": "14", "peak_mw": 0.3}],
            "sensors": [
                {
                    "source": "pmu",
                    "quantities": ["vm_pu"],
                    "at": ["buses"],
                    "sigma": 0.005,
                    "period_s": 60,
                    "limits": {"vm_pu": [0.8, 1.2]},
                }
            ],
            "faults": [{"kind": "spike", "rate": 0.01, "size": [10, 20]}],
        },
        "simulate",
    )
    assert params.sensors[0].limits == {"vm_pu": (0.8, 1.2)}
    assert params.faults[0].size == (10.0, 20.0)
    assert params.pv[0].profile == "PV1"
