"""Files that are whole and unchanged: digests, checksums of a folder, replacement in one step.

Standard library only: a cached run uses it without waiting for pandas.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from pse_analysis.errors import DamagedFile, TableError

CHECKSUMS = "checksums.json"
"""File in a raw folder that lists size and digest of every table in it."""

SIMULATED = "simulated.json"
"""File in a raw folder that a simulation made."""

DIGEST_BYTES = 16
MAX_JSON_BYTES = 64 * 2**20

_CHUNK = 2**20
_PARQUET = b"PAR1"

Facts = Mapping[str, Any]
"""What is known of one file: ``bytes``, ``digest``, of a parquet file ``content``, ``times``."""


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
        if path.stat().st_size > MAX_JSON_BYTES:
            return {}
        value = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def digest_file(path: Path) -> str:
    """Digest of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, _hash).hexdigest()


def _hash() -> Any:
    return hashlib.blake2b(digest_size=DIGEST_BYTES)


def describe(path: Path) -> dict[str, Any]:
    """Size, digest and times of a file; of a parquet file also the digest of its pages.

    ``content`` leaves out the footer, where provenance stands: two tables of equal values have it
    in common although they were made under other versions of the program.
    """
    with path.open("rb") as file:
        found = os.fstat(file.fileno())
        pages = _bytes_of_pages(file, found.st_size)
        whole, content = _hash(), _hash()
        left = pages or 0
        while chunk := file.read(_CHUNK):
            whole.update(chunk)
            content.update(chunk[:left])
            left -= min(left, len(chunk))
    facts = {"bytes": found.st_size, "digest": whole.hexdigest(), "times": _times(found)}
    return facts if pages is None else {**facts, "content": content.hexdigest()}


def _bytes_of_pages(file: BinaryIO, size: int) -> int | None:
    """Bytes of a parquet file before its footer; None if it is none."""
    if size < 12 or file.read(4) != _PARQUET:
        file.seek(0)
        return None
    file.seek(size - 8)
    length, end = struct.unpack("<I4s", file.read(8))
    file.seek(0)
    return size - 8 - length if end == _PARQUET and length <= size - 12 else None


def _times(found: os.stat_result) -> list[int]:
    """When a file's content and when its node last changed: a rewrite moves one or both."""
    return [found.st_mtime_ns, found.st_ctime_ns]


def content(facts: Facts) -> str:
    """The digest by which a file counts as an input: of its pages, where it is a parquet file."""
    return str(facts.get("content", facts["digest"]))


def unchanged(path: Path, facts: Facts, *, thorough: bool = False) -> bool:
    """Whether a file is there as it was described.

    Parameters
    ----------
    path
        The file.
    facts
        Its description, by `describe`.
    thorough
        Read it although size and times agree.
    """
    try:
        found = path.stat()
        if found.st_size != facts["bytes"]:
            return False
        if not thorough and _times(found) == facts.get("times"):
            return True
        return digest_file(path) == str(facts["digest"])
    except OSError:
        return False


def check(path: Path, facts: Facts, remedy: str) -> None:
    """Refuse a file that is not as it was written.

    Raises
    ------
    DamagedFile
        With what differs, and the remedy.
    """
    try:
        size = path.stat().st_size
    except OSError as error:
        raise DamagedFile(f"{path} is gone, although it was written: {remedy}") from error
    if size != facts["bytes"]:
        raise DamagedFile(
            f"{path} is not as it was written (expected {facts['bytes']} bytes, received {size}); "
            f"it was damaged or changed: {remedy}"
        )
    received = digest_file(path)
    if received != facts["digest"]:
        raise DamagedFile(
            f"{path} is not as it was written (expected digest {facts['digest']}, received "
            f"{received}); it was damaged or changed: {remedy}"
        )


def files_below(folder: Path) -> Iterator[Path]:
    """Files below a folder, sorted; hidden ones are left out, links to folders not followed."""
    found = []
    for root, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(root, name) for name in names if not name.startswith(".")]
    yield from sorted(path for path in found if path.is_file())


