"""Claim: no file that the program did not write is removed, changed or followed, whatever runs."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from fake_work import WORK, edit, prepare

from pse_analysis.pipeline import cli, runner
from pse_analysis.pipeline.plan import NAMES, Options

RUN = runner.run
GONE = 4194305
"""Larger than any number of a process."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        RUN("small", prepare(folder, patch), work=WORK)
    (folder / "outside").mkdir()
    (folder / "outside" / "mine.parquet").write_text("outside")
    return folder


@pytest.fixture
def options(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Options:
    """A copy of that run."""
    options = prepare(tmp_path, monkeypatch)
    monkeypatch.setattr(runner, "run", lambda n, o, r: RUN(n, o, r, work=WORK))
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    return options


def pse(options: Options, *arguments: str) -> int:
    where = ["--data", str(options.data), "--cases", str(options.cases)]
    return cli.main([arguments[0], "small", *arguments[1:], *where])


def file(path: Path) -> None:
    path.write_text("mine")


def folder(path: Path) -> None:
    path.mkdir()
    (path / "inside.txt").write_text("mine")


def link(path: Path) -> None:
    path.symlink_to(path.parents[len(path.parents) - 2] / "nowhere")


def hard(path: Path) -> None:
    os.link(outside(path), path)


def linked_folder(path: Path) -> None:
    path.symlink_to(outside(path).parent)


def circle(path: Path) -> None:
    path.symlink_to(path.name)


def outside(path: Path) -> Path:
    root = next(parent for parent in path.parents if (parent / "outside").is_dir())
    return root / "outside" / "mine.parquet"


KINDS: tuple[Callable[[Path], None], ...] = (
    file,
    folder,
    Path.mkdir,
    link,
    hard,
    linked_folder,
    circle,
    os.mkfifo,
)


def state(path: Path) -> object:
    """What can be seen of a file, folder, link or pipe without opening what is none."""
    if not os.path.lexists(path):
        return None
    mode = path.lstat().st_mode
    if stat.S_ISLNK(mode):
        return os.readlink(path)
    if stat.S_ISDIR(mode):
        return {p.name: state(p) for p in path.iterdir()}
    return path.read_bytes() if stat.S_ISREG(mode) else mode


def current(options: Options, stage: str) -> Path:
    """Folder of a stage's current result."""
    (found,) = (options.data_folder / "processed" / "small" / stage).glob("?" * 20)
    return found


@pytest.mark.parametrize("make", KINDS, ids=lambda make: make.__name__)
def test_bystanders_stay_as_they_are(options: Options, make: Callable[[Path], None]) -> None:
    data = options.data_folder
    raw, processed = data / "raw" / "small", data / "processed" / "small"
    align = current(options, "align")
    (raw / "telemetry").mkdir()
    bystanders = [
        *(data / name for name in ("notes", "raw/notes", "raw/.small.old", "raw/small.old")),
        data / "raw" / f".other.tmp-{GONE}",
        *(raw / name for name in ("june", ".hidden", "mine.parquet", "telemetry/notes.txt")),
        *(processed / name for name in ("june", ".hidden", "simulate", "mine.parquet")),
        *(processed / "align" / name for name in ("june", ".hidden", f".x.tmp-{GONE}")),
        *(align / name for name in ("june", "mine.parquet", "scored.parquet", "other.rrd")),
        current(options, "score") / "notes.txt",
    ]
    for path in bystanders:
        make(path)
    before = [state(path) for path in (*bystanders, options.data_folder.parent / "outside")]
    assert pse(options, "run") == 0
    edit(options, "seed = 3", "seed = 4")
    for arguments in ((), ("--force",), ("--until", "align"), ("--only", "score", "--force")):
        assert pse(options, "run", *arguments) == 0
    assert pse(options, "verify") in (0, 1)
    after = [state(path) for path in (*bystanders, options.data_folder.parent / "outside")]
    assert after == before


SHAPED = (
    "raw/.small.tmp-{gone}",
    "processed/small/.manifest.json.tmp-{gone}",
    "processed/small/.manifest.json.tmp-{here}",
    "processed/small/align/.{fingerprint}.tmp-{here}",
    "processed/small/align/{fingerprint}-2",
    "raw/small.kept",
    "raw/.small.tmp-{here}",
)


@pytest.mark.parametrize("make", [folder, linked_folder, circle, os.mkfifo])
def test_what_only_has_a_name_like_ours_is_no_dead_end(
    options: Options, make: Callable[[Path], None]
) -> None:
    values = {"gone": GONE, "here": os.getpid(), "fingerprint": current(options, "align").name}
    paths = [options.data_folder / name.format(**values) for name in SHAPED]
    for path in paths:
        make(path)
    before = [state(path) for path in (*paths, outside(paths[0]).parent)]
    for arguments in ((), ("--force",)):
        assert pse(options, "run", *arguments) == 0
    assert [state(path) for path in (*paths, outside(paths[0]).parent)] == before


@pytest.mark.parametrize("make", [folder, linked_folder, os.mkfifo])
@pytest.mark.parametrize(
    "place", ["processed/small/manifest.json", "processed/small/.lock", "processed/small/align"]
)
def test_what_stands_in_the_place_of_ours_is_refused_and_not_touched(
    options: Options,
    place: str,
    make: Callable[[Path], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = options.data_folder / place
    path.rename(options.data_folder / "away")
    make(path)
    before = [state(path), state(outside(path).parent)]
    for arguments in (("run",), ("verify",)):
        code = pse(options, *arguments)
        told = capsys.readouterr()
        if arguments[0] == "run" and not (place.endswith("align") and make is folder):
            assert code == 1
            assert "move it away" in told.err
        assert "bug" not in told.err
        if not place.endswith("align") or make is not folder:
            assert [state(path), state(outside(path).parent)] == before
    if path.is_dir() and not path.is_symlink():
        assert (path / "inside.txt").read_text() == "mine"
        (path / "inside.txt").unlink()
        if not place.endswith("align"):
            path.rmdir()
    else:
        path.unlink()
    assert pse(options, "run") == 0


@pytest.mark.parametrize("make", [file, circle])
@pytest.mark.parametrize("place", ["", "raw", "raw/small", "processed", "processed/small"])
def test_what_is_no_folder_where_data_belong_is_named(
    options: Options,
    place: str,
    make: Callable[[Path], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = options.data_folder / place
    path.rename(path.parent / "away")
    make(path)
    before = state(path)
    assert pse(options, "run") == 1
    text = capsys.readouterr().err
    assert "bug" not in text
    assert "move it away" in text or "--data DIR" in text or "leads back to itself" in text
    assert state(path) == before


def test_file_of_the_user_among_raw_tables_is_kept_with_a_warning(
    options: Options, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = options.data_folder / "raw" / "small"
    (raw / "telemetry" / "june").mkdir(parents=True)
    (raw / "telemetry" / "june" / "more.parquet").write_text("mine")
    (raw / "telemetry" / "notes.txt").write_text("notes")
    assert pse(options, "run") == 1
    assert "more.parquet is not as the simulation wrote it: --force" in capsys.readouterr().err
    assert pse(options, "run", "--force") == 0
    assert "had not written" in capsys.readouterr().err
    kept = options.data_folder / "raw" / "small.kept" / "telemetry" / "june" / "more.parquet"
    assert kept.read_text() == "mine"
    assert (raw / "telemetry" / "notes.txt").read_text() == "notes"
    assert pse(options, "run") == 0


def test_backup_beside_the_raw_folder_stays(options: Options) -> None:
    raw = options.data_folder / "raw" / "small"
    backup = raw.with_name(".small.old")
    subprocess.run(["cp", "-a", str(raw), str(backup)], check=True)
    before = state(backup)
    edit(options, "seed = 3", "seed = 4")
    assert pse(options, "run") == 0
    assert state(backup) == before


def test_raw_folder_may_be_a_link_to_a_place_that_is_not_there_yet(options: Options) -> None:
    raw = options.data_folder / "raw" / "small"
    raw.rename(raw.with_name("away"))
    raw.symlink_to("../../outside/new/small")
    for arguments in ((), ("--force",), ()):
        assert pse(options, "run", *arguments) == 0
    assert raw.is_symlink()
    assert {p.name for p in (raw.parent / os.readlink(raw)).parent.iterdir()} == {"small"}


def test_two_cases_may_share_one_raw_folder_in_turns(options: Options) -> None:
    assert options.cases is not None
    text = (options.cases / "small.toml").read_text(encoding="utf-8")
    (options.cases / "other.toml").write_text(text.replace("seed = 3", "seed = 5"))
    raw = options.data_folder / "raw"
    (raw / "other").symlink_to("small")
    assert RUN("other", options, work=WORK).ran == NAMES
    assert RUN("other", options, work=WORK).ran == ()
    assert RUN("small", options, work=WORK).ran == ("simulate",)
    assert (raw / "other").is_symlink()


class TestReadOnly:
    """A folder that cannot be written to shows what is current in it, and says what else is."""

    CODE = (
        "import os, sys\n"
        "from fake_work import WORK\n"
        "from pse_analysis.pipeline import cli, runner\n"
        # What root imports, another user may not be able to.
        "if os.geteuid() == 0: os.setgid(65534); os.setuid(65534)\n"
        "runner.code = lambda stage: {'module': stage.module}\n"
        "run = runner.run\n"
        "runner.run = lambda n, o, r: run(n, o, r, work=WORK)\n"
        "sys.exit(cli.main(sys.argv[1:]))"
    )

    def pse(self, options: Options, *arguments: str) -> subprocess.CompletedProcess[str]:
        where = ["--data", str(options.data), "--cases", str(options.cases)]
        return subprocess.run(
            [sys.executable, "-c", self.CODE, arguments[0], "small", *arguments[1:], *where],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
            check=False,
        )

    @pytest.fixture
    def sealed(self, options: Options) -> Options:
        """The data folder without leave to write, its files with leave to read."""
        root = options.data_folder.parent
        for path in (root, *root.parents[:3]):
            path.chmod(path.stat().st_mode | 0o055)
        for path in options.data_folder.rglob("*"):
            path.chmod(0o555 if path.is_dir() else 0o444)
        options.data_folder.chmod(0o555)
        return options

    def test_what_is_current_is_shown(self, sealed: Options) -> None:
        done = self.pse(sealed, "run")
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.count("cached") == len(NAMES)
        assert "all is well" in done.stdout

    @pytest.mark.parametrize("arguments", [("--force",), ("--only", "align", "--force")])
    def test_what_would_have_to_run_is_named(
        self, sealed: Options, arguments: tuple[str, ...]
    ) -> None:
        done = self.pse(sealed, "run", *arguments)
        assert done.returncode == 1
        assert "cannot be written to: make it writable, or name another folder" in done.stderr

    def test_damage_there_is_named(self, sealed: Options) -> None:
        path = current(sealed, "align") / "aligned.parquet"
        path.chmod(0o644)
        path.write_text("other")
        path.chmod(0o444)
        done = self.pse(sealed, "run")
        assert done.returncode == 1
        assert "aligned.parquet: damaged or changed since written: `pse run small`" in done.stderr

    def test_what_may_not_be_read_is_named(self, sealed: Options) -> None:
        path = sealed.data_folder / "processed" / "small" / "manifest.json"
        path.chmod(0o000)
        done = self.pse(sealed, "run")
        assert done.returncode == 1
        assert "manifest.json cannot be read (Permission denied)" in done.stderr

    def test_raw_data_that_may_not_be_read_are_not_left_out(self, sealed: Options) -> None:
        raw = sealed.data_folder / "raw" / "small"
        raw.chmod(0o755)
        (raw / "telemetry" / "source=a").mkdir(parents=True)
        (raw / "telemetry" / "source=a" / "more.parquet").write_text("1")
        (raw / "telemetry" / "source=a").chmod(0o000)
        for command in ("run", "verify"):
            done = self.pse(sealed, command)
            assert done.returncode == 1
            assert re.search(r"source=a\b.*Permission denied", done.stdout + done.stderr)
