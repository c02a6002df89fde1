"""Claim: a raw folder gives back what was written; a broken one names its fault and remedy."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from simulated_case import case

from pse_analysis import telemetry
from pse_analysis.errors import TableError


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("raw") / "case"
    telemetry.write_raw(folder, case())
    return folder


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage, as another program would have written it."""
    copy = Path(shutil.copytree(written, tmp_path / "case"))
    (copy / "checksums.json").unlink()
    return copy


def one_file(folder: Path) -> Path:
    return folder / "telemetry" / "source=pmu" / "date=2016-06-09" / "part-0.parquet"


def rewrite(path: Path, name: str, column: pa.Array | None) -> None:
    """Replace a column of a parquet file, or drop it."""
    table = pq.ParquetFile(path).read()
    i = table.column_names.index(name)
    table = table.drop_columns(name) if column is None else table.set_column(i, name, column)
    pq.write_table(table, path)


def column(path: Path, name: str) -> pa.ChunkedArray:
    return pq.ParquetFile(path).read().column(name)


def test_what_is_written_comes_back(written: Path):
    raw = telemetry.read_raw(written)
    for table in ("channels", "truth", "sample_truth", "faults"):
        pd.testing.assert_frame_equal(getattr(raw, table), getattr(case(), table))
    expected = case().telemetry.sort_values(["trial", "channel", "seq"], ignore_index=True)
    pd.testing.assert_frame_equal(raw.telemetry, expected)
    np.testing.assert_array_equal(raw.network.y_bus.toarray(), case().network.y_bus.toarray())


def test_the_date_of_a_file_is_that_of_its_samples(written: Path):
    for path in (written / "telemetry").rglob("*.parquet"):
        part = telemetry.read_table(path, "telemetry")
        assert set(part.time_utc.dt.strftime("%Y-%m-%d")) == {path.parent.name.split("=")[1]}
        assert set(part.channel.str.split(":").str[0]) == {path.parent.parent.name.split("=")[1]}


def test_a_part_of_the_telemetry_can_be_read_alone(folder: Path):
    one_file(folder).write_bytes(b"damaged")
    part = telemetry.read_telemetry(folder, sources=["ami"], dates=["2016-06-09"])
    assert part.channel.str.startswith("ami").all()
    with pytest.raises(TableError, match=r"holds no .* for sources \['radar'\].*source=ami"):
        telemetry.read_telemetry(folder, sources=["radar"])


def test_faults_of_samples_are_kept_as_they_are(tmp_path: Path):
    frame = case().telemetry.copy()
    frame.loc[:2, "value"] = [np.nan, np.inf, -np.inf]
    frame["quality"] = frame["quality"].mask(frame.index == 5, 192)
    telemetry.write_raw(tmp_path / "case", dataclasses.replace(case(), telemetry=frame))
    back = telemetry.read_raw(tmp_path / "case").telemetry
    pd.testing.assert_frame_equal(
        back, frame.sort_values(["trial", "channel", "seq"], ignore_index=True)
    )


def test_narrower_types_and_other_resolutions_are_widened(folder: Path):
    path = one_file(folder)
    rewrite(path, "time_utc", column(path, "time_utc").cast(pa.timestamp("ns", tz="UTC")))
    rewrite(path, "arrival_utc", column(path, "arrival_utc").cast(pa.timestamp("ms", "UTC"), False))
    rewrite(path, "value", column(path, "value").cast(pa.float32()))
    rewrite(path, "channel", column(path, "channel").dictionary_encode())
    rewrite(path, "trial", column(path, "trial").cast(pa.int64()))
    read = telemetry.read_raw(folder).telemetry
    assert read.time_utc.dt.unit == "us"
    assert str(read.value.dtype) == "float64"
    assert str(read.trial.dtype) == "int32"


def test_existing_telemetry_is_never_overwritten(written: Path):
    with pytest.raises(TableError, match="already holds telemetry, which is never overwritten"):
        telemetry.write_raw(written, case())


