"""Claim: files of others are read within bounds, and what is wrong with them is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pse_analysis import telemetry
from pse_analysis.errors import TableError
from pse_analysis.telemetry.parquet import MAX_ROWS, arrow_schema


def scored() -> pa.Table:
    """Table ``scored`` of three rows."""
    columns = {
        field.name: pa.array(["a"] * 3) if pa.types.is_string(field.type) else pa.array([1.0] * 3)
        for field in arrow_schema("scored")
    }
    return pa.table(columns).cast(arrow_schema("scored"))


def write(path: Path, table: pa.Table) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)
    return path


def test_more_rows_than_the_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "t.parquet", pa.table({"a": [0] * 100}))
    monkeypatch.setattr("pse_analysis.telemetry.parquet.MAX_ROWS", 99)
    with pytest.raises(TableError, match="at most 99 rows, received 100: part it"):
        telemetry.parquet.read_arrow(path)


def test_small_file_that_stands_for_very_many_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pse_analysis.telemetry.parquet.MAX_ROWS", MAX_ROWS // 100)
    count = MAX_ROWS // 100
    schema = pa.schema([("a", pa.dictionary(pa.int8(), pa.bool_()))])
    path = tmp_path / "bomb.parquet"
    zeros = pa.DictionaryArray.from_arrays(pa.array(np.zeros(count // 50 + 1, np.int8)), [True])
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for _ in range(51):
            writer.write_table(pa.table([zeros], schema=schema))
    assert path.stat().st_size < 2**20
    with pytest.raises(TableError, match="rows, received"):
        telemetry.read_table(path, "telemetry")


def test_too_many_columns(tmp_path: Path) -> None:
    wide = pa.table({f"c{i}": [0] for i in range(10_001)})
    with pytest.raises(TableError, match="at most 10000 columns, received 10001"):
        telemetry.read_table(write(tmp_path / "t.parquet", wide), "channels")


def test_nested_and_repeated_columns(tmp_path: Path) -> None:
    table = scored()
    nested = pa.array([[1.0]] * len(table))
    i = table.column_names.index("value")
    path = write(tmp_path / "t.parquet", table.set_column(i, "value", nested))
    with pytest.raises(TableError, match=r"'value' of .*expected .*double.*received list<"):
        telemetry.read_table(path, "scored")
    twice = table.append_column("value", table.column("value"))
    with pytest.raises(TableError, match="'value' stands 2 times"):
        telemetry.read_table(write(tmp_path / "u.parquet", twice), "scored")


def test_text_that_is_not_utf8(tmp_path: Path) -> None:
    table = scored()
    broken = pa.array([b"\xff\xfe"] * len(table), pa.binary()).view(pa.string())
    i = table.column_names.index("method")
    path = write(tmp_path / "t.parquet", table.set_column(i, "method", broken))
    with pytest.raises(TableError, match=r"not UTF-8.*write it again"):
        telemetry.read_table(path, "scored")


def test_names_of_columns_that_are_no_text(tmp_path: Path) -> None:
    path = write(tmp_path / "t.parquet", scored())
    content = path.read_bytes()
    assert content.count(b"metric") > 1
    path.write_bytes(content.replace(b"metric", b"metr\xdfc"))
    with pytest.raises(TableError, match=r"t\.parquet"):
        telemetry.read_table(path, "scored")
