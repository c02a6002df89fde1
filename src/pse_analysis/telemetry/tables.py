"""The raw folder of a case.

::

    telemetry/source=<source>/date=<YYYY-MM-DD>/part-0.parquet
    channels.parquet  grid/{network,buses,branches}.parquet, or machine.parquet in place of a grid
    truth.parquet  sample_truth.parquet  faults.parquet        simulated cases only

The date is the UTC date of ``time_utc``. Files carry no time of writing, so equal tables give equal
bytes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from pse_analysis import checksums, files, leftovers
from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.measurement import Model
from pse_analysis.telemetry.channels import check_channels, check_known
from pse_analysis.telemetry.parquet import (
    read_arrow,
    read_columns,
    read_table,
    to_pandas,
    write_arrow,
    write_checked,
    write_table,
)
from pse_analysis.vocabulary import check

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


def write_raw(folder: str | Path, raw: RawCase) -> None:
    """Write a raw case into a folder that holds none yet, whole or not at all.

    ``checksums.json`` in it lists what was written; a file that differs later is refused.

    Raises
    ------
    TableError
        If the folder already holds telemetry or other contents in any of the files, or a table
        breaks its schema.
    """
    folder = files.real(folder)
    if os.path.lexists(folder) and not folder.is_dir():
        raise TableError(f"{folder} is not a folder: choose another name, or move it away first")
    if (folder / "telemetry").exists():
        raise TableError(
            f"{folder} already holds telemetry, which is never overwritten: choose another "
            "folder, or remove that one first"
        )
    for orphan in leftovers.orphans(folder):
        leftovers.remove_own(orphan, checksums.is_own)
    part = leftovers.temporary(folder)
    part.mkdir(parents=True)
    try:
        write_files(part, raw)
        checksums.write_checksums(part)
        files.flush_folder(part)
        if folder.exists():
            _move(part, folder)
        else:
            part.replace(folder)
        files.flush(folder.parent)
    finally:
        leftovers.remove_own(part, checksums.is_own)


def _move(part: Path, folder: Path) -> None:
    """Bring written files into a folder that is there.

    Telemetry comes last: without it nothing reads the folder. A file of the same content is what
    a writer left that was interrupted here.
    """
    names = [path.relative_to(part) for path in files.files_below(part)]
    for name in names:
        there = folder / name
        if os.path.lexists(there) and not files.unchanged(there, files.describe(part / name)):
            raise TableError(
                f"{there} is there already and is not overwritten: choose another folder, or "
                "remove that file first"
            )
    for name in names:
        if name.parts[0] != "telemetry":
            (folder / name).parent.mkdir(exist_ok=True)
            (part / name).replace(folder / name)
    (part / "telemetry").replace(folder / "telemetry")


def accept(folder: str | Path) -> None:
    """List anew the files of a raw folder, after a change that was meant.

    Every table must be whole; from then on the folder counts as it is now.

    Raises
    ------
    TableError
        If a table is missing, damaged, or breaks its schema; or if a simulation made the folder,
        which would go on to stand for what the case file says.
    """
    folder = Path(folder)
    if (folder / checksums.SIMULATED).exists():
        raise TableError(
            f"{folder} was made by a simulation, whose tables must be as it wrote them: "
            f"{checksums.remedy(folder)}; to keep your change, remove "
            f"{folder / checksums.SIMULATED} and the case file's grid and [simulate], then accept"
        )
    _read_raw(folder, {})
    checksums.write_checksums(folder)


def write_files(folder: Path, raw: RawCase) -> None:
    """Write the files of a raw case one by one, for a folder that nobody reads yet.

    Raises
    ------
    TableError
        If a table breaks its schema.
    """
    channels = check_channels(raw.channels, raw.model)
    telemetry = check("telemetry", raw.telemetry)
    check_known(telemetry, channels)
    for table in OPTIONAL_TABLES:
        frame = getattr(raw, table)
        if frame is not None:
            write_table(folder / f"{table}.parquet", frame, table)
    write_checked(folder / "channels.parquet", channels, "channels")
    tables = (
        {"machine": raw.model.to_table()}
        if isinstance(raw.model, Machine)
        else {f"grid/{name}": frame for name, frame in raw.model.to_tables().items()}
    )
    for name, frame in tables.items():
        path = folder / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrow(path, pa.Table.from_pandas(frame, preserve_index=False))
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
        write_checked(path, part, "telemetry")


_PARTITION = re.compile(r"source=([^/]*)/date=([^/]*)/[^/]*\.parquet", re.DOTALL)


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
    folder = Path(folder)
    return _read_telemetry(folder, checksums.read_checksums(folder), sources, dates)


def _read_telemetry(
    folder: Path,
    listed: Mapping[str, files.Facts],
    sources: Collection[str] | None = None,
    dates: Collection[str] | None = None,
) -> pd.DataFrame:
    root = folder / "telemetry"
    if not root.is_dir():
        raise TableError(
            f"telemetry: no folder {root}; write it with pse_analysis.telemetry.write_raw, or run "
            "the case's simulation"
        )
    checksums.refuse_links(folder)
    paths = [
        path
        for path in files.files_below(root)
        if (place := _PARTITION.fullmatch(path.relative_to(root).as_posix()))
        and (sources is None or place[1] in sources)
        and (dates is None or place[2] in dates)
    ]
    if not paths:
        asked = f" for sources {sources or 'all'} and dates {dates or 'all'}"
        raise TableError(
            f"telemetry: {root} holds no source=…/date=…/*.parquet{asked}; there are "
            f"{', '.join(sorted(p.name for p in root.glob('source=*'))) or 'none'}"
        )
    arrow = pa.concat_tables(
        [read_columns(_checked(path, folder, listed), "telemetry") for path in paths]
    )
    if not arrow.num_rows:
        raise TableError(f"telemetry: the {len(paths)} files in {root} are empty; expected samples")
    frame = to_pandas(arrow)
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
    return _read_raw(folder, checksums.read_checksums(folder))


def _read_raw(folder: Path, listed: Mapping[str, files.Facts]) -> RawCase:
    model = _read_model(folder, listed)
    channels = check_channels(
        to_pandas(read_columns(_checked(folder / "channels.parquet", folder, listed), "channels")),
        model,
    )
    telemetry = _read_telemetry(folder, listed)
    check_known(telemetry, channels)
    optional = {
        table: read_table(_checked(folder / f"{table}.parquet", folder, listed), table)
        for table in OPTIONAL_TABLES
        if (folder / f"{table}.parquet").is_file()
    }
    return RawCase(model, channels, telemetry, **optional)


def read_raw_table(folder: str | Path, table: str) -> pd.DataFrame:
    """Read one of the tables of a raw folder that stand in a single file.

    Raises
    ------
    TableError
        If it is missing, damaged, or breaks its schema.
    """
    folder = Path(folder)
    listed = checksums.read_checksums(folder)
    return read_table(_checked(folder / f"{table}.parquet", folder, listed), table)


def read_model(folder: str | Path) -> Model:
    """Read the grid or machine of a raw folder.

    Raises
    ------
    TableError
        If one of its files is missing or not whole.
    """
    folder = Path(folder)
    return _read_model(folder, checksums.read_checksums(folder))


def _read_model(folder: Path, listed: Mapping[str, files.Facts]) -> Model:
    if (folder / "machine.parquet").is_file():
        return Machine.from_table(_read_model_table(folder, "machine.parquet", listed))
    return Network.from_tables(
        **{n: _read_model_table(folder, f"grid/{n}.parquet", listed) for n in GRID_TABLES}
    )


def _read_model_table(folder: Path, name: str, listed: Mapping[str, files.Facts]) -> pd.DataFrame:
    path = folder / name
    if not path.is_file():
        raise TableError(
            f"grid: no file {path}; expected {', '.join(f'{n}.parquet' for n in GRID_TABLES)} in "
            "grid/, or machine.parquet: write them with pse_analysis.telemetry.write_raw"
        )
    arrow = read_arrow(_checked(path, folder, listed))
    return to_pandas(arrow.replace_schema_metadata(None))


def _checked(path: Path, folder: Path, listed: Mapping[str, files.Facts]) -> Path:
    """The path of a raw file, once it is seen to be as it was written."""
    facts = listed.get(path.relative_to(folder).as_posix())
    if facts is not None and path.is_file():
        files.check(path, facts, checksums.remedy(folder))
    return path
