"""Strategies that change a table in ways that exports, hands and faults of storage do.

A mutation is a tuple of its name and its numbers, drawn by hypothesis, so that a failing example
shrinks to the fewest and simplest changes; `apply` performs it. A change that pandas itself refuses
leaves the table as it was.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Any

import numpy as np
import pandas as pd
from hypothesis import strategies as st

Mutation = tuple[str, tuple[Any, ...]]

ODD_VALUES: tuple[Any, ...] = (
    *(None, np.nan, pd.NA, pd.NaT, np.inf, -np.inf),
    *(0, -1, 1, 0.0, -0.0, 1e300, -1e300, 1e-300, 5e-324, 10**400, 2**63, -(2**63), 257),
    *(True, False, np.bool_(True), 1j, 0.5 + 0.87j, complex("nan"), np.complex64(1)),
    *("", " ", "text", "1,5", "1.5", "nan", "inf", "bus/1", "bus/", "branch/", "\udcff", "\x00"),
    *("a\nb", "\x1b[2J", "=cmd()", "<script>", "|", "../..", "a" * 5000, "\u202e", "vm_pu"),
    *(b"bytes", Decimal("1.5"), Decimal("NaN"), [1, 2], {"a": 1}, (), np.array([1.0, 2.0])),
    *(datetime(2016, 6, 9), datetime(2016, 6, 9, tzinfo=UTC), timedelta(seconds=1)),
    *(pd.Timestamp("2016-06-09T08:00Z"), pd.Timestamp("2016-06-09"), pd.Period("2016-06", "M")),
    *(datetime(1, 1, 1), datetime(9999, 12, 31, tzinfo=UTC), np.datetime64("NaT"), object),
)
"""What a cell may hold."""

FACTORS = (1e300, 1e-300, 1e6, 1e3, 100.0, 1e-3, 0.0, -1.0, np.nan, np.inf)

TYPES = (
    *("float32", "float16", "float64", "int64", "int8", "uint8", "Int64", "Float64", "boolean"),
    *("bool", "object", "str", "string", "string[pyarrow]", "category", "complex128"),
    *("datetime64[ns]", "datetime64[us, UTC]", "timedelta64[ns]", "Sparse[float64]"),
    *("double[pyarrow]", "int64[pyarrow]", "large_string[pyarrow]", "period[D]", "longdouble"),
)

OTHER_OBJECTS: tuple[Callable[[pd.DataFrame], Any], ...] = (
    lambda frame: None,
    lambda frame: frame.to_dict("list"),
    lambda frame: frame.iloc[:, 0],
    lambda frame: frame.to_numpy(),
    lambda frame: "telemetry.csv",
)

INDEXES: tuple[Callable[[int], Any], ...] = (
    lambda n: [7] * n,
    lambda n: pd.MultiIndex.from_arrays([np.arange(n) % 2, np.arange(n)]),
    lambda n: pd.MultiIndex.from_arrays([[1] * n, [2] * n]),
    lambda n: [f"r{i}" for i in range(n)][::-1],
    lambda n: pd.date_range("2016", periods=n, tz="UTC"),
    lambda n: [np.nan] * n,
    lambda n: pd.CategoricalIndex(["a"] * n),
)


def _cell(frame: pd.DataFrame, column: int, rows: list[int], value: int) -> pd.DataFrame:
    place = column % frame.shape[1]
    changed = list(frame.iloc[:, place])
    for row in rows:
        changed[row % len(changed)] = ODD_VALUES[value]
    return _with(frame, place, _series(changed, frame.index))


def _series(values: list[Any], index: pd.Index) -> pd.Series:
    """A column as pandas would infer it, or of objects where it cannot."""
    try:
        return pd.Series(values, index=index)
    except Exception:
        out = np.empty(len(values), dtype=object)
        out[:] = values
        return pd.Series(out, index=index)


def _column(frame: pd.DataFrame, column: int, value: int) -> pd.DataFrame:
    place = column % frame.shape[1]
    return _with(frame, place, _series([ODD_VALUES[value]] * len(frame), frame.index))


def _with(frame: pd.DataFrame, place: int, values: pd.Series) -> pd.DataFrame:
    parts = [frame.iloc[:, i] for i in range(frame.shape[1])]
    parts[place] = values
    out = pd.concat(parts, axis=1)
    out.columns = frame.columns
    return out


def _retyped(frame: pd.DataFrame, column: int, kind: int) -> pd.DataFrame:
    place = column % frame.shape[1]
    return _with(frame, place, frame.iloc[:, place].astype(TYPES[kind]))


def _scaled(frame: pd.DataFrame, column: int, factor: int) -> pd.DataFrame:
    place = column % frame.shape[1]
    with np.errstate(all="ignore"):
        return _with(frame, place, frame.iloc[:, place] * FACTORS[factor])


def _moved(frame: pd.DataFrame, column: int, days: int) -> pd.DataFrame:
    place = column % frame.shape[1]
    return _with(frame, place, frame.iloc[:, place] + pd.Timedelta(days=days))


TIMES: tuple[Callable[[pd.Series], pd.Series], ...] = (
    lambda t: t.dt.tz_localize(None),
    lambda t: t.dt.tz_convert("Asia/Kathmandu"),
    lambda t: t.dt.tz_convert("Europe/Berlin").astype(object),
    lambda t: t.astype(str),
    lambda t: t.dt.as_unit("s"),
    lambda t: t.dt.as_unit("ns"),
    lambda t: t.dt.as_unit("us").astype("int64"),
    lambda t: t.dt.as_unit("s").astype("int64"),
    lambda t: t.dt.as_unit("s").astype("int64").astype("datetime64[ns, UTC]"),
    lambda t: t.iloc[::-1].set_axis(t.index),
    lambda t: pd.Series([t.iloc[0]] * len(t), index=t.index),
    lambda t: t.dt.tz_localize(None).dt.to_period("s"),
    lambda t: t.dt.tz_localize(None).dt.date,
)


def _retimed(frame: pd.DataFrame, column: int, way: int) -> pd.DataFrame:
    place = column % frame.shape[1]
    return _with(frame, place, TIMES[way](frame.iloc[:, place]))


def _renamed(frame: pd.DataFrame, column: int, name: int) -> pd.DataFrame:
    names = list(frame.columns)
    names[column % len(names)] = ("value", "x", 7, "", None, "VALUE", "channel ", ("a", "b"))[name]
    return frame.set_axis(names, axis=1)


def _widened(frame: pd.DataFrame, count: int) -> pd.DataFrame:
    more = pd.DataFrame(np.zeros((len(frame), count)), index=frame.index)
    return pd.concat([frame, more.add_prefix("extra")], axis=1)


def _rows(frame: pd.DataFrame, way: int, seed: int) -> pd.DataFrame:
    n = len(frame)
    rng = np.random.default_rng(seed)
    order = (
        rng.permutation(n),
        rng.integers(0, n, n),
        np.arange(n)[::-1],
        np.flatnonzero(rng.random(n) < 0.5),
        np.arange(0),
        np.arange(min(n, 1)),
        np.repeat(np.arange(n), 2),
    )[way]
    return frame.iloc[order]


WAYS: dict[str, Callable[..., Any]] = {
    "cell": _cell,
    "column": _column,
    "type": _retyped,
    "factor": _scaled,
    "days": _moved,
    "time": _retimed,
    "rename": _renamed,
    "drop": lambda frame, column: frame.drop(columns=frame.columns[column % frame.shape[1]]),
    "twice": lambda frame, column: pd.concat(
        [frame, frame.iloc[:, [column % frame.shape[1]]]], axis=1
    ),
    "wide": _widened,
    "rows": _rows,
    "index": lambda frame, way: frame.set_axis(INDEXES[way](len(frame)), axis=0),
    "levels": lambda frame: frame.set_axis([["a"] * frame.shape[1], frame.columns], axis=1),
    "order": lambda frame: frame[frame.columns[::-1]],
    "other": lambda frame, way: OTHER_OBJECTS[way](frame),
}

_COLUMN = st.integers(0, 14)


def _way(name: str, *numbers: st.SearchStrategy[Any]) -> st.SearchStrategy[Mutation]:
    return st.tuples(st.just(name), st.tuples(*numbers))


def _at(values: tuple[Any, ...]) -> st.SearchStrategy[int]:
    return st.integers(0, len(values) - 1)


VALUE_MUTATIONS = st.one_of(
    _way("cell", _COLUMN, st.lists(st.integers(0, 60), min_size=1, max_size=3), _at(ODD_VALUES)),
    _way("column", _COLUMN, _at(ODD_VALUES)),
    _way("type", _COLUMN, _at(TYPES)),
    _way("factor", _COLUMN, _at(FACTORS)),
    _way("days", _COLUMN, st.sampled_from([1, -1, 400, -20_000, 200_000, -600_000])),
    _way("time", _COLUMN, _at(TIMES)),
)
SHAPE_MUTATIONS = st.one_of(
    _way("rename", _COLUMN, st.integers(0, 7)),
    _way("drop", _COLUMN),
    _way("twice", _COLUMN),
    _way("wide", st.sampled_from([1, 40, 400])),
    _way("rows", st.integers(0, 6), st.integers(0, 3)),
    _way("index", _at(INDEXES)),
    _way("levels"),
    _way("order"),
    _way("other", _at(OTHER_OBJECTS)),
)
MUTATIONS = st.lists(
    st.one_of(VALUE_MUTATIONS, VALUE_MUTATIONS, SHAPE_MUTATIONS), min_size=1, max_size=3
)
"""One to three changes of a table, two in three of them of values."""


def apply(frame: pd.DataFrame, mutations: list[Mutation]) -> Any:
    """The table after its mutations."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, numbers in mutations:
            if not isinstance(frame, pd.DataFrame) or not len(frame.columns):
                return frame
            try:
                frame = WAYS[name](frame, *numbers)
            except Exception:
                continue  # pandas refuses it, so that nobody can have such a table
    return frame
