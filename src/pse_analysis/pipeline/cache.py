"""The stage cache: results that are either whole and current, or not there.

A stage writes its folder under a temporary name, flushes it, renames it to its fingerprint and
then replaces ``manifest.json``, which alone says what is current. Killed at any instant, the next
run finds the old result or the new one. Standard library only.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pse_analysis.errors import PseError
from pse_analysis.pipeline.fingerprint import canonical, describe_folder

MANIFEST = "manifest.json"
MARKER = "simulated.json"


class CacheError(PseError, RuntimeError):
    """Stored results or raw data are in a state that a run must not touch."""


def flush(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def flush_folder(folder: Path) -> None:
    """Bring a whole folder to the disk: its files first, then the names that lead to them."""
    for root, _, names in os.walk(folder, topdown=False):
        for name in names:
            flush(Path(root, name))
        flush(Path(root))


def write_json(path: Path, value: object) -> None:
    """Replace a JSON file as a whole: readers see the old text or the new one."""
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    text = json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False)
    temporary.write_text(text + "\n", encoding="utf-8")
    flush(temporary)
    os.replace(temporary, path)
    flush(path.parent)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; an empty one if the file is missing or damaged."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


@contextmanager
def lock(folder: Path, case: str) -> Iterator[None]:
    """Hold the case for this process; the kernel lets go of it when the process ends.

    Raises
    ------
    CacheError
        If another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            owner = file.read().strip() or "unknown"
            raise CacheError(
                f"case {case!r} is being run by another process (pid {owner}): wait until it ends "
                "or stop it; two runners of one case would overwrite each other"
            ) from error
        file.seek(0)
        file.truncate()
        file.write(str(os.getpid()))
        file.flush()
        yield


@dataclass(frozen=True)
class Entry:
    """What the manifest says about one stage.

    Attributes
    ----------
    folder : Path
        Where its files are.
    fingerprint : str
        Of the run that made them.
    files : mapping
        Size and digest of each file by name, ``{"bytes": …, "digest": …}``.
    seconds : float
        How long it took. [s]
    """

    folder: Path
    fingerprint: str
    files: Mapping[str, Mapping[str, Any]]
    seconds: float

    def whole(self) -> bool:
        """Whether every file is there with the size it was written with."""
        for name, facts in self.files.items():
            try:
                if (self.folder / name).stat().st_size != facts["bytes"]:
                    return False
            except OSError:
                return False
        return True


