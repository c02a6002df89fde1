"""Errors that a user can mend: each says what was expected, what came and what to do next."""

from __future__ import annotations

import errno
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
            The file, or the folder, that was written to.
        needed
            Size of the file, if it is known. [bytes]
        """
        size = "" if needed is None else f" of {megabytes(needed)}"
        message = f"{path}{size} could not be written whole: {error.strerror or error}"
        return cls(f"{message}{_remedy(error, path)}")


def megabytes(size: float) -> str:
    """A size in bytes as text, in MB of a million bytes."""
    return f"{size / 1e6:,.1f} MB"


def _remedy(error: OSError, path: Path) -> str:
    folder = next((p for p in path.parents if p.is_dir()), Path())
    elsewhere = "or keep the data elsewhere with --data FOLDER"
    if error.errno == errno.ENOSPC:
        free = megabytes(shutil.disk_usage(folder).free)
        return f"; {free} are free in {folder}: free some space there and run again, {elsewhere}"
    if error.errno == errno.EDQUOT:
        return f"; your quota there is used up: remove files and run again, {elsewhere}"
    if error.errno == errno.EFBIG:
        return "; no file may be that large here: raise the limit (ulimit -f) and run again"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f": let this user write to {folder}, {elsewhere}"
    return f": check the disk and run again, {elsewhere}"
