"""Files and folders of this program among those of others: temporary names, and removal.

Whatever the program did not write stays where it is, and links are never followed. Standard
library only.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable
from pathlib import Path

_TEMPORARY = re.compile(r"\..+\.tmp-(\d+)(-\d+)?", re.DOTALL)


def temporary(path: Path) -> Path:
    """Return a free name beside a file or folder, under which this process writes it first."""
    return free(path.with_name(f".{path.name}.tmp-{os.getpid()}"), "-")


def free(path: Path, joint: str) -> Path:
    """Return a path, or the first of ``path-2``, ``path-3``, … at which there is nothing yet."""
    found, number = path, 1
    while os.path.lexists(found):
        number += 1
        found = path.with_name(f"{path.name}{joint}{number}")
    return found


def is_orphan(path: Path) -> bool:
    """Whether a temporary file or folder belongs to a process that is gone."""
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


def orphans(path: Path) -> list[Path]:
    """Temporary files and folders beside a path, under its name, whose process is gone."""
    start = f".{path.name}.tmp-"
    try:
        beside = list(path.parent.iterdir())
    except OSError:
        return []
    return [other for other in beside if other.name.startswith(start) and is_orphan(other)]


def remove_file(path: Path) -> None:
    """Remove a file; what is a link, a folder or a pipe is somebody else's and stays."""
    if stat.S_ISREG(path.lstat().st_mode):
        path.unlink()


def remove_own(folder: Path, own: Callable[[str], bool]) -> bool:
    """Remove a folder's own files and folders, and the folder itself if nothing else is in it.

    Links are never followed: one to a file or folder counts as somebody else's and stays.

    Parameters
    ----------
    folder
        Where to begin; not a link.
    own
        Whether a file or folder may go, by its path relative to ``folder``: ``/`` stands between
        its parts, and at the end of a folder's.

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
            if own(path.relative_to(folder).as_posix()):
                remove_file(path)
        for name in folders:
            path = Path(root, name)
            if own(f"{path.relative_to(folder).as_posix()}/"):
                remove_empty(path)
    return remove_empty(folder)


def remove_empty(folder: Path) -> bool:
    """Remove a folder if nothing is in it; returns whether it is gone."""
    try:
        os.rmdir(folder)
    except OSError:
        return False
    return True
