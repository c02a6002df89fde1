"""Each check on its own: from a series, or a block of them, to booleans of the same index.

True always means flagged. A sample that a check cannot judge (NaN, the first of a series) is not
flagged by it; `not_finite` and `gap` say so instead. Rows stand in order of arrival. Nothing here
looks ahead.

Values are a `pandas.Series`, a `pandas.DataFrame` of one channel per column, or an array of one or
two dimensions; the flags come back as the same kind. Times come from a ``DatetimeIndex``, or from
``time`` (datetimes, or numbers in the unit of ``period``); without either, samples count as one
period apart.
"""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import BoolArray, FloatArray, utc_microseconds
from pse_analysis.errors import ParameterError
from pse_analysis.validation import timing
from pse_analysis.validation.block import Criteria, screen
from pse_analysis.validation.motion import Motion, extrapolating, given
from pse_analysis.vocabulary import Reason

Samples = TypeVar("Samples", pd.Series, pd.DataFrame, npt.NDArray[Any])


def not_finite(values: Samples) -> Samples:
    """NaN and ±inf."""
    return _like(values, ~np.isfinite(block(values)))


def limits(
    values: Samples, lower: npt.ArrayLike = -np.inf, upper: npt.ArrayLike = np.inf
) -> Samples:
    """Finite values below ``lower`` or above ``upper`` (numbers, or one per channel)."""
    x = block(values)
    low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    return _like(values, np.isfinite(x) & ((x < low) | (x > high)))


def increment(
    values: Samples,
    threshold: npt.ArrayLike,
    *,
    period: float | pd.Timedelta | None = None,
    time: npt.ArrayLike | None = None,
    confirm: int = 2,
) -> Samples:
    """Change since the last good sample above γ; eq. (1) of [anishchenko2018].

    Parameters
    ----------
    values : Series, DataFrame or array
        Samples in order of arrival. [unit]
    threshold : float or (n_channel,)
        γ over one period; γ√m over m periods. [unit]
    period : float or Timedelta, optional
        Sampling period; default the median of the time steps. [s where times are datetimes]
    time : array_like, optional
        Times in place of the index.
    confirm : int
        Samples that must agree with a flagged one before a step is accepted.
    """
    x = block(values)
    motion = given(_positive("threshold", threshold), x.shape[1], _at_least("confirm", confirm, 1))
    return _like(values, _moved(values, motion, period, time, Reason.INCREMENT))


def extrapolation(
    values: Samples,
    threshold: npt.ArrayLike,
    k: npt.ArrayLike,
    *,
    period: float | pd.Timedelta | None = None,
    time: npt.ArrayLike | None = None,
    confirm: int = 2,
) -> Samples:
    """Deviation from the extrapolated value above γ; eqs. (12), (14) of [anishchenko2018].

    Parameters
    ----------
    values : Series, DataFrame or array
        Samples in order of arrival. [unit]
    threshold : float or (n_channel,)
        γ over one period. Over gaps it grows as for increments of autocorrelation k, k², …
        [unit]
    k : float or (n_channel,)
        Coefficient of the last increment; 0 is the first-increment check.
    period, time, confirm
        As for `increment`.
    """
    x = block(values)
    motion = extrapolating(
        _positive("threshold", threshold), k, x.shape[1], _at_least("confirm", confirm, 1)
    )
    return _like(values, _moved(values, motion, period, time, Reason.EXTRAPOLATION))


def stuck(values: Samples, count: int, *, at_zero: bool = True) -> Samples:
    """The ``count``-th and later of equal values in a row; exact zeros too unless told not to."""
    x = block(values)
    n_channel = x.shape[1]
    criteria = Criteria(
        lower=np.full(n_channel, np.nan),
        upper=np.full(n_channel, np.nan),
        motion=_no_motion(n_channel),
        stuck=np.full(n_channel, _at_least("count", count, 2)),
        stuck_at_zero=np.full(n_channel, at_zero),
    )
    found = screen(x, np.arange(len(x)), criteria, detail=False).reasons
    return _like(values, (found & Reason.STUCK) != 0)


def duplicate(values: Samples, *, time: npt.ArrayLike | None = None) -> Samples:
    """Samples whose time stamp an earlier one already had."""
    return _like(values, timing.duplicates(_stamps(values, time))[:, None])


def backward(values: Samples, *, time: npt.ArrayLike | None = None) -> Samples:
    """Samples stamped before one that arrived earlier."""
    stamps = _stamps(values, time)
    latest = timing.latest_before(stamps)
    known = stamps.time != timing.NO_TIME
    return _like(values, (known & (stamps.time < latest))[:, None])


def gap(
    values: Samples,
    *,
    period: float | pd.Timedelta | None = None,
    time: npt.ArrayLike | None = None,
) -> Samples:
    """Samples before which at least one is missing."""
    stamps = _stamps(values, time)
    step = _step(stamps, period)
    latest = timing.latest_before(stamps)
    since = np.where(latest == timing.NO_TIME, 0, stamps.time - np.maximum(latest, -(2**62)))
    return _like(values, (since > timing.GAP_PERIODS * step)[:, None])


def late(
    values: Samples,
    arrival: npt.ArrayLike,
    allowed: float | pd.Timedelta,
    *,
    time: npt.ArrayLike | None = None,
) -> Samples:
    """Samples that arrived more than ``allowed`` after their stamp. [s where datetimes]"""
    stamps = _stamps(values, time)
    came = ticks(arrival)
    known = (came != timing.NO_TIME) & (stamps.time != timing.NO_TIME)
    limit = pd.Timedelta(allowed, unit="s") / pd.Timedelta(1, unit="us")
    delay = np.where(known, came - stamps.time, 0)
    return _like(values, (known & (delay > limit))[:, None])


