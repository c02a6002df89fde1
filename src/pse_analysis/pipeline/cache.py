"""The stage cache: results that are either whole and current, or not there.

A stage writes its folder under a temporary name, flushes it, renames it to its fingerprint and
then replaces ``manifest.json``, which alone says what is current. Killed at any instant, the next
run finds the old result or the new one. Whatever the program did not write stays where it is, and
links are never followed. Standard library only.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pse_analysis.errors import PseError
from pse_analysis.files import (
    Facts,
    describe_folder,
    flush,
    flush_folder,
    is_facts,
    is_orphan,
    read_json,
    remove_own,
    unchanged,
    write_json,
)

MANIFEST = "manifest.json"
VERSION = 2

STAGES = ("validate", "align", "estimate", "score")
"""Stages that have a folder of their own below that of the case."""

_FOLDER = re.compile(r"[0-9a-f]{20}(-\d+)?")
_TEMPORARY = re.compile(r"\.[0-9a-f]{20}\.tmp-\d+")
_OWN = re.compile(r"[a-z_]+(-\d+-\d+)?\.parquet|(validate|align|estimate|score)\.rrd|summary\.txt")
READ_ONLY = (errno.EROFS, errno.EACCES, errno.EPERM)


class CacheError(PseError, RuntimeError):
    """Stored results or raw data are in a state that a run must not touch."""


@contextmanager
def lock(folder: Path, case: str) -> Iterator[bool]:
    """Hold the case for this process; the kernel lets go of it when the process ends.

    Yields
    ------
    bool
        Whether the folder can be written to. One that cannot needs no lock: a run may still show
        what is current in it.

    Raises
    ------
    CacheError
        If another process holds it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise CacheError(
                f"{folder / '.lock'} is a symbolic link, expected a file of this program: remove it"
            ) from error
        if error.errno not in READ_ONLY or not folder.is_dir():
            raise
        yield False
        return
    with os.fdopen(handle, "r+", encoding="utf-8", errors="replace") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = file.read(20).strip() or "unknown"
            raise CacheError(
                f"case {case!r} is being run by another process (pid {owner}): wait until it ends "
                "or stop it; two runners of one case would overwrite each other"
            ) from error
        # A file with another name elsewhere is not only ours to write to.
        if os.fstat(file.fileno()).st_nlink == 1:
            file.truncate()
            file.write(str(os.getpid()))
            file.flush()
        yield True


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
        Description of each file by name, `pse_analysis.files.describe`.
    seconds : float
        How long it took. [s]
    parameters : mapping
        What it read of the case file, as canonical JSON by key.
    inputs : mapping
        Digest of the content of every file it read, by name.
    """

    folder: Path
    fingerprint: str
    files: Mapping[str, Facts]
    seconds: float
    parameters: Mapping[str, str]
    inputs: Mapping[str, str]

    def damaged(self, *, thorough: bool = False) -> tuple[str, ...]:
        """Files that are not as they were written.

        Parameters
        ----------
        thorough
            Compare digests although sizes and times agree.
        """
        return tuple(
            name
            for name, facts in self.files.items()
            if not unchanged(self.folder / name, facts, thorough=thorough)
        )


def _entry(folder: Path, facts: Any) -> Entry | None:
    """An entry from the manifest; None if it does not have the form that this program writes."""
    if not isinstance(facts, dict):
        return None
    place, fingerprint, seconds = (facts.get(key) for key in ("folder", "fingerprint", "seconds"))
    if (
        not isinstance(place, str)
        or not isinstance(fingerprint, str)
        or not isinstance(seconds, int | float)
        or _FOLDER.fullmatch(place) is None
        or (folder / place).is_symlink()
    ):
        return None
    parameters, inputs = _texts(facts.get("parameters")), _texts(facts.get("inputs"))
    files = _files(facts.get("files"))
    if parameters is None or inputs is None or files is None or not all(map(_is_own, files)):
        return None
    return Entry(folder / place, fingerprint, files, float(seconds), parameters, inputs)


def _texts(value: Any) -> Mapping[str, str] | None:
    valid = isinstance(value, dict) and all(isinstance(text, str) for text in value.values())
    return MappingProxyType(value) if valid else None


def _files(value: Any) -> Mapping[str, Facts] | None:
    valid = isinstance(value, dict) and all(map(is_facts, value.values()))
    return MappingProxyType(value) if valid else None


@dataclass(frozen=True)
class Store:
    """Processed results of one case: ``folder/manifest.json`` and ``folder/<stage>/…``."""

    folder: Path

    def _stages(self) -> dict[str, Any]:
        stages = read_json(self.folder / MANIFEST).get("stages")
        return dict(stages) if isinstance(stages, dict) else {}

    def entries(self) -> Mapping[str, Entry]:
        """Stages that the manifest names; one it cannot make sense of is left out."""
        stages = self._stages()
        found = {s: _entry(self.folder / s, stages[s]) for s in STAGES if s in stages}
        return MappingProxyType({s: entry for s, entry in found.items() if entry is not None})

    def raw_files(self) -> Mapping[str, Facts]:
        """Files of the raw folder as the last run described them."""
        return _files(read_json(self.folder / MANIFEST).get("raw")) or MappingProxyType({})

    def begin(self, stage: str, fingerprint: str) -> Path:
        """Make an empty folder for the stage to write to."""
        temporary = self.folder / stage / f".{fingerprint}.tmp-{os.getpid()}"
        remove_own(temporary, _is_own)
        temporary.mkdir(parents=True)
        return temporary

    def publish(self, stage: str, entry: Entry) -> Entry:
        """Make a written folder the stage's current result, then remove what it replaces.

        Parameters
        ----------
        stage
            Its name.
        entry
            The result, with the folder of `begin`; its files are described here.
        """
        flush_folder(entry.folder)
        files = describe_folder(entry.folder)
        final = self._free(stage, entry.fingerprint)
        os.rename(entry.folder, final)
        flush(final.parent)
        self._write({stage: _facts(entry, final.name, files)})
        self.prune()
        return Entry(**{**vars(entry), "folder": final, "files": MappingProxyType(files)})

    def _free(self, stage: str, fingerprint: str) -> Path:
        """Return a folder that is not there yet.

        A forced run repeats a fingerprint, and the current folder must stay until the manifest no
        longer names it.
        """
        final, number = self.folder / stage / fingerprint, 1
        while os.path.lexists(final):
            number += 1
            final = final.with_name(f"{fingerprint}-{number}")
        return final

    def _write(self, stages: Mapping[str, Any], raw: Mapping[str, Facts] | None = None) -> None:
        known = {name: facts for name, facts in self._stages().items() if name in STAGES}
        files = self.raw_files() if raw is None else raw
        value = {"version": VERSION, "raw": dict(files), "stages": {**known, **stages}}
        write_json(self.folder / MANIFEST, value)

    def note(self, raw: Mapping[str, Facts], entries: Mapping[str, Entry]) -> None:
        """Keep sizes and times of files just compared, so that the next look need not read them.

        Parameters
        ----------
        raw
            Files of the raw folder.
        entries
            Stages whose files are as they were written.
        """
        stages = self._stages()
        changed = dict(raw) != dict(self.raw_files())
        for stage, entry in entries.items():
            files = describe_folder(entry.folder, entry.files)
            kept = {name: files.get(name, facts) for name, facts in entry.files.items()}
            changed |= kept != dict(entry.files)
            stages[stage] = {**stages[stage], "files": kept}
        if changed:
            self._write(stages, raw)

    def prune(self) -> None:
        """Remove results that the manifest does not name, those of interrupted runs included.

        Only files and folders with the names that this program gives are removed. Call it under
        the case's `lock` only: otherwise a temporary folder may be another run's.
        """
        kept = {entry.folder for entry in self.entries().values()}
        for path in self.folder.glob(f".{MANIFEST}.tmp-*"):
            if is_orphan(path) and not path.is_symlink():
                path.unlink()
        for stage in STAGES:
            folder = self.folder / stage
            if folder.is_symlink() or not folder.is_dir():
                continue
            for path in folder.iterdir():
                shaped = _FOLDER.fullmatch(path.name) or _TEMPORARY.fullmatch(path.name)
                if shaped and path not in kept:
                    remove_own(path, _is_own)


def _is_own(name: str) -> bool:
    return _OWN.fullmatch(name) is not None


def _facts(entry: Entry, folder: str, files: Mapping[str, Facts]) -> dict[str, Any]:
    return {
        "fingerprint": entry.fingerprint,
        "folder": folder,
        "files": dict(files),
        "seconds": round(entry.seconds, 3),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "parameters": dict(entry.parameters),
        "inputs": dict(entry.inputs),
    }
