"""The runner: which stages of a case must run, in order, and where their results go.

Standard library only. The stages' own code is imported when the first of them has to run, so that
a cached run ends before pandas would have been imported.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from pse_analysis.errors import ParameterError, TableError
from pse_analysis.pipeline.cache import CacheError, Entry, RawFolder, Store, foreign, lock
from pse_analysis.pipeline.case import Case, load_case, project_root
from pse_analysis.pipeline.fingerprint import (
    SOURCE_ROOT,
    closure,
    describe_folder,
    digest_code,
    fingerprint,
)
from pse_analysis.pipeline.plan import (
    NAMES,
    STAGES,
    Job,
    Options,
    Reporter,
    Result,
    Stage,
    Work,
)

T = TypeVar("T")

PROFILES = "load_profiles"

# Modules behind every stage: the tables' forms and files. What calls the stages counts by its own
# text only: it imports them all.
_SHARED = ("pse_analysis.telemetry", "pse_analysis.vocabulary")
_CALLERS = ("pse_analysis.pipeline.stages", "pse_analysis.pipeline.tables")


def profiles_folder(data: Path) -> Path:
    """Load profiles beside the data, or else the project's own."""
    own = data / "raw" / PROFILES
    return own if own.is_dir() else project_root() / "data" / "raw" / PROFILES


def parameters(case: Case, stage: Stage) -> dict[str, Any]:
    """What the stage reads of the case file."""
    values: dict[str, Any] = {}
    for key in stage.keys:
        values[key] = case.sections.get(key) if key not in ("grid", "title") else None
    if "grid" in stage.keys:
        values["grid"] = case.grid
    if "title" in stage.keys:
        values["title"] = case.title
    return values


def code(stage: Stage) -> dict[str, str]:
    """Digest of each module the stage uses."""
    return digest_code([*closure(stage.module, *_SHARED, *stage.leaves), *_CALLERS])


def run(
    name: str,
    options: Options | None = None,
    reporter: Reporter | None = None,
    work: Work | None = None,
) -> Result:
    """Run the stages of a case that are not current.

    Parameters
    ----------
    name
        The case.
    options
        What to run and where.
    reporter
        Hears what happens.
    work
        Function of each stage; by default those of `pse_analysis.pipeline.stages`.

    Raises
    ------
    PseError
        With what was expected, what came and what to do next.
    """
    options = options or Options()
    reporter = reporter or Reporter()
    case = load_case(name, options.cases)
    processed = options.data_folder / "processed" / case.name
    with lock(processed, case.name):
        current = _Run(
            case,
            options,
            reporter,
            work,
            RawFolder(options.data_folder / "raw" / case.name),
            Store(processed),
        )
        current.raw.recover()
        current.store.prune()
        reporter.case(case)
        result = current.run()
    reporter.result(result)
    return result


