"""The runner: which stages of a case must run, in order, and where their results go.

Standard library only. The stages' own code is imported when the first of them has to run, so that
a cached run ends before pandas would have been imported.
"""

from __future__ import annotations

import platform
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from pse_analysis import __version__
from pse_analysis.errors import FULL, ParameterError, PseError, StorageError, TableError
from pse_analysis.files import SIMULATED, Facts, describe_folder, unchanged
from pse_analysis.pipeline import memory, space
from pse_analysis.pipeline.cache import CacheError, Entry, Store, lock
from pse_analysis.pipeline.case import Case, load_case, project_root
from pse_analysis.pipeline.descent import inputs, older, read_parameters
from pse_analysis.pipeline.fingerprint import (
    SOURCE_ROOT,
    closure,
    digest_code,
    fingerprint,
)
from pse_analysis.pipeline.plan import (
    NAMES,
    STAGES,
    SUMMARY,
    Job,
    Options,
    Reporter,
    Result,
    Stage,
    Work,
)
from pse_analysis.pipeline.raw_folder import RawFolder, foreign

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
    with lock(processed, case.name) as writable:
        current = _Run(
            case,
            options,
            reporter,
            work,
            RawFolder(options.data_folder / "raw" / case.name),
            Store(processed),
            writable,
        )
        if writable:
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
    writable: bool
    ran: list[str] = field(default_factory=list)
    cached: list[str] = field(default_factory=list)

    def run(self) -> Result:
        raw_files = self._simulate(STAGES[0])
        entries: dict[str, Entry] = {}
        for stage in STAGES[1 : NAMES.index(self.options.last) + 1]:
            entries[stage.name] = self._stage(stage, raw_files, entries)
        if self.writable:
            self.store.note(raw_files, entries)
        every = {**self.store.entries(), **entries}
        return Result(
            self.case,
            self.raw.folder,
            MappingProxyType(entries),
            tuple(self.ran),
            tuple(self.cached),
            MappingProxyType(older(self.case, every, raw_files, self.raw.marker())),
        )

    def _forced(self, stage: str) -> bool:
        return self.options.force and self.options.may_run(stage)

    def _simulate(self, stage: Stage) -> Mapping[str, Facts]:
        """Bring the raw folder up to date; returns a description of its files."""
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
            files = self.raw.describe(self.store.raw_files())
            self.raw.check(files)
            return files
        read, profiles = read_parameters(self.case, stage), self._simulation_inputs()
        key = fingerprint(stage.name, parameters=read, inputs=profiles, code=code(stage))
        if self.raw.occupied:
            marker = self.raw.marker()
            if marker is None:
                raise CacheError(foreign(folder))
            files = self.raw.describe(self.store.raw_files())
            changed = self.raw.changed(files)
            forced = self._forced(stage.name)
            if changed is not None and not forced:
                raise CacheError(
                    f"{folder / changed} is not as the simulation wrote it: --force simulates "
                    f"again and loses the change; to keep it, remove {folder / SIMULATED} and the "
                    "case file's grid and [simulate]"
                )
            if marker.get("fingerprint") == key and not forced:
                self._report_cached(stage.name)
                return files
        self._require(stage.name)
        self._require_room(stage.name, folder, self.store.raw_files(), {})
        self._perform(
            stage,
            self.raw.begin(),
            {},
            self._provenance(stage, key, profiles),
            partial(self.raw.publish, key, read),
        )
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
        self, stage: Stage, raw_files: Mapping[str, Facts], entries: dict[str, Entry]
    ) -> Entry:
        """Return the stage's current result, made now if there is none."""
        entry = self.store.entries().get(stage.name)
        if (
            entry is not None
            and entry.fingerprint == self._key(stage, raw_files, entries)
            and not self._forced(stage.name)
            and _complete(entry, stage.name)
            and not self._damaged(stage.name, entry)
        ):
            self._report_cached(stage.name)
            return entry
        self._require(stage.name)
        self._mend_inputs(stage, raw_files, entries)
        return self._make(stage, raw_files, entries)

    def _key(
        self, stage: Stage, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
    ) -> str:
        return fingerprint(
            stage.name,
            parameters=read_parameters(self.case, stage),
            inputs=inputs(stage, raw_files, entries),
            code=code(stage),
        )

    def _damaged(self, stage: str, entry: Entry, *, thorough: bool = False) -> bool:
        """Whether files of a result are not as they were written; the user is told which."""
        names = entry.damaged(thorough=thorough)
        if not names and not unchanged_summary(entry):
            names = (SUMMARY,)
        if names:
            more = f" and {len(names) - 1} more files of {stage}" if names[1:] else ""
            self.reporter.warning(
                f"{entry.folder / names[0]}{more}: damaged or changed since written; made again"
            )
        return bool(names)

    def _mend_inputs(
        self, stage: Stage, raw_files: Mapping[str, Facts], entries: dict[str, Entry]
    ) -> None:
        """Compare what the stage is about to read with its digests; make again what differs."""
        for name in dict.fromkeys(earlier for earlier, _ in stage.tables):
            if name in self.ran or not self._damaged(name, entries[name], thorough=True):
                continue
            self._require(name)
            earlier = STAGES[NAMES.index(name)]
            self._mend_inputs(earlier, raw_files, entries)
            entries[name] = self._make(earlier, raw_files, entries)
            self.cached.remove(name)

    def _make(
        self, stage: Stage, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
    ) -> Entry:
        read, found = read_parameters(self.case, stage), inputs(stage, raw_files, entries)
        key = self._key(stage, raw_files, entries)

        def publish(folder: Path, seconds: float) -> Entry:
            return self.store.publish(stage.name, Entry(folder, key, {}, seconds, read, found))

        self._require_writable(stage.name)
        last = self.store.entries().get(stage.name)
        before = {} if last is None else last.files
        self._require_room(stage.name, self.store.folder, before, raw_files)
        return self._perform(
            stage,
            self.store.begin(stage.name, key),
            {earlier: entry.folder for earlier, entry in entries.items()},
            self._provenance(stage, key, found),
            publish,
        )

    def _provenance(self, stage: Stage, key: str, found: Mapping[str, str]) -> dict[str, Any]:
        return {
            "case": self.case.name,
            "stage": stage.name,
            "fingerprint": key,
            "parameters": read_parameters(self.case, stage),
            "inputs": dict(found),
            "versions": versions(),
        }

    def _report_cached(self, stage: str) -> None:
        self.cached.append(stage)
        self.reporter.cached(stage)

    def _require(self, stage: str) -> None:
        self._require_writable(stage)
        if not self.options.may_run(stage):
            raise CacheError(
                f"stage {self.options.only!r} needs a current result of {stage!r}: run that "
                f"first, or both with --until {self.options.only}"
            )

    def _require_room(
        self, stage: str, folder: Path, before: Mapping[str, Facts], raw: Mapping[str, Facts]
    ) -> None:
        bytes_needed = space.needed(stage, before, raw)
        space.require(folder, bytes_needed, f"{stage} of case {self.case.name!r}")

    def _require_writable(self, stage: str) -> None:
        if not self.writable:
            raise CacheError(
                f"stage {stage!r} has to run, but {self.store.folder} cannot be written to: make "
                "it writable, or name another folder of data with --data DIR"
            )

    def _perform(
        self,
        stage: Stage,
        output: Path,
        folders: Mapping[str, Path],
        provenance: Mapping[str, Any],
        publish: Callable[[Path, float], T],
    ) -> T:
        """Let the stage write to ``output`` and publish that; remove it if either fails."""
        self.reporter.started(stage.name)
        since = time.perf_counter()
        try:
            if self.work is None:
                # numpy and pandas are imported here, and only here.
                memory.require()
                from pse_analysis.pipeline import stages

                stages.check_case(self.case)
                self.work = stages.WORK
            job = Job(
                case=self.case,
                raw=self.raw.folder,
                profiles=profiles_folder(self.options.data_folder),
                inputs=MappingProxyType(dict(folders)),
                output=output,
                workers=self.options.worker_count,
                progress=partial(self.reporter.progress, stage.name),
                provenance=provenance,
            )
            self.work[stage.name](job)
            published = publish(output, time.perf_counter() - since)
        except BaseException as error:
            # Just made, and under a name that is this process's: nobody else's files are in it.
            shutil.rmtree(output, ignore_errors=True)
            self.reporter.failed(stage.name)
            if isinstance(error, PseError):
                raise
            if isinstance(error, OSError) and error.errno in FULL:
                raise StorageError.of(error, output.parent) from error
            if memory.ran_out(error):
                raise memory.explain(error, stage.name, self.options.worker_count) from error
            raise
        self.ran.append(stage.name)
        self.reporter.finished(stage.name, time.perf_counter() - since)
        return published


LIBRARIES = ("numpy", "pandas", "pyarrow", "scipy", "rerun-sdk")
"""Libraries whose versions a derived table names."""


def versions() -> dict[str, str]:
    """Versions of what a result was made with."""
    found = {"pse_analysis": __version__, "python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


def unchanged_summary(entry: Entry) -> bool:
    """Whether the summary, which a cached run prints, is as it was written to the last bit."""
    facts = entry.files.get(SUMMARY)
    return facts is None or unchanged(entry.folder / SUMMARY, facts, thorough=True)


def _complete(entry: Entry, stage: str) -> bool:
    needed = [f"{table}.parquet" for s in STAGES for earlier, table in s.tables if earlier == stage]
    return all(name in entry.files for name in needed)
