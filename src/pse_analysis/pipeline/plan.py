"""What stages there are, what each reads, and what goes in and out of a run.

Standard library only.
"""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pse_analysis.errors import ParameterError
from pse_analysis.files import Facts, check
from pse_analysis.pipeline.cache import SUMMARY, Entry
from pse_analysis.pipeline.case import Case, project_root

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""What the BLAS libraries read, when numpy is imported, to learn how many threads to start."""


@dataclass(frozen=True)
class Stage:
    """What a stage reads; its fingerprint covers that and nothing else.

    Attributes
    ----------
    name, module : str
        Its name, and the module that does its work.
    keys : tuple of str
        Tables and texts of the case file.
    raw : tuple of str
        Files and folders of the raw folder.
    tables : tuple of (str, str)
        Tables of earlier stages: the stage and the table.
    leaves : tuple of str
        Modules that show its result.
    """

    name: str
    module: str
    keys: tuple[str, ...]
    raw: tuple[str, ...] = ()
    tables: tuple[tuple[str, str], ...] = ()
    leaves: tuple[str, ...] = ("pse_analysis.recording",)


STAGES = (
    Stage(
        "simulate",
        "pse_analysis.simulation",
        keys=("grid", "machine", "study", "simulate"),
        leaves=(),
    ),
    Stage(
        "validate",
        "pse_analysis.validation",
        keys=("study", "validate"),
        raw=(
            "telemetry",
            "grid",
            "machine.parquet",
            "channels.parquet",
            "sample_truth.parquet",
            "faults.parquet",
        ),
    ),
    Stage(
        "align",
        "pse_analysis.alignment",
        keys=("study", "align"),
        raw=("grid", "machine.parquet", "channels.parquet", "truth.parquet"),
        tables=(("validate", "validated"),),
    ),
    Stage(
        "estimate",
        "pse_analysis.estimation",
        keys=("study", "estimate"),
        raw=("grid", "machine.parquet", "channels.parquet", "truth.parquet"),
        tables=(("align", "aligned"),),
    ),
    Stage(
        "score",
        "pse_analysis.scoring",
        # What theory says of an observer follows from its tuning and the true densities.
        # What was checked of which channel stands in the summary.
        keys=("title", "machine", "study", "simulate", "validate", "estimate", "score"),
        raw=("grid", "machine.parquet", "channels.parquet", "truth.parquet", "faults.parquet"),
        tables=(
            ("validate", "validated"),
            ("estimate", "estimated"),
            ("estimate", "residuals"),
            ("estimate", "steps"),
        ),
        leaves=(
            "pse_analysis.recording",
            "pse_analysis.pipeline.account",
            "pse_analysis.pipeline.summary",
        ),
    ),
)
NAMES = tuple(stage.name for stage in STAGES)


class Reporter:
    """Hears what a run does; this one keeps it to itself, the command line's print."""

    def case(self, case: Case) -> None:
        """A case begins."""

    def cached(self, stage: str) -> None:
        """A stage's stored result is current."""

    def started(self, stage: str) -> None:
        """A stage begins to run."""

    def progress(self, stage: str, done: int, total: int, note: str) -> None:
        """Report how far the running stage is."""

    def warning(self, text: str) -> None:
        """Report something that a person should know, although the run goes on."""

    def finished(self, stage: str, seconds: float) -> None:
        """Report that a stage's result is stored."""

    def failed(self, stage: str) -> None:
        """Report that a stage ended with an error, which follows."""

    def result(self, result: Result) -> None:
        """A case ended."""