@dataclass(frozen=True)
class Store:
    """Processed results of one case: ``folder/manifest.json`` and ``folder/<stage>/…``."""

    folder: Path

    def entries(self) -> Mapping[str, Entry]:
        """Stages that the manifest names; one it cannot make sense of is left out."""
        stages = read_json(self.folder / MANIFEST).get("stages", {})
        found = {}
        for stage, facts in stages.items():
            try:
                found[stage] = Entry(
                    folder=self.folder / stage / facts["folder"],
                    fingerprint=facts["fingerprint"],
                    files=facts["files"],
                    seconds=facts["seconds"],
                )
            except (KeyError, TypeError):
                continue
        return MappingProxyType(found)

    def entry(self, stage: str) -> Entry | None:
        """The stage's current result, if it has a whole one."""
        entry = self.entries().get(stage)
        return entry if entry is not None and entry.whole() else None

    def begin(self, stage: str, fingerprint: str) -> Path:
        """Make an empty folder for the stage to write to."""
        temporary = self.folder / stage / f".{fingerprint}.tmp-{os.getpid()}"
        if temporary.exists():
            shutil.rmtree(temporary)
        temporary.mkdir(parents=True)
        return temporary

    def publish(self, stage: str, fingerprint: str, temporary: Path, seconds: float) -> Entry:
        """Make a written folder the stage's current result, then remove what it replaces."""
        files = describe_folder(temporary)
        flush_folder(temporary)
        final = self.folder / stage / fingerprint
        current = self.entries().get(stage)
        if current is not None and current.folder == final:
            # A forced run repeats a fingerprint: the current folder must stay until the manifest
            # no longer names it.
            final = final.with_name(f"{fingerprint}-again")
        if final.exists():
            shutil.rmtree(final)
        os.rename(temporary, final)
        flush(final.parent)
        manifest = read_json(self.folder / MANIFEST)
        stages = dict(manifest.get("stages", {}))
        stages[stage] = {
            "fingerprint": fingerprint,
            "folder": final.name,
            "files": files,
            "seconds": round(seconds, 3),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        write_json(self.folder / MANIFEST, {"version": 1, "stages": stages})
        self.prune()
        return Entry(final, fingerprint, MappingProxyType(files), seconds)

    def prune(self) -> None:
        """Remove folders that the manifest does not name, those of interrupted runs included.

        Call it under the case's `lock` only: otherwise a temporary folder may be another run's.
        """
        kept = {entry.folder for entry in self.entries().values()}
        if not self.folder.is_dir():
            return
        for path in self.folder.glob(f".{MANIFEST}.tmp-*"):
            path.unlink()
        for stage in self.folder.iterdir():
            if stage.is_dir():
                for path in stage.iterdir():
                    if path.is_dir() and path not in kept:
                        shutil.rmtree(path)


@dataclass(frozen=True)
class RawFolder:
    """The raw folder of a case; one that a simulation made carries ``simulated.json``.

    A folder without that marker belongs to the user and is never written to.
    """

    folder: Path

    @property
    def _old(self) -> Path:
        return self.folder.with_name(f".{self.folder.name}.old")

    @property
    def occupied(self) -> bool:
        """Whether it is there and holds anything."""
        return self.folder.is_dir() and any(self.folder.iterdir())

    def recover(self) -> None:
        """Finish or undo a swap that was interrupted; call it under the case's `lock`."""
        if self._old.exists():
            if self.folder.exists():
                shutil.rmtree(self._old)
            else:
                os.rename(self._old, self.folder)
        for path in self.folder.parent.glob(f".{self.folder.name}.tmp-*"):
            shutil.rmtree(path)

    def describe(self) -> dict[str, dict[str, Any]]:
        """Size and digest of its files, read for real: users edit raw data."""
        files = describe_folder(self.folder)
        files.pop(MARKER, None)
        return files

    def marker(self) -> Mapping[str, Any] | None:
        """What the simulation noted about itself; None if it did not make this folder."""
        path = self.folder / MARKER
        return read_json(path) if path.is_file() else None

    def changed(self, files: Mapping[str, Mapping[str, Any]]) -> str | None:
        """First file that is not as the simulation wrote it; None if there is none."""
        marker = self.marker() or {}
        written = marker.get("files", {})
        for name in sorted(set(written) | set(files)):
            if canonical(written.get(name)) != canonical(files.get(name)):
                return name
        return None

    def begin(self) -> Path:
        """Make an empty sibling folder for the simulation to write to."""
        temporary = self.folder.with_name(f".{self.folder.name}.tmp-{os.getpid()}")
        if temporary.exists():
            shutil.rmtree(temporary)
        temporary.mkdir(parents=True)
        return temporary

    def publish(self, fingerprint: str, temporary: Path, seconds: float) -> None:
        """Swap a written folder in by two renames; `recover` knows how to finish them."""
        if self.occupied and self.marker() is None:
            raise CacheError(foreign(self.folder))
        marker = {
            "fingerprint": fingerprint,
            "files": describe_folder(temporary),
            "seconds": round(seconds, 3),
        }
        write_json(temporary / MARKER, marker)
        flush_folder(temporary)
        if self.folder.exists():
            os.rename(self.folder, self._old)
        os.rename(temporary, self.folder)
        flush(self.folder.parent)
        if self._old.exists():
            shutil.rmtree(self._old)


def foreign(folder: Path) -> str:
    """Why a simulation leaves a raw folder alone, and what to do."""
    return (
        f"{folder} was not made by a simulation (it has no {MARKER}), so it is not overwritten: "
        "move it away to simulate the case, or remove grid and [simulate] from the case file to "
        "use it"
    )
