"""How an odd input may end, and how long it may take."""

from __future__ import annotations

import logging
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pse_analysis.errors import PseError

OK, REFUSED, FOREIGN, NOT_FINITE, SLOW, DIFFERENT = (
    *("ok", "PseError", "foreign", "not finite"),
    *("slow", "different"),
)
OUTCOMES = (OK, REFUSED, FOREIGN, NOT_FINITE, SLOW, DIFFERENT)
PATIENCE_S = 60
"""Time after which an input counts as one that hangs. [s]"""


class NotFinite(AssertionError):
    """A result says ok and is no number."""


class Different(AssertionError):
    """Two tables that mean the same gave different results."""


class Slow(BaseException):
    """An input takes too long; no handler of the program may swallow it."""


@contextmanager
def _deadline(seconds: int) -> Iterator[None]:
    def ring(_signal: int, _frame: Any) -> None:
        raise Slow(f"still running after {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(work: Callable[[], object]) -> tuple[str, BaseException | None]:
    """Do a piece of work and tell how it ended; a warning is as foreign as an exception.

    Returns
    -------
    str
        One of `OUTCOMES`.
    BaseException or None
        What ended it, where that is not as it should be.
    """
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), _deadline(PATIENCE_S):
            warnings.simplefilter("error")
            work()
    except PseError as error:
        if len(str(error)) < 20:
            return FOREIGN, error  # no remedy fits into so few letters
        return REFUSED, None
    except NotFinite as error:
        return NOT_FINITE, error
    except Different as error:
        return DIFFERENT, error
    except Slow as error:
        return SLOW, error
    except Exception as error:
        return FOREIGN, error
    finally:
        logging.disable(logging.NOTSET)
    return OK, None


def place(error: BaseException) -> str:
    """Where in the program an exception was raised, as a name under which to count it."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "pse_analysis" in f.filename] or frames[-1:]
    at = f"{own[-1].filename.rpartition('pse_analysis/')[2]}:{own[-1].lineno}" if own else "?"
    return f"{type(error).__name__} at {at}"
