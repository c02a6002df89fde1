"""Which generators are beyond what they hold, and states in which none is."""

from __future__ import annotations

import numpy as np

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.grid.continuation.base import LOWER, UPPER, VOLTAGE, StatusArray
from pse_analysis.grid.continuation.equations import LoadedGrid, coordinate

MARGIN = 1e-8
"""How far beyond a limit a bus counts as beyond it. [p.u.]"""


def excess(grid: LoadedGrid, y: FloatArray, status: StatusArray) -> tuple[FloatArray, IntArray]:
    """Returns by how much each generator is beyond what it holds, and what it should hold.

    One that holds its voltage must stay within its reactive limits; one at its upper limit must
    not have a voltage above its set-point, one at its lower limit none below.

    Returns
    -------
    excess : (N,) ndarray
        Negative where there is room; -∞ at buses that control nothing. [p.u.]
    target : (N,) ndarray of int
    """
    n = grid.n
    to_upper, to_lower = grid.q_margin(y)
    rise = y[n : 2 * n] - grid.base.vm_set
    held = status == VOLTAGE
    beyond = np.select(
        [held, status == UPPER, status == LOWER],
        [np.maximum(-to_upper, -to_lower), rise, -rise],
        -np.inf,
    )
    target = np.where(held, np.where(to_upper < to_lower, UPPER, LOWER), VOLTAGE)
    return np.where(grid.controlled, beyond, -np.inf), target


def settled(
    grid: LoadedGrid,
    y: FloatArray,
    status: StatusArray,
    loading: float,
    tolerance: float,
    *,
    near: bool = False,
) -> tuple[FloatArray, StatusArray] | None:
    """Returns the state at a loading, with what each generator holds there.

    All that are beyond their limits change together, and where that leads nowhere, one at a time,
    the furthest first.

    Parameters
    ----------
    grid : LoadedGrid
    y, status
        To start from.
    loading : float
        λ.
    tolerance : float
        Largest mismatch. [p.u.]
    near : bool
        The state must lie so near that a few full Newton steps and changes lead to it.
    """
    passes, iterations, halvings = (20, 5, 0) if near else (2 * grid.n + 1, 30, 10)
    condition = coordinate(2 * grid.n + 1, loading)
    for together in (True, False):
        moved, held = y, status.copy()
        for _ in range(passes):
            found = grid.solve(
                moved,
                held,
                condition,
                tolerance=tolerance,
                max_iterations=iterations,
                halvings=halvings,
            )
            if found is None:
                break
            moved = found
            by, target = excess(grid, moved, held)
            beyond = by > MARGIN
            if not beyond.any():
                return moved, held
            if not together:
                beyond &= np.arange(grid.n) == np.argmax(by)
            held[beyond] = target[beyond]
    return None
