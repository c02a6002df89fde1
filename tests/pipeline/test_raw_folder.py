"""Claim: a simulated raw folder is replaced as a whole, and nobody else's file goes with it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from pse_analysis.checksums import write_checksums
from pse_analysis.errors import DamagedFile, TableError
from pse_analysis.pipeline.cache import CacheError
from pse_analysis.pipeline.raw_folder import RawFolder

WRITTEN = {"channels.parquet", "checksums.json", "simulated.json"}


def write_raw(raw: RawFolder, key: str, text: str) -> None:
    folder = raw.begin()
    (folder / "channels.parquet").write_text(text, encoding="utf-8")
    raw.publish({"fingerprint": key}, folder)


def test_simulated_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "1")
    write_raw(raw, "two", "2")
    assert {path.name for path in raw.folder.iterdir()} == WRITTEN
    assert (raw.folder / "channels.parquet").read_text() == "2"
    assert [path.name for path in tmp_path.iterdir()] == ["small"]


def test_what_others_put_there_stays(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "1")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "x").write_text("x")
    (raw.folder / "NOTES.md").write_text("notes")
    (raw.folder / "june" / "plots").mkdir(parents=True)
    (raw.folder / "june" / "plots" / "a.png").write_text("plot")
    (raw.folder / "link").symlink_to(tmp_path / "elsewhere")
    (raw.folder / "telemetry").mkdir()
    (raw.folder / "telemetry" / "more.parquet").write_text("a table of my own")
    os.link(raw.folder / "channels.parquet", tmp_path / "kept.parquet")
    write_raw(raw, "two", "2")
    assert (raw.folder / "NOTES.md").read_text() == "notes"
    assert (raw.folder / "june" / "plots" / "a.png").read_text() == "plot"
    assert (raw.folder / "link").is_symlink()
    assert (tmp_path / "elsewhere" / "x").read_text() == "x"
    assert (tmp_path / "kept.parquet").read_text() == "1"
    # A table would be read as part of the new case: it lies beside the folder.
    assert not (raw.folder / "telemetry").exists()
    kept = tmp_path / "small.kept" / "telemetry" / "more.parquet"
    assert kept.read_text() == "a table of my own"
    assert raw.changed(raw.describe()) is None


def test_folder_of_the_user_is_never_replaced(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    raw.folder.mkdir()
    (raw.folder / "channels.parquet").write_text("mine")
    with pytest.raises(CacheError, match="was not made by a simulation"):
        write_raw(raw, "one", "1")
    assert (raw.folder / "channels.parquet").read_text() == "mine"


@pytest.mark.parametrize("text", ["", "null", "[]", '{"files": []}', '{"files": {"a": 1}}', "{"])
def test_odd_list_of_checksums_is_a_change_and_no_dead_end(tmp_path: Path, text: str) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "1")
    (raw.folder / "checksums.json").write_text(text)
    (raw.folder / "simulated.json").write_text(text)
    assert raw.changed(raw.describe()) == "checksums.json"
    write_raw(raw, "two", "2")
    assert raw.changed(raw.describe()) is None


def test_change_by_hand_is_seen(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "1")
    assert raw.changed(raw.describe()) is None
    (raw.folder / "channels.parquet").write_text("2")
    assert raw.changed(raw.describe()) == "channels.parquet"


def test_users_files_are_held_to_their_checksums_and_new_ones_are_welcome(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    (raw.folder / "telemetry").mkdir(parents=True)
    (raw.folder / "channels.parquet").write_text("1")
    raw.check(raw.describe())
    write_checksums(raw.folder)
    (raw.folder / "telemetry" / "july.parquet").write_text("2")
    raw.check(raw.describe())
    (raw.folder / "channels.parquet").write_text("3")
    with pytest.raises(DamagedFile, match=r"channels\.parquet is not as it was written.*--accept"):
        raw.check(raw.describe())
    (raw.folder / "channels.parquet").unlink()
    with pytest.raises(DamagedFile, match=r"channels\.parquet is gone.*--accept"):
        raw.check(raw.describe())


@pytest.mark.parametrize("to", ["file", "folder"])
def test_link_out_of_the_folder_is_refused(tmp_path: Path, to: str) -> None:
    raw = RawFolder(tmp_path / "small")
    raw.folder.mkdir()
    outside = tmp_path / "secret"
    outside.mkdir() if to == "folder" else outside.write_text("secret")
    (raw.folder / "telemetry").symlink_to(outside)
    with pytest.raises(TableError, match=r"telemetry is a link to .*secret.*copy it there"):
        raw.describe()


def test_folder_that_is_a_link_is_simulated_where_it_leads(tmp_path: Path) -> None:
    (tmp_path / "big disk").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "small").symlink_to(tmp_path / "big disk" / "small")
    for key in ("one", "two", "three"):
        raw = RawFolder(tmp_path / "data" / "small")
        raw.recover()
        write_raw(raw, key, key)
        assert (tmp_path / "data" / "small" / "channels.parquet").read_text() == key
    assert (tmp_path / "data" / "small").is_symlink()
    assert [path.name for path in (tmp_path / "big disk").iterdir()] == ["small"]


def test_leftovers_are_swept_when_their_process_is_gone(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "1")
    gone = max_pid() + 1
    for name in (f".small.tmp-{gone}", f".small.tmp-{os.getpid()}", f".other.tmp-{gone}"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "truth.parquet").write_text("half")
    mine = tmp_path / f".small.tmp-{gone}" / "mine.txt"
    mine.write_text("mine")
    raw.recover()
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*tmp*/*")}
    assert left == {
        f".small.tmp-{gone}/mine.txt",
        f".small.tmp-{os.getpid()}/truth.parquet",
        f".other.tmp-{gone}/truth.parquet",
    }


def max_pid() -> int:
    """The largest number that a process of this machine can have."""
    return int(Path("/proc/sys/kernel/pid_max").read_text())


@pytest.mark.parametrize("rename", [1, 2])
def test_interrupted_swap_is_finished_or_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rename: int
) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "old")
    calls = 0
    real = os.rename

    def stop(*arguments: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == rename:
            raise KeyboardInterrupt
        real(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", stop)
        with pytest.raises(KeyboardInterrupt):
            write_raw(raw, "two", "new")
    raw.begin()
    raw.recover()
    assert (raw.folder / "channels.parquet").read_text() == "old"
    assert json.loads((raw.folder / "simulated.json").read_text())["fingerprint"] == "one"


@pytest.mark.parametrize("call", [1, 2, 3])
def test_interrupted_return_of_others_files_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "old")
    for name in ("a.txt", "b.txt", "c.txt"):
        (raw.folder / name).write_text(name)
    calls = 0
    real = os.rename

    def stop(*arguments: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == 2 + call:
            raise KeyboardInterrupt
        real(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", stop)
        with pytest.raises(KeyboardInterrupt):
            write_raw(raw, "two", "new")
    raw.recover()
    assert {path.name for path in raw.folder.iterdir()} == WRITTEN | {"a.txt", "b.txt", "c.txt"}
    assert (raw.folder / "channels.parquet").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["small"]