def block(values: pd.Series | pd.DataFrame | npt.NDArray[Any]) -> FloatArray:
    """Values as floats, (n, n_channel); what is not a number becomes NaN."""
    if isinstance(values, pd.Series):
        return numbers(values)[:, None]
    if isinstance(values, pd.DataFrame):
        columns = [numbers(values.iloc[:, i]) for i in range(values.shape[1])]
        return np.column_stack(columns) if columns else np.empty((len(values), 0))
    array = np.asarray(values, dtype=float)
    return array[:, None] if array.ndim == 1 else array


def numbers(series: pd.Series) -> FloatArray:
    """A series as floats; NaN where it holds no number."""
    return np.asarray(pd.to_numeric(series, errors="coerce").to_numpy(dtype=float, na_value=np.nan))


def ticks(times: npt.ArrayLike | pd.Index) -> npt.NDArray[np.int64]:
    """Times as whole microseconds; numbers count as seconds; `timing.NO_TIME` where missing."""
    index = pd.Index(times)
    if isinstance(index, pd.DatetimeIndex):
        return utc_microseconds(index).astype(np.int64)
    seconds = np.asarray(pd.to_numeric(index, errors="coerce"), dtype=float)
    known = np.isfinite(seconds) & (np.abs(seconds) < 4e12)
    return np.where(known, np.rint(np.where(known, seconds, 0.0) * 1e6), timing.NO_TIME).astype(
        np.int64
    )


def _no_motion(n_channel: int) -> Motion:
    off = np.full(n_channel, np.inf)
    return Motion(
        np.tile(np.arange(3.0), (n_channel, 1)),
        np.zeros(n_channel),
        off,
        off,
        np.ones(n_channel, dtype=np.int64),
    )


def _moved(
    values: pd.Series | pd.DataFrame | npt.NDArray[Any],
    motion: Motion,
    period: float | pd.Timedelta | None,
    time: npt.ArrayLike | None,
    reason: Reason,
) -> BoolArray:
    x = block(values)
    n_channel = x.shape[1]
    stamps = _stamps(values, time)
    timeless = stamps.time == timing.NO_TIME
    ruled_out = timing.duplicates(stamps) | timeless
    reasons = np.zeros(x.shape, dtype=np.int32)
    reasons[ruled_out] = np.int32(Reason.DUPLICATE)
    older = (stamps.time < timing.latest_before(stamps)) & ~timeless
    first = stamps.time[~timeless][:1]
    origin = int(first[0]) if len(first) else 0
    with np.errstate(over="ignore"):
        elapsed = np.where(timeless, np.nan, (stamps.time - origin) / _step(stamps, period))
    criteria = Criteria(
        lower=np.full(n_channel, np.nan),
        upper=np.full(n_channel, np.nan),
        motion=motion,
        stuck=np.zeros(n_channel, dtype=np.int64),
        stuck_at_zero=np.zeros(n_channel, dtype=bool),
    )
    found = screen(
        x,
        elapsed,
        criteria,
        reasons=reasons,
        backward=older[:, None] if older.any() else None,
        detail=False,
    ).reasons
    return np.asarray((found & reason) != 0)


def _stamps(
    values: pd.Series | pd.DataFrame | npt.NDArray[Any], time: npt.ArrayLike | None
) -> timing.Stamps:
    n = len(values)
    if time is None and isinstance(values, pd.Series | pd.DataFrame):
        time = values.index if isinstance(values.index, pd.DatetimeIndex) else None
    when = np.arange(n) * 1_000_000 if time is None else ticks(time)
    if len(when) != n:
        raise ParameterError(f"time has {len(when)} entries, the samples have {n} rows")
    return timing.Stamps(np.zeros(n, dtype=np.int64), when, np.full(n, timing.NO_TIME))


def _step(stamps: timing.Stamps, period: float | pd.Timedelta | None) -> float:
    """Sampling period. [µs]"""
    if period is not None:
        step = float(pd.Timedelta(period, unit="s") / pd.Timedelta(1, unit="us"))
        if not step > 0.0:
            raise ParameterError(f"period must be positive, received {period}")
        return step
    return usual_step(stamps.time)


def usual_step(time: npt.NDArray[np.int64]) -> float:
    """Median of the forward time steps; a second where there is none. [µs]"""
    known = time[time != timing.NO_TIME]
    steps = np.diff(known)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 1e6


def _like(values: Samples, flags: BoolArray) -> Samples:
    if isinstance(values, pd.Series):
        return cast("Samples", pd.Series(flags[:, 0], index=values.index, name=values.name))
    n_channel = 1 if values.ndim == 1 else values.shape[1]
    wide = np.broadcast_to(flags, (len(values), n_channel)).copy()
    if isinstance(values, pd.DataFrame):
        return cast(
            "Samples", pd.DataFrame(wide, index=values.index, columns=values.columns, dtype=bool)
        )
    return cast("Samples", wide[:, 0] if values.ndim == 1 else wide)


def _positive(name: str, value: npt.ArrayLike) -> FloatArray:
    array = np.asarray(value, dtype=float)
    if not np.all(array > 0.0):
        raise ParameterError(f"{name} must be > 0, received {value!r}")
    return array


def _at_least(name: str, value: int, least: int) -> int:
    if value < least:
        raise ParameterError(f"{name} must be ≥ {least}, received {value!r}")
    return int(value)
