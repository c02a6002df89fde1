"""Columns as their values, however a table stores them: categories, Arrow arrays, pandas' texts."""

from __future__ import annotations

import re
from collections.abc import Collection, Hashable
from typing import TYPE_CHECKING

import numpy as np

from pse_analysis.errors import PseError, TableError

if TYPE_CHECKING:
    import pandas as pd

CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")
"""Characters that end a line, drive a terminal or turn the direction of what follows."""


def plain_columns(
    table: str,
    frame: pd.DataFrame,
    columns: Collection[str],
    *,
    error: type[PseError] = TableError,
) -> pd.DataFrame:
    """The frame in which the named columns stand once each, as values instead of codes.

    Parameters
    ----------
    table
        Its name, for messages.
    frame
        Columns that are not named stay as they are.
    columns
        Names to look at; a column that is absent is passed over.
    error
        Class of the error, by what the table describes.

    Returns
    -------
    DataFrame
        The same rows and index. Texts have the type ``object``; other categories and Arrow arrays
        have the type of their values.

    Raises
    ------
    PseError
        Of class ``error``, if it is no frame, a name stands twice, or bytes are no text.
    """
    import pandas as pd

    if not isinstance(frame, pd.DataFrame):
        raise error(
            f"{table}: expected a pandas DataFrame, received {type(frame).__name__}: make one with "
            "pandas.DataFrame(…)"
        )
    if isinstance(frame.columns, pd.MultiIndex):
        raise error(
            f"{table}: column names have {frame.columns.nlevels} levels, e.g. "
            f"{frame.columns[0] if len(frame.columns) else ()}; expected one: "
            "set frame.columns to plain names"
        )
    unnamed = [name for name in frame.columns if not isinstance(name, Hashable)]
    if unnamed:
        raise error(
            f"{table}: {unnamed[0]!r} is no name of a column; expected texts: set frame.columns"
        )
    if not frame.columns.is_unique:
        twice = [name for name in frame.columns[frame.columns.duplicated()] if name in columns]
        if twice:
            raise error(
                f"{table}: {twice[0]!r} is the name of two columns; expected one: rename or drop "
                "the other"
            )
    changed = {}
    for name in columns:
        if name in frame.columns:
            stored = frame[name]
            values = plain_values(f"{table}: column {name!r}", stored, error=error)
            if values is not stored:
                changed[name] = values
    return frame.assign(**changed) if changed else frame


def plain_values(what: str, series: pd.Series, *, error: type[PseError] = TableError) -> pd.Series:
    """A column as values instead of codes; the same object where nothing has to change.

    Raises
    ------
    PseError
        Of class ``error``, if bytes of a text are not UTF-8.
    """
    import pandas as pd

    kind = series.dtype
    if isinstance(kind, pd.CategoricalDtype):
        categories, code = series.cat.categories, series.cat.codes.to_numpy()
        if not len(categories):
            return pd.Series(np.full(len(series), None, dtype=object), series.index)
        values = pd.Series(categories.take(np.maximum(code, 0)), name=series.name)
        values.index = series.index
        return plain_values(what, values if (code >= 0).all() else values.where(code >= 0))
    try:
        if isinstance(kind, pd.ArrowDtype):
            return _from_arrow(what, series, error)
        if isinstance(kind, pd.StringDtype):
            # Python's own strings compare into numpy's booleans, which have no third value.
            values = series.astype(object)
            return values.where(series.notna(), None)
    except UnicodeDecodeError as broken:
        raise error(
            f"{what} holds bytes that are not UTF-8 text ({broken.reason}): read the source "
            "with its own encoding, e.g. encoding='cp1252'"
        ) from broken
    if isinstance(kind, pd.SparseDtype):
        return series.sparse.to_dense()
    return series


def _from_arrow(what: str, series: pd.Series, error: type[PseError]) -> pd.Series:
    """Values of a column that Arrow stores."""
    import pandas as pd
    import pyarrow as pa

    try:
        array = pa.array(series.array)
        array.validate(full=True)
    except pa.ArrowInvalid as broken:
        raise error(
            f"{what} cannot be read ({broken}): where it is text, read the source with its own "
            "encoding, e.g. encoding='cp1252'"
        ) from broken
    types = {pa.int8(): pd.Int8Dtype(), pa.int16(): pd.Int16Dtype(), pa.int32(): pd.Int32Dtype(),
             pa.int64(): pd.Int64Dtype()}  # fmt: skip
    # Integers with gaps must not become floats, which hold fewer digits.
    values = array.to_pandas(types_mapper=types.get if array.null_count else None)
    return plain_values(what, pd.Series(values.array, series.index, name=series.name))


def as_number(value: object) -> float:
    """A cell as a number, also where a table spells it as text.

    Raises
    ------
    TypeError, ValueError, OverflowError
        If it is none, or a complex one.
    """
    if isinstance(value, complex | np.complexfloating):
        raise TypeError(f"expected a real number, received {value}")
    return float(value)  # type: ignore[arg-type]


def unwritable(names: Collection[str]) -> list[str]:
    """Names that files and terminals cannot hold: damaged text, and control characters."""
    found = []
    for name in names:
        try:
            name.encode("utf-8")
        except UnicodeEncodeError:
            found.append(name)
        else:
            if not name.isprintable() and CONTROL.search(name):
                found.append(name)
    return found
