"""Claim: a recording is on the disk with every byte and row, or it is an error."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pse_analysis.errors import PseError, StorageError
from pse_analysis.recording import Take, whole
from pse_analysis.recording.whole import count_rows, write_whole

BLUEPRINT = rrb.Blueprint(rrb.TimeSeriesView(origin="/"))
N_COLUMNS, N_ROWS = 3, 400
SENT = N_COLUMNS * (N_ROWS + 1)


def draw(path: Path) -> None:
    """Three series of 400 samples, each with a name."""
    rng = np.random.default_rng(11)
    times = np.arange(N_ROWS).astype("datetime64[m]").astype("datetime64[ns]")
    with Take(path, "demo").open(BLUEPRINT) as stream:
        for k in range(N_COLUMNS):
            stream.log(f"a/{k}", rr.SeriesLines(names=str(k)), static=True)
            stream.send_columns(
                f"a/{k}",
                indexes=[rr.TimeColumn("time", timestamp=times)],
                columns=rr.Scalars.columns(scalars=rng.normal(size=N_ROWS)),
            )


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "demo.rrd"
    draw(path)
    return path.read_bytes()


def test_all_rows_that_were_sent_can_be_read_back(tmp_path: Path) -> None:
    draw(tmp_path / "demo.rrd")
    assert count_rows(tmp_path / "demo.rrd") == SENT


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_file_that_the_disk_cut_or_changed_is_an_error_and_removed(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: st.DataObject
) -> None:
    place = data.draw(st.integers(0, len(content) - 1), label="byte")
    bit = data.draw(st.integers(0, 8), label="bit (8: cut)")

    def lose(handle: int) -> None:
        """A disk that says that all is written, and lost or changed a part."""
        if bit == 8:
            os.truncate(path, place)
        else:
            damaged = bytearray(content)
            damaged[place] ^= 1 << bit
            path.write_bytes(damaged)

    path = tmp_path / "demo.rrd"
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", lose)
        with pytest.raises(StorageError, match=r"demo\.rrd does not hold what was written to it"):
            write_whole(path, content, SENT)
    assert not path.exists()


@pytest.mark.parametrize(
    ("code", "remedy"),
    [
        (
            errno.ENOSPC,
            r"MB could not .* No space left .* MB are free there: free some",
        ),
        (errno.EDQUOT, "your quota there is used up: remove files"),
        (errno.EFBIG, r"raise the limit \(ulimit -f\)"),
        (errno.EROFS, "let this user read and write there"),
        (errno.EIO, "check the disk and run again"),
    ],
)
def test_error_of_the_disk_says_what_to_do_and_leaves_no_file(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, remedy: str
) -> None:
    def fail(handle: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(StorageError, match=remedy) as caught:
        write_whole(tmp_path / "demo.rrd", content, SENT)
    assert isinstance(caught.value, PseError)
    assert not (tmp_path / "demo.rrd").exists()


def test_folder_that_is_not_there_is_named(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"no/demo\.rrd of .* could not be written whole: No"):
        write_whole(tmp_path / "no" / "demo.rrd", content, SENT)


def test_rows_that_rerun_lost_are_an_error(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=f"{SENT + 1} rows were recorded, but {SENT} can be"):
        write_whole(tmp_path / "demo.rrd", content, SENT + 1)
    assert not (tmp_path / "demo.rrd").exists()


def test_drawing_that_fails_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "demo.rrd"
    with pytest.raises(ZeroDivisionError), Take(path, "demo").open(BLUEPRINT):
        raise ZeroDivisionError
    assert not path.exists()


def test_what_rerun_would_only_warn_of_is_an_error(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match="same length"),
        Take(tmp_path / "demo.rrd", "demo").open(BLUEPRINT) as stream,
    ):
        stream.send_columns(
            "a",
            indexes=[rr.TimeColumn("time", sequence=[1, 2, 3])],
            columns=rr.Scalars.columns(scalars=[1.0, 2.0]),
        )


def test_recording_that_the_environment_turned_off_is_an_error(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[2]);"
        "from test_recording_whole import draw; draw(Path(sys.argv[1]))"
    )
    environment = {
        **os.environ,
        "RERUN": "off",
        "PYTHONPATH": str(Path(whole.__file__).parents[2]),
    }
    path = tmp_path / "demo.rrd"
    done = subprocess.run(
        [sys.executable, "-c", code, str(path), str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert done.returncode == 1
    assert "ParameterError: the variable RERUN=off turns recordings off: unset it" in done.stderr
    assert not path.exists()
