"""Tables of the raw folder one at a time: who needs the grid need not read the telemetry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.telemetry import read_table, read_telemetry

GRID = ("network", "buses", "branches")


def read_network(raw: Path) -> Network:
    """The grid of a raw folder.

    Raises
    ------
    TableError
        If one of its files is missing or not whole.
    """
    tables = {}
    for name in GRID:
        path = raw / "grid" / f"{name}.parquet"
        try:
            tables[name] = pq.ParquetFile(path).read().to_pandas()
        except (pa.ArrowInvalid, OSError) as error:
            raise TableError(
                f"grid: {path} is missing or not a whole parquet file ({error}): write it with "
                "pse_analysis.telemetry.write_raw"
            ) from error
    return Network.from_tables(**tables)


def read_raw_table(raw: Path, table: str) -> pd.DataFrame | None:
    """A table of a raw folder; None if it is one that only simulations know and is not there."""
    if table == "telemetry":
        return read_telemetry(raw)
    path = raw / f"{table}.parquet"
    if table != "channels" and not path.is_file():
        return None
    return read_table(path, table)


def merge_files(paths: Sequence[Path], target: Path) -> None:
    """Join parquet files of one schema, one after another, and remove them."""
    schema = pq.read_schema(paths[0])
    with pq.ParquetWriter(target, schema, compression="zstd") as writer:
        for path in paths:
            writer.write_table(pq.ParquetFile(path).read())
            path.unlink()
