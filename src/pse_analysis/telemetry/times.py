"""Times of a table of one's own, in UTC and microseconds."""

from __future__ import annotations

import logging
from zoneinfo import available_timezones

import numpy as np
import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.telemetry.channels import suggest
from pse_analysis.vocabulary import shown

log = logging.getLogger(__name__)

_EPOCHS = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
"""Units in which systems count from 1970, and how many make a second."""
_COUNTED = (3.15e8, 1.58e10)
"""Seconds since 1970 that telemetry may carry, 1980 … 2470; no two units of `_EPOCHS` overlap."""
_SHEET_DAYS = (2e4, 1e5)
"""Days since 1899-12-30, as spreadsheets count them: 1954 … 2173."""
CREDIBLE = (pd.Timestamp("1980-01-01", tz="UTC"), pd.Timestamp("2200-01-01", tz="UTC"))
"""Time outside of which a stamp is nobody's telemetry but a wrong unit's."""


def to_utc(times: pd.Series, name: str, timezone: str | None) -> pd.Series:
    """Times in UTC and microseconds, in the order of the rows and with a plain index.

    Parameters
    ----------
    times
        Column of datetime64, with a zone or without.
    name
        Of the column, for messages.
    timezone
        Zone of times that carry none.

    Raises
    ------
    TableError
        If they are no times (then the message names the conversion that fits them), carry no zone
        while none is given, or do not exist in theirs.
    """
    times = times.reset_index(drop=True)
    if not pd.api.types.is_datetime64_any_dtype(times.dtype):
        raise TableError(
            f"telemetry: column {name!r} must hold times, received {times.dtype}, e.g. "
            f"{shown(_first(times))}; {_advice(times, name)}"
        )
    if times.dt.tz is None:
        if timezone is None:
            raise TableError(
                f"telemetry: column {name!r} has no time zone (first: {times.iloc[0]}); expected "
                "UTC or any other zone: pass timezone='UTC' or e.g. timezone='Europe/Berlin'"
            )
        try:
            pd.Timestamp(0).tz_localize(timezone)
        except Exception as error:
            raise TableError(
                f"telemetry: no time zone {timezone!r}: "
                f"{suggest(str(timezone), available_timezones())}"
            ) from error
        try:
            times = times.dt.tz_localize(timezone)
        except Exception as error:
            raise TableError(
                f"telemetry: column {name!r} cannot be read as times in {timezone!r} ({error}); "
                "around a change of summer time only the source's UTC offset tells: export UTC, "
                f"or offsets, and read them with pandas.to_datetime(frame.{name}, utc=True)"
            ) from error
    try:
        utc = times.dt.tz_convert("UTC").dt.as_unit("us")
    except (OverflowError, ValueError) as error:  # OutOfBoundsDatetime is a ValueError
        raise TableError(
            f"telemetry: column {name!r} holds times that no calendar reaches ({error}): check "
            "the unit that they were read with"
        ) from error
    _name_incredible(utc, name)
    return utc


def _name_incredible(times: pd.Series, name: str) -> None:
    """Warn of stamps far from any telemetry, as seconds read as nanoseconds give them."""
    outside = ((times < CREDIBLE[0]) | (times >= CREDIBLE[1])).to_numpy()
    if outside.any():
        log.warning(
            "telemetry: %d of %d times in %s lie outside %d … %d, e.g. %s: numbers that were read "
            "with a wrong unit look so; pandas.to_datetime(…, unit='s') reads seconds since 1970",
            *(int(outside.sum()), len(times), name, CREDIBLE[0].year, CREDIBLE[1].year),
            times[outside].iloc[0],
        )


def _first(values: pd.Series) -> object:
    """The first value that is there."""
    there = values[values.notna()]
    return (there if len(there) else values).iloc[0]


def _advice(times: pd.Series, name: str) -> str:
    """Which conversion fits what stands in a column of times."""
    column = f"frame.{name}"
    if isinstance(times.dtype, pd.PeriodDtype):
        return f"use {column}.dt.to_timestamp(), with timezone= here"
    numbers = pd.to_numeric(times, errors="coerce") if _may_count(times) else None
    if numbers is not None and numbers.notna().any():
        given = column
        if not pd.api.types.is_numeric_dtype(times.dtype):
            given = f"pandas.to_numeric({column})"
        size = float(np.median(np.abs(numbers.dropna().to_numpy(dtype=np.float64))))
        for unit, per_second in _EPOCHS:
            if _COUNTED[0] <= size / per_second < _COUNTED[1]:
                return (
                    f"these numbers are {unit} since 1970: use pandas.to_datetime({given}, "
                    f"unit={unit!r}, utc=True)"
                )
        if _SHEET_DAYS[0] <= size < _SHEET_DAYS[1]:
            return (
                "these numbers are days as spreadsheets count them: use pandas.to_datetime("
                f"{given}, unit='D', origin='1899-12-30'), with timezone= here"
            )
        return (
            "these numbers are no s, ms, us or ns since 1970: find out from which origin and in "
            f"which unit they count, and use pandas.to_datetime({given}, unit=…, origin=…)"
        )
    return (
        f"use pandas.to_datetime({column}, utc=True), or without utc and with timezone= here if "
        "they are local times"
    )


def _may_count(times: pd.Series) -> bool:
    """Whether a column may hold numbers, or texts of numbers, that count from an epoch."""
    kind = times.dtype
    if pd.api.types.is_bool_dtype(kind) or pd.api.types.is_complex_dtype(kind):
        return False
    if pd.api.types.is_numeric_dtype(kind):
        return True
    return pd.api.types.is_object_dtype(kind) and pd.api.types.infer_dtype(times, skipna=True) in (
        *("string", "integer", "floating", "mixed-integer-float", "decimal"),
    )
