"""The stage cache: results that are either whole and current, or not there.

A stage writes its folder under a temporary name, flushes it, renames it to its fingerprint and
then replaces ``manifest.json``, which alone says what is current. Killed at any instant, the next
run finds the old result or the new one. Whatever the program did not write stays where it is, and
links are never followed. Standard library only.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pse_analysis.errors import PseError
from pse_analysis.files import (
    DIGEST_BYTES,
    Facts,
    describe_folder,
    flush,
    flush_folder,
    is_facts,
    read_json,
    refresh,
    refuse_foreign,
    unchanged,
    write_json,
)
from pse_analysis.leftovers import free, orphans, remove_file, remove_own, temporary

MANIFEST = "manifest.json"
VERSION = 3

TABLES = {
    "validate": ("validated",),
    "align": ("aligned",),
    "estimate": ("estimated", "residuals", "steps"),
    "score": ("scored",),
}
"""Stages that have a folder of their own below that of the case, and the tables they write."""

SUMMARY = "summary.txt"

_FOLDER = re.compile(r"[0-9a-f]{20}(-\d+)?")
_TEMPORARY = re.compile(r"\.[0-9a-f]{20}\.tmp-\d+(-\d+)?")
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
    PseError
        If another process holds it, or no such folder or file can be made.
    """
    path = folder / ".lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        refuse_foreign(path)
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if error.errno in READ_ONLY and folder.is_dir():
            yield False
            return
        raise CacheError(
            f"{folder}: no folder for the results of case {case!r} can be made there "
            f"({error.strerror}): mend that, or name another folder of data with --data DIR"
        ) from error
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
    finished : str
        When it ended, in ISO 8601; empty before.
    """

    folder: Path
    fingerprint: str
    files: Mapping[str, Facts]
    seconds: float
    parameters: Mapping[str, str]
    inputs: Mapping[str, str]
    finished: str = ""

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
    """An entry from the manifest; None if it is not as this program wrote it."""
    if not isinstance(facts, dict):
        return None
    place, fingerprint, seconds, finished = (
        facts.get(key) for key in ("folder", "fingerprint", "seconds", "finished")
    )
    if (
        not isinstance(place, str)
        or not isinstance(fingerprint, str)
        or not isinstance(finished, str)
        or not isinstance(seconds, float)
        or _FOLDER.fullmatch(place) is None
        or folder.is_symlink()
        or (folder / place).is_symlink()
    ):
        return None
    parameters, inputs = _texts(facts.get("parameters")), _texts(facts.get("inputs"))
    files = _files(facts.get("files"))
    if parameters is None or inputs is None or files is None:
        return None
    if not all(is_own(folder.name, name) for name in files):
        return None
    return Entry(folder / place, fingerprint, files, seconds, parameters, inputs, finished)


def _texts(value: Any) -> Mapping[str, str] | None:
    valid = isinstance(value, dict) and all(isinstance(text, str) for text in value.values())
    return MappingProxyType(value) if valid else None


def _files(value: Any) -> Mapping[str, Facts] | None:
    valid = isinstance(value, dict) and all(map(is_facts, value.values()))
    return MappingProxyType(value) if valid else None


def seal(value: object) -> str:
    """Digest of a part of the manifest: a part that was damaged or edited differs from its own."""
    text = json.dumps(value, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=DIGEST_BYTES).hexdigest()


@dataclass(frozen=True)
class Store:
    """Processed results of one case: ``folder/manifest.json`` and ``folder/<stage>/…``."""

    folder: Path

    def _parts(self) -> dict[str, Any]:
        """What the manifest says of each stage, and of the files of the raw folder as ``raw``.

        A part that differs from its seal is None.
        """
        value = read_json(self.folder / MANIFEST)
        stages, seals = value.get("stages"), value.get("seals")
        if value.get("version") != VERSION or not isinstance(stages, dict):
            return {}
        known = seals if isinstance(seals, dict) else {}
        parts = {**stages, "raw": value.get("raw")}
        return {name: p if known.get(name) == seal(p) else None for name, p in parts.items()}

    def entries(self) -> Mapping[str, Entry]:
        """Stages that the manifest names; one it cannot make sense of is left out."""
        parts = self._parts()
        found = {s: _entry(self.folder / s, parts[s]) for s in TABLES if s in parts}
        return MappingProxyType({s: entry for s, entry in found.items() if entry is not None})

    def damaged(self) -> tuple[str, ...]:
        """Stages that the manifest names, but not as this program wrote it."""
        named, whole = self._parts(), self.entries()
        return tuple(
            stage
            for stage in TABLES
            if stage in named and stage not in whole and not (self.folder / stage).is_symlink()
        )

    def raw_files(self) -> Mapping[str, Facts]:
        """Files of the raw folder as the last run described them."""
        return _files(self._parts().get("raw")) or MappingProxyType({})

    def begin(self, stage: str, fingerprint: str) -> Path:
        """Make an empty folder for the stage to write to.

        Raises
        ------
        PseError
            If something else stands where the stage's folder or the manifest belongs.
        """
        refuse_foreign(self.folder / MANIFEST)
        folder = self.folder / stage
        if os.path.lexists(folder) and (folder.is_symlink() or not folder.is_dir()):
            raise CacheError(
                f"{folder}: expected a folder of this program, received a link or a file: move it "
                f"away; to keep results elsewhere, make {self.folder} as a whole a link"
            )
        part = temporary(folder / fingerprint)
        part.mkdir(parents=True)
        return part

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
        files = describe_folder(entry.folder, asked=partial(is_own, stage))
        # A forced run repeats a fingerprint, and the current folder must stay until the manifest
        # no longer names it.
        final = free(self.folder / stage / entry.fingerprint, "-")
        os.rename(entry.folder, final)
        flush(final.parent)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        done = replace(entry, folder=final, files=MappingProxyType(files), finished=now)
        self._write({**self.entries(), stage: done}, self.raw_files())
        self.prune()
        return done

    def _write(self, entries: Mapping[str, Entry], raw: Mapping[str, Facts]) -> None:
        stages = {stage: _facts(entry) for stage, entry in entries.items()}
        files = {name: dict(facts) for name, facts in raw.items()}
        seals = {name: seal(part) for name, part in {**stages, "raw": files}.items()}
        value = {"version": VERSION, "raw": files, "stages": stages, "seals": seals}
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
        before = self.entries()
        now = {s: replace(e, files=refresh(e.folder, e.files)) for s, e in entries.items()}
        if any(now[s] != before.get(s) for s in now) or dict(raw) != dict(self.raw_files()):
            self._write({**before, **now}, raw)

    def prune(self) -> None:
        """Remove results that the manifest does not name, those of interrupted runs included.

        Only files and folders with the names that this program gives are removed. Call it under
        the case's `lock` only: otherwise a temporary folder may be another run's.
        """
        kept = {entry.folder for entry in self.entries().values()}
        for path in orphans(self.folder / MANIFEST):
            remove_file(path)
        for stage in TABLES:
            folder = self.folder / stage
            if folder.is_symlink() or not folder.is_dir():
                continue
            for path in folder.iterdir():
                shaped = _FOLDER.fullmatch(path.name) or _TEMPORARY.fullmatch(path.name)
                if shaped and path not in kept:
                    remove_own(path, partial(is_own, stage))


def is_own(stage: str, name: str) -> bool:
    """Whether a stage writes a file of that name into its folder."""
    if name in (f"{stage}.rrd", SUMMARY):
        return name != SUMMARY or stage == "score"
    match = re.fullmatch(r"([a-z]+)(-\d+-\d+)?\.parquet", name)
    return match is not None and match[1] in TABLES[stage]


def _facts(entry: Entry) -> dict[str, Any]:
    return {
        "fingerprint": entry.fingerprint,
        "folder": entry.folder.name,
        "files": {name: dict(facts) for name, facts in entry.files.items()},
        "seconds": float(round(entry.seconds, 3)),
        "finished": entry.finished,
        "parameters": dict(entry.parameters),
        "inputs": dict(entry.inputs),
    }
