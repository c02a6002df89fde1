"""Claim: what is damaged, mixed or edited is found before it is used, whenever that happens."""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_work import WORK, change, edit, prepare

from pse_analysis.errors import DamagedFile, TableError
from pse_analysis.pipeline import cache, descent, results, runner
from pse_analysis.pipeline.plan import NAMES, Job, Options, Reporter, Result


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        runner.run("small", prepare(folder, patch), work=WORK)
    return folder


@pytest.fixture
def options(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Options:
    """A copy of that run."""
    options = prepare(tmp_path, monkeypatch)
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    return options


@pytest.fixture
def of_user(options: Options) -> Options:
    """The same case with the raw folder of a user, who keeps no list of checksums."""
    raw = options.data_folder / "raw" / "small"
    edit(options, "[simulate]\nseed = 3\n", "")
    edit(options, 'grid = "ieee14"\n', "")
    (raw / "simulated.json").unlink()
    (raw / "checksums.json").unlink()
    run(options)
    return options


class Warnings(Reporter):
    """Keeps what a run warns of."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def warning(self, text: str) -> None:
        self.texts.append(text)


def run(options: Options, heard: Reporter | None = None, **work: Callable[[Job], None]) -> Result:
    return runner.run("small", options, heard, work={**WORK, **work})


def load(options: Options, *, older: bool = False) -> results.Results:
    return results.load("small", data=options.data, cases=options.cases, older=older)


def table(options: Options, stage: str, name: str) -> Path:
    return load(options).files[name]


def manifest(options: Options) -> Path:
    return options.data_folder / "processed" / "small" / "manifest.json"


def pretend_unchanged(options: Options, path: Path) -> None:
    """Let the manifest have a file's times as they are now, as if its damage had moved none."""
    value = json.loads(manifest(options).read_text())
    for files in (value["raw"], *(stage["files"] for stage in value["stages"].values())):
        for name, facts in files.items():
            if path.as_posix().endswith(name):
                facts["times"] = [path.stat().st_mtime_ns, path.stat().st_ctime_ns]
    parts = {**value["stages"], "raw": value["raw"]}
    value["seals"] = {name: cache.seal(part) for name, part in parts.items()}
    manifest(options).write_text(json.dumps(value))


def test_file_damaged_while_a_later_stage_runs_is_not_taken_for_the_right_one(
    options: Options,
) -> None:
    validated = table(options, "validate", "validated")
    good = validated.read_text()

    def damage(job: Job) -> None:
        WORK["align"](job)
        (job.inputs["validate"] / "validated.parquet").write_text(good.upper())

    edit(options, "max_age_s = 900", "max_age_s = 901")
    with pytest.raises(DamagedFile, match=r"validated\.parquet changed while align read it"):
        run(options, align=damage)
    heard = Warnings()
    assert run(options, heard).ran == NAMES[1:]
    assert "validated.parquet: damaged or changed since written; made again" in heard.texts[0]

    def damage_beside(job: Job) -> None:
        WORK["estimate"](job)
        table(options, "validate", "validated").write_text(good.upper())

    edit(options, "[score]", "[estimate]\nmethods = []\n[score]")
    run(change(options, only="estimate"), estimate=damage_beside)
    with pytest.raises(DamagedFile, match=r"validated\.parquet: damaged .* run small"):
        run(change(options, only="score"))
    assert "validate" in run(options).ran
    assert run(options).ran == ()


def test_what_descends_from_a_damaged_table_that_comes_out_otherwise_is_made_again(
    options: Options,
) -> None:
    path = table(options, "validate", "validated")
    path.write_text(path.read_text().upper())
    pretend_unchanged(options, path)
    assert run(options).ran == ()

    def otherwise(job: Job) -> None:
        (job.output / "validated.parquet").write_text("other")

    edit(options, "[score]", "[score]\nbuses = 3")
    heard = Warnings()
    assert run(options, heard, validate=otherwise).ran == NAMES[1:]
    assert len(heard.texts) == 1
    assert load(options).older == {}


def test_raw_file_that_changes_while_a_stage_reads_it_gives_no_result(of_user: Options) -> None:
    path = of_user.data_folder / "raw" / "small" / "channels.parquet"

    def disturb(job: Job) -> None:
        WORK["align"](job)
        path.write_text("new")

    edit(of_user, "max_age_s = 900", "max_age_s = 901")
    with pytest.raises(DamagedFile, match=r"channels\.parquet changed while align read it"):
        run(of_user, align=disturb)
    assert run(of_user).ran == NAMES[1:]


def test_raw_file_that_rots_without_a_list_is_found_when_it_is_read_again(
    of_user: Options,
) -> None:
    path = of_user.data_folder / "raw" / "small" / "channels.parquet"
    path.write_text(path.read_text().upper())
    pretend_unchanged(of_user, path)
    assert run(of_user).ran == ()
    edit(of_user, "max_age_s = 900", "max_age_s = 901")
    with pytest.raises(DamagedFile, match=r"although its size and time are.*restore it"):
        run(of_user)
    os.utime(path)
    assert run(of_user).ran == NAMES[1:]


def test_raw_table_read_after_its_folder_was_replaced_is_refused(options: Options) -> None:
    tables = load(options)
    edit(options, "seed = 3", "seed = 4")
    run(options)
    with pytest.raises(TableError, match=r"channels\.parquet is not as it was .* load the case ag"):
        tables["channels"]


def test_damaged_table_is_left_out_by_itself(options: Options) -> None:
    path = table(options, "align", "aligned")
    path.write_text("damaged")
    tables = load(options)
    assert set(tables.older) == {"align"}
    assert "estimated" in tables.files
    with pytest.raises(TableError, match=r"aligned is .*damaged.*`pse run small` brings it"):
        tables["aligned"]
    with pytest.raises(DamagedFile, match=r"aligned\.parquet is not as it was written"):
        load(options, older=True)["aligned"]


def test_tables_exchanged_for_each_other_are_made_again(options: Options) -> None:
    one, two = table(options, "estimate", "estimated"), table(options, "estimate", "steps")
    good = one.read_text()
    one.write_text("of another run")
    two.write_text("of another case")
    assert run(options).ran == ("estimate",)
    assert table(options, "estimate", "estimated").read_text() == good
    assert run(options).ran == ()


def test_changed_inputs_of_the_simulation_make_results_older(
    options: Options, monkeypatch: pytest.MonkeyPatch
) -> None:
    (options.data_folder / "raw" / "load_profiles").mkdir()
    (options.data_folder / "raw" / "load_profiles" / "week.parquet").write_text("other")
    with pytest.raises(TableError, match=r"simulate: profiles/week\.parquet has changed since"):
        load(options)
    assert set(load(options, older=True).older) == set(NAMES)
    assert run(options).ran == ("simulate",)
    assert load(options).older == {}
    monkeypatch.setattr(descent, "SOURCE_ROOT", options.data_folder)
    with pytest.raises(TableError, match=r"simulate: tables/.* is gone since"):
        load(options)


def test_raw_data_that_are_gone_are_named(options: Options, of_user: Options) -> None:
    raw = options.data_folder / "raw" / "small"
    (raw / "channels.parquet").rename(options.data_folder / "away")
    with pytest.raises(TableError, match=r"raw/channels\.parquet is gone since"):
        load(options)
    (raw / "telemetry").mkdir()
    (options.data_folder / "away").rename(raw / "channels.parquet")
    (raw / "telemetry" / "july.parquet").write_text("1")
    with pytest.raises(TableError, match=r"raw/telemetry/july\.parquet is new since"):
        load(options)


def test_simulated_raw_data_that_are_gone_are_named(options: Options) -> None:
    shutil.rmtree(options.data_folder / "raw" / "small")
    with pytest.raises(TableError, match=r"simulate: its raw data are gone"):
        load(options)
    assert run(options).ran == ("simulate",)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something stands in a JSON value."""
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else ()
    for key, inner in items:
        yield from places(inner, (*path, key))


def edited(value: Any, path: tuple[Any, ...], new: object) -> Any:
    whole = copy.deepcopy(value)
    inner = whole
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = new
    return whole


EVERY = 4
"""Of some two hundred places in a manifest one in so many is edited."""

ODD = (None, [], {}, 7, 0.5, "x", "\0", "\ud800", "../..", True, float("inf"), 10**400)


@pytest.mark.parametrize("place", ["processed/small/manifest.json", "raw/small/simulated.json"])
def test_edited_list_of_ours_makes_no_dead_end_and_no_other_result(
    options: Options, place: str
) -> None:
    path = options.data_folder / place
    good = json.loads(path.read_text())
    before = load(options)
    tables = {name: file.read_bytes() for name, file in before.files.items()}
    for number, where in enumerate([*places(good)][::EVERY]):
        path.write_text(json.dumps(edited(good, where, ODD[number % len(ODD)])))
        run(options)
        after = load(options)
        assert after.older == {}
        assert {name: file.read_bytes() for name, file in after.files.items()} == tables
        assert after.summary == before.summary
        assert run(options).ran == ()


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "utf-32"])
def test_manifest_in_another_encoding_is_made_again(options: Options, encoding: str) -> None:
    path = manifest(options)
    path.write_text(path.read_text(), encoding=encoding)
    assert run(options).ran == NAMES[1:]
    assert run(options).ran == ()


def test_edited_list_of_checksums_is_refused_and_force_mends_it(options: Options) -> None:
    path = options.data_folder / "raw" / "small" / "checksums.json"
    good = json.loads(path.read_text())
    name = "channels.parquet"
    for bad in (
        edited(good, ("files", name, "bytes"), -1),
        edited(good, ("files", "\0"), good["files"][name]),
        edited(good, ("files", "../../mine"), good["files"][name]),
        edited(good, ("files",), {}),
    ):
        path.write_text(json.dumps(bad))
        with pytest.raises(cache.CacheError, match="not as the simulation wrote it: --force"):
            run(options)
        assert run(change(options, force=True)).ran == NAMES
        assert [p.name for p in (options.data_folder / "raw").iterdir()] == ["small"]


def test_names_of_files_need_not_be_utf8(of_user: Options) -> None:
    folder = of_user.data_folder / "raw" / "small" / "telemetry"
    folder.mkdir()
    Path(os.fsdecode(os.fsencode(folder) + b"/\xff.parquet")).write_text("1")
    assert run(of_user).ran == ("validate",)
    assert run(of_user).ran == ()


def test_copy_of_the_project_stays_cached(options: Options, tmp_path: Path) -> None:
    target = tmp_path / "copy"
    shutil.copytree(options.data_folder, target, copy_function=shutil.copyfile)
    heard = Warnings()
    assert run(change(options, data=target), heard).ran == ()
    assert heard.texts == []
    assert run(change(options, data=target)).ran == ()
