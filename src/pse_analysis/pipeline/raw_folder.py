"""The raw folder of a case, and how a simulation replaces the one that it made.

Standard library only.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pse_analysis.errors import DamagedFile
from pse_analysis.files import (
    CHECKSUMS,
    SIMULATED,
    Facts,
    accept,
    describe_folder,
    flush,
    flush_folder,
    is_orphan,
    read_checksums,
    read_json,
    refuse_links,
    remove_own,
    write_checksums,
    write_json,
)
from pse_analysis.pipeline.cache import CacheError
from pse_analysis.pipeline.plan import STAGES

READ = frozenset(name for stage in STAGES for name in stage.raw)
"""Files and folders in it that stages read."""

_LISTS = (SIMULATED, CHECKSUMS)


@dataclass(frozen=True)
class RawFolder:
    """The raw folder of a case; one that a simulation made carries ``simulated.json``.

    A folder without that marker belongs to the user and is never written to. If the folder is a
    link, data are read and written where it leads.
    """

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", self.folder.resolve())

    @property
    def _old(self) -> Path:
        return self.folder.with_name(f".{self.folder.name}.old")

    @property
    def occupied(self) -> bool:
        """Whether it is there and holds anything."""
        return self.folder.is_dir() and any(self.folder.iterdir())

    def recover(self) -> None:
        """Finish or undo a swap that was interrupted; call it under the case's `lock`."""
        if self._old.is_symlink():
            # An earlier version moved a linked folder's link aside and could not go on.
            self._old.unlink()
        elif self._old.exists():
            if self.folder.exists():
                self._retire()
            else:
                os.rename(self._old, self.folder)
        if self.folder.parent.is_dir():
            for path in list(self.folder.parent.iterdir()):
                if path.name.startswith(f".{self.folder.name}.tmp-") and is_orphan(path):
                    remove_own(path, _is_raw)

    def describe(self, known: Mapping[str, Facts] | None = None) -> dict[str, dict[str, Any]]:
        """Description of the files that stages read, `pse_analysis.files.describe_folder`.

        Raises
        ------
        TableError
            If a link leads out of the folder.
        """
        refuse_links(self.folder, READ)
        files = describe_folder(self.folder, known)
        return {name: facts for name, facts in files.items() if name.split("/")[0] in READ}

    def marker(self) -> Mapping[str, Any] | None:
        """What the simulation noted about itself; None if it did not make this folder."""
        path = self.folder / SIMULATED
        return read_json(path) if path.is_file() else None

    def changed(self, files: Mapping[str, Facts]) -> str | None:
        """First file that is not as it was written, or was added; None if there is none.

        Parameters
        ----------
        files
            What is there, from `describe`.
        """
        try:
            written = read_checksums(self.folder)
        except DamagedFile:
            return CHECKSUMS
        for name in sorted(set(written) | set(files)):
            if written.get(name, {}).get("digest") != files.get(name, {}).get("digest"):
                return name
        return None

    def check(self, files: Mapping[str, Facts]) -> None:
        """Refuse files of the user that differ from their checksums; new files are welcome.

        Raises
        ------
        DamagedFile
            With the first file, and how to accept it.
        """
        for name, facts in read_checksums(self.folder).items():
            if name not in files:
                raise DamagedFile(f"{self.folder / name} is gone: {accept(self.folder)}")
            if facts["digest"] != files[name]["digest"]:
                raise DamagedFile(
                    f"{self.folder / name} is not as it was written; it was damaged or changed: "
                    f"{accept(self.folder)}"
                )

    def begin(self) -> Path:
        """Make an empty sibling folder for the simulation to write to."""
        temporary = self.folder.with_name(f".{self.folder.name}.tmp-{os.getpid()}")
        remove_own(temporary, _is_raw)
        temporary.mkdir(parents=True)
        return temporary

    def publish(
        self,
        fingerprint: str,
        parameters: Mapping[str, str],
        temporary: Path,
        seconds: float,
    ) -> None:
        """Swap a written folder in by two renames; `recover` knows how to finish them."""
        if self.occupied and self.marker() is None:
            raise CacheError(foreign(self.folder))
        write_checksums(temporary)
        marker = {
            "fingerprint": fingerprint,
            "parameters": dict(parameters),
            "seconds": round(seconds, 3),
        }
        write_json(temporary / SIMULATED, marker)
        flush_folder(temporary)
        if self.folder.exists():
            os.rename(self.folder, self._old)
        os.rename(temporary, self.folder)
        flush(self.folder.parent)
        if self._old.exists():
            self._retire()

    def _retire(self) -> None:
        """Remove what a simulation wrote into the old folder; what others put there stays.

        It returns to its place; a table of theirs would be read as part of the new case, and is
        kept beside the folder instead.
        """
        written = read_json(self._old / CHECKSUMS).get("files")
        own = {*_LISTS, *(written if isinstance(written, dict) else ())}
        remove_own(self._old, own.__contains__)
        kept = self.folder.with_name(f"{self.folder.name}.kept")
        for path in list(_left(self._old)):
            name = path.relative_to(self._old)
            target = self.folder / name
            if name.parts[0] in READ or os.path.lexists(target):
                target = _free(kept / name)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(path, target)
        remove_own(self._old, own.__contains__)


def _left(folder: Path) -> Iterator[Path]:
    for root, folders, names in os.walk(folder):
        yield from (Path(root, name) for name in names)
        yield from (path for name in folders if (path := Path(root, name)).is_symlink())


def _free(path: Path) -> Path:
    free, number = path, 1
    while os.path.lexists(free):
        number += 1
        free = path.with_name(f"{path.name}.{number}")
    return free


def _is_raw(name: str) -> bool:
    return name in _LISTS or name.split("/")[0] in READ


def foreign(folder: Path) -> str:
    """Why a simulation leaves a raw folder alone, and what to do."""
    return (
        f"{folder} was not made by a simulation (it has no {SIMULATED}), so it is not overwritten: "
        "move it away to simulate the case, or remove grid and [simulate] from the case file to "
        "use it"
    )
