"""Claim: a disk that takes no more ends a run with the remedy, and loses nothing that was there."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from small_case import Place

from pse_analysis import pipeline
from pse_analysis.errors import StorageError
from pse_analysis.pipeline import cli, runner, space
from pse_analysis.pipeline.plan import NAMES

NOBODY = 65534


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size, in bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def assert_old_results_stand(place: Place, before: dict[str, str]) -> None:
    assert place.leftovers() == []
    assert place.digests() == before
    tables = pipeline.load("small", data=place.data, cases=place.folder / "cases", older=True)
    assert len(tables["scored"]) > 0


def size_of(whole: Place, name: str) -> int:
    return next(p for p in whole.data.rglob(name)).stat().st_size


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("checksums.json", 0.0),
        ("part-0.parquet", 0.5),
        ("validated.parquet", 0.9),
        ("validate.rrd", 0.5),
        ("validate.rrd", 0.99),
        ("align.rrd", 0.99),
    ],
)
def test_file_that_may_not_grow_to_its_size_ends_the_run_with_the_remedy(
    whole: Place, place: Place, capsys: pytest.CaptureFixture[str], name: str, share: float
) -> None:
    before = place.digests()
    limit = int(share * size_of(whole, name))
    with files_up_to(limit):
        code = cli.main([*place.arguments, "--force"])
    said = capsys.readouterr().err
    assert code == 1
    assert "File too large" in said
    assert "raise the limit (ulimit -f) and run again" in said
    assert "bug" not in said
    assert place.leftovers() == []
    tables = pipeline.load("small", data=place.data, cases=place.folder / "cases")
    assert len(tables["scored"]) > 0
    result = runner.run("small", place.options)
    assert set(result.ran) | set(result.cached) == set(NAMES)
    assert place.digests() == before


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """File systems in memory of a given size, in bytes; skips where this user may mount none."""
    mounted: list[Path] = []

    def mount(size: int) -> Path:
        folder = tmp_path / f"disk{len(mounted)}"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            pytest.skip("no program mount: a small disk cannot be made")
        if done.returncode != 0:
            pytest.skip(f"this user may not mount a small disk: {done.stderr.strip()}")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("room", [20_000, 150_000, 400_000, 600_000])
def test_full_disk_ends_the_run_with_the_remedy_and_the_next_one_is_right(
    whole: Place,
    small_disk: Callable[[int], Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    room: int,
) -> None:
    # Whoever fills the disk after the stage began: what is asked before finds room enough.
    monkeypatch.setattr(space, "require", lambda *_: None)
    held = sum(p.stat().st_size for p in whole.folder.rglob("*") if p.is_file())
    disk = small_disk(held + 2_000_000)
    shutil.copytree(whole.folder, disk / "place")
    place = Place(disk / "place")
    before = place.digests()
    free = shutil.disk_usage(disk).free
    (disk / "ballast").write_bytes(b"x" * max(0, free - room))
    code = cli.main([*place.arguments, "--force"])
    said = capsys.readouterr().err
    assert code == 1
    assert "No space left on device" in said
    assert "MB are free there: free some space and run again" in said
    assert "bug" not in said
    assert place.leftovers() == []
    assert place.digests() == before
    (disk / "ballast").unlink()
    result = runner.run("small", place.options)
    assert set(result.ran) | set(result.cached) == set(NAMES)
    assert place.digests() == before


def test_disk_without_room_for_the_next_stage_is_refused_before_it_begins(
    whole: Place,
    small_disk: Callable[[int], Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    held = sum(p.stat().st_size for p in whole.folder.rglob("*") if p.is_file())
    disk = small_disk(held + 2_000_000)
    shutil.copytree(whole.folder, disk / "place")
    place = Place(disk / "place")
    place.change()
    before = place.digests()
    (disk / "ballast").write_bytes(b"x" * (shutil.disk_usage(disk).free - 300_000))
    assert cli.main(place.arguments) == 1
    said = capsys.readouterr().err
    assert "validate of case 'small' will write at least 0.6 MB to" in said
    assert "where 0.3 MB are free: free some space" in said
    assert_old_results_stand(place, before)


class TestSpace:
    """What a stage will at least write, by hand."""

    LAST = {"a.parquet": {"bytes": 1000}, "b.rrd": {"bytes": 500}}  # noqa: RUF012
    RAW = {"x": {"bytes": 10_000}, "y": {"bytes": 10_000}}  # noqa: RUF012

    def test_last_result_tells_it(self) -> None:
        assert space.needed("validate", self.LAST, self.RAW) == 1350
        assert space.needed("estimate", self.LAST, self.RAW) == 2250

    def test_raw_folder_tells_it_where_there_is_no_result(self) -> None:
        assert space.needed("validate", {}, self.RAW) == 22_000
        assert space.needed("simulate", {}, {}) == 0

    def test_more_than_is_free_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(StorageError, match=r"the stage will write at least .* MB are free"):
            space.require(tmp_path / "not" / "there", 10**18, "the stage")

    def test_less_than_is_free_is_not(self, tmp_path: Path) -> None:
        space.require(tmp_path / "not" / "there", 1, "the stage")
        assert not (tmp_path / "not").exists()

    def test_small_case_needs_about_what_it_needed(self, whole: Place) -> None:
        raw = runner.Store(whole.processed).raw_files()
        for stage, entry in runner.Store(whole.processed).entries().items():
            size = sum(facts["bytes"] for facts in entry.files.values())
            assert space.needed(stage, {}, raw) <= size


def without_privileges() -> Sequence[str]:
    """A prefix under which root, too, may only write where the folder's mode says so."""
    if os.geteuid() != 0:
        return ()
    if shutil.which("setpriv") is None:
        pytest.skip("root may write everywhere, and there is no setpriv to take that away")
    lost = "-dac_override,-dac_read_search,-fowner"
    return ("setpriv", f"--bounding-set={lost}", f"--inh-caps={lost}")


@contextmanager
def modes(folder: Path, change: Callable[[Path], None]) -> Iterator[None]:
    """Change a folder and all below; afterwards its owner may write to it again."""
    paths = [folder, *folder.rglob("*")]
    for path in reversed(paths):
        change(path)
    try:
        yield
    finally:
        for path in paths:
            if os.geteuid() == 0:
                os.chown(path, 0, 0)
            path.chmod(0o755 if path.is_dir() else 0o644)


def read_only(path: Path) -> None:
    path.chmod(0o555 if path.is_dir() else 0o444)


def test_current_case_in_a_read_only_folder_is_shown(place: Place) -> None:
    with modes(place.data, read_only):
        done = place.run(prefix=without_privileges())
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(" cached\n") == len(NAMES)


def test_stage_that_would_write_to_a_read_only_folder_is_refused(place: Place) -> None:
    before = place.digests()
    place.change()
    with modes(place.data, read_only):
        done = place.run(prefix=without_privileges())
    assert done.returncode == 1
    assert "cannot be written to: make it writable, or name another folder" in done.stderr
    assert_old_results_stand(place, before)


@pytest.mark.parametrize("mode", [0o755, 0o700])
def test_folder_of_another_user_is_an_error_with_the_remedy(place: Place, mode: int) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give a folder to another user")

    def give(path: Path) -> None:
        os.chown(path, NOBODY, NOBODY)
        path.chmod(mode if path.is_dir() else mode & 0o644)

    before = place.digests()
    place.change()
    with modes(place.data, give):
        done = place.run(prefix=without_privileges())
    assert done.returncode == 1
    assert "--data" in done.stderr
    assert "bug" not in done.stderr
    assert "Traceback" not in done.stderr
    assert_old_results_stand(place, before)
