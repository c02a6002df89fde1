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
from pse_analysis.files import Facts, check
from pse_analysis.pipeline import descent, runner
from pse_analysis.pipeline.cache import Entry, Store
from pse_analysis.pipeline.case import Case, load_case
from pse_analysis.pipeline.plan import NAMES, Options, Reporter, Result, again
from pse_analysis.pipeline.raw_folder import RawFolder

if TYPE_CHECKING:
    import pandas as pd

    from pse_analysis.grid.network import Network
    from pse_analysis.machine import Machine
    from pse_analysis.pipeline.stages import Parameters

RAW_TABLES = ("telemetry", "channels", "truth", "sample_truth", "faults")
MODEL = ("grid", "machine.parquet")


class Recordings(Mapping[str, Path]):
    """Rerun recording of each stage that has one; asked for, it is compared with its digest."""

    def __init__(self, case: str, files: Mapping[str, tuple[Path, Facts]]) -> None:
        self._case = case
        self._files = files

    def __getitem__(self, stage: str) -> Path:
        path, facts = self._files[stage]
        check(path, facts, again(self._case))
        return path

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


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
    older : mapping of str to str
        Stages whose stored result does not descend from the case file and the other results as
        they are now, or is damaged, and why. Their tables are left out, unless `load` was asked
        for them.
    """

    case: Case
    raw_folder: Path
    files: Mapping[str, Path]
    recordings: Mapping[str, Path]
    older: Mapping[str, str] = field(default_factory=dict)
    _score: Entry | None = field(default=None, repr=False, compare=False)
    _facts: Mapping[str, Facts] = field(default_factory=dict, repr=False, compare=False)
    _raw_files: Mapping[str, Facts] = field(default_factory=dict, repr=False, compare=False)
    _hidden: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)
    _read: dict[str, pd.DataFrame] = field(default_factory=dict, repr=False, compare=False)

    @property
    def network(self) -> Network:
        """The grid."""
        from pse_analysis.pipeline.tables import read_network

        self._check_raw(*MODEL)
        return read_network(self.raw_folder)

    @property
    def machine(self) -> Machine:
        """The machine."""
        from pse_analysis.pipeline.tables import read_machine

        self._check_raw(*MODEL)
        return read_machine(self.raw_folder)

    @property
    def parameters(self) -> Parameters:
        """Frozen parameters of every stage, as the case file states them."""
        from pse_analysis.pipeline.stages import check_case

        return check_case(self.case)

    @property
    def summary(self) -> str:
        """The table of scores as text; empty before the case is scored."""
        scored = {} if self._score is None else {"score": self._score}
        return Result(self.case, self.raw_folder, scored).summary

    def __getitem__(self, table: str) -> pd.DataFrame:
        if table not in self._read:
            from pse_analysis.pipeline.tables import find_raw_table
            from pse_analysis.telemetry import read_table

            if table in self._hidden:
                raise TableError(
                    f"{table} is older than what it was made from, or damaged "
                    f"({self._hidden[table]}): `pse run {self.case.name}` brings it up to date, "
                    f"load({self.case.name!r}, older=True) shows it as it is"
                )
            if table not in set(self):
                raise KeyError(f"{table}: expected any of {', '.join(self)}")
            if table in self.files:
                if not self.files[table].is_file():
                    raise TableError(
                        f"{self.files[table]} is gone: a later run replaced it; load the case again"
                    )
                check(self.files[table], self._facts[table], again(self.case.name))
                frame = read_table(self.files[table], table)
            else:
                self._check_raw(table, f"{table}.parquet")
                found = find_raw_table(self.raw_folder, table)
                assert found is not None
                frame = found
            self._read[table] = frame
        return self._read[table]

    def _check_raw(self, *names: str) -> None:
        """Refuse raw files that are not those which the other tables were made from."""
        now = RawFolder(self.raw_folder).describe(self._raw_files)
        for name in sorted({*now, *self._raw_files}):
            digests = {files.get(name, {}).get("digest") for files in (now, self._raw_files)}
            if name.split("/")[0] in names and len(digests) > 1:
                raise TableError(
                    f"{self.raw_folder / name} is not as it was when the case was loaded: load "
                    "the case again"
                )

    def __iter__(self) -> Iterator[str]:
        yield from (n for n in RAW_TABLES if n not in self._hidden and self._in_raw(n))
        yield from self.files

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _in_raw(self, table: str) -> bool:
        return (self.raw_folder / table).is_dir() or (
            self.raw_folder / f"{table}.parquet"
        ).is_file()


def _results(
    case: Case,
    raw_folder: Path,
    entries: Mapping[str, Entry],
    older: Mapping[str, str],
    raw_files: Mapping[str, Facts],
    shown: bool = False,
) -> Results:
    """Results of the given entries; without those that are older, unless they are to be shown."""
    hidden = {} if shown else {stage: why for stage, why in older.items() if stage in NAMES}
    tables: dict[str, tuple[Path, Facts]] = {}
    recordings: dict[str, tuple[Path, Facts]] = {}
    left_out = dict.fromkeys(RAW_TABLES, hidden["simulate"]) if "simulate" in hidden else {}
    for stage in NAMES:
        entry = entries.get(stage)
        for name, facts in entry.files.items() if entry is not None else ():
            assert entry is not None
            table, found = name.removesuffix(".parquet"), (entry.folder / name, facts)
            if name.endswith(".parquet") and stage in hidden:
                left_out[table] = hidden[stage]
            elif name.endswith(".parquet"):
                tables[table] = found
            elif name.endswith(".rrd") and stage not in hidden:
                recordings[stage] = found
    return Results(
        case=case,
        raw_folder=raw_folder,
        files=MappingProxyType({table: path for table, (path, _) in tables.items()}),
        recordings=Recordings(case.name, recordings),
        older=MappingProxyType(dict(older)),
        _score=None if "score" in hidden else entries.get("score"),
        _facts={table: facts for table, (_, facts) in tables.items()},
        _raw_files=raw_files,
        _hidden=left_out,
    )


def load(
    case: str,
    data: str | Path | None = None,
    cases: str | Path | None = None,
    *,
    older: bool = False,
) -> Results:
    """Current tables of a case, as its last run left them.

    A table is current if it descends from the case file and from the other tables as they are
    now; `Results.older` says which stages do not, and why.

    Parameters
    ----------
    case
        Its name.
    data, cases
        Folder of raw and processed data, folder of case files; by default the project's own.
    older
        Give older tables too. They belong to other parameters than `Results.parameters`.

    Raises
    ------
    ParameterError
        If there is no such case.
    TableError
        If it was not run yet, or everything is older.
    """
    options = Options(data=_path(data), cases=_path(cases))
    found = load_case(case, options.cases)
    folder = options.data_folder / "processed" / found.name
    entries, outdated, raw_files = stored(found, options)
    if not entries:
        raise TableError(
            f"case {case!r} has no results in {folder}: run it first, with `pse run {case}` or "
            f"pse_analysis.pipeline.run({case!r})"
        )
    if not older and set(entries) <= set(outdated):
        stage = next(iter(outdated))
        raise TableError(
            f"all results of case {case!r} in {folder} are older than what they were made from, or "
            f"damaged ({stage}: {outdated[stage]}): `pse run {case}` brings them up to date, "
            f"load({case!r}, older=True) shows them as they are"
        )
    raw_folder = options.data_folder / "raw" / found.name
    return _results(found, raw_folder, entries, outdated, raw_files, shown=older)


def stored(
    case: Case, options: Options
) -> tuple[dict[str, Entry], dict[str, str], Mapping[str, Facts]]:
    """Results of a case by stage; which are older than the rest, or damaged, and why; raw files."""
    store = Store(options.data_folder / "processed" / case.name)
    entries = dict(store.entries())
    raw = RawFolder(options.data_folder / "raw" / case.name)
    files = raw.describe(store.raw_files()) if raw.occupied else {}
    read = descent.simulation_inputs(case, options.data_folder)
    unfit = descent.older(case, entries, files, raw.marker(), read)
    for stage, entry in entries.items():
        if names := entry.damaged():
            unfit[stage] = f"{entry.folder / names[0]} is gone, damaged or changed since written"
    return entries, unfit, files


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
    return _results(result.case, result.raw, result.entries, result.older, result.raw_files)


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
