"""The raw folder of a case, and how a simulation replaces the one that it made.

Standard library only.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pse_analysis.checksums import (
    CHECKSUMS,
    RAW,
    SIMULATED,
    is_own,
    is_raw_table,
    may_be_read,
    read_checksums,
    refuse_links,
    remedy,
    write_checksums,
)
from pse_analysis.errors import DamagedFile
from pse_analysis.files import (
    Facts,
    describe_folder,
    files_below,
    flush,
    flush_folder,
    read_json,
    real,
    write_json,
)
from pse_analysis.leftovers import free, orphans, remove_empty, remove_own, temporary
from pse_analysis.pipeline.cache import CacheError


def _silent(_: str) -> None:
    """Keep a warning to itself."""


@dataclass(frozen=True)
class RawFolder:
    """The raw folder of a case; one that a simulation made carries ``simulated.json``.

    A folder without that marker belongs to the user and is never written to. If the folder is a
    link, data are read and written where it leads.

    Attributes
    ----------
    folder : Path
        Where it is.
    warn : callable
        Is told of files that had to be put elsewhere.
    """

    folder: Path
    warn: Callable[[str], None] = _silent

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", real(self.folder))
        if os.path.lexists(self.folder) and not self.folder.is_dir():
            raise CacheError(
                f"{self.folder}: expected the folder of the case's raw data, received a file: "
                "move it away"
            )

    @property
    def occupied(self) -> bool:
        """Whether it is there and holds anything."""
        return self.folder.is_dir() and any(self.folder.iterdir())

    def recover(self) -> None:
        """Finish or undo a swap that was interrupted; call it under the case's `lock`."""
        for old in self._replaced():
            if self.folder.exists():
                self._retire(old)
            else:
                os.rename(old, self.folder)
        for orphan in orphans(self.folder):
            remove_own(orphan, is_own)

    def _replaced(self) -> list[Path]:
        """Folders that a swap has put aside."""
        name = re.compile(rf"\.{re.escape(self.folder.name)}\.tmp-\d+(-\d+)?\.old(-\d+)?")
        beside = list(self.folder.parent.iterdir()) if self.folder.parent.is_dir() else []
        return [p for p in beside if name.fullmatch(p.name) and p.is_dir() and not p.is_symlink()]

    def describe(self, known: Mapping[str, Facts] | None = None) -> dict[str, dict[str, Any]]:
        """Description of the tables that stages read, `pse_analysis.files.describe_folder`.

        Parameters
        ----------
        known
            Earlier descriptions; where they contradict the list of checksums, files are read.

        Raises
        ------
        TableError
            If a link leads out of the folder, or a file cannot be read.
        """
        refuse_links(self.folder)
        try:
            listed = read_checksums(self.folder)
        except DamagedFile:
            listed = {}
        agreed = {
            name: facts
            for name, facts in (known or {}).items()
            if _alike(listed.get(name, facts), facts)
        }
        return describe_folder(self.folder, agreed, asked=is_raw_table)

    def marker(self) -> Mapping[str, Any] | None:
        """What the simulation noted about itself; None if it did not make this folder."""
        path = self.folder / SIMULATED
        return read_json(path) if path.is_file() and not path.is_symlink() else None

    def changed(self, files: Mapping[str, Facts]) -> str | None:
        """First table that is not as it was written, or was added; None if there is none.

        Parameters
        ----------
        files
            What is there, from `describe`.
        """
        try:
            written = _tables(read_checksums(self.folder))
        except DamagedFile:
            return CHECKSUMS
        if not written:
            return CHECKSUMS
        for name in sorted(set(written) | set(files)):
            if not _alike(written.get(name), files.get(name)):
                return name
        return None

    def check(self, files: Mapping[str, Facts]) -> None:
        """Refuse tables of the user that differ from their checksums; new ones are welcome.

        Raises
        ------
        DamagedFile
            With the first file, and how to accept it.
        """
        for name, facts in _tables(read_checksums(self.folder)).items():
            if name not in files:
                raise DamagedFile(f"{self.folder / name} is gone: {remedy(self.folder)}")
            if not _alike(facts, files[name]):
                raise DamagedFile(
                    f"{self.folder / name} is not as it was written; it was damaged or changed: "
                    f"{remedy(self.folder)}"
                )

    def begin(self) -> Path:
        """Make an empty sibling folder for the simulation to write to."""
        part = temporary(self.folder)
        part.mkdir(parents=True)
        return part

    def publish(self, marker: Mapping[str, Any], part: Path) -> None:
        """Swap a written folder in by two renames; `recover` knows how to finish them.

        Parameters
        ----------
        marker
            What the simulation notes about itself.
        part
            The folder of `begin`.
        """
        if self.occupied and self.marker() is None:
            raise CacheError(foreign(self.folder))
        write_checksums(part)
        # Named twice, so that damage to one of the lists does not make them somebody else's.
        names = sorted(read_checksums(part))
        write_json(part / SIMULATED, {**marker, "tables": names})
        flush_folder(part)
        old = free(part.with_name(f"{part.name}.old"), "-")
        if self.folder.exists():
            os.rename(self.folder, old)
        os.rename(part, self.folder)
        flush(self.folder.parent)
        if old.exists():
            self._retire(old)

    def _retire(self, old: Path) -> None:
        """Remove what a simulation wrote into a replaced folder; what others put there stays.

        It returns to its place; a table of theirs would be read as part of the new case, and is
        kept beside the folder instead.
        """
        listed = read_json(old / CHECKSUMS).get("files"), read_json(old / SIMULATED).get("tables")
        tables = {n for names in listed if isinstance(names, dict | list) for n in map(str, names)}
        # The lists go last: without them, an interrupted removal could not go on.
        if remove_own(old, lambda name: is_own(name) and (name in tables or name.endswith("/"))):
            return
        kept = self.folder.with_name(f"{self.folder.name}.kept")
        if os.path.lexists(kept) and (kept.is_symlink() or not kept.is_dir()):
            kept = free(kept, ".")
        if count := self._put_back(old, old, kept):
            self.warn(
                f"what the simulation had not written into {self.folder} ({count} files or "
                f"folders) lies in {kept} now, so that it is not taken for part of the new one"
            )
        remove_own(old, is_own)

    def _put_back(self, old: Path, folder: Path, kept: Path) -> int:
        """Move what lies in a folder below ``old`` to its place; returns how many were kept."""
        count = 0
        for path in list(folder.iterdir()):
            name = path.relative_to(old)
            if name.as_posix() in (SIMULATED, CHECKSUMS) and stat.S_ISREG(path.lstat().st_mode):
                continue
            if path.is_dir() and not path.is_symlink() and is_own(f"{name.as_posix()}/"):
                count += self._put_back(old, path, kept)
                remove_empty(path)
                continue
            target = self.folder / name
            aside = _would_be_read(path, name) or os.path.lexists(target)
            if aside:
                target = free(kept / name, ".")
                count += 1
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(path, target)
        return count


def _alike(one: Facts | None, other: Facts | None) -> bool:
    """Whether two descriptions are of the same content."""
    if one is None or other is None:
        return False
    return bool(one["bytes"] == other["bytes"] and one["digest"] == other["digest"])


def _tables(listed: Mapping[str, Facts]) -> dict[str, Facts]:
    return {name: facts for name, facts in listed.items() if is_raw_table(name)}


def _would_be_read(path: Path, name: Path) -> bool:
    """Whether a file or folder would be read, or a link be refused, as part of a case."""
    if name.parts[0] not in RAW:
        return False
    if path.is_dir() and not path.is_symlink():
        return any(p.suffix == ".parquet" for p in files_below(path))
    return len(name.parts) == 1 or may_be_read(path.name)


def foreign(folder: Path) -> str:
    """Why a simulation leaves a raw folder alone, and what to do."""
    return (
        f"{folder} was not made by a simulation (it has no {SIMULATED}), so it is not overwritten: "
        "move it away to simulate the case, or remove grid and [simulate] from the case file to "
        "use it"
    )
