"""Whether memory ran out, and what to reduce then.

Standard library only.
"""

from __future__ import annotations

import errno
import resource

from pse_analysis.errors import OutOfMemory, megabytes

LIBRARIES_BYTES = 10**9
"""Address space that numpy, scipy, pandas, pyarrow and rerun reserve before they compute anything.

Measured, with one BLAS thread: below 1.0 GB some of them cannot be loaded.
"""

# What libraries say when the system refuses them memory or a thread, which takes memory, too.
_SAID = (
    "failed to map segment",
    "cannot allocate memory",
    "can't start new thread",
    "failed to launch worker thread",
    "resource temporarily unavailable",
)


def limit() -> int | None:
    """Address space that this process may use; None if it is not limited. [bytes]"""
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft


def require() -> None:
    """Refuse to load the libraries where they cannot be.

    Raises
    ------
    OutOfMemory
        If the process's own limit is below what they need.
    """
    allowed = limit()
    if allowed is not None and allowed < LIBRARIES_BYTES:
        raise OutOfMemory(
            f"this process may use {megabytes(allowed)} of memory (ulimit -v), but the libraries "
            f"alone reserve more than {megabytes(LIBRARIES_BYTES)}: raise that limit"
        )


def ran_out(error: BaseException) -> bool:
    """Whether an error says that the system refused memory, or a thread."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError) and error.errno in (errno.ENOMEM, errno.EAGAIN):
        return True
    said = str(error).lower()
    return any(words in said for words in _SAID)


def explain(error: BaseException, stage: str, workers: int) -> OutOfMemory:
    """Say what ran out of memory and what to reduce.

    Parameters
    ----------
    error
        For which `ran_out` holds.
    stage
        What was running.
    workers
        Processes that it might use.
    """
    allowed = limit()
    capped = "" if allowed is None else f" (this process may use {megabytes(allowed)}: ulimit -v)"
    fewer = f"fewer processes (--workers 1, now {workers}), " if workers > 1 else ""
    detail = " ".join(str(error).split())
    return OutOfMemory(
        f"{stage}: out of memory{capped}{f': {detail}' if detail else ''}; what needs less: "
        f"{fewer}a shorter [study] or history_s, fewer trials, fewer methods"
    )
