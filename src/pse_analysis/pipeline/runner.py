"""The runner: which stages of a case must run, in order, and where their results go.

Standard library only. The stages' own code is imported when the first of them has to run, so that
a cached run ends before pandas would have been imported.
"""

from __future__ import annotations

import errno
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

from pse_analysis.checksums import SIMULATED, remedy
from pse_analysis.errors import (
    FULL,
    DamagedFile,
    ParameterError,
    PseError,
    StorageError,
    TableError,
)
from pse_analysis.files import Facts, unchanged
from pse_analysis.pipeline import memory, space
from pse_analysis.pipeline.cache import MANIFEST, READ_ONLY, SUMMARY, CacheError, Entry, Store, lock
from pse_analysis.pipeline.case import Case, load_case
from pse_analysis.pipeline.descent import (
    filters,
    inputs,
    older,
    profiles_folder,
    read_parameters,
    simulation_inputs,
)
from pse_analysis.pipeline.fingerprint import closure, digest_code, digest_installed, fingerprint
from pse_analysis.pipeline.plan import NAMES, STAGES, Job, Options, Reporter, Result, Stage, Work
from pse_analysis.pipeline.provenance import provenance
from pse_analysis.pipeline.raw_folder import RawFolder, foreign

T = TypeVar("T")

# Modules behind every stage: the tables' forms and files. What calls the stages counts by its own
# text only: it imports them all.
_SHARED = ("pse_analysis.telemetry", "pse_analysis.vocabulary")
_CALLERS = ("pse_analysis.pipeline.stages", "pse_analysis.pipeline.tables")


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
            RawFolder(options.data_folder / "raw" / case.name, reporter.warning),
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
    unfit: set[str] = field(default_factory=set)
    """Stages whose result was found damaged when a later one was about to read it."""

    def run(self) -> Result:
        raw_files = self._simulate(STAGES[0])
        wanted = STAGES[1 : NAMES.index(self.options.last) + 1]
        entries: dict[str, Entry] = {}
        while len(entries) < len(wanted):
            stage = wanted[len(entries)]
            entry = self._current(stage, raw_files, entries)
            if entry is None:
                damaged = self._damaged_input(stage, entries)
                if damaged is not None:
                    # What was made from it may have to be made again, too: go back to it.
                    self.unfit.add(damaged)
                    entries = {s: entries[s] for s in NAMES[1 : NAMES.index(damaged)]}
                    continue
                entry = self._make(stage, raw_files, entries)
            entries[stage.name] = entry
        if self.writable:
            self.store.note(raw_files, entries)
        return Result(
            self.case,
            self.raw.folder,
            MappingProxyType(entries),
            tuple(self.ran),
            tuple(name for name in self.cached if name not in self.ran),
            MappingProxyType(self._older(raw_files, {**self.store.entries(), **entries})),
            raw_files,
        )

    def _older(
        self, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
    ) -> dict[str, str]:
        data = self.options.data_folder
        return older(
            self.case, entries, raw_files, self.raw.marker(), simulation_inputs(self.case, data)
        )

    def _forced(self, stage: str) -> bool:
        return self.options.force and self.options.may_run(stage) and stage not in self.ran

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
        read = simulation_inputs(self.case, self.options.data_folder)
        parameters = read_parameters(self.case, stage)
        key = fingerprint(stage.name, parameters=parameters, inputs=read, code=code(stage))
        noted = {"fingerprint": key, "parameters": parameters, "inputs": read}
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
            if not forced and all(marker.get(name) == value for name, value in noted.items()):
                self._report_cached(stage.name)
                return files
        self._require(stage.name)
        size = space.needed(stage.name, self.store.raw_files(), {})
        space.require(folder, size, f"{stage.name} of case {self.case.name!r}")

        def publish(part: Path, seconds: float) -> None:
            self.raw.publish({**noted, "seconds": round(seconds, 3)}, part)

        self._perform(stage, self.raw.begin, {}, key, read, publish)
        return self.raw.describe()

    def _current(
        self, stage: Stage, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
    ) -> Entry | None:
        """Return the stage's stored result if it is current and whole."""
        entry = self.store.entries().get(stage.name)
        if self._forced(stage.name) or stage.name in self.unfit:
            return None
        if entry is None:
            if stage.name in self.store.damaged():
                self._again(stage.name, f"{self.store.folder / MANIFEST}: its part on {stage.name}")
            return None
        if (
            entry.fingerprint != self._key(stage, raw_files, entries)
            or not _complete(entry, stage.name)
            or self._is_damaged(stage.name, entry)
        ):
            return None
        self._report_cached(stage.name)
        return entry

    def _key(
        self, stage: Stage, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
    ) -> str:
        return fingerprint(
            stage.name,
            parameters=read_parameters(self.case, stage),
            inputs=inputs(stage, raw_files, entries),
            code={**code(stage), **digest_installed(filters(self.case, stage))},
        )

    def _is_damaged(self, stage: str, entry: Entry, *, thorough: bool = False) -> bool:
        """Whether files of a result are not as they were written; the user is told which."""
        names = entry.damaged(thorough=thorough)
        if not names and not unchanged_summary(entry):
            names = (SUMMARY,)
        if names:
            more = f" and {len(names) - 1} more files of {stage}" if names[1:] else ""
            self._again(stage, f"{entry.folder / names[0]}{more}")
        return bool(names)

    def _again(self, stage: str, what: str) -> None:
        """Say that something is damaged and its stage runs again; refuse if it may not."""
        if not (self.writable and self.options.may_run(stage)):
            raise DamagedFile(
                f"{what}: damaged or changed since written: `pse run {self.case.name}`, with "
                "leave to write there, makes it again"
            )
        self.reporter.warning(f"{what}: damaged or changed since written; made again")

    def _damaged_input(self, stage: Stage, entries: Mapping[str, Entry]) -> str | None:
        """The first stage whose result differs from its digest although it is about to be read."""
        self._require(stage.name)
        for name in sorted({earlier for earlier, _ in stage.tables}, key=NAMES.index):
            if name not in self.ran and self._is_damaged(name, entries[name], thorough=True):
                return name
        return None

    def _make(
        self, stage: Stage, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
    ) -> Entry:
        read, found = read_parameters(self.case, stage), inputs(stage, raw_files, entries)
        key = self._key(stage, raw_files, entries)
        self._check_raw(stage, raw_files, thorough=True)

        def publish(folder: Path, seconds: float) -> Entry:
            # Data that change while they are read give a result of neither state.
            self._check_raw(stage, raw_files)
            for earlier in {earlier for earlier, _ in stage.tables}:
                if names := entries[earlier].damaged():
                    raise DamagedFile(
                        f"{entries[earlier].folder / names[0]} changed while {stage.name} read "
                        "it: run again"
                    )
            return self.store.publish(stage.name, Entry(folder, key, {}, seconds, read, found))

        last = self.store.entries().get(stage.name)
        size = space.needed(stage.name, {} if last is None else last.files, raw_files)
        space.require(self.store.folder, size, f"{stage.name} of case {self.case.name!r}")
        begin = partial(self.store.begin, stage.name, key)
        entry = self._perform(stage, begin, entries, key, found, publish)
        self.unfit.discard(stage.name)
        return entry

    def _check_raw(
        self, stage: Stage, raw_files: Mapping[str, Facts], *, thorough: bool = False
    ) -> None:
        """Refuse raw files that are not as they were when this run looked at the folder."""
        for name, facts in raw_files.items():
            path = self.raw.folder / name
            if name.split("/")[0] not in stage.raw or unchanged(path, facts, thorough=thorough):
                continue
            if not thorough:
                raise DamagedFile(f"{path} changed while {stage.name} read it: run again")
            raise DamagedFile(
                f"{path} is not as it was when it was last read, although its size and time are: "
                f"it was damaged; {remedy(self.raw.folder)}"
            )

    def _report_cached(self, stage: str) -> None:
        if stage not in self.cached and stage not in self.ran:
            self.cached.append(stage)
            self.reporter.cached(stage)

    def _require(self, stage: str) -> None:
        if not self.writable:
            raise CacheError(
                f"stage {stage!r} has to run, but {self.store.folder} cannot be written to: make "
                "it writable, or name another folder of data with --data DIR"
            )
        if not self.options.may_run(stage):
            raise CacheError(
                f"stage {self.options.only!r} needs a current result of {stage!r}: run that "
                f"first, or both with --until {self.options.only}"
            )

    def _perform(
        self,
        stage: Stage,
        begin: Callable[[], Path],
        entries: Mapping[str, Entry],
        key: str,
        read: Mapping[str, str],
        publish: Callable[[Path, float], T],
    ) -> T:
        """Let the stage write to a folder and publish that; remove it if either fails."""
        self.reporter.started(stage.name)
        since = time.perf_counter()
        try:
            with self._folder(begin) as output:
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
                    inputs=MappingProxyType({name: e.folder for name, e in entries.items()}),
                    output=output,
                    workers=self.options.worker_count,
                    progress=partial(self.reporter.progress, stage.name),
                    provenance=provenance(self.case, stage, key, read),
                )
                self.work[stage.name](job)
                published = publish(output, time.perf_counter() - since)
        except BaseException as error:
            self.reporter.failed(stage.name)
            if isinstance(error, PseError):
                raise
            if isinstance(error, OSError) and error.errno in FULL:
                raise StorageError.of(error, self.store.folder) from error
            if memory.ran_out(error):
                raise memory.explain(error, stage.name, self.options.worker_count) from error
            raise
        self.ran.append(stage.name)
        self.reporter.finished(stage.name, time.perf_counter() - since)
        return published

    @contextmanager
    def _folder(self, begin: Callable[[], Path]) -> Iterator[Path]:
        """Give an empty folder to write to, and leave nothing of it behind if that fails."""
        try:
            output = begin()
        except OSError as error:
            if error.errno not in (*READ_ONLY, errno.ENOTDIR, errno.EEXIST, errno.ELOOP):
                raise
            raise CacheError(
                f"{error.filename} cannot be made ({error.strerror}): let its folder be one that "
                "can be written to, or name another folder of data with --data DIR"
            ) from error
        try:
            yield output
        except BaseException:
            # Just made, and under a name that is this process's: nobody else's files are in it.
            shutil.rmtree(output, ignore_errors=True)
            # An exchange of folders may have been cut short.
            with suppress(OSError, PseError):
                self.raw.recover()
                self.store.prune()
            raise


def unchanged_summary(entry: Entry) -> bool:
    """Whether the summary, which a cached run prints, is as it was written to the last bit."""
    facts = entry.files.get(SUMMARY)
    return facts is None or unchanged(entry.folder / SUMMARY, facts, thorough=True)


def _complete(entry: Entry, stage: str) -> bool:
    needed = [f"{table}.parquet" for s in STAGES for earlier, table in s.tables if earlier == stage]
    return all(name in entry.files for name in needed)
