"""Claim: stored results are whole and current or not there, whatever interrupts a run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pse_analysis.errors import TableError
from pse_analysis.pipeline import cache
from pse_analysis.pipeline.cache import Entry, Store, lock

ONE, TWO = "1" * 20, "2" * 20


def publish(store: Store, key: str, text: str) -> Entry:
    folder = store.begin("align", key)
    (folder / "aligned.parquet").write_text(text, encoding="utf-8")
    return store.publish("align", Entry(folder, key, {}, 1.0, {}, {}))


def current(store: Store) -> str | None:
    entry = store.entries().get("align")
    if entry is None or entry.damaged():
        return None
    return (entry.folder / "aligned.parquet").read_text()


def test_published_folder_is_current_and_older_ones_are_pruned(tmp_path: Path) -> None:
    store = Store(tmp_path)
    publish(store, ONE, "1")
    publish(store, TWO, "2")
    assert current(store) == "2"
    assert [path.name for path in (tmp_path / "align").iterdir()] == [TWO]


def test_same_fingerprint_may_be_published_again_and_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for text in ("1", "2", "3"):
        publish(store, ONE, text)
        assert current(store) == text
        assert len(list((tmp_path / "align").iterdir())) == 1


@pytest.mark.parametrize("damage", ["shorter", "gone", "manifest", "one bit", "other bytes"])
def test_damaged_result_is_not_current(tmp_path: Path, damage: str) -> None:
    store = Store(tmp_path)
    publish(store, ONE, "whole")
    path = tmp_path / "align" / ONE / "aligned.parquet"
    if damage == "gone":
        path.unlink()
    elif damage == "manifest":
        (tmp_path / "manifest.json").write_text('{"stages": {"align": {"folder": "one"')
    else:
        path.write_text({"shorter": "who", "one bit": "whnle", "other bytes": "!!!!!"}[damage])
    assert current(store) is None


def test_damage_that_keeps_size_and_time_is_found_by_a_thorough_look(tmp_path: Path) -> None:
    store = Store(tmp_path)
    entry = publish(store, ONE, "whole")
    path = entry.folder / "aligned.parquet"
    path.write_text("whnle")
    blind = {"aligned.parquet": {**entry.files["aligned.parquet"], "times": times(path)}}
    entry = Entry(entry.folder, ONE, blind, 1.0, {}, {})
    assert entry.damaged() == ()
    assert entry.damaged(thorough=True) == ("aligned.parquet",)


def times(path: Path) -> list[int]:
    return [path.stat().st_mtime_ns, path.stat().st_ctime_ns]


def test_a_copy_of_the_folder_is_as_current_as_the_original(tmp_path: Path) -> None:
    store = Store(tmp_path)
    path = publish(store, ONE, "whole").folder / "aligned.parquet"
    os.utime(path, (1.0, 1.0))
    entries = store.entries()
    assert entries["align"].damaged() == ()
    store.note({}, entries)
    assert store.entries()["align"].files["aligned.parquet"]["times"] == times(path)


def test_interruption_between_rename_and_manifest_keeps_the_old_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    publish(store, ONE, "old")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(cache, "write_json", stop)
        with pytest.raises(KeyboardInterrupt):
            publish(store, TWO, "new")
    assert current(store) == "old"
    store.prune()
    assert [path.name for path in (tmp_path / "align").iterdir()] == [ONE]
    publish(store, TWO, "new")
    assert current(store) == "new"


def test_what_others_put_into_the_case_folder_stays(tmp_path: Path) -> None:
    folder, outside = tmp_path / "case", tmp_path / "outside"
    (outside / ONE).mkdir(parents=True)
    (outside / ONE / "aligned.parquet").write_text("outside")
    store = Store(folder)
    first = publish(store, ONE, "1")
    bystanders = [
        folder / "my_plots" / "june" / "a.png",
        folder / "align" / "notes.txt",
        folder / "align" / "june" / "aligned.parquet",
        folder / "estimate" / ".hidden" / "estimated.parquet",
        folder / "june" / ONE / "aligned.parquet",
        first.folder / "my remarks.txt",
        first.folder / "june" / "b.png",
        folder / "align" / f".{TWO}.tmp-1" / "mine.txt",
    ]
    for path in bystanders:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(path.name)
    os.link(first.folder / "aligned.parquet", folder / "kept.parquet")
    (folder / "score").symlink_to(outside)
    (folder / "align" / "3".ljust(20, "3")).symlink_to(outside / ONE)
    (first.folder / "link").symlink_to(outside / ONE)
    publish(store, TWO, "2")
    store.prune()
    for path in bystanders:
        assert path.read_text() == path.name
    assert (folder / "kept.parquet").read_text() == "1"
    assert (outside / ONE / "aligned.parquet").read_text() == "outside"
    assert (folder / "score").is_symlink()
    assert (first.folder / "link").is_symlink()
    assert not (first.folder / "aligned.parquet").exists()


def test_a_link_where_a_result_belongs_is_no_dead_end(tmp_path: Path) -> None:
    store = Store(tmp_path / "case")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "aligned.parquet").write_text("not ours")
    (tmp_path / "case" / "align").mkdir(parents=True)
    (tmp_path / "case" / "align" / ONE).symlink_to(tmp_path / "elsewhere")
    publish(store, ONE, "1")
    publish(store, ONE, "2")
    assert current(store) == "2"
    assert (tmp_path / "elsewhere" / "aligned.parquet").read_text() == "not ours"


ODD_VALUES = (None, [], {}, 1, "x", "\0", "../..", [[]], {"a": 1}, True, 1e999, "a" * 5000)


@pytest.mark.parametrize("value", ODD_VALUES, ids=lambda value: repr(value)[:20])
def test_odd_but_readable_manifest_names_nothing_that_is_not_whole(
    tmp_path: Path, value: object
) -> None:
    store = Store(tmp_path)
    publish(store, ONE, "whole")
    path = tmp_path / "manifest.json"
    good = json.loads(path.read_text())
    variants = [value, {"stages": value}, {"stages": {"align": value}}, {**good, "raw": value}]
    for key in good["stages"]["align"]:
        variants.append({"stages": {"align": {**good["stages"]["align"], key: value}}})
    files = good["stages"]["align"]["files"]
    variants += [
        {"stages": {"align": {**good["stages"]["align"], "files": changed}}}
        for changed in (
            {"aligned.parquet": value},
            {str(value): files["aligned.parquet"]},
            *(
                {"aligned.parquet": {**files["aligned.parquet"], k: value}}
                for k in ("bytes", "digest", "times")
            ),
        )
    ]
    for variant in variants:
        path.write_text(json.dumps(variant))
        for entry in store.entries().values():
            assert entry.folder.parent == tmp_path / "align"
            entry.damaged()
        assert all(isinstance(facts, dict) for facts in store.raw_files().values())
        store.prune()
        publish(store, ONE, "again")
        assert current(store) == "again"


def test_manifest_of_endless_nesting_names_nothing(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("[" * 100_000)
    assert not Store(tmp_path).entries()


@pytest.mark.parametrize("kind", ["symbolic", "hard"])
def test_lock_is_not_written_through_a_link(tmp_path: Path, kind: str) -> None:
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (tmp_path / "case").mkdir()
    if kind == "hard":
        os.link(mine, tmp_path / "case" / ".lock")
        with lock(tmp_path / "case", "small"):
            pass
    else:
        (tmp_path / "case" / ".lock").symlink_to(mine)
        with (
            pytest.raises(TableError, match=r"\.lock: expected a file .* a link: move it away"),
            lock(tmp_path / "case", "small"),
        ):
            pass
    assert mine.read_text() == "mine"


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
