"""Schemas of the tables, checked at every read and write."""

from __future__ import annotations

import enum
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

import numpy as np

from pse_analysis.errors import TableError
from pse_analysis.vocabulary.columns import plain_columns
from pse_analysis.vocabulary.terms import (
    Aggregation,
    FaultKind,
    Flag,
    Origin,
    Quantity,
    Side,
    SigmaKind,
    Source,
    Status,
)

if TYPE_CHECKING:
    import pandas as pd
    import pandera.errors
    import pandera.pandas as pa

PERIOD_S = (1e-6, 1e9)
"""Shortest and longest sampling period: stamps count microseconds, and 64 bits of them. [s]"""

KEYS: MappingProxyType[str, tuple[str, ...]] = MappingProxyType(
    {
        "telemetry": ("trial", "channel", "seq"),
        "channels": ("channel",),
        "truth": ("trial", "time_utc", "element", "quantity"),
        "sample_truth": ("trial", "channel", "seq"),
        "faults": ("trial", "channel", "kind", "seq"),
        "validated": ("trial", "channel", "seq"),
        "aligned": ("variant", "trial", "time_utc", "channel"),
        "estimated": ("method", "trial", "time_utc", "element", "quantity"),
        "residuals": ("method", "trial", "time_utc", "channel"),
        "steps": ("method", "trial", "time_utc"),
        "scored": ("method", "trial", "metric", "element"),
    }
)
"""Columns that identify a row of each table."""


@cache
def schema(table: str) -> pa.DataFrameSchema:
    """Pandera schema of a table.

    Pandera is imported here, so that reading a flag does not wait for it.

    Raises
    ------
    KeyError
        If there is no such table.
    """
    import pandera.pandas as pa
    from pandas.api.types import infer_dtype

    def col(
        kind: object, *checks: pa.Check, nullable: bool = False, required: bool = True
    ) -> pa.Column:
        return pa.Column(
            kind, checks=list(checks), nullable=nullable, required=required, coerce=False
        )

    def text(*checks: pa.Check) -> pa.Column:
        # pandas' own look at the values: pandera's calls Python once per row.
        strings = pa.Check(
            lambda values: infer_dtype(values, skipna=False) in ("string", "empty"),
            error="text",
        )
        return col(None, strings, *checks)

    def one_of(values: type[enum.StrEnum]) -> pa.Check:
        names = [str(v) for v in values]
        return pa.Check.isin(names, error=f"one of {', '.join(map(repr, names))}")

    above_0, not_below_0 = pa.Check.gt(0, error="above 0"), pa.Check.ge(0, error="0 or above")
    low, high = PERIOD_S
    seconds = pa.Check.in_range(low, high, error=f"{low:g} … {high:g} seconds")
    element = pa.Check.str_matches(
        r"^(bus|branch|machine)/.+", error="bus/NAME, branch/NAME or machine/NAME"
    )
    flags = ", ".join(f"{int(f)} ({f.name.lower()})" for f in Flag)

    utc = "datetime64[us, UTC]"
    key_sample = {"trial": col("int32"), "channel": text(), "seq": col("int64")}
    sample = {
        "time_utc": col(utc),
        "arrival_utc": col(utc, nullable=True),
        "value": col("float64", nullable=True),
        "quality": col("Int16", nullable=True),
    }
    finding = {
        "flag": col("int8", pa.Check.isin([int(f) for f in Flag], error=f"one of {flags}")),
        "reasons": col("int32"),
    }
    step_key = {"method": text(), "trial": col("int32"), "time_utc": col(utc)}
    tables: dict[str, dict[str, pa.Column]] = {
        "telemetry": {**key_sample, **sample},
        "channels": {
            "channel": text(),
            "source": text(one_of(Source)),
            "quantity": text(one_of(Quantity)),
            "element": text(element),
            "side": text(one_of(Side)),
            "unit": text(),
            "sigma": col("float64", above_0),
            "sigma_kind": text(one_of(SigmaKind)),
            "lower": col("float64", nullable=True),
            "upper": col("float64", nullable=True),
            "period_s": col("float64", above_0, seconds),
            "sign": col("int8", pa.Check.isin([-1, 1], error="1 or -1")),
            "aggregation": text(one_of(Aggregation)),
        },
        "truth": {
            "trial": col("int32"),
            "time_utc": col(utc),
            "element": text(),
            "quantity": text(one_of(Quantity)),
            "value": col("float64"),
        },
        "sample_truth": {**key_sample, "time_utc": col(utc), "value": col("float64")},
        "faults": {
            "trial": col("int32"),
            "channel": text(),
            "seq": col("Int64", nullable=True),
            "time_utc": col(utc),
            "kind": text(one_of(FaultKind)),
            "size": col("float64"),
        },
        "validated": {
            **key_sample,
            **sample,
            **finding,
            "statistic": col("float64", nullable=True),
            "threshold": col("float64", nullable=True),
            "corrected": col("float64", nullable=True),
        },
        "aligned": {
            "variant": text(),
            "trial": col("int32"),
            "time_utc": col(utc),
            "channel": text(),
            "value_pu": col("float64"),
            "sigma_pu": col("float64", above_0),
            "sigma_age_pu": col("float64", not_below_0),
            "origin": text(one_of(Origin)),
            "sample_utc": col(utc),
            "time_confidence": col("float64", pa.Check.in_range(0, 1, error="0 … 1")),
            "age_s": col("float64", not_below_0),
            **finding,
        },
        "estimated": {
            **step_key,
            "element": text(),
            "quantity": text(one_of(Quantity)),
            "value": col("float64", nullable=True),
            "sigma": col("float64", nullable=True),
            "relative": col("float64", nullable=True),
            "sigma_relative": col("float64", nullable=True),
        },
        "residuals": {
            **step_key,
            "channel": text(),
            "innovation": col("float64"),
            "sigma_innovation": col("float64", above_0),
            "inflation": col("float64", not_below_0),
            "used": col("bool"),
            "reasons": col("int32"),
        },
        "steps": {
            **step_key,
            "status": text(one_of(Status)),
            "iterations": col("int32"),
            "nis": col("float64", nullable=True),
            "nees": col("float64", nullable=True),
            "dof": col("int32"),
            "rejected": col("int32"),
            "seconds": col("float64"),
            "detail": text(),
        },
        "scored": {
            "method": text(),
            "trial": col("int32"),
            "metric": text(),
            "element": text(),
            "value": col("float64", nullable=True),
            "unit": text(),
            "published": col("float64", nullable=True),
            "source": text(),
        },
    }
    return pa.DataFrameSchema(tables[table], strict="filter", name=table)