@dataclass(frozen=True)
class Options:
    """What a run may be asked for.

    Attributes
    ----------
    until : str or None
        Last stage to run.
    only : str or None
        The one stage to run; those before it must be current.
    force : bool
        Run stages although their results are current.
    workers : int or None
        Processes for the estimators; None for as many as there are cores, at most four.
    data, cases : Path or None
        Folder of raw and processed data, folder of case files; None for the project's own.
    """

    until: str | None = None
    only: str | None = None
    force: bool = False
    workers: int | None = None
    data: Path | None = None
    cases: Path | None = None

    def __post_init__(self) -> None:
        for name in (self.until, self.only):
            if name is not None and name not in NAMES:
                close = difflib.get_close_matches(name, NAMES, n=1)
                hint = f"did you mean {close[0]!r}? " if close else ""
                raise ParameterError(
                    f"unknown stage {name!r}: {hint}expected any of {', '.join(NAMES)}"
                )
        if self.workers is not None and self.workers < 1:
            raise ParameterError(f"workers: expected 1 or more, received {self.workers}")
        for folder in (self.data_folder, self.cases):
            _require_utf8(folder)

    @property
    def data_folder(self) -> Path:
        """Folder that holds ``raw`` and ``processed``."""
        return project_root() / "data" if self.data is None else Path(self.data)

    @property
    def worker_count(self) -> int:
        """Processes for the estimators. Each holds its own pandas and scipy, some 150 MB."""
        return self.workers or min(4, len(os.sched_getaffinity(0)))

    @property
    def last(self) -> str:
        """Last stage that a run considers."""
        return self.only or self.until or NAMES[-1]

    def may_run(self, stage: str) -> bool:
        """Whether the stage may be run, rather than only be looked up."""
        return self.only in (None, stage)


@dataclass(frozen=True)
class Job:
    """Everything a stage's work needs: the case, and paths.

    Attributes
    ----------
    case : Case
        The case.
    raw : Path
        Its raw folder.
    profiles : Path
        Folder of the load profiles that simulations draw from.
    inputs : mapping of str to Path
        Folder of the current result of each earlier stage, by its name.
    output : Path
        Empty folder to write to.
    workers : int
        Processes it may use.
    progress : callable
        ``progress(done, total, note)``.
    provenance : mapping
        What every table that it writes says of its origin,
        `pse_analysis.telemetry.read_provenance`.
    """

    case: Case
    raw: Path
    profiles: Path
    inputs: Mapping[str, Path]
    output: Path
    workers: int
    progress: Callable[[int, int, str], None]
    provenance: Mapping[str, Any] = field(default_factory=dict)


Work = Mapping[str, Callable[[Job], None]]


def _require_utf8(folder: Path | None) -> None:
    """Refuse a name that parquet and Rerun, which take UTF-8 only, could not open."""
    try:
        str(folder).encode()
    except UnicodeEncodeError as error:
        shown = str(folder).encode(errors="backslashreplace").decode()
        raise ParameterError(
            f"{shown}: this name is not UTF-8 where the locale's encoding is "
            f"{sys.getfilesystemencoding()}: set LANG=C.UTF-8 and unset PYTHONUTF8, or choose a "
            "folder with a name of ASCII letters"
        ) from error


@dataclass(frozen=True)
class Result:
    """What a run left behind.

    Attributes
    ----------
    case : Case
        The case.
    raw : Path
        Its raw folder.
    entries : mapping of str to Entry
        Current result of each stage that has one.
    ran, cached : tuple of str
        Stages that ran, and stages whose results were current.
    older : mapping of str to str
        Stages whose stored result does not descend from the current ones, and why.
    raw_files : mapping of str to mapping
        Description of the raw folder's tables that the results descend from, by name.
    """

    case: Case
    raw: Path
    entries: Mapping[str, Entry]
    ran: tuple[str, ...] = ()
    cached: tuple[str, ...] = ()
    older: Mapping[str, str] = field(default_factory=dict)
    raw_files: Mapping[str, Facts] = field(default_factory=dict)

    @property
    def recordings(self) -> tuple[Path, ...]:
        """Recordings of the stages, in their order."""
        return tuple(
            self.entries[stage].folder / name
            for stage in NAMES
            if stage in self.entries
            for name in self.entries[stage].files
            if name.endswith(".rrd")
        )

    @property
    def summary(self) -> str:
        """The table of scores as text; empty if the case is not scored.

        Raises
        ------
        DamagedFile
            If it is not as it was written.
        """
        entry = self.entries.get("score")
        if entry is None or SUMMARY not in entry.files:
            return ""
        check(entry.folder / SUMMARY, entry.files[SUMMARY], again(self.case.name))
        return (entry.folder / SUMMARY).read_text(encoding="utf-8")


def again(case: str) -> str:
    """What to do about a derived file that is not as it was written."""
    return f"`pse run {case} --force` makes it again"