@dataclass
class _Run:
    case: Case
    options: Options
    reporter: Reporter
    work: Work | None
    raw: RawFolder
    store: Store
    ran: list[str] = field(default_factory=list)
    cached: list[str] = field(default_factory=list)

    def run(self) -> Result:
        raw_files = self._simulate(STAGES[0])
        entries: dict[str, Entry] = {}
        for stage in STAGES[1 : NAMES.index(self.options.last) + 1]:
            entries[stage.name] = self._stage(stage, raw_files, entries)
        return Result(
            self.case,
            self.raw.folder,
            MappingProxyType(entries),
            tuple(self.ran),
            tuple(self.cached),
        )

    def _forced(self, stage: str) -> bool:
        return self.options.force and self.options.may_run(stage)

    def _simulate(self, stage: Stage) -> dict[str, dict[str, Any]]:
        """Bring the raw folder up to date; returns size and digest of its files."""
        folder = self.raw.folder
        if not self.case.simulated:
            if self.options.only == stage.name:
                raise ParameterError(
                    f"{self.case.path}: nothing to simulate: the case has no [simulate] table"
                )
            if not self.raw.occupied:
                raise TableError(
                    f"no raw data for case {self.case.name!r}: expected {folder} with telemetry/, "
                    "channels.parquet and grid/ or machine.parquet; write it with "
                    "pse_analysis.telemetry.write_raw, or add [simulate] to the case file"
                )
            return self.raw.describe()
        key = fingerprint(
            stage.name,
            parameters=parameters(self.case, stage),
            inputs=self._simulation_inputs(),
            code=code(stage),
        )
        if self.raw.occupied:
            marker = self.raw.marker()
            if marker is None:
                raise CacheError(foreign(folder))
            files = self.raw.describe()
            changed = self.raw.changed(files)
            forced = self._forced(stage.name)
            if changed is not None and not forced:
                raise CacheError(
                    f"{folder / changed} is not as the simulation wrote it: --force simulates "
                    f"again and loses the change; to keep it, remove {folder / 'simulated.json'} "
                    "and the case file's grid and [simulate]"
                )
            if marker.get("fingerprint") == key and not forced:
                self._report_cached(stage.name)
                return files
        self._require(stage.name)
        self._perform(stage, self.raw.begin(), {}, partial(self.raw.publish, key))
        return self.raw.describe()

    def _simulation_inputs(self) -> dict[str, str]:
        folders = {
            "profiles": profiles_folder(self.options.data_folder),
            "tables": SOURCE_ROOT / "pse_analysis" / "grid" / "tables" / str(self.case.grid),
        }
        return {
            f"{kind}/{name}": facts["digest"]
            for kind, folder in folders.items()
            for name, facts in describe_folder(folder).items()
            if name.endswith((".parquet", ".csv"))
        }

    def _stage(
        self, stage: Stage, raw_files: Mapping[str, Mapping[str, Any]], entries: dict[str, Entry]
    ) -> Entry:
        inputs = {
            f"raw/{name}": facts["digest"]
            for name, facts in raw_files.items()
            if name.split("/")[0] in stage.raw
        }
        for earlier, table in stage.tables:
            file = f"{table}.parquet"
            inputs[f"{earlier}/{file}"] = entries[earlier].files[file]["digest"]
        key = fingerprint(
            stage.name,
            parameters=parameters(self.case, stage),
            inputs=inputs,
            code=code(stage),
        )
        entry = self.store.entry(stage.name)
        if (
            entry is not None
            and entry.fingerprint == key
            and not self._forced(stage.name)
            and _complete(entry, stage.name)
        ):
            self._report_cached(stage.name)
            return entry
        self._require(stage.name)
        folders = {earlier: found.folder for earlier, found in entries.items()}
        publish = partial(self.store.publish, stage.name, key)
        return self._perform(stage, self.store.begin(stage.name, key), folders, publish)

    def _report_cached(self, stage: str) -> None:
        self.cached.append(stage)
        self.reporter.cached(stage)

    def _require(self, stage: str) -> None:
        if not self.options.may_run(stage):
            raise CacheError(
                f"stage {self.options.only!r} needs a current result of {stage!r}: run that "
                f"first, or both with --until {self.options.only}"
            )

    def _perform(
        self,
        stage: Stage,
        output: Path,
        inputs: Mapping[str, Path],
        publish: Callable[[Path, float], T],
    ) -> T:
        """Let the stage write to ``output`` and publish that; remove it if either fails."""
        self.reporter.started(stage.name)
        since = time.perf_counter()
        try:
            if self.work is None:
                # numpy and pandas are imported here, and only here.
                from pse_analysis.pipeline import stages

                stages.check_case(self.case)
                self.work = stages.WORK
            job = Job(
                case=self.case,
                raw=self.raw.folder,
                profiles=profiles_folder(self.options.data_folder),
                inputs=MappingProxyType(dict(inputs)),
                output=output,
                workers=self.options.worker_count,
                progress=partial(self.reporter.progress, stage.name),
            )
            self.work[stage.name](job)
            published = publish(output, time.perf_counter() - since)
        except BaseException:
            shutil.rmtree(output, ignore_errors=True)
            self.reporter.failed(stage.name)
            raise
        self.ran.append(stage.name)
        self.reporter.finished(stage.name, time.perf_counter() - since)
        return published


def _complete(entry: Entry, stage: str) -> bool:
    needed = [f"{table}.parquet" for s in STAGES for earlier, table in s.tables if earlier == stage]
    return all(name in entry.files for name in needed)
