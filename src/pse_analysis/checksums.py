"""The files of a raw folder, and the list of their checksums. Standard library only."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from pse_analysis.errors import DamagedFile, TableError
from pse_analysis.files import Facts, describe_folder, is_facts, read_json, unreadable, write_json

CHECKSUMS = "checksums.json"
"""File in a raw folder that lists size and digest of every table in it."""

SIMULATED = "simulated.json"
"""File in a raw folder that a simulation made."""

RAW = (
    "telemetry",
    "grid",
    "channels.parquet",
    "machine.parquet",
    "truth.parquet",
    "sample_truth.parquet",
    "faults.parquet",
)
"""Files and folders of a raw folder that a case is read from."""

_OWN = re.compile(
    r"telemetry/(source=[^/]+/(date=[^/]+/(part-0\.parquet)?)?)?|grid/([a-z]+\.parquet)?"
    r"|(channels|machine|truth|sample_truth|faults)\.parquet"
    r"|(checksums|simulated)\.json|\.(checksums|simulated)\.json\.tmp-\d+(-\d+)?",
    re.DOTALL,
)


_READ = re.compile(r"(source|date)=.*|.*\.parquet", re.DOTALL)


def is_raw_table(name: str) -> bool:
    """Whether a file is one that a case is read from, by its path relative to the raw folder."""
    return name.split("/")[0] in RAW and name.endswith(".parquet")


def may_be_read(name: str) -> bool:
    """Whether a file or folder of that name, below ``telemetry`` or ``grid``, can hold a table."""
    return _READ.fullmatch(name) is not None


def is_own(name: str) -> bool:
    """Whether a file, or with ``/`` at its end a folder, has a name that this program gives."""
    return _OWN.fullmatch(name) is not None


def refuse_links(folder: Path) -> None:
    """Refuse tables of a raw folder that are links out of it, and links to folders of tables.

    The folder itself may be a link: its owner chose where the data lie.

    Raises
    ------
    TableError
        With the first such link, or if this user may not look into a folder.
    """
    inside = folder.resolve()
    waiting = [folder / name for name in RAW]
    while waiting:
        path = waiting.pop()
        if path.is_symlink():
            read = path.parent == folder or may_be_read(path.name)
            if read and not (path.is_file() and path.resolve().is_relative_to(inside)):
                raise TableError(
                    f"{path} is a link to {os.readlink(path)}: expected the file itself, since "
                    "what a case is read from must lie in its own folder: copy it there, remove "
                    f"the link, or make {folder} as a whole a link to where the data are"
                )
        elif path.is_dir():
            try:
                waiting += (p for p in path.iterdir() if not p.name.startswith("."))
            except PermissionError as error:
                raise unreadable(path, error) from error


def write_checksums(folder: Path) -> None:
    """List size and digest of every table of a raw folder, in the folder.

    Call it again after a deliberate change: what differs from the list is refused as damaged.
    """
    files = describe_folder(folder, asked=is_raw_table)
    for facts in files.values():
        # Times are of this copy; a list that travels with the files must hold for every copy.
        del facts["times"]
    write_json(folder / CHECKSUMS, {"version": 1, "files": files})


def read_checksums(folder: Path) -> Mapping[str, Facts]:
    """What the list of a folder says of its files; empty if there is none.

    Raises
    ------
    DamagedFile
        If there is one, but it cannot be read.
    """
    path = folder / CHECKSUMS
    if not os.path.lexists(path):
        return {}
    files = read_json(path).get("files")
    if not isinstance(files, dict) or not all(
        _is_inside(name) and is_facts(facts) for name, facts in files.items()
    ):
        raise DamagedFile(
            f"{path} is not a list of checksums; it was damaged or changed: {remedy(folder)}"
        )
    return files


def _is_inside(name: str) -> bool:
    """Whether a name is one of a file below the folder that lists it."""
    return "\0" not in name and not name.startswith("/") and ".." not in name.split("/")


def remedy(folder: Path) -> str:
    """What to do about a raw file that differs from its checksum."""
    if (folder / SIMULATED).is_file():
        return f"`pse run {folder.name} --force` simulates it again"
    return (
        "restore it from a copy; or, if the change is yours, accept it with `pse verify "
        f"{folder.name} --accept` or pse_analysis.telemetry.accept({str(folder)!r})"
    )
