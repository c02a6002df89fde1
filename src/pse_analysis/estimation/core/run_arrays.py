"""Run a filter over measurements that stand in arrays, for experiments of many trials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import TableError
from pse_analysis.estimation.core.interface import Info, Snapshot
from pse_analysis.estimation.filters.recursion import GaussianFilter
from pse_analysis.vocabulary import Status

EPOCH = np.datetime64("2000-01-01T00:00:00", "us")


@dataclass(frozen=True, eq=False)
class ArrayRun:
    """What a filter made of T snapshots.

    Attributes
    ----------
    x : (T, 2N) ndarray
        [θ; |V|]; the first is the start, NaN once the filter was lost. [rad; p.u.]
    P : (n, n) ndarray
        Covariance of the estimated ones at the end.
    info : tuple of Info, length T - 1
    alpha : (T - 1,) ndarray
        α of every step, where it adapts.
    """

    x: FloatArray
    P: FloatArray
    info: tuple[Info, ...]
    alpha: FloatArray

    def rmse(self, truth: FloatArray) -> tuple[float, float]:
        """RMSE of |V| and of θ after the start. [p.u., rad]

        Notes
        -----
        Eq. (35) of [qu2018], with voltages and angles apart.
        """
        square = (self.x - truth)[1:] ** 2
        n = truth.shape[1] // 2
        return float(np.sqrt(square[:, n:].mean())), float(np.sqrt(square[:, :n].mean()))

    def field(self, name: str) -> npt.NDArray[np.generic]:
        """One field of every step's `Info`, (T - 1, …)."""
        return np.array([getattr(info, name) for info in self.info])

    def times(self, status: Status) -> int:
        """How many steps ended with a status."""
        return sum(info.status is status for info in self.info)


def run_arrays(
    made: GaussianFilter,
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    sigma: FloatArray,
    *,
    available: BoolArray | None = None,
    step_s: float = 600.0,
    first: np.datetime64 = EPOCH,
) -> ArrayRun:
    """Follow T snapshots from a given start.

    Parameters
    ----------
    made : GaussianFilter
    x : (2N,) ndarray
        [θ; |V|] at the first instant. [rad; p.u.]
    P : (n, n) ndarray
        Its covariance.
    z : (T, m) ndarray
        Measurements; the first row is not read. [p.u., rad]
    sigma : (m,) ndarray
    available : (T, m) ndarray of bool, optional
        All by default.
    step_s : float
    first : datetime64

    Returns
    -------
    ArrayRun

    Raises
    ------
    TableError
        If z does not have a column per row of the filter's layout.
    """
    m = made.model.shape[0]
    if z.ndim != 2 or z.shape[1] != m or len(sigma) != m:
        raise TableError(
            f"run_arrays: expected z of shape (T, {m}) and {m} sigmas, received {z.shape} and "
            f"{len(sigma)}"
        )
    known = np.ones(z.shape, dtype=bool) if available is None else available
    zero = np.zeros(m)
    state = made.begin(x, P, first)
    path = np.full((len(z), len(x)), np.nan)
    path[0] = x
    info: list[Info] = []
    alpha: list[float] = []
    for k in range(1, len(z)):
        now = first + k * np.timedelta64(round(step_s * 1e6), "us")
        snapshot = Snapshot(now, z[k], sigma, zero, known[k], known[k], zero)
        after, step = made.step(state, snapshot)
        info.append(step)
        if after is None:
            break
        state = after
        path[k] = state.x
        alpha.append(state.alpha)
    n = len(made.model.columns)
    return ArrayRun(path, state.P[:n, :n], tuple(info), np.array(alpha))
