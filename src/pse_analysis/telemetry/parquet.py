"""Parquet files of one table each: checked against the schema, page by page against checksums.

Files carry no time of writing, so equal tables give equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from pse_analysis.errors import DamagedFile, TableError
from pse_analysis.vocabulary import check, schema

MAX_ROWS = 500_000_000
"""Rows of one file; a page of a few bytes can stand for billions of equal values."""

MAX_COLUMNS = 10_000
MAX_BYTES = 64 * 2**30
"""Bytes that one file may take once it is decompressed."""

MAX_FOOTER_STRING = 16 * 2**20
MAX_FOOTER_ITEMS = 2_000_000

UNREADABLE = (
    pa.ArrowInvalid,
    pa.ArrowNotImplementedError,
    pa.ArrowTypeError,
    OSError,
    UnicodeDecodeError,
)

PROVENANCE = b"pse_analysis"
"""Key of a file's metadata under which its provenance stands, as JSON."""


def arrow_type(dtype: object) -> pa.DataType:
    """Arrow type of a column's type in `pse_analysis.vocabulary.schema`; text has none there."""
    if dtype is None:
        return pa.string()
    name = str(dtype)
    if name.startswith("datetime64"):
        return pa.timestamp("us", tz="UTC")
    if name == "bool":
        return pa.bool_()
    return pa.type_for_alias(name.lower())


def arrow_schema(table: str) -> pa.Schema:
    """Names and Arrow types of a table's columns."""
    return pa.schema([(name, arrow_type(c.dtype)) for name, c in schema(table).columns.items()])


