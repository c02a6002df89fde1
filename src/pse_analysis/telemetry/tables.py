"""The raw folder of a case.

::

    telemetry/source=<source>/date=<YYYY-MM-DD>/part-0.parquet
    channels.parquet  grid/{network,buses,branches}.parquet, or machine.parquet in place of a grid
    truth.parquet  sample_truth.parquet  faults.parquet        simulated cases only

The date is the UTC date of ``time_utc``. Files carry no time of writing, so equal tables give equal
bytes.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.measurement import Model
from pse_analysis.telemetry.channels import check_channels, check_known
from pse_analysis.vocabulary import check, schema

GRID_TABLES = ("network", "buses", "branches")
OPTIONAL_TABLES = ("truth", "sample_truth", "faults")


@dataclass(frozen=True, eq=False)
class RawCase:
    """Everything that a case starts from.

    Attributes
    ----------
    model
        The grid, or the machine.
    channels, telemetry
        Tables ``channels`` and ``telemetry`` of `pse_analysis.vocabulary`.
    truth, sample_truth, faults
        What only a simulation knows; None otherwise.
    """

    model: Model
    channels: pd.DataFrame
    telemetry: pd.DataFrame
    truth: pd.DataFrame | None = None
    sample_truth: pd.DataFrame | None = None
    faults: pd.DataFrame | None = None

    @property
    def network(self) -> Network:
        """The grid.

        Raises
        ------
        TableError
            If the case is about a machine.
        """
        if isinstance(self.model, Machine):
            raise TableError(f"the case is about {self.model.element}, not about a grid: use model")
        return self.model


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


def write_table(path: str | Path, frame: pd.DataFrame, table: str) -> None:
    """Write a table to one parquet file, checked against its schema.

    Equal frames give equal bytes.

    Raises
    ------
    TableError
        If the frame breaks the schema.
    """
    _write(Path(path), check(table, frame), table)


def _write(path: Path, frame: pd.DataFrame, table: str) -> None:
    fields = [(name, arrow_type(c.dtype)) for name, c in schema(table).columns.items()]
    arrow = pa.Table.from_pandas(frame, schema=pa.schema(fields), preserve_index=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Without pandas' metadata the file says nothing about who wrote it.
    pq.write_table(arrow.replace_schema_metadata(None), path, compression="zstd")


def read_table(path: str | Path, table: str) -> pd.DataFrame:
    """Read one parquet file as a table, checked against its schema.

    Narrower numbers, other time resolutions and dictionary-encoded names are accepted and
    widened; anything else must have the schema's type.

    Raises
    ------
    TableError
        If the file is missing, cut short, or does not fit the schema.
    """
    return check(table, _to_pandas(_read(Path(path), table)))


def _read(path: Path, table: str) -> pa.Table:
    if not path.is_file():
        raise TableError(
            f"{table}: no file {path}; write it with pse_analysis.telemetry.write_raw, or run the "
            "case's simulation"
        )
    try:
        arrow = pq.ParquetFile(path).read()
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, OSError) as error:
        raise TableError(
            f"{table}: {path} is not a whole parquet file ({error}); it was cut short or damaged: "
            "copy or write it again"
        ) from error
    expected = {name: arrow_type(c.dtype) for name, c in schema(table).columns.items()}
    missing = [name for name in expected if name not in arrow.column_names]
    if missing:
        raise TableError(
            f"{table}: column {missing[0]!r} is missing in {path}; expected columns "
            f"{', '.join(expected)}; received {', '.join(arrow.column_names)}"
        )
    columns = [
        _cast(arrow.column(name), kind, f"{table}: column {name!r} of {path}")
        for name, kind in expected.items()
    ]
    return pa.Table.from_arrays(columns, names=list(expected))


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
            return column.cast(wanted, safe=not types.is_timestamp(wanted))
        except pa.ArrowInvalid as error:
            raise TableError(
                f"{what} does not fit {wanted}: {error}; convert it before writing"
            ) from error
    raise TableError(
        f"{what}: expected {wanted}, received {given}; bring the table in with "
        "pse_analysis.telemetry.ingest, or write the column with that type"
    )


def _to_pandas(arrow: pa.Table) -> pd.DataFrame:
    nullable = {pa.int16(): pd.Int16Dtype()}
    if "kind" in arrow.column_names:
        nullable[pa.int64()] = pd.Int64Dtype()
    frame: pd.DataFrame = arrow.to_pandas(types_mapper=nullable.get)
    return frame


def write_raw(folder: str | Path, raw: RawCase) -> None:
    """Write a raw case into a folder that holds none yet, whole or not at all.

    Raises
    ------
    TableError
        If the folder already holds telemetry, or a table breaks its schema.
    """
    folder = Path(folder).resolve()
    if (folder / "telemetry").exists():
        raise TableError(
            f"{folder} already holds telemetry, which is never overwritten: choose another "
            "folder, or remove that one first"
        )
    channels = check_channels(raw.channels, raw.model)
    telemetry = check("telemetry", raw.telemetry)
    check_known(telemetry, channels)
    part = folder.with_name(f".{folder.name}.part")
    # What a killed writer left is nobody's.
    shutil.rmtree(part, ignore_errors=True)
    try:
        _write_folder(part, raw, channels, telemetry)
        if folder.exists():
            # Telemetry comes last: without it nothing reads the folder.
            for path in [
                p for p in part.rglob("*.parquet") if p.relative_to(part).parts[0] != "telemetry"
            ]:
                target = folder / path.relative_to(part)
                target.parent.mkdir(exist_ok=True)
                path.replace(target)
            (part / "telemetry").replace(folder / "telemetry")
        else:
            part.replace(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write_folder(
    folder: Path, raw: RawCase, channels: pd.DataFrame, telemetry: pd.DataFrame
) -> None:
    for table in OPTIONAL_TABLES:
        frame = getattr(raw, table)
        if frame is not None:
            write_table(folder / f"{table}.parquet", frame, table)
    _write(folder / "channels.parquet", channels, "channels")
    tables = (
        {"machine": raw.model.to_table()}
        if isinstance(raw.model, Machine)
        else {f"grid/{name}": frame for name, frame in raw.model.to_tables().items()}
    )
    for name, frame in tables.items():
        path = folder / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        arrow = pa.Table.from_pandas(frame, preserve_index=False).replace_schema_metadata(None)
        pq.write_table(arrow, path, compression="zstd")
    _write_partitions(folder / "telemetry", telemetry, channels)


def _write_partitions(folder: Path, telemetry: pd.DataFrame, channels: pd.DataFrame) -> None:
    source_of = channels.set_index("channel")["source"]
    code, names = pd.factorize(telemetry["channel"])
    sources, source = np.unique(source_of.reindex(names).to_numpy(dtype=str), return_inverse=True)
    day = telemetry["time_utc"].dt.tz_localize(None).to_numpy().astype("datetime64[D]").astype("i8")
    rank = np.argsort(np.argsort(names.astype(str)))[code]
    order = np.lexsort(
        (telemetry["seq"], rank, telemetry["trial"], day, source[code] if len(code) else code)
    )
    if not len(order):
        raise TableError("telemetry: no rows to write; expected at least one sample")
    key = np.stack([source[code][order], day[order]])
    edges = np.flatnonzero(np.r_[True, (key[:, 1:] != key[:, :-1]).any(axis=0), True])
    for first, last in pairwise(edges):
        part = telemetry.iloc[order[first:last]]
        date = np.datetime64(int(key[1, first]), "D")
        path = folder / f"source={sources[key[0, first]]}" / f"date={date}" / "part-0.parquet"
        _write(path, part, "telemetry")


def read_telemetry(
    folder: str | Path,
    sources: Collection[str] | None = None,
    dates: Collection[str] | None = None,
) -> pd.DataFrame:
    """Telemetry of a raw folder, or the part of it that is asked for.

    Parameters
    ----------
    folder
        The case's raw folder.
    sources, dates
        Sources, and UTC dates as ``YYYY-MM-DD``; all by default. Other files are not opened.

    Returns
    -------
    DataFrame
        Table ``telemetry`` by trial, channel and seq.

    Raises
    ------
    TableError
        If there is no such data, or a file does not fit; the message names it.
    """
    root = Path(folder) / "telemetry"
    if not root.is_dir():
        raise TableError(
            f"telemetry: no folder {root}; write it with pse_analysis.telemetry.write_raw, or run "
            "the case's simulation"
        )
    files = [
        path
        for path in sorted(root.glob("source=*/date=*/*.parquet"))
        if (sources is None or path.parts[-3].removeprefix("source=") in sources)
        and (dates is None or path.parts[-2].removeprefix("date=") in dates)
    ]
    if not files:
        asked = f" for sources {sources or 'all'} and dates {dates or 'all'}"
        raise TableError(
            f"telemetry: {root} holds no source=…/date=…/*.parquet{asked}; there are "
            f"{', '.join(sorted(p.name for p in root.glob('source=*'))) or 'none'}"
        )
    arrow = pa.concat_tables([_read(path, "telemetry") for path in files])
    if not arrow.num_rows:
        raise TableError(f"telemetry: the {len(files)} files in {root} are empty; expected samples")
    frame = _to_pandas(arrow)
    code, names = pd.factorize(frame["channel"])
    rank = np.argsort(np.argsort(names.astype(str)))[code]
    order = np.lexsort((frame["seq"], rank, frame["trial"]))
    return check("telemetry", frame.take(order).reset_index(drop=True))


def read_raw(folder: str | Path) -> RawCase:
    """Everything in a raw folder, checked.

    Raises
    ------
    TableError
        If a table is missing, damaged, breaks its schema, or names what the grid does not have.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise TableError(
            f"no raw folder {folder}; expected telemetry/, channels.parquet and grid/ or "
            "machine.parquet in it: write it with pse_analysis.telemetry.write_raw, or run the "
            "case's simulation"
        )
    model = read_model(folder)
    channels = check_channels(_to_pandas(_read(folder / "channels.parquet", "channels")), model)
    telemetry = read_telemetry(folder)
    check_known(telemetry, channels)
    optional = {
        table: read_table(folder / f"{table}.parquet", table)
        for table in OPTIONAL_TABLES
        if (folder / f"{table}.parquet").is_file()
    }
    return RawCase(model, channels, telemetry, **optional)


def read_model(folder: str | Path) -> Model:
    """The grid or machine of a raw folder.

    Raises
    ------
    TableError
        If one of its files is missing or not whole.
    """
    folder = Path(folder)
    if (folder / "machine.parquet").is_file():
        return Machine.from_table(_read_model_table(folder / "machine.parquet"))
    return Network.from_tables(
        **{n: _read_model_table(folder / "grid" / f"{n}.parquet") for n in GRID_TABLES}
    )


def _read_model_table(path: Path) -> pd.DataFrame:
    if not path.is_file():
        raise TableError(
            f"grid: no file {path}; expected {', '.join(f'{n}.parquet' for n in GRID_TABLES)} in "
            "grid/, or machine.parquet: write them with pse_analysis.telemetry.write_raw"
        )
    try:
        frame: pd.DataFrame = pq.ParquetFile(path).read().to_pandas()
    except (pa.ArrowInvalid, OSError) as error:
        raise TableError(
            f"grid: {path} is not a whole parquet file ({error}): copy or write it again"
        ) from error
    return frame
