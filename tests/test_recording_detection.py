"""The recording of a case of checks alone verifies, and draws each sample by what became of it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pandas as pd
import pytest
from rerun.chunk import RrdReader
from study_tables import StudyTables, study_tables

from pse_analysis import recording
from pse_analysis.pipeline import viewer
from pse_analysis.recording import Take
from pse_analysis.recording.detection import N_BIN, _by_size
from pse_analysis.vocabulary import Flag

STYLE = ("1_good", "2_threshold", "3_found")


@pytest.fixture(scope="module")
def tables() -> StudyTables:
    return study_tables(n_instant=48, n_trial=1)


def record(tables: StudyTables, path: Path, *, known: bool) -> set[str]:
    """Entity paths of the recording."""
    decided = tables.validated.assign(statistic=0.1, threshold=0.15)
    recording.detected(
        Take(path, "demo", tables.study),
        decided,
        tables.channels,
        tables.faults if known else None,
        summary_markdown="# s",
    )
    chunks = RrdReader(str(path)).stream().to_chunks()
    return {str(chunk.entity_path).lstrip("/") for chunk in chunks}


@pytest.mark.parametrize("known", [True, False])
def test_recording_passes_the_verification_of_rerun(
    tables: StudyTables, tmp_path: Path, known: bool
) -> None:
    record(tables, tmp_path / "score.rrd", known=known)
    done = subprocess.run(
        [viewer.find(), "rrd", "verify", str(tmp_path / "score.rrd")],
        capture_output=True,
        text=True,
        env=viewer.quiet(os.environ),
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_every_channel_shows_what_became_of_its_samples(
    tables: StudyTables, tmp_path: Path
) -> None:
    paths = record(tables, tmp_path / "score.rrd", known=True)
    assert "text/scored" in paths
    faulty = tables.faults.dropna(subset=["seq"]).channel.iloc[0].replace(":", "/")
    for part in STYLE:
        assert f"decided/{faulty}/{part}" in paths
    assert {f"sizes/{faulty}/found", f"sizes/{faulty}/missed"} <= paths
    unknown = record(tables, tmp_path / "real.rrd", known=False)
    assert not [path for path in unknown if path.startswith("sizes")]


def test_spikes_are_counted_by_size() -> None:
    size = [0.1, -0.1, 5.9, 6.0, -6.0]
    flag = [Flag.GOOD, Flag.BAD, Flag.BAD, Flag.BAD, Flag.MISSING]
    counted = _by_size(pd.DataFrame({"kind": "spike", "size": size, "flag": flag}))
    assert len(counted) == N_BIN
    assert counted.iloc[0].tolist() == [1, 1]
    assert counted.iloc[-1].tolist() == [3, 0]
    assert counted.index[-1] == 6.0