def check(table: str, frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with its columns checked against the schema, in the schema's order.

    Raises
    ------
    TableError
        With the table, the column, what was expected and what came.
    """
    import pandera.errors

    expected = schema(table)
    columns = list(expected.columns)
    frame = plain_columns(table, frame, columns)
    missing = [name for name in columns if name not in frame.columns]
    if missing:
        raise TableError(
            f"{table}: column {missing[0]!r} is missing; expected columns "
            f"{', '.join(columns)}; received {', '.join(map(str, frame.columns))}"
        )
    try:
        checked = expected.validate(frame[columns], lazy=False)
    except pandera.errors.SchemaError as error:
        raise TableError(_broken(table, frame, error)) from error
    if table != "faults":
        repeated = checked.duplicated(list(KEYS[table])).to_numpy()
        if repeated.any():
            first = checked.iloc[int(np.argmax(repeated))]
            row = ", ".join(f"{key} {shown(first[key])}" for key in KEYS[table])
            raise TableError(
                f"{table}: {int(repeated.sum())} rows repeat the key of another, the first has "
                f"{row}; expected one row each: leave one out, or give it a key of its own"
            )
    return cast("pd.DataFrame", checked)


def shown(value: object) -> str:
    """A value as a message shows it, without numpy's or pandas' type around it."""
    if hasattr(value, "isoformat"):
        return str(value)
    return repr(value.item() if isinstance(value, np.generic) else value)


def _broken(table: str, frame: pd.DataFrame, error: pandera.errors.SchemaError) -> str:
    """The row that breaks its schema, what was expected there and what came."""
    column = str(getattr(error.schema, "name", None) or "?")
    series, where = frame[column], f"{table}: column {column!r}"
    if not len(series):
        return f"{where}: no rows, and type {series.dtype}; expected {error.check}: fill the table"
    if str(error.check) == "not_nullable":
        wanted, bad = "a value in every row", series.isna()
    elif getattr(error.check, "error", None) == "text":
        wanted, bad = "text", ~series.map(lambda value: isinstance(value, str))
    elif getattr(error.check, "error", None):
        wanted, bad = error.check.error, _failing(table, series)
    else:
        kind = schema(table).columns[column].dtype
        return (
            f"{where}: expected type {kind}, received {series.dtype}, e.g. "
            f"{shown(series.iloc[0])}; convert the column"
        )
    row = int(np.argmax(np.asarray(bad, dtype=bool)))
    keys = [f"{key} {shown(frame[key].iloc[row])}" for key in KEYS[table] if key != column]
    return (
        f"{where}{' of ' if keys else ''}{', '.join(keys)}: expected {wanted}, received "
        f"{shown(series.iloc[row])}; mend that row, or leave it out"
    )


def _failing(table: str, series: pd.Series) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Rows that break the schema of their column, by position: an index may repeat its labels."""
    import pandera.errors

    plain = series.reset_index(drop=True)
    try:
        schema(table).columns[str(series.name)].validate(plain.to_frame(), lazy=False)
    except pandera.errors.SchemaError as error:
        return np.asarray(plain.index.isin(error.failure_cases["index"]))
    return np.ones(len(series), dtype=bool)
