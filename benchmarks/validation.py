"""The checks of the validate stage beside a plain pandas version and ioos_qc, on the same block."""

from __future__ import annotations

import math
import time
import tracemalloc
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.validation.block import Criteria, screen
from pse_analysis.validation.motion import Motion, gap_variance

N_CHANNEL = 1_000
N_ROW = 10_000
PEER_CHANNELS = 20
REPEATS = 3
SHARE_OF_ERRORS = 0.01
QUANTILE = 3.5
STUCK = 5
LIMIT = 1e4
RHO = 0.5

Array = npt.NDArray[np.float64]


class Row(NamedTuple):
    """One comparison.

    Attributes
    ----------
    what : str
        What was done.
    ours_s, peer_s : float
        Seconds of this project and of the peer for the same work, the best of a few runs; NaN
        where the peer is not installed.
    peer : str
    note : str
    """

    what: str
    ours_s: float
    peer_s: float
    peer: str
    note: str


def block(n_row: int = N_ROW, n_channel: int = N_CHANNEL, seed: int = 20) -> Array:
    """Loads with increments of ρ₁ = 0.5 and 1 % gross errors of up to 6σ, (n_row, n_channel)."""
    rng = np.random.default_rng(seed)
    change = rng.standard_normal((n_row, n_channel))
    for row in range(1, n_row):
        change[row] = RHO * change[row - 1] + math.sqrt(1.0 - RHO**2) * change[row]
    value = np.cumsum(change, axis=0)
    hit = np.flatnonzero(rng.random(value.size) < SHARE_OF_ERRORS)
    value.ravel()[hit] += rng.uniform(-6.0, 6.0, len(hit))
    return value


def criteria(n_channel: int) -> Criteria:
    """Limits, first increment, extrapolation and stuck value for every channel."""
    each = np.ones(n_channel)
    structure = gap_variance(1.0, RHO ** np.arange(1, 9), 8)
    motion = Motion(
        np.tile(structure, (n_channel, 1)),
        RHO * each,
        QUANTILE * each,
        QUANTILE * each,
        np.full(n_channel, 2),
    )
    return Criteria(
        -LIMIT * each, LIMIT * each, motion, np.full(n_channel, STUCK), np.zeros(n_channel, bool)
    )


def pandas_rolling(frame: pd.DataFrame) -> pd.DataFrame:
    """What one writes in an afternoon: differences and rolling windows, spikes flagged twice."""
    change = frame.diff()
    sigma_e = math.sqrt(1.0 - RHO**2)
    stuck = frame.rolling(STUCK).max() == frame.rolling(STUCK).min()
    return (
        (frame.abs() > LIMIT)
        | (change.abs() > QUANTILE)
        | ((change - RHO * change.shift()).abs() > QUANTILE * sigma_e)
        | stuck
    )


def run() -> list[Row]:
    """Time the checks on one core; samples per second and memory stand in the notes."""
    value = block()
    stamps = np.arange(len(value))
    checked = criteria(value.shape[1])
    ours = _best(lambda: screen(value, stamps, checked))
    rate = value.size / ours / 1e6
    part = value[:, :PEER_CHANNELS]
    frame = pd.DataFrame(part, index=pd.date_range("2024-01-01", periods=len(part), freq="2min"))
    share = part.size / value.size
    plain = _best(lambda: pandas_rolling(frame)) / share
    rows = [
        Row(
            f"all checks, {value.shape[1]} channels × {value.shape[0]} samples",
            ours,
            plain,
            "pandas rolling",
            f"{rate:.0f} million samples/s; memory {_memory(value, checked):.2f} × the block, "
            f"itself included; peer timed on {PEER_CHANNELS} channels",
        )
    ]
    peer = _ioos(frame)
    rows.append(
        Row(
            rows[0].what,
            ours,
            math.nan if peer is None else _best(peer, 1) / share,
            "ioos_qc",
            "gross range, spike, rate of change, flat line"
            if peer is not None
            else "not installed: pip install ioos_qc",
        )
    )
    return rows


def _ioos(frame: pd.DataFrame) -> Callable[[], object] | None:
    try:
        from ioos_qc import qartod
    except ImportError:
        return None
    stamps = frame.index.to_numpy()
    seconds = 120.0

    def work() -> None:
        for name in frame:
            value = frame[name].to_numpy()
            qartod.gross_range_test(value, fail_span=(-LIMIT, LIMIT))
            qartod.spike_test(value, suspect_threshold=QUANTILE, fail_threshold=2.0 * QUANTILE)
            qartod.rate_of_change_test(value, stamps, threshold=QUANTILE / seconds)
            qartod.flat_line_test(
                value,
                stamps,
                suspect_threshold=int(STUCK * seconds),
                fail_threshold=int(2 * STUCK * seconds),
                tolerance=0.0,
            )

    return work


def _best(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Least processor time of a few runs, so that other work on the machine counts little. [s]"""
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent)


def _memory(value: Array, checked: Criteria) -> float:
    """Peak memory over the size of the block, the block included."""
    tracemalloc.start()
    screen(value, np.arange(len(value)), checked)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return 1.0 + peak / value.nbytes


if __name__ == "__main__":
    for each in run():
        print(each)
