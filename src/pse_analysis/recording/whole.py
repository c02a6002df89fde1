"""Recordings that are written whole: counted while they are drawn, read back when they are written.

Rerun writes a file in a thread of its own and only logs what goes wrong there, so that a full disk
would leave a recording cut short without an error. Here the recording is drawn in memory, written
by this process, and read back twice: every byte must be as it was in memory, and Rerun must decode
as many rows as were sent.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.chunk import RrdReader

from pse_analysis.errors import StorageError

OWN = "/__"
"""Entities that Rerun adds itself begin so."""


class CountedStream(rr.RecordingStream):  # type: ignore[misc]
    """A stream of Rerun's that counts the rows sent, and raises where Rerun would only warn.

    Attributes
    ----------
    rows : int
        Rows that were sent, those of Rerun's own entities apart.
    """

    rows: int = 0

    def log(self, entity_path: Any, entity: Any, *extra: Any, **options: Any) -> None:
        """Send one row, as `rerun.RecordingStream.log` does."""
        super().log(entity_path, entity, *extra, **{"strict": True, **options})
        self.rows += 1

    def send_columns(
        self, entity_path: str, indexes: Iterable[Any], columns: Iterable[Any], **options: Any
    ) -> None:
        """Send rows column by column, as `rerun.RecordingStream.send_columns` does."""
        indexes = list(indexes)
        super().send_columns(entity_path, indexes, columns, **{"strict": True, **options})
        self.rows += len(indexes[0].as_arrow_array())


def write_whole(path: Path, content: bytes, rows: int) -> None:
    """Write a recording and read it back.

    Parameters
    ----------
    path
        The file to write; replaced if it exists, removed if it cannot be written whole.
    content
        The recording as Rerun encoded it.
    rows
        Rows that were sent to it.

    Raises
    ------
    StorageError
        If the disk is full or fails, or the file does not hold every byte and every row.
    """
    try:
        with path.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.read_bytes() != content:
            raise StorageError(
                f"{path} does not hold what was written to it: the disk may be failing; check it, "
                "then run again, with --data FOLDER on another disk if it fails again"
            )
        found = count_rows(path)
    except OSError as error:
        path.unlink(missing_ok=True)
        if isinstance(error, StorageError):
            raise
        raise StorageError.of(error, path, len(content)) from error
    if found != rows:
        path.unlink(missing_ok=True)
        raise StorageError(
            f"{path}: {rows} rows were recorded, but {found} can be read back: Rerun lost some, "
            "as it may when memory runs out; leave more memory free and run again"
        )


def count_rows(path: Path) -> int:
    """Rows of a recording's data that can be decoded, Rerun's own entities apart."""
    reader = RrdReader(path)
    return sum(
        chunk.num_rows
        for store in reader.recordings()
        for chunk in reader.stream(store=store)
        if not str(chunk.entity_path).startswith(OWN)
    )
