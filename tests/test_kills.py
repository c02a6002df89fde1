"""Claim: a run or writer killed at any instant leaves old tables or new ones, never halves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pse_analysis

ROOT = Path(__file__).parents[1]
KILLS = 6
"""In a short form; `make endurance` kills a thousand times."""


def test_killed_runs_and_writers_leave_nothing_half() -> None:
    # A process of its own: one that has used threads must not be forked.
    paths = [str(Path(pse_analysis.__file__).parents[1]), str(ROOT)]
    done = subprocess.run(
        [sys.executable, "-m", "tests.endurance", "kills", "--count", str(KILLS)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert f"{KILLS} kills, nothing half, nothing different" in done.stdout
