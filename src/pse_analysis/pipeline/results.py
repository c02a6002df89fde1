"""Current tables of a case by name, for notebooks.

Standard library only at import; pandas comes with the first table.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from pse_analysis.errors import TableError
from pse_analysis.pipeline import runner
from pse_analysis.pipeline.cache import Entry, Store
from pse_analysis.pipeline.case import Case, load_case
from pse_analysis.pipeline.plan import NAMES, Options, Reporter, Result

if TYPE_CHECKING:
    import pandas as pd

    from pse_analysis.grid.network import Network
    from pse_analysis.machine import Machine
    from pse_analysis.pipeline.stages import Parameters

RAW_TABLES = ("telemetry", "channels", "truth", "sample_truth", "faults")


@dataclass(frozen=True)
class Results(Mapping[str, "pd.DataFrame"]):
    """Tables of a case by name, each read and checked when it is first asked for.

    ``results["estimated"]`` is a DataFrame; `list` tells which tables there are. The frames are
    shared between askers: copy one before changing it.

    Attributes
    ----------
    case : Case
        The case.
    files : mapping of str to Path
        Parquet file of each processed table.
    recordings : mapping of str to Path
        Rerun recording of each stage that has one.
    summary : str
        The table of scores as text; empty before the case is scored.
    """

    case: Case
    raw_folder: Path
    files: Mapping[str, Path]
    recordings: Mapping[str, Path]
    summary: str
    _read: dict[str, pd.DataFrame] = field(default_factory=dict, repr=False, compare=False)

    @property
    def network(self) -> Network:
        """The grid."""
        from pse_analysis.pipeline.tables import read_network

        return read_network(self.raw_folder)

    @property
    def machine(self) -> Machine:
        """The machine."""
        from pse_analysis.pipeline.tables import read_machine

        return read_machine(self.raw_folder)

    @property
    def parameters(self) -> Parameters:
        """Frozen parameters of every stage, as the case file states them."""
        from pse_analysis.pipeline.stages import check_case

        return check_case(self.case)

    def __getitem__(self, table: str) -> pd.DataFrame:
        if table not in self._read:
            from pse_analysis.pipeline.tables import read_raw_table
            from pse_analysis.telemetry import read_table

            if table not in set(self):
                raise KeyError(f"{table}: expected any of {', '.join(self)}")
            if table in self.files and not self.files[table].is_file():
                raise TableError(
                    f"{self.files[table]} is gone: a later run replaced it; load the case again"
                )
            frame = (
                read_table(self.files[table], table)
                if table in self.files
                else read_raw_table(self.raw_folder, table)
            )
            assert frame is not None
            self._read[table] = frame
        return self._read[table]

    def __iter__(self) -> Iterator[str]:
        yield from (name for name in RAW_TABLES if self._in_raw(name))
        yield from self.files

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _in_raw(self, table: str) -> bool:
        return (self.raw_folder / table).is_dir() or (
            self.raw_folder / f"{table}.parquet"
        ).is_file()


def _results(case: Case, raw_folder: Path, entries: Mapping[str, Entry]) -> Results:
    files: dict[str, Path] = {}
    recordings: dict[str, Path] = {}
    for stage in NAMES:
        entry = entries.get(stage)
        for name in entry.files if entry is not None else ():
            assert entry is not None
            if name.endswith(".parquet"):
                files[name.removesuffix(".parquet")] = entry.folder / name
            elif name.endswith(".rrd"):
                recordings[stage] = entry.folder / name
    return Results(
        case=case,
        raw_folder=raw_folder,
        files=MappingProxyType(files),
        recordings=MappingProxyType(recordings),
        summary=Result(case, raw_folder, entries).summary,
    )


def load(case: str, data: str | Path | None = None, cases: str | Path | None = None) -> Results:
    """Current tables of a case, as its last run left them.

    Parameters
    ----------
    case
        Its name.
    data, cases
        Folder of raw and processed data, folder of case files; by default the project's own.

    Raises
    ------
    ParameterError
        If there is no such case.
    TableError
        If it was not run yet.
    """
    options = Options(data=_path(data), cases=_path(cases))
    found = load_case(case, options.cases)
    store = Store(options.data_folder / "processed" / found.name)
    entries = {name: entry for name, entry in store.entries().items() if entry.whole()}
    if not entries:
        raise TableError(
            f"case {case!r} has no results in {store.folder}: run it first, with `pse run {case}` "
            f"or pse_analysis.pipeline.run({case!r})"
        )
    return _results(found, options.data_folder / "raw" / found.name, entries)


def run(
    case: str,
    *,
    until: str | None = None,
    force: bool = False,
    workers: int | None = 1,
    data: str | Path | None = None,
    cases: str | Path | None = None,
    reporter: Reporter | None = None,
) -> Results:
    """Bring a case up to date and return its tables; stages that are current do not run.

    Parameters
    ----------
    case
        Its name.
    until
        Last stage to run; by default all of them.
    force
        Run stages although their results are current.
    workers
        Processes for the estimators; None for as many as there are cores, at most four.
    data, cases
        Folder of raw and processed data, folder of case files; by default the project's own.
    reporter
        Hears what happens; by default nobody does.

    Raises
    ------
    PseError
        With what was expected, what came and what to do next.
    """
    options = Options(
        until=until, force=force, workers=workers, data=_path(data), cases=_path(cases)
    )
    result = runner.run(case, options, reporter)
    return _results(result.case, result.raw, result.entries)


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
