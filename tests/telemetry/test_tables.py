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
from pse_analysis.files import describe
from pse_analysis.pipeline.descent import inputs
from pse_analysis.pipeline.plan import STAGES
from pse_analysis.pipeline.raw_folder import RawFolder


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


def test_writer_that_was_interrupted_beside_files_of_others_may_write_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "NOTES.md").write_text("mine")
    move = Path.replace

    def stop(path: Path, target: Path) -> Path:
        if path.name == "telemetry":
            raise KeyboardInterrupt
        return move(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stop)
        with pytest.raises(KeyboardInterrupt):
            telemetry.write_raw(folder, case())
    assert not (folder / "telemetry").exists()
    with pytest.raises(TableError, match=r"is there already and is not overwritten"):
        telemetry.write_raw(folder, dataclasses.replace(case(), truth=case().truth[1:]))
    telemetry.write_raw(folder, case())
    assert telemetry.read_raw(folder).telemetry.shape == case().telemetry.shape
    assert (folder / "NOTES.md").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["case"]


def test_raw_case_is_written_into_folders_only(tmp_path: Path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(TableError, match="is not a folder: choose another name"):
        telemetry.write_raw(tmp_path / "file", case())
    with pytest.raises(TableError, match="leads back to itself"):
        telemetry.write_raw(tmp_path / "circle", case())


def test_notes_beside_accepted_tables_may_change(written: Path, tmp_path: Path):
    folder = Path(shutil.copytree(written, tmp_path / "case"))
    (folder / "NOTES.md").write_text("one")
    (folder / "telemetry" / "notes.txt").write_text("one")
    telemetry.accept(folder)
    (folder / "NOTES.md").write_text("two")
    (folder / "telemetry" / "notes.txt").unlink()
    raw = RawFolder(folder)
    raw.check(raw.describe())
    before = telemetry.read_raw(written).telemetry
    pd.testing.assert_frame_equal(telemetry.read_raw(folder).telemetry, before)


def test_change_of_what_a_simulation_wrote_is_not_accepted(written: Path, tmp_path: Path):
    folder = Path(shutil.copytree(written, tmp_path / "case"))
    (folder / "simulated.json").write_text("{}")
    with pytest.raises(TableError, match=r"was made by a simulation.*--force.*to keep your change"):
        telemetry.accept(folder)


def test_what_counts_as_changed_is_what_is_read(folder: Path):
    hidden = one_file(folder).with_name("._part-0.parquet")
    hidden.write_bytes(b"left by a file manager")
    before = telemetry.read_raw(folder).telemetry
    assert hidden.relative_to(folder).as_posix() not in RawFolder(folder).describe()
    shutil.copy(one_file(folder), folder / "telemetry" / "a copy.parquet")
    assert telemetry.read_raw(folder).telemetry.equals(before)


def test_linked_folder_of_telemetry_is_refused_rather_than_left_out(folder: Path, tmp_path: Path):
    source = folder / "telemetry" / "source=pmu"
    source.rename(tmp_path / "elsewhere")
    source.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(TableError, match=r"source=pmu is a link to .*copy it there"):
        telemetry.read_raw(folder)
    source.unlink()
    (tmp_path / "elsewhere").rename(source)
    (folder / "telemetry" / "plots").symlink_to(tmp_path)
    telemetry.read_raw(folder)


def test_same_pages_under_another_unit_are_another_input(tmp_path: Path):
    path, found = tmp_path / "telemetry" / "t.parquet", []
    path.parent.mkdir()
    for unit in ("us", "ms"):
        times = pa.array([1, 2, 3]).cast(pa.timestamp(unit, "UTC"))
        pq.write_table(pa.table({"time_utc": times}), path, store_schema=False)
        found.append(describe(path))
    assert found[0]["content"] == found[1]["content"]
    validate = next(stage for stage in STAGES if stage.name == "validate")
    one, two = (inputs(validate, {"telemetry/t.parquet": facts}, {}) for facts in found)
    assert one != two


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
