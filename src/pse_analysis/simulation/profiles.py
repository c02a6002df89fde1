"""Real 15-min curves of load and infeed, and a stochastic bridge between their points.

A linear interpolation would make every increment below 15 min predictable (lag-1 autocorrelation
above 0.86), and any result about increments an artefact. The bridge draws the movement in between
from a process whose increments have a stated lag-1 autocorrelation, conditioned on the points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from scipy.linalg import solve_toeplitz

from pse_analysis.arrays import FloatArray
from pse_analysis.checksums import read_checksums
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.files import check
from pse_analysis.telemetry.parquet import read_arrow, to_pandas

PROFILE_STEP_S = 900.0
"""Step that curves must have. [s]"""

FILE = "week.parquet"


def load(folder: str | Path) -> pd.DataFrame:
    """Curves of load classes and PV plants.

    Parameters
    ----------
    folder
        Folder that holds ``week.parquet``, e.g. ``data/raw/load_profiles``; or such a file itself.

    Returns
    -------
    DataFrame
        Indexed by ``time_utc``, 15-min steps; columns ``<class>_pload``, ``<class>_qload`` and
        ``PV<i>``, relative to the peak. [1]

    Raises
    ------
    TableError
        If the file is absent, unreadable, not in steps of 15 min of UTC, or has gaps.
    """
    path = Path(folder)
    path = path / FILE if path.suffix != ".parquet" else path
    if not path.is_file():
        raise TableError(
            f"load profiles: no file {path}; expected the folder data/raw/load_profiles of this "
            "project: pass the data folder it lies in"
        )
    remedy = "restore it from the repository, or run take_extract.py beside it"
    listed = read_checksums(path.parent)
    if path.name in listed:
        check(path, listed[path.name], remedy)
    try:
        frame = to_pandas(read_arrow(path))
    except TableError as error:
        raise TableError(f"load profiles: {error}; {remedy}") from error
    if "time_utc" not in frame.columns:
        raise TableError(
            f"load profiles: {path} lacks the column 'time_utc'; received "
            f"{', '.join(map(str, frame.columns[:6]))}, …"
        )
    index = pd.DatetimeIndex(frame.pop("time_utc"))
    if index.tz is None:
        raise TableError(
            f"load profiles: time_utc of {path} has no time zone; expected timestamp[us, tz=UTC]"
        )
    frame.index = index.tz_convert("UTC").as_unit("us")
    step = np.diff(frame.index.asi8) / 1e6
    if len(frame) < 2 or np.any(step != PROFILE_STEP_S):
        raise TableError(
            f"load profiles: {path} must rise in steps of {PROFILE_STEP_S:g} s, received "
            f"{sorted(set(step.tolist()))[:4]}"
        )
    frame = frame.astype("float64")
    if not bool(np.isfinite(frame.to_numpy()).all()):
        gap = frame.columns[~np.isfinite(frame.to_numpy()).all(axis=0)][0]
        raise TableError(f"load profiles: column {gap!r} of {path} has gaps; fill or drop it")
    return frame


def between(profiles: pd.DataFrame, start: pd.Timestamp, end: pd.Timestamp) -> pd.DataFrame:
    """Curves from the last point at or before ``start`` to the first at or after ``end``.

    Raises
    ------
    ParameterError
        If the curves do not reach that far.
    """
    index = pd.DatetimeIndex(profiles.index)
    first = int(index.searchsorted(start, side="right")) - 1
    last = int(index.searchsorted(end, side="left"))
    if first < 0 or last >= len(index):
        raise ParameterError(
            f"[study] the load curves reach from {index[0].isoformat()} to "
            f"{index[-1].isoformat()}, the telemetry would reach from {start.isoformat()} to "
            f"{end.isoformat()}: move start and end, or shorten history_s"
        )
    return profiles.iloc[first : max(last, first + 1) + 1]


def column(profiles: pd.DataFrame, name: str, where: str) -> FloatArray:
    """One curve as an array.

    Raises
    ------
    ParameterError
        If there is no such curve; the message lists those there are.
    """
    if name not in profiles.columns:
        names = sorted({str(c).removesuffix("_pload").removesuffix("_qload") for c in profiles})
        raise ParameterError(
            f"[{where}] no curve {name!r} among the load profiles: expected any of "
            f"{', '.join(names)}"
        )
    return np.asarray(profiles[name].to_numpy(), dtype=np.float64)


def ar1(drive: FloatArray, phi: float) -> FloatArray:
    """Solution of y_k = φ y_{k−1} + drive_k along the last axis, from y_{−1} = 0.

    Sums over twice as many terms in each pass, so a record takes about log₂ n passes.
    """
    y = np.array(drive, dtype=np.float64)
    reach = 1
    while reach < y.shape[-1] and abs(phi) ** reach > 1e-18:
        y[..., reach:] += phi**reach * y[..., :-reach]
        reach *= 2
    return y


def local_volatility(points: FloatArray, window: int = 8) -> FloatArray:
    """Root mean square of the increments around each interval.

    Parameters
    ----------
    points : (n, n_interval + 1) ndarray
        Values at the ends of the intervals.
    window : int
        Number of intervals averaged over, centred; fewer at the ends of the record.

    Returns
    -------
    (n, n_interval) ndarray
        Standard deviation of an increment over one interval, in the unit of ``points``.
    """
    square = np.diff(points, axis=1) ** 2
    total = np.cumsum(np.pad(square, ((0, 0), (1, 0))), axis=1)
    centre = np.arange(square.shape[1])
    low = np.maximum(centre - window // 2, 0)
    high = np.minimum(centre + (window - window // 2), square.shape[1])
    mean = (total[:, high] - total[:, low]) / (high - low)
    # Differences of a running sum may fall below zero by rounding.
    return np.asarray(np.sqrt(np.maximum(mean, 0.0)))


def bridge(
    points: FloatArray,
    normal: FloatArray,
    *,
    rho1: float = 0.0,
    volatility: FloatArray | None = None,
    window: int = 8,
    scale: Literal["linear", "log", "nonnegative"] = "linear",
) -> FloatArray:
    """Paths through the points whose small increments have a stated autocorrelation.

    Parameters
    ----------
    points : (n, n_interval + 1) ndarray
        Values at the ends of the intervals, any unit.
    normal : (n, n_interval·k) ndarray
        Independent standard normal numbers; k is the number of steps per interval. Rows that are
        correlated with each other give correlated paths.
    rho1 : float
        Lag-1 autocorrelation of the increments per step; 0 is the Brownian bridge.
    volatility : (n, n_interval) ndarray, optional
        Standard deviation of the increment over one interval, on the chosen scale; by default
        `local_volatility` of the points.
    window : int
        Intervals over which the default volatility is averaged.
    scale
        ``linear``: additive. ``log``: the bridge runs on the logarithm, so paths stay positive.
        ``nonnegative``: additive and clipped at zero, still where both ends are zero (PV at night).

    Returns
    -------
    (n, n_interval·k + 1) ndarray
        The paths; column j·k equals ``points[:, j]`` exactly.

    Raises
    ------
    ParameterError
        If shapes do not fit, |rho1| ≥ 1, or the points do not allow the scale.

    Notes
    -----
    Unit increments over an interval are u = Δx/volatility. The increments per step e follow a
    stationary AR(1) with coefficient φ = rho1, scaled so that their sum over an interval has
    variance 1. A free path e is conditioned on all sums at once,
    δ = e + Cov(e, Ae) Cov(Ae)⁻¹ (u − Ae), with A the sum per interval: δ has exactly the law of e
    given the points. Cov(Ae) is Toeplitz and Cov(e, Ae) decays geometrically, so the cost is linear
    in the number of steps. If the points themselves move as this law says (increments with variance
    volatility²), the path has increments of variance volatility²·Var(e) and lag-1 autocorrelation
    φ, across the points as well.
    """
    points = np.atleast_2d(np.asarray(points, dtype=np.float64))
    n, n_interval = points.shape[0], points.shape[1] - 1
    k, rest = divmod(normal.shape[1], max(n_interval, 1))
    if n_interval < 1 or rest or k < 1 or normal.shape[0] != n:
        raise ParameterError(
            f"bridge: {n} rows of {n_interval} intervals need normal numbers of shape "
            f"({n}, {n_interval}·k), received {normal.shape}"
        )
    if not -1.0 < rho1 < 1.0:
        raise ParameterError(f"bridge: rho1 must lie between -1 and 1, received {rho1}")
    if scale != "linear" and bool(np.any(points < 0 if scale == "nonnegative" else points <= 0)):
        raise ParameterError(
            f"bridge: scale {scale!r} needs {'positive' if scale == 'log' else 'non-negative'} "
            f"points, received a smallest of {points.min():g}; use scale 'linear'"
        )
    x = np.log(points) if scale == "log" else points
    sigma = local_volatility(x, window) if volatility is None else np.asarray(volatility)
    if scale == "nonnegative":
        sigma = np.where((points[:, 1:] == 0) & (points[:, :-1] == 0), 0.0, sigma)
    increment = np.diff(x, axis=1)
    still = sigma <= 0
    unit = np.where(still, 0.0, increment / np.where(still, 1.0, sigma))
    step = _conditioned(unit, normal, rho1) * sigma[:, :, None]
    # An interval without volatility is a straight line.
    step = np.where(still[:, :, None], increment[:, :, None] / k, step)
    path = np.empty((n, n_interval * k + 1))
    path[:, :1] = x[:, :1]
    # The sums start anew at each point, so that rounding does not accumulate over the record.
    path[:, 1:] = (x[:, :-1, None] + np.cumsum(step, axis=2)).reshape(n, -1)
    if scale == "log":
        path = np.exp(path)
    elif scale == "nonnegative":
        path = np.maximum(path, 0.0)
    path[:, ::k] = points
    return path


def _conditioned(unit: FloatArray, normal: FloatArray, phi: float) -> FloatArray:
    """AR(1) increments per step, (n, n_interval, k), whose sums per interval are ``unit``."""
    n, n_interval = unit.shape
    k = normal.shape[1] // n_interval
    sigma2 = step_variance(k, phi)
    drive = normal * np.sqrt(1.0 - phi**2)
    drive[:, 0] = normal[:, 0]
    free = (np.sqrt(sigma2) * ar1(drive, phi)).reshape(n, n_interval, k)

    geometric = float(np.sum(phi ** np.arange(k)))
    decay = phi**k
    covariance = np.empty(n_interval)
    covariance[0] = 1.0
    covariance[1:] = sigma2 * phi * geometric**2 * decay ** np.arange(n_interval - 1)
    weight = solve_toeplitz(covariance, (unit - free.sum(axis=2)).T).T

    def tail(w: FloatArray) -> FloatArray:
        """Sum over earlier intervals, decaying by φᵏ for each interval in between."""
        return ar1(np.pad(w[:, :-1], ((0, 0), (1, 0))), decay)

    before = tail(weight)
    after = tail(weight[:, ::-1])[:, ::-1]
    position = np.arange(k)
    own = np.sum(phi ** np.abs(position[:, None] - position[None, :]), axis=1)
    return np.asarray(
        free
        + sigma2 * own * weight[:, :, None]
        + sigma2 * geometric * phi ** (position + 1) * before[:, :, None]
        + sigma2 * geometric * phi ** (k - position) * after[:, :, None]
    )


def step_variance(k: int, rho1: float = 0.0) -> float:
    """Variance of one step's increment when an interval of k steps has variance 1.

    Parameters
    ----------
    k
        Steps per interval.
    rho1
        Lag-1 autocorrelation of the increments.

    Returns
    -------
    float
        1/(k + 2 Σ_{d<k} (k − d) rho1^d).
    """
    lag = np.arange(1, k)
    return float(1.0 / (k + 2.0 * np.sum((k - lag) * rho1**lag)))
