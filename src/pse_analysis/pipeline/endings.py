"""How a signal ends the program: with one line, its exit code, and nothing left behind.

Standard library only.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
"""Signals that ask the program to end, and its exit code then."""


class Ended(BaseException):
    """A signal asked the program to end; not an error that a stage could outlive."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = signal.Signals(number)

    @property
    def code(self) -> int:
        """The program's exit code."""
        return CODES[self.number]

    def __str__(self) -> str:
        """What a person is told."""
        how = "interrupted" if self.number == signal.SIGINT else f"ended by {self.number.name}"
        return f"{how}: finished stages are kept, the next run goes on"


_received: list[int] = []


def check() -> None:
    """Raise `Ended` if a signal came and what was running then swallowed or replaced it.

    A library may do so, as Python itself does while a class is made.
    """
    if _received:
        raise Ended(_received[0])


@contextmanager
def by_signal() -> Iterator[None]:
    """Let signals raise `Ended`, so that temporary folders are removed on the way out.

    The first one counts; those after it would only disturb that removal. One that was ignored
    before, as ``nohup`` does with SIGHUP, stays ignored.
    """
    before: dict[signal.Signals, Any] = {}

    def end(number: int, _: object) -> None:
        if not _received:
            _received.append(number)
            raise Ended(number)

    def report(unraisable: Any) -> None:
        # What came where nothing can be raised `check` raises again; what a signal left half made
        # may complain when it is removed.
        if not _received:
            sys.__unraisablehook__(unraisable)

    # Only the main thread may say what a signal does.
    if threading.current_thread() is threading.main_thread():
        for number in CODES:
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                before[number] = signal.getsignal(number)
        for number in before:
            signal.signal(number, end)
    hook, sys.unraisablehook = sys.unraisablehook, report
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            # While the program ends, a second signal must not change its exit code.
            signal.signal(number, signal.SIG_IGN if _received else handler)
        _received.clear()
