"""Claim: however this project starts Rerun, no usage data are collected and none announced."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import pse_analysis
from pse_analysis.errors import ParameterError
from pse_analysis.pipeline import viewer

PATIENCE_S = 60.0


def at_home(home: Path) -> dict[str, str]:
    """The environment of a user who never started Rerun, at a place that does not look like CI."""
    kept = {k: v for k, v in os.environ.items() if k != "CI" and not k.startswith("XDG_")}
    return {**kept, "HOME": str(home), "FORCE_RERUN_ANALYTICS": "0"}


def analytics(home: Path, environment: dict[str, str]) -> tuple[str, list[Path]]:
    """What Rerun's program says, and the files that it leaves in the home folder."""
    done = subprocess.run(
        [viewer.find(), "analytics", "config"],
        capture_output=True,
        text=True,
        env=environment,
        timeout=PATIENCE_S,
        check=False,
    )
    return done.stdout + done.stderr, [path for path in home.rglob("*") if path.is_file()]


def test_viewer_collects_no_usage_data_and_leaves_the_home_folder_alone(tmp_path: Path) -> None:
    said, files = analytics(tmp_path, viewer.quiet(at_home(tmp_path)))
    assert "usage data" not in said
    assert files == []


def test_viewer_left_to_itself_announces_the_collection(tmp_path: Path) -> None:
    """Otherwise the test above could not fail."""
    said, files = analytics(tmp_path, at_home(tmp_path))
    assert "collects anonymous usage data" in said
    assert "analytics.json" in [path.name for path in files]


def test_wish_to_collect_all_the_same_is_not_passed_on() -> None:
    assert viewer.quiet({"FORCE_RERUN_ANALYTICS": "1", "A": "b"}) == {"A": "b", "CI": "true"}


def test_drawing_a_recording_leaves_the_home_folder_alone(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[2]);"
        "from test_recording_whole import draw; draw(Path(sys.argv[1]))"
    )
    source = str(Path(pse_analysis.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.rrd"), str(Path(__file__).parents[1])],
        capture_output=True,
        text=True,
        env={**at_home(home), "PYTHONPATH": source},
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.rrd").is_file()
    assert "usage data" not in done.stdout + done.stderr
    assert [path for path in home.rglob("*") if "rerun" in str(path)] == []


def test_missing_viewer_is_named_with_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ParameterError, match="install rerun-sdk"):
        viewer.find()
