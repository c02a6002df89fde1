"""Errors that a user can mend: each says what was expected, what came and what to do next."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path


class PseError(Exception):
    """Base of them all; the command line prints these without a traceback."""


class ParameterError(PseError, ValueError):
    """A case file has a key or a value that nothing can use."""


class TableError(PseError, ValueError):
    """A table does not have the columns, types, units or names that its schema asks for."""


class DamagedFile(TableError):
    """A file is not as it was written: cut short, damaged, or changed by somebody else."""


class GridError(PseError, ValueError):
    """A grid model is inconsistent, or an element is not in it."""


class NotConverged(PseError, ArithmeticError):
    """An iteration ended without a solution."""


class Unobservable(PseError, ArithmeticError):
    """The measurements do not determine the state."""


class OutOfMemory(PseError, MemoryError):
    """The system refused memory, or ended a process that took too much of it."""


class StorageError(PseError, OSError):
    """A file could not be written whole, or read back as it was written."""

    @classmethod
    def of(cls, error: OSError, path: Path, needed: int | None = None) -> StorageError:
        """Say what kept a file from being written, how much space is there, and what to do.

        Parameters
        ----------
        error
            What the system said.
        path
            The file or folder that was written to.
        needed
            Size of the file, if it is known. [bytes]
        """
        size = "" if needed is None else f" of {megabytes(needed)}"
        said = os.strerror(error.errno) if error.errno else str(error)
        found = cls(f"{path}{size} could not be written whole: {said}{remedy(error.errno, path)}")
        found.errno = error.errno
        return found


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of the system that only a write can have."""


def megabytes(size: float) -> str:
    """A size in bytes as text, in MB of a million bytes."""
    return f"{size / 1e6:,.1f} MB"


def remedy(code: int | None, path: Path | None = None) -> str:
    """What to do about an error of the system, as the end of a sentence; empty if it is no fault.

    Parameters
    ----------
    code
        The error's number.
    path
        The file or folder that it is about, if that is known.
    """
    elsewhere = "or keep the data elsewhere with --data FOLDER"
    if code == errno.ENOSPC:
        return f"{_free(path)}: free some space and run again, {elsewhere}"
    if code == errno.EDQUOT:
        return f"; your quota there is used up: remove files and run again, {elsewhere}"
    if code == errno.EFBIG:
        return "; no file may be that large here: raise the limit (ulimit -f) and run again"
    if code in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f": let this user read and write there, {elsewhere}"
    if code == errno.EIO:
        return f": check the disk and run again, {elsewhere}"
    return ""


def _free(path: Path | None) -> str:
    if path is None:
        return ""
    folder = next(p for p in (path, *path.absolute().parents) if p.is_dir())
    return f"; {megabytes(shutil.disk_usage(folder).free)} are free there"
