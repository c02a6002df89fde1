"""Each recording verifies, holds the stated entities, and needs neither truth nor faults."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from study_tables import VM_BUSES, StudyTables, study_tables

from pse_analysis import drawing, recording
from pse_analysis.grid import library
from pse_analysis.pipeline import viewer
from pse_analysis.recording import Take


@pytest.fixture(scope="module")
def tables() -> StudyTables:
    return study_tables(n_instant=48, n_trial=1)


@pytest.fixture(scope="module")
def folder(tables, tmp_path_factory) -> Path:
    """Recordings of all stages, with truth and without."""
    folder = tmp_path_factory.mktemp("recordings")
    for name, known in (("simulated", True), ("real", False)):
        _record(folder / name, tables, known=known)
    return folder


def _record(to: Path, t: StudyTables, *, known: bool) -> None:
    to.mkdir()
    truth = t.truth if known else None
    recording.validated(
        Take(to / "validate.rrd", "demo", t.study),
        t.validated,
        t.channels,
        sample_truth=t.sample_truth if known else None,
        faults=t.faults if known else None,
    )
    recording.aligned(Take(to / "align.rrd", "demo"), t.aligned, t.channels, truth=truth)
    recording.estimated(
        Take(to / "estimate.rrd", "demo"),
        t.estimated,
        t.steps,
        t.residuals,
        aligned=t.aligned,
        channels=t.channels,
        network=t.network,
        truth=truth,
    )
    scored = t.scored if known else t.scored[t.scored.metric == "nis_ratio"]
    recording.scored(
        Take(to / "score.rrd", "demo"),
        scored,
        t.estimated,
        truth,
        t.network,
        summary_markdown="# s",
    )


def entities(path: Path) -> set[str]:
    """Entity paths of the data in a recording."""
    chunks = RrdReader(str(path)).stream().to_chunks()
    return {str(chunk.entity_path).lstrip("/") for chunk in chunks}


STAGES = ("validate", "align", "estimate", "score")


@pytest.mark.parametrize("kind", ["simulated", "real"])
def test_recordings_pass_the_verification_of_rerun(folder, kind):
    paths = [str(folder / kind / f"{stage}.rrd") for stage in STAGES]
    done = subprocess.run(
        [viewer.find(), "rrd", "verify", *paths],
        capture_output=True,
        text=True,
        env=viewer.quiet(os.environ),
    )
    assert done.returncode == 0, done.stderr
    assert "without error" in done.stdout + done.stderr


def test_files_of_a_case_share_one_recording_so_that_the_viewer_merges_them(folder):
    seen = set()
    for stage in STAGES:
        (store,) = RrdReader(str(folder / "simulated" / f"{stage}.rrd")).recordings()
        seen.add((store.application_id, store.recording_id))
    assert seen == {("pse_analysis", "pse_analysis-demo")}


def test_validated_holds_samples_truth_and_a_lane_per_channel(folder, tables):
    found = entities(folder / "simulated" / "validate.rrd")
    lanes = {e for e in found if e.startswith("flags/")}
    assert lanes == {f"flags/{c.replace(':', '/')}" for c in tables.channels.channel}
    for part in ("true", "usable", "bad"):
        assert any(e.startswith("telemetry/") and e.endswith(f"_{part}") for e in found)


def test_estimated_holds_truth_measurements_and_a_band_per_method(folder, tables):
    found = entities(folder / "simulated" / "estimate.rrd")
    first = tables.estimated[tables.estimated.trial == 0]
    mean = first[first.quantity == "vm_pu"].groupby("element").value.mean()
    bands = ("1_true", "3_wls", "4_kf_scalar", "5_kf_load")
    # The weakest bus is always drawn, and of the metered ones the first.
    for element in (mean.idxmin(), f"bus/{VM_BUSES[0]}"):
        assert {f"vm/{element}/{band}" for band in bands} <= found
    assert f"vm/bus/{VM_BUSES[0]}/2_measured/scada" in found
    for method in ("wls", "kf_scalar", "kf_load"):
        assert {f"grid/{method}", f"normalised/{method}", f"status/{method}"} <= found
    assert {"nis/methods", "nis/bounds_0", "text/estimated"} <= found


def test_scored_holds_the_summary_and_errors_over_time_and_by_bus(folder):
    found = entities(folder / "simulated" / "score.rrd")
    assert {"text/scored", "error/mean", "error/largest", "error/by_bus/wls"} <= found
    assert "score_grid/kf_load" in found


def test_without_truth_the_recordings_say_nothing_of_it(folder):
    for stage in STAGES:
        found = entities(folder / "real" / f"{stage}.rrd")
        assert f"text/{stage}d" in found or f"text/{stage}ed" in found
        assert not any(e.split("/")[-1] in ("true", "1_true", "2_true") for e in found)
    # The grid then shows the estimate's own σ.
    assert "grid/wls" in entities(folder / "real" / "estimate.rrd")


def test_a_method_that_never_ended_well_is_recorded_all_the_same(tables, tmp_path):
    lost = tables.estimated.copy()
    lost.loc[lost.method == "wls", ["value", "sigma"]] = np.nan
    steps = tables.steps.copy()
    steps.loc[steps.method == "wls", "status"] = "unobservable"
    steps.loc[steps.method == "wls", ["nis", "dof"]] = [np.nan, 0]
    steps["dof"] = steps.dof.astype("int32")
    recording.estimated(
        Take(tmp_path / "e.rrd", "demo"),
        lost,
        steps,
        tables.residuals[tables.residuals.method != "wls"],
        aligned=tables.aligned,
        channels=tables.channels,
        network=tables.network,
        truth=tables.truth,
    )
    found = entities(tmp_path / "e.rrd")
    assert "status/wls" in found
    assert "grid/wls" in found


def test_more_channels_than_lanes_leaves_those_with_findings(tables, tmp_path, monkeypatch):
    monkeypatch.setattr(recording.telemetry, "MAX_LANES", 5)
    recording.validated(Take(tmp_path / "v.rrd", "demo"), tables.validated, tables.channels)
    lanes = {e for e in entities(tmp_path / "v.rrd") if e.startswith("flags/")}
    flagged = tables.validated[(tables.validated.trial == 0) & (tables.validated.flag > 0)]
    assert len(lanes) == 5
    assert lanes <= {f"flags/{c.replace(':', '/')}" for c in flagged.channel}


def test_recording_prints_nothing(tables, tmp_path, capfd):
    recording.aligned(Take(tmp_path / "a.rrd", "demo"), tables.aligned, tables.channels)
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("name", ["ieee14", "ieee30", "ieee33", "ieee118"])
def test_layout_is_the_same_every_time_and_keeps_buses_apart(name):
    network = library.load(name)
    xy = drawing.layout(network)
    np.testing.assert_array_equal(xy, drawing.layout(network))
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=2) + 10 * np.eye(len(xy))
    assert apart.min() > 0.15


def test_layout_draws_the_longest_path_of_a_feeder_straight():
    network = library.load("ieee33")
    xy = drawing.layout(network)
    np.testing.assert_array_equal(xy[:18], np.stack([np.arange(18), np.zeros(18)], axis=1))


def test_a_colour_scale_ends_on_a_round_number_and_shows_the_unknown_in_grey():
    assert [drawing.round_up(v) for v in (0.0031, 1.2, 5.0, 70.0)] == [0.005, 2.0, 5.0, 100.0]
    colours = drawing.sequential([0.0, 1.0, 7.0, np.nan], 1.0)
    np.testing.assert_array_equal(colours[1], colours[2])
    assert len(set(colours[3].tolist())) == 1
    assert len(set(colours[0].tolist())) > 1
