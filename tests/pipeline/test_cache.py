"""Claim: stored results are whole and current or not there, whatever interrupts a run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pse_analysis.pipeline import cache
from pse_analysis.pipeline.cache import CacheError, RawFolder, Store, lock


def publish(store: Store, key: str, text: str) -> None:
    folder = store.begin("align", key)
    (folder / "aligned.parquet").write_text(text, encoding="utf-8")
    store.publish("align", key, folder, 1.0)


def current(store: Store) -> str | None:
    entry = store.entry("align")
    return None if entry is None else (entry.folder / "aligned.parquet").read_text()


def test_published_folder_is_current_and_older_ones_are_pruned(tmp_path: Path) -> None:
    store = Store(tmp_path)
    publish(store, "one", "1")
    publish(store, "two", "2")
    assert current(store) == "2"
    assert [path.name for path in (tmp_path / "align").iterdir()] == ["two"]


def test_same_fingerprint_may_be_published_again_and_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for text in ("1", "2", "3"):
        publish(store, "one", text)
        assert current(store) == text
        assert len(list((tmp_path / "align").iterdir())) == 1


@pytest.mark.parametrize("damage", ["shorter", "gone", "manifest"])
def test_damaged_result_is_not_current(tmp_path: Path, damage: str) -> None:
    store = Store(tmp_path)
    publish(store, "one", "whole")
    path = tmp_path / "align" / "one" / "aligned.parquet"
    if damage == "shorter":
        path.write_text("who")
    elif damage == "gone":
        path.unlink()
    else:
        (tmp_path / "manifest.json").write_text('{"stages": {"align": {"folder": "one"')
    assert store.entry("align") is None


def test_interruption_between_rename_and_manifest_keeps_the_old_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    publish(store, "one", "old")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(cache, "write_json", stop)
        with pytest.raises(KeyboardInterrupt):
            publish(store, "two", "new")
    assert current(store) == "old"
    store.prune()
    assert [path.name for path in (tmp_path / "align").iterdir()] == ["one"]
    publish(store, "two", "new")
    assert current(store) == "new"


def test_second_process_is_refused_with_the_first_ones_id(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from pse_analysis.pipeline.cache import lock\n"
        "with lock(Path(sys.argv[1]), 'small'): pass"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with lock(tmp_path, "small"):
        refused = subprocess.run(command, capture_output=True, text=True, check=False)
    assert f"another process (pid {os.getpid()})" in refused.stderr
    assert subprocess.run(command, check=False).returncode == 0


def write_raw(raw: RawFolder, key: str, text: str) -> None:
    folder = raw.begin()
    (folder / "channels.parquet").write_text(text, encoding="utf-8")
    raw.publish(key, folder, 1.0)


def test_simulated_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "1")
    (raw.folder / "left_over").write_text("x")
    write_raw(raw, "two", "2")
    assert {path.name for path in raw.folder.iterdir()} == {"channels.parquet", "simulated.json"}
    assert (raw.folder / "channels.parquet").read_text() == "2"
    assert [path.name for path in tmp_path.iterdir()] == ["small"]


def test_raw_folder_of_the_user_is_never_replaced(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    raw.folder.mkdir()
    (raw.folder / "channels.parquet").write_text("mine")
    with pytest.raises(CacheError, match="was not made by a simulation"):
        write_raw(raw, "one", "1")
    assert (raw.folder / "channels.parquet").read_text() == "mine"


def test_change_by_hand_is_seen(tmp_path: Path) -> None:
    raw = RawFolder(tmp_path / "small")
    write_raw(raw, "one", "1")
    assert raw.changed(raw.describe()) is None
    (raw.folder / "channels.parquet").write_text("2")
    assert raw.changed(raw.describe()) == "channels.parquet"


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
    raw.recover()
    assert (raw.folder / "channels.parquet").read_text() == "old"
    assert json.loads((raw.folder / "simulated.json").read_text())["fingerprint"] == "one"
    assert [path.name for path in tmp_path.iterdir()] == ["small"]