@pytest.mark.parametrize("there", [False, True])
def test_an_interrupted_writer_leaves_nothing_that_can_be_run(
    tmp_path: Path, there: bool, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "mine"
    if there:
        folder.mkdir()
        (folder / "NOTES.md").write_text("ours")
    write, calls = pq.write_table, iter(range(100))

    def interrupted(*args: object, **kwargs: object) -> None:
        if next(calls) == 7:
            raise KeyboardInterrupt
        write(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(pq, "write_table", interrupted)
        with pytest.raises(KeyboardInterrupt):
            telemetry.write_raw(folder, case())
    assert next(calls) == 8
    assert [p.name for p in tmp_path.rglob("*")] == (["mine", "NOTES.md"] if there else [])
    with pytest.raises(TableError, match=r"write (it|them) with pse_"):
        telemetry.read_raw(folder)
    telemetry.write_raw(folder, case())
    assert len(telemetry.read_raw(folder).telemetry) == len(case().telemetry)


def test_missing_folder(tmp_path: Path):
    with pytest.raises(TableError, match=r"no raw folder .*none; expected telemetry/.*write_raw"):
        telemetry.read_raw(tmp_path / "none")


@pytest.mark.parametrize("part", ["telemetry", "channels.parquet", "grid/buses.parquet"])
def test_missing_part_of_the_folder(folder: Path, part: str):
    path = folder / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(TableError, match=rf"no (file|folder) .*{part}.*write_raw"):
        telemetry.read_raw(folder)


def test_missing_column(folder: Path):
    rewrite(one_file(folder), "value", None)
    with pytest.raises(
        TableError, match=r"column 'value' is missing in .*part-0.parquet; expected .*; received"
    ):
        telemetry.read_raw(folder)


def test_wrong_type(folder: Path):
    path = one_file(folder)
    rewrite(path, "value", column(path, "value").cast(pa.string()))
    with pytest.raises(
        TableError, match=r"'value' of .*part-0.parquet: expected double, received string.*ingest"
    ):
        telemetry.read_raw(folder)


def test_naive_time(folder: Path):
    path = one_file(folder)
    rewrite(path, "time_utc", column(path, "time_utc").cast(pa.timestamp("us")))
    with pytest.raises(TableError, match=r"'time_utc' of .* has no time zone.*timezone="):
        telemetry.read_raw(folder)


@pytest.mark.parametrize("name", ["truth.parquet", "channels.parquet", "grid/branches.parquet"])
def test_truncated_file_is_named(folder: Path, name: str):
    path = folder / name
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(TableError, match=rf"{name} is not a whole parquet file"):
        telemetry.read_raw(folder)


def test_truncated_part_of_the_telemetry_is_named(folder: Path):
    path = one_file(folder)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(
        TableError, match=r"source=pmu/date=2016-06-09/part-0.parquet is not a whole"
    ):
        telemetry.read_raw(folder)


def test_empty_telemetry(folder: Path, tmp_path: Path):
    for path in (folder / "telemetry").rglob("*.parquet"):
        pq.write_table(pq.ParquetFile(path).read().slice(0, 0), path)
    with pytest.raises(TableError, match="are empty; expected samples"):
        telemetry.read_raw(folder)
    empty = dataclasses.replace(case(), telemetry=case().telemetry.iloc[:0])
    with pytest.raises(TableError, match="no rows to write"):
        telemetry.write_raw(tmp_path / "empty", empty)


def test_unknown_channel(folder: Path):
    channels = case().channels
    telemetry.write_table(
        folder / "channels.parquet", channels[channels.channel != "pmu:bus/6:vm_pu"], "channels"
    )
    with pytest.raises(TableError, match="'pmu:bus/6:vm_pu' is not in the channels table"):
        telemetry.read_raw(folder)


def test_a_number_that_does_not_fit_is_refused(folder: Path):
    path = one_file(folder)
    n = len(column(path, "trial"))
    rewrite(path, "trial", pa.array([2**40] * n, pa.int64()))
    with pytest.raises(TableError, match=r"'trial' of .* does not fit int32"):
        telemetry.read_raw(folder)
