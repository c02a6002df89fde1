"""All checks in one call on a pandas Series of the user's own."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime, timedelta

import numpy as np
import pandas as pd

from pse_analysis.errors import ParameterError
from pse_analysis.validation import qartod
from pse_analysis.validation.checks import numbers, ticks, usual_step
from pse_analysis.validation.rules import Rule, ValidateParams
from pse_analysis.validation.stage import validate
from pse_analysis.validation.timing import NO_TIME
from pse_analysis.vocabulary import Flag, Reason, usable

HISTORY_SHARE = 0.25
"""Part of a series that counts as history where nothing is said."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NAME = "series"


def check_series(
    series: pd.Series,
    *,
    lower: float | None = None,
    upper: float | None = None,
    period: float | pd.Timedelta | None = None,
    history_end: datetime | pd.Timestamp | float | None = None,
    rule: Rule | None = None,
) -> pd.DataFrame:
    """Limits, increments, extrapolation, stuck values and time stamps of one series.

    Parameters
    ----------
    series : Series
        Samples in order of arrival. A ``DatetimeIndex`` gives their times (naive ones are taken
        as UTC); with any other index, samples count as one second apart.
    lower, upper : float, optional
        Limits. [unit]
    period : float or Timedelta, optional
        Sampling period; default the median time step of the history. [s]
    history_end : datetime or float, optional
        What lies before it is the history that σ and k are learnt from; from it on, flags depend
        on samples up to their own only. A number counts seconds, or rows without times. Default:
        the first quarter of the samples.
    rule : Rule, optional
        Anything else: criterion, q, costs, k, given thresholds, …

    Returns
    -------
    DataFrame
        With the index of the series: ``value``, ``flag``, ``reasons``, ``statistic``,
        ``threshold``, ``corrected`` and ``qartod``.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> load = pd.Series(20 + np.random.default_rng(2).normal(0, 0.1, 400).cumsum())
    >>> load[300] += 5
    >>> found = check_series(load)
    >>> found.index[found.flag == 2].tolist()
    [300]
    """
    n = len(series)
    value = numbers(series)
    index = series.index
    time = ticks(index) if isinstance(index, pd.DatetimeIndex) else np.arange(n) * 1_000_000
    timed = time != NO_TIME
    end = _end(history_end, time, timed)
    past = timed if end is None else timed & (time < end)
    step = usual_step(time[past]) if period is None else _microseconds(period)
    if not step > 0.0:
        raise ParameterError(f"period must be positive, received {period}")

    rule = Rule() if rule is None else rule
    rule = dataclasses.replace(
        rule,
        source="*",
        quantity="*",
        channel="*",
        unit=None,
        lower=rule.lower if lower is None else lower,
        upper=rule.upper if upper is None else upper,
    )
    stamp = pd.Series(pd.DatetimeIndex(time[timed].astype("datetime64[us]"), tz="UTC"))
    count = int(timed.sum())
    telemetry = pd.DataFrame(
        {
            "trial": np.zeros(count, dtype=np.int32),
            "channel": np.full(count, _NAME, dtype=object),
            "seq": np.flatnonzero(timed).astype(np.int64),
            "time_utc": stamp,
            "arrival_utc": pd.Series(pd.NaT, index=stamp.index, dtype="datetime64[us, UTC]"),
            "value": value[timed],
            "quality": pd.array([pd.NA] * count, dtype="Int16"),
        }
    )
    channels = pd.DataFrame(
        {
            "channel": [_NAME], "source": ["scada"], "quantity": ["p_mw"], "element": ["bus/1"],
            "side": [""], "unit": ["pu"], "sigma": [np.finfo(float).tiny],
            "sigma_kind": ["absolute"], "lower": [np.nan], "upper": [np.nan],
            "period_s": [step / 1e6], "sign": np.array([1], dtype=np.int8),
            "aggregation": ["instant"],
        }
    )  # fmt: skip
    until = None if end is None else _EPOCH + timedelta(microseconds=end)
    found = validate(telemetry, channels, ValidateParams((rule,)), history_end=until)

    out = pd.DataFrame(
        {
            "value": value,
            "flag": np.full(n, Flag.MISSING, dtype=np.int8),
            "reasons": np.full(n, Reason.NOT_FINITE, dtype=np.int32),
            "statistic": np.full(n, np.nan),
            "threshold": np.full(n, np.nan),
        },
        index=index,
    )
    for name in ("flag", "reasons", "statistic", "threshold"):
        column = out[name].to_numpy().copy()
        column[timed] = found[name].to_numpy()
        out[name] = column
    out["corrected"] = np.where(usable(out["flag"].to_numpy()), value, np.nan)
    out["qartod"] = qartod.codes(out["flag"].to_numpy(), out["threshold"].to_numpy())
    return out


def _microseconds(period: float | pd.Timedelta) -> float:
    return float(pd.Timedelta(period, unit="s") / pd.Timedelta(1, unit="us"))


def _end(
    history_end: datetime | pd.Timestamp | float | None,
    time: np.ndarray,
    timed: np.ndarray,
) -> int | None:
    """History's end in microseconds; None where no sample has a time."""
    if history_end is None:
        known = np.sort(time[timed])
        return int(known[int(len(known) * HISTORY_SHARE)]) if len(known) else None
    if isinstance(history_end, int | float):
        return int(history_end * 1_000_000)
    return int(ticks(pd.DatetimeIndex([history_end]))[0])