def write_table(
    path: str | Path, frame: pd.DataFrame, table: str, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a table to one parquet file, checked against its schema.

    Equal frames of equal provenance give equal bytes.

    Parameters
    ----------
    path
        The file; replaced if it exists.
    frame, table
        The rows, and the table's name in `pse_analysis.vocabulary`.
    provenance
        Where the table comes from, for `read_provenance`.

    Raises
    ------
    TableError
        If the frame breaks the schema.
    """
    write_checked(Path(path), check(table, frame), table, provenance)


def write_checked(
    path: Path, frame: pd.DataFrame, table: str, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a frame that is known to fit the schema of its table."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrow = pa.Table.from_pandas(frame, schema=arrow_schema(table), preserve_index=False)
    write_arrow(path, arrow, provenance)


def write_arrow(path: Path, arrow: pa.Table, provenance: Mapping[str, Any] | None = None) -> None:
    """Write an Arrow table with a checksum for each page."""
    # Without pandas' metadata the file says nothing about who wrote it.
    arrow = arrow.replace_schema_metadata(_metadata(provenance))
    pq.write_table(arrow, path, compression="zstd", write_page_checksum=True)


def merge_files(
    paths: Sequence[Path], target: Path, table: str, provenance: Mapping[str, Any] | None = None
) -> None:
    """Join parquet files of one table, one after another, and remove them.

    Without any, the result is a table without rows.
    """
    form = arrow_schema(table).with_metadata(_metadata(provenance))
    with pq.ParquetWriter(target, form, compression="zstd", write_page_checksum=True) as writer:
        for path in paths:
            writer.write_table(read_arrow(path).replace_schema_metadata(form.metadata))
            path.unlink()


def _metadata(provenance: Mapping[str, Any] | None) -> dict[bytes, bytes] | None:
    if provenance is None:
        return None
    return {PROVENANCE: json.dumps(provenance, sort_keys=True).encode()}


def read_provenance(path: str | Path) -> Mapping[str, Any]:
    """Tell where a derived table comes from; empty for a table that does not say.

    Returns
    -------
    mapping
        ``case``, ``stage``, ``fingerprint``, ``parameters`` as JSON by key of the case file,
        ``inputs`` with the digest of each file's content, ``versions`` of this package, Python and
        the libraries that numbers depend on.

    Raises
    ------
    TableError
        If the file is missing or not a whole parquet file.
    """
    metadata = _open(Path(path)).schema_arrow.metadata or {}
    try:
        found = json.loads(metadata.get(PROVENANCE, b"{}"))
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def read_table(path: str | Path, table: str) -> pd.DataFrame:
    """Read one parquet file as a table, checked against its schema.

    Narrower numbers, other time resolutions and dictionary-encoded names are accepted and
    widened; anything else must have the schema's type.

    Raises
    ------
    TableError
        If the file is missing, cut short or damaged, too large, or does not fit the schema.
    """
    return check(table, to_pandas(read_columns(Path(path), table)))


def read_columns(path: Path, table: str) -> pa.Table:
    """Read the columns of a table from one file, with the schema's types."""
    if not path.is_file():
        raise TableError(
            f"{table}: no file {path}; write it with pse_analysis.telemetry.write_raw, or run the "
            "case's simulation"
        )
    expected = arrow_schema(table)
    file = _open(path)
    given = file.schema_arrow.names
    missing = [name for name in expected.names if name not in given]
    if missing:
        raise TableError(
            f"{table}: column {missing[0]!r} is missing in {path}; expected columns "
            f"{', '.join(expected.names)}; received {_some(given)}"
        )
    twice = [name for name in expected.names if given.count(name) > 1]
    if twice:
        raise TableError(
            f"{table}: column {twice[0]!r} stands {given.count(twice[0])} times in {path}; "
            "expected once: leave the others out"
        )
    for field in file.schema_arrow:
        if field.name in expected.names and pa.types.is_nested(field.type):
            raise TableError(
                f"{table}: column {field.name!r} of {path}: expected {expected.field(field.name)}, "
                f"received {field.type}: write one value per row"
            )
    arrow = _columns(file, path, expected.names)
    columns = [
        _cast(arrow.column(field.name), field.type, f"{table}: column {field.name!r} of {path}")
        for field in expected
    ]
    return pa.Table.from_arrays(columns, schema=expected)


def read_arrow(path: Path) -> pa.Table:
    """Read a whole parquet file, with its pages checked.

    Raises
    ------
    TableError
        If it is cut short or damaged, or too large.
    """
    return _columns(_open(path), path, None)


def read_rows(path: Path, table: str, **equal: object) -> pd.DataFrame:
    """Read the rows of a table in which columns have the given values."""
    try:
        arrow = pq.read_table(
            path,
            filters=[(name, "==", value) for name, value in equal.items()],
            page_checksum_verification=True,
        )
    except UNREADABLE as error:
        raise _damaged(path, error) from error
    return check(table, to_pandas(arrow))


def read_trials(path: Path) -> list[int]:
    """Numbers of the trials in a table, sorted."""
    column = _columns(_open(path), path, ["trial"]).column("trial")
    return sorted(column.unique().to_pylist())


def _open(path: Path) -> pq.ParquetFile:
    """Open a file and look at what its footer promises, before anything is decompressed."""
    try:
        file = pq.ParquetFile(
            path,
            page_checksum_verification=True,
            thrift_string_size_limit=MAX_FOOTER_STRING,
            thrift_container_size_limit=MAX_FOOTER_ITEMS,
        )
    except UNREADABLE as error:
        raise _damaged(path, error) from error
    about = file.metadata
    size = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
    for what, received, most in (
        ("rows", about.num_rows, MAX_ROWS),
        ("columns", about.num_columns, MAX_COLUMNS),
        ("bytes once decompressed", size, MAX_BYTES),
    ):
        if not 0 <= received <= most:
            raise TableError(
                f"{path}: expected at most {most} {what}, received {received}: part it into "
                "several files"
            )
    return file


def _columns(file: pq.ParquetFile, path: Path, names: Collection[str] | None) -> pa.Table:
    try:
        return file.read(columns=None if names is None else list(names))
    except UNREADABLE as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> DamagedFile:
    return DamagedFile(
        f"{path} is not a whole parquet file ({_first_line(error)}); it was cut short or damaged: "
        "copy or write it again"
    )


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _some(names: Sequence[str]) -> str:
    most = 20
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _cast(column: pa.ChunkedArray, wanted: pa.DataType, what: str) -> pa.ChunkedArray:
    given = column.type
    if given == wanted:
        return column
    types = pa.types
    if types.is_timestamp(wanted) and types.is_timestamp(given) and given.tz is None:
        raise TableError(
            f"{what} has no time zone: expected {wanted}, received {given}; bring the table in "
            "with pse_analysis.telemetry.ingest(..., timezone='Europe/Berlin')"
        )
    if types.is_dictionary(given):
        return _cast(column.cast(given.value_type), wanted, what)
    alike = (
        (types.is_timestamp(wanted) and types.is_timestamp(given))
        or (types.is_string(wanted) and types.is_large_string(given))
        or (types.is_integer(wanted) and types.is_integer(given))
        or (types.is_floating(wanted) and (types.is_floating(given) or types.is_integer(given)))
        or types.is_null(given)
    )
    if alike:
        try:
            # Nanoseconds below the microsecond are nobody's clock.
            finer = types.is_timestamp(given) and given.unit == "ns"
            return column.cast(wanted, safe=not finer)
        except pa.ArrowInvalid as error:
            raise TableError(
                f"{what} does not fit {wanted}: {error}; convert it before writing"
            ) from error
    raise TableError(
        f"{what}: expected {wanted}, received {given}; bring the table in with "
        "pse_analysis.telemetry.ingest, or write the column with that type"
    )


def to_pandas(arrow: pa.Table) -> pd.DataFrame:
    """The frame of an Arrow table, with nullable integers where the schemas have them."""
    nullable = {pa.int16(): pd.Int16Dtype()}
    if "kind" in arrow.column_names:
        nullable[pa.int64()] = pd.Int64Dtype()
    try:
        frame: pd.DataFrame = arrow.to_pandas(types_mapper=nullable.get)
    except MemoryError:
        raise
    except (UnicodeDecodeError, pa.ArrowException) as error:
        raise TableError(
            f"a text in one of the columns {_some(arrow.column_names)} is not UTF-8 "
            f"({_first_line(error)}): write it again with its encoding named"
        ) from error
    return frame
