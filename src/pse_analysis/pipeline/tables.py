"""Tables of the raw folder one at a time: who needs the grid need not read the telemetry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.telemetry import read_model, read_table, read_telemetry
from pse_analysis.telemetry.tables import arrow_type
from pse_analysis.vocabulary import schema


def read_network(raw: Path) -> Network:
    """The grid of a raw folder.

    Raises
    ------
    TableError
        If one of its files is missing or not whole, or the case is about a machine.
    """
    model = read_model(raw)
    if isinstance(model, Machine):
        raise TableError(f"{raw} holds {model.element}, not a grid: use read_model")
    return model


def read_machine(raw: Path) -> Machine:
    """The machine of a raw folder.

    Raises
    ------
    TableError
        If its file is missing or not whole, or the case is about a grid.
    """
    model = read_model(raw)
    if not isinstance(model, Machine):
        raise TableError(f"{raw} holds the grid {model.name}, not a machine: use read_network")
    return model


def read_raw_table(raw: Path, table: str) -> pd.DataFrame | None:
    """A table of a raw folder; None if it is one that only simulations know and is not there."""
    if table == "telemetry":
        return read_telemetry(raw)
    path = raw / f"{table}.parquet"
    if table != "channels" and not path.is_file():
        return None
    return read_table(path, table)


def write_empty(path: Path, table: str) -> None:
    """Write a table without rows."""
    fields = [(name, arrow_type(c.dtype)) for name, c in schema(table).columns.items()]
    pq.write_table(pa.schema(fields).empty_table(), path, compression="zstd")


def merge_files(paths: Sequence[Path], target: Path) -> None:
    """Join parquet files of one schema, one after another, and remove them."""
    form = pq.read_schema(paths[0])
    with pq.ParquetWriter(target, form, compression="zstd") as writer:
        for path in paths:
            writer.write_table(pq.ParquetFile(path).read())
            path.unlink()
