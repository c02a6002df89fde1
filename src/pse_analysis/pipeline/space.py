"""Whether the disk has room for what a stage is about to write.

Standard library only.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from pse_analysis.errors import StorageError, megabytes
from pse_analysis.files import Facts

OF_RAW: Mapping[str, float] = MappingProxyType(
    {"validate": 1.1, "align": 0.35, "estimate": 0.4, "score": 0.02}
)
"""Least size of a stage's files, as a share of the raw folder's.

Smallest of the project's six cases, rounded down: validate 1.16 to 2.03, align 0.39 to 2.95,
estimate 0.43 to 10.07 (0.02 where no method runs), score 0.02 to 1.22.
"""

_AGAIN = 0.9  # Of the last result: the same stage, at times with fewer methods or a shorter study.
_COPIES = MappingProxyType({"estimate": 2.0})  # Parts of its tables lie beside the joined ones.


def needed(stage: str, before: Mapping[str, Facts], raw: Mapping[str, Facts]) -> int:
    """Bytes that a stage will at least write, temporary files included.

    Parameters
    ----------
    stage
        Its name.
    before
        Files of its last result by name, `pse_analysis.files.describe`; empty if there is none.
        For ``simulate`` those of the raw folder.
    raw
        Files of the raw folder. They tell the size where there is no last result.
    """
    if before:
        tables = sum(facts["bytes"] for name, facts in before.items() if name.endswith(".parquet"))
        others = sum(facts["bytes"] for facts in before.values()) - tables
        return int(_AGAIN * (_COPIES.get(stage, 1.0) * tables + others))
    return int(OF_RAW.get(stage, 0.0) * sum(facts["bytes"] for facts in raw.values()))


def require(folder: Path, needed_bytes: int, what: str) -> None:
    """Refuse to begin what the disk has no room for.

    Parameters
    ----------
    folder
        Where it will be written; it need not be there yet.
    needed_bytes
        What it will at least take.
    what
        What needs it, for the message.

    Raises
    ------
    StorageError
        If less is free for this user.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    free = shutil.disk_usage(there).free
    if free < needed_bytes:
        raise StorageError(
            f"{what} will write at least {megabytes(needed_bytes)} to {folder}, where "
            f"{megabytes(free)} are free: free some space there and run again, or keep the data "
            "elsewhere with --data FOLDER"
        )
