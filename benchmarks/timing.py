"""How times are taken: in alternation, so that both sides meet the same weather on the machine."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


class Row(NamedTuple):
    """One comparison.

    Attributes
    ----------
    what : str
        What was done.
    ours_s, peer_s : float
        Seconds of this project and of the peer for the same work; NaN where there is no peer.
    peer : str
    note : str
    """

    what: str
    ours_s: float
    peer_s: float
    peer: str
    note: str

    @property
    def ratio(self) -> float:
        """How many times as long the peer takes; NaN without one."""
        return self.peer_s / self.ours_s if self.ours_s > 0 else math.nan


def alternate(
    ours: Callable[[], object], peer: Callable[[], object], repeats: int
) -> tuple[float, float]:
    """Median processor time of both sides, run in turn after one run to warm up. [s]

    Processor time does not count what other programs take; with one thread it is what a quiet
    machine would need.
    """
    spent: tuple[list[float], list[float]] = ([], [])
    for turn in range(repeats + 1):
        for work, kept in zip((ours, peer), spent, strict=True):
            begun = time.process_time()
            work()
            if turn:
                kept.append(time.process_time() - begun)
    return statistics.median(spent[0]), statistics.median(spent[1])
