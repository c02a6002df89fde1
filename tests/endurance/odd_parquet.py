"""Parquet files as other programs, versions and faults of storage leave them."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st
from tests.endurance import tiny_case

from pse_analysis.telemetry import read_raw, read_table, write_raw
from pse_analysis.vocabulary import check

Arrow = pa.Table
Change = tuple[str, tuple[int, ...]]

TYPES: tuple[Callable[[pa.DataType], pa.DataType], ...] = (
    *(lambda _t, kind=kind: kind for kind in (
        pa.int8(), pa.int16(), pa.int32(), pa.int64(), pa.uint64(), pa.float16(), pa.float32(),
        pa.float64(), pa.bool_(), pa.string(), pa.large_string(), pa.binary(), pa.string_view(),
        pa.timestamp("s", "UTC"), pa.timestamp("ms", "UTC"), pa.timestamp("us", "UTC"),
        pa.timestamp("ns", "UTC"), pa.timestamp("us"), pa.timestamp("us", "Asia/Kathmandu"),
        pa.timestamp("us", "+05:30"), pa.date32(), pa.duration("us"), pa.decimal128(30, 6),
    )),
    lambda t: pa.dictionary(pa.int8(), t),
    lambda t: pa.dictionary(pa.int64(), t),
    lambda t: pa.list_(t),
)  # fmt: skip
"""Types to which a column is cast, where Arrow can."""

TABLES = ("telemetry", "channels", "validated", "aligned", "estimated", "steps", "residuals")


@cache
def tables() -> dict[str, Arrow]:
    """Small sound tables, as Arrow holds them."""
    run = tiny_case.plain_run()
    frames = {
        "telemetry": run.raw.telemetry,
        "channels": run.raw.channels,
        "validated": run.validated,
        "aligned": run.aligned,
        "estimated": run.estimated[0].estimated,
        "steps": run.estimated[0].steps,
        "residuals": run.estimated[0].residuals,
    }
    return {
        name: pa.Table.from_pandas(check(name, frame).head(40), preserve_index=False)
        for name, frame in frames.items()
    }


def _put(table: Arrow, place: int, column: Any) -> Arrow:
    return table.set_column(place, table.column_names[place], column)


def _cast(table: Arrow, column: int, kind: int) -> Arrow:
    place = column % table.num_columns
    given = table.column(place)
    wanted = TYPES[kind](given.type)
    if pa.types.is_list(wanted):
        return _put(table, place, pa.array([[value] for value in given.to_pylist()]))
    if pa.types.is_dictionary(wanted):
        return _put(table, place, given.combine_chunks().dictionary_encode())
    return _put(table, place, given.cast(wanted, safe=False))


def _nulls(table: Arrow, column: int, every: int) -> Arrow:
    place = column % table.num_columns
    values = table.column(place).to_pylist()
    values[::every] = [None] * len(values[::every])
    return _put(table, place, pa.array(values, table.column(place).type))


def _numbers(table: Arrow, column: int, value: int) -> Arrow:
    place = column % table.num_columns
    values = table.column(place).to_pylist()
    values[0] = (np.nan, np.inf, -np.inf, 1e300, -1, 0, 2**40, 2**62, "x", "")[value]
    return _put(table, place, pa.array(values, table.column(place).type))


def _damaged_text(table: Arrow, column: int) -> Arrow:
    """Bytes that are no UTF-8 under the type of a text."""
    place = column % table.num_columns
    values = [b"\xff\xfe" + str(v).encode() for v in table.column(place).to_pylist()]
    raw = pa.array(values, pa.binary())
    return _put(table, place, pa.Array.from_buffers(pa.string(), len(raw), raw.buffers()))


def _struct(table: Arrow, column: int) -> Arrow:
    place = column % table.num_columns
    return _put(table, place, pa.array([{"a": {"b": [1, None]}}] * table.num_rows))


CHANGES: dict[str, Callable[..., Arrow]] = {
    "cast": _cast,
    "nulls": _nulls,
    "number": _numbers,
    "damaged": _damaged_text,
    "struct": _struct,
    "null type": lambda t, c: _put(t, c % t.num_columns, pa.nulls(t.num_rows)),
    "drop": lambda t, c: t.remove_column(c % t.num_columns),
    "twice": lambda t, c: t.append_column(t.column_names[c % t.num_columns], t.column(0)),
    "wide": lambda t, n: pa.table(
        dict(zip(t.column_names, t.columns, strict=False))
        | {f"extra{i}": t.column(0) for i in range((1, 50, 300)[n])}
    ),
    "empty": lambda t: t.slice(0, 0),
    "chunks": lambda t: pa.concat_tables([t.slice(0, 3), t.slice(3)]),
    "rows twice": lambda t: pa.concat_tables([t, t]),
    "reversed": lambda t: t.take(pa.array(np.arange(t.num_rows)[::-1].copy())),
    "order": lambda t: t.select(t.column_names[::-1]),
}
BYTES: dict[str, Callable[[bytes, int], bytes]] = {
    "whole": lambda content, _at: content,
    "cut": lambda content, at: content[: at % (len(content) + 1)],
    "bit": lambda content, at: _turned(content, at),
    "text": lambda _content, at: b"channel,time_utc,value\n" * (at % 50),
    "zeros": lambda content, at: content[: at % len(content)] + bytes(64) + content[64:],
}


def _turned(content: bytes, at: int) -> bytes:
    turned = bytearray(content)
    turned[at // 8 % len(turned)] ^= 1 << at % 8
    return bytes(turned)


_C = st.integers(0, 14)
_CHANGE = st.one_of(
    st.tuples(st.just("cast"), st.tuples(_C, st.integers(0, len(TYPES) - 1))),
    st.tuples(st.just("nulls"), st.tuples(_C, st.sampled_from([1, 7]))),
    st.tuples(st.just("number"), st.tuples(_C, st.integers(0, 9))),
    *(
        st.tuples(st.just(name), st.tuples(_C))
        for name in ("damaged", "struct", "null type", "drop", "twice")
    ),
    st.tuples(st.just("wide"), st.tuples(st.integers(0, 2))),
    *(
        st.tuples(st.just(name), st.tuples())
        for name in ("empty", "chunks", "rows twice", "reversed", "order")
    ),
)
FILES = st.tuples(
    st.sampled_from((*TABLES, "raw/telemetry", "raw/channels", "raw/grid/buses", "raw/machine")),
    st.lists(_CHANGE, max_size=3),
    st.sampled_from(["whole"] * 4 + ["cut", "bit", "text", "zeros"]),
    st.integers(0, 2**20),
)
"""A table, what is done to it, and what to the bytes of its file."""


def _apply(table: Arrow, changes: list[Change]) -> Arrow:
    for name, numbers in changes:
        try:
            table = CHANGES[name](table, *numbers)
        except Exception:
            continue  # Arrow has no such table
        if not table.num_columns:
            break
    return table


@cache
def _folder() -> Path:
    """A folder of this process, with a raw case in it."""
    folder = Path(tempfile.mkdtemp(prefix="pse_parquet_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    write_raw(folder / "raw", tiny_case.plain_run().raw)
    # Written by another program: nothing lists its checksums.
    (folder / "raw" / "checksums.json").unlink()
    return folder


def read_odd(drawn: tuple[str, list[Change], str, int]) -> None:
    """Read a changed file; what is read obeys its schema."""
    name, changes, damage, at = drawn
    if name.startswith("raw/"):
        _read_raw(name.removeprefix("raw/"), changes, damage, at)
        return
    path = _folder() / "table.parquet"
    _write(path, _apply(tables()[name], changes), damage, at)
    check(name, read_table(path, name))


def _write(path: Path, table: Arrow, damage: str, at: int) -> None:
    try:
        pq.write_table(table, path, write_page_checksum=True)
    except Exception:
        path.write_bytes(b"PAR1")  # Arrow cannot write it
    path.write_bytes(BYTES[damage](path.read_bytes(), at))


def _read_raw(name: str, changes: list[Change], damage: str, at: int) -> None:
    """Read the raw folder with one of its files changed, and put that back."""
    raw = _folder() / "raw"
    if name == "machine":
        path, table = raw / "machine.parquet", _machine()
    else:
        path = sorted(raw.rglob("part-0.parquet"))[0] if name == "telemetry" else None
        path = path or raw / f"{name}.parquet"
        table = pq.ParquetFile(path).read()
    kept = path.read_bytes() if path.is_file() else None
    try:
        _write(path, _apply(table, changes), damage, at)
        read_raw(raw)
    finally:
        if kept is None:
            path.unlink(missing_ok=True)
        else:
            path.write_bytes(kept)


def _machine() -> Arrow:
    frame = pd.DataFrame(
        {"name": ["1"], "s_mva": 200.0, "u_kv": 13.8, "f_hz": 50.0, "t_j_s": 6.4, "k_d_pu": 0.03}
    )
    return pa.Table.from_pandas(frame, preserve_index=False)
