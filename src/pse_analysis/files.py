"""Files that are whole and unchanged: their digests, and replacement in one step.

Standard library only: a cached run uses it without waiting for pandas.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from pse_analysis.errors import DamagedFile, TableError
from pse_analysis.leftovers import orphans, remove_file, temporary

DIGEST_BYTES = 16
MAX_JSON_BYTES = 64 * 2**20

_CHUNK = 2**20
_PARQUET = b"PAR1"

Facts = Mapping[str, Any]
"""What is known of one file: ``bytes``, ``digest``, of a parquet file ``content``, ``times``."""


def real(path: str | Path) -> Path:
    """Where a path leads, with every link in it followed.

    Raises
    ------
    TableError
        If its links lead in a circle.
    """
    try:
        return Path(path).resolve()
    except (OSError, RuntimeError) as error:
        raise TableError(
            f"{path} is a link that leads back to itself: make it lead to a folder, or remove it"
        ) from error


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
    """Replace a JSON file as a whole: readers see the old text or the new one.

    Raises
    ------
    TableError
        If a link, a folder or a pipe stands in its place.
    """
    refuse_foreign(path)
    for orphan in orphans(path):
        remove_file(orphan)
    # Names of files need not be UTF-8; escaped, they are text that can be read back.
    text = json.dumps(value, indent=1, sort_keys=True)
    part = temporary(path)
    try:
        with part.open("x", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    flush(path.parent)


def refuse_foreign(path: Path) -> None:
    """Refuse to replace what cannot be a file of this program.

    Raises
    ------
    TableError
        If a link, a folder or a pipe stands there.
    """
    if not os.path.lexists(path):
        return
    mode = path.lstat().st_mode
    if stat.S_ISREG(mode):
        return
    kinds = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder"}
    raise TableError(
        f"{path}: expected a file of this program, received "
        f"{kinds.get(stat.S_IFMT(mode), 'a pipe, socket or device')}: move it away and run again"
    )


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; an empty one if the file is missing or damaged.

    Raises
    ------
    TableError
        If this user may not read it.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_JSON_BYTES:
            return {}
        value = json.loads(path.read_text(encoding="utf-8"))
    except PermissionError as error:
        raise unreadable(path, error) from error
    except (OSError, ValueError, RecursionError):
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
        if found.st_size != facts["bytes"] or not stat.S_ISREG(found.st_mode):
            return False
        if not thorough and _times(found) == facts.get("times"):
            return True
        return digest_file(path) == str(facts["digest"])
    except OSError:
        return False


def refresh(folder: Path, files: Mapping[str, Facts]) -> dict[str, Facts]:
    """Descriptions of files with their times as they are now, where the content did not change.

    A copy has other times than the original; noted once, its files need not be read every time.
    """
    now = {}
    for name, facts in files.items():
        path = folder / name
        try:
            times: Any = _times(path.stat())
        except OSError:
            times = facts.get("times")
        moved = times != facts.get("times") and unchanged(path, facts, thorough=True)
        now[name] = {**facts, "times": times} if moved else facts
    return now


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
    try:
        received = digest_file(path)
    except OSError as error:
        raise unreadable(path, error) from error
    if received != facts["digest"]:
        raise DamagedFile(
            f"{path} is not as it was written (expected digest {facts['digest']}, received "
            f"{received}); it was damaged or changed: {remedy}"
        )


def files_below(folder: Path) -> Iterator[Path]:
    """Files below a folder, sorted; hidden ones are left out, links to folders not followed.

    Raises
    ------
    TableError
        If this user may not look into a folder: what lies there must not be missed.
    """
    found = []

    def refuse(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):
            raise unreadable(Path(error.filename), error) from error

    for root, folders, names in os.walk(folder, onerror=refuse):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(root, name) for name in names if not name.startswith(".")]
    yield from sorted(path for path in found if path.is_file())


def describe_folder(
    folder: Path,
    known: Mapping[str, Facts] | None = None,
    *,
    asked: Callable[[str], bool] = lambda name: True,
) -> dict[str, dict[str, Any]]:
    """Description of the files below a folder, by their paths relative to it, sorted.

    Parameters
    ----------
    folder
        Where to look.
    known
        Earlier descriptions; a file whose size and times agree with its own is not read again.
    asked
        Whether a file is asked for, by its path relative to the folder; others are not opened.
    """
    found = {}
    for path in files_below(folder):
        name = path.relative_to(folder).as_posix()
        if not asked(name):
            continue
        facts = (known or {}).get(name, {})
        status = path.stat()
        same = facts.get("bytes") == status.st_size and facts.get("times") == _times(status)
        try:
            found[name] = dict(facts) if same else describe(path)
        except PermissionError as error:
            raise unreadable(path, error) from error
    return found


def unreadable(path: Path, error: OSError) -> TableError:
    """The error to raise where this user may not read a file or folder."""
    return TableError(f"{path} cannot be read ({error.strerror}): check its owner and mode")


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