def refuse_links(folder: Path, names: Iterable[str]) -> None:
    """Refuse links inside a folder that lead out of it, or to folders.

    The folder itself may be a link: its owner chose where the data lie.

    Parameters
    ----------
    folder
        Where to look.
    names
        Files and folders in it that will be read.

    Raises
    ------
    TableError
        With the first such link.
    """
    inside = folder.resolve()
    for name in names:
        waiting = [folder / name]
        while waiting:
            path = waiting.pop()
            if path.is_symlink() and not (path.is_file() and path.resolve().is_relative_to(inside)):
                raise TableError(
                    f"{path} is a link to {os.readlink(path)}: expected the file itself, since "
                    "what a case is read from must lie in its own folder: copy it there, or make "
                    f"{folder} as a whole a link to where the data are"
                )
            if path.is_dir() and not path.is_symlink():
                waiting += path.iterdir()


def describe_folder(
    folder: Path, known: Mapping[str, Facts] | None = None
) -> dict[str, dict[str, Any]]:
    """Description of every file below a folder, by its path relative to it, sorted.

    Parameters
    ----------
    folder
        Where to look.
    known
        Earlier descriptions; a file whose size and times agree with its own is not read again.
    """
    found = {}
    for path in files_below(folder):
        name = path.relative_to(folder).as_posix()
        facts = (known or {}).get(name, {})
        status = path.stat()
        same = facts.get("bytes") == status.st_size and facts.get("times") == _times(status)
        found[name] = dict(facts) if same else describe(path)
    return found


def is_facts(value: object) -> bool:
    """Whether a value read from a JSON file can be the description of a file."""
    if not isinstance(value, dict):
        return False
    times = value.get("times", [])
    return (
        type(value.get("bytes")) is int
        and isinstance(value.get("digest"), str)
        and isinstance(value.get("content", ""), str)
        and isinstance(times, list)
        and all(type(time) is int for time in times)
    )


def write_checksums(folder: Path) -> None:
    """List size and digest of every file below a folder, in the folder.

    Call it again after a deliberate change: what differs from the list is refused as damaged.
    """
    files = describe_folder(folder)
    files.pop(CHECKSUMS, None)
    for facts in files.values():
        # Times are of this copy; a list that travels with the files must hold for every copy.
        del facts["times"]
    write_json(folder / CHECKSUMS, {"version": 1, "files": files})


def read_checksums(folder: Path) -> dict[str, Facts]:
    """What the list of a folder says of its files; empty if there is none.

    Raises
    ------
    DamagedFile
        If there is one, but it cannot be read.
    """
    path = folder / CHECKSUMS
    if not path.is_file():
        return {}
    files = read_json(path).get("files")
    if not isinstance(files, dict) or not all(map(is_facts, files.values())):
        raise DamagedFile(
            f"{path} is not a list of checksums; it was damaged or changed: {accept(folder)}"
        )
    return files


def accept(folder: Path) -> str:
    """What to do about a raw file that differs from its checksum."""
    if (folder / SIMULATED).is_file():
        return f"`pse run {folder.name} --force` simulates it again"
    return (
        "restore it from a copy; or, if the change is yours, accept it with `pse verify "
        f"{folder.name} --accept` or pse_analysis.telemetry.accept({str(folder)!r})"
    )


def remove_own(folder: Path, own: Callable[[str], bool]) -> bool:
    """Remove a folder's own files, and the folder if nothing else is in it.

    Links are never followed: one to a file or folder counts as somebody else's and stays.

    Parameters
    ----------
    folder
        Where to begin; not a link.
    own
        Whether a file may go, by its path relative to the folder, with ``/`` between parts.

    Returns
    -------
    bool
        Whether the folder is gone.
    """
    if folder.is_symlink() or not folder.is_dir():
        return not os.path.lexists(folder)
    for root, folders, names in os.walk(folder, topdown=False):
        for name in names:
            path = Path(root, name)
            if stat.S_ISREG(path.lstat().st_mode) and own(path.relative_to(folder).as_posix()):
                path.unlink()
        for name in folders:
            _remove_empty(Path(root, name))
    return _remove_empty(folder)


def _remove_empty(folder: Path) -> bool:
    try:
        os.rmdir(folder)
    except OSError:
        return False
    return True


_TEMPORARY = re.compile(r".*\.tmp-(\d+)", re.DOTALL)


def is_orphan(path: Path) -> bool:
    """Whether a temporary file or folder, ``….tmp-PID``, belongs to a process that is gone."""
    match = _TEMPORARY.fullmatch(path.name)
    if match is None:
        return False
    try:
        os.kill(int(match[1]), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False
