"""The command line: ``pse run``, ``pse cases``, ``pse view`` and ``pse verify``.

Standard library only at import; `rich` is imported when a stage has to run and a person watches.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pse_analysis.errors import ParameterError, PseError, TableError, remedy
from pse_analysis.files import check
from pse_analysis.pipeline import endings, memory, runner, viewer
from pse_analysis.pipeline.case import Case, list_cases, load_case, project_root
from pse_analysis.pipeline.plan import NAMES, THREADS, Options, Reporter, Result, again
from pse_analysis.pipeline.results import stored
from pse_analysis.pipeline.verify import verify

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class Lines(Reporter):
    """Prints a line per stage: for files, pipes, and runs in which nothing has to run."""

    def case(self, case: Case) -> None:
        """Print the case's name and title."""
        print(f"{case.name} · {case.title}", flush=True)

    def cached(self, stage: str) -> None:
        """Print that nothing had to be done."""
        endings.check()
        print(f"  {stage:<9} cached", flush=True)

    def started(self, stage: str) -> None:
        """Go on unless a signal came."""
        endings.check()

    def progress(self, stage: str, done: int, total: int, note: str) -> None:
        """Go on unless a signal came."""
        endings.check()

    def finished(self, stage: str, seconds: float) -> None:
        """Print how long it took."""
        print(f"  {stage:<9} {seconds:.1f} s", flush=True)

    def warning(self, text: str) -> None:
        """Print it among the errors."""
        sys.stdout.flush()
        print(f"warning: {text}", file=sys.stderr, flush=True)

    def result(self, result: Result) -> None:
        """Print the scores, and where everything is."""
        if result.summary:
            print(f"\n{result.summary.rstrip()}\n")
        for label, place in places(result):
            print(f"  {label:<10} {place}")
        for stage, why in result.older.items():
            print(f"  {stage:<10} older: {why}; `pse run {result.case.name}` makes it anew")
        print(flush=True)


class Bars(Lines):
    """Draws a progress bar per stage that runs, for a person at a terminal."""

    def __init__(self) -> None:
        self._progress: Progress | None = None
        self._task: TaskID | None = None

    def started(self, stage: str) -> None:
        """Draw an empty bar."""
        super().started(stage)
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress = Progress(
            TextColumn("  {task.fields[stage]:<9}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
        )
        self._task = self._progress.add_task("", stage=stage, total=None)
        self._progress.start()

    def progress(self, stage: str, done: int, total: int, note: str) -> None:
        """Move the bar."""
        super().progress(stage, done, total, note)
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, completed=done, total=total, description=note)

    def finished(self, stage: str, seconds: float) -> None:
        """Leave a full bar."""
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, completed=1, total=1, description="")
        self._stop()

    def failed(self, stage: str) -> None:
        """Leave the bar where it is."""
        self._stop()

    def _stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()
        self._progress = None


def places(result: Result) -> list[tuple[str, str]]:
    """Where a run's tables, recordings and notebook are: label and place."""
    found = []
    for stage in NAMES:
        entry = result.entries.get(stage)
        if entry is not None:
            names = [name for name in entry.files if name.endswith(".parquet")]
            joined = names[0] if len(names) == 1 else f"{{{','.join(names)}}}"
            found.append((stage, f"{_near(entry.folder)}/{joined}"))
    if result.recordings:
        files = ", ".join(path.name for path in result.recordings)
        found.append(("recordings", f"{files} beside them; open: pse view {result.case.name}"))
    notebook = result.case.notebook
    if notebook and (project_root() / notebook).is_file():
        found.append(("notebook", f"{_near(project_root() / notebook)}"))
    return found


def _near(path: Path) -> Path:
    """The path from the working folder if it is below it."""
    absolute = Path(os.path.realpath(path))
    here = Path.cwd().resolve()
    return absolute.relative_to(here) if absolute.is_relative_to(here) else absolute


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``pse``; returns the exit code."""
    _open_closed_streams()
    # Printing σ must not end a run on a terminal that cannot show it.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    with endings.by_signal():
        return _guarded(arguments)


def _open_closed_streams() -> None:
    """Lead streams that whoever started us closed to nowhere.

    Otherwise the next file that is opened takes the number of the closed stream, and what libraries
    print goes into it.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115


def parser() -> argparse.ArgumentParser:
    """Parser of the arguments of ``pse``."""
    whole = argparse.ArgumentParser(
        prog="pse", description="Power-system state estimation from raw telemetry to a score."
    )
    commands = whole.add_subparsers(required=True, metavar="COMMAND")
    run_parser = commands.add_parser("run", help="run the stages of a case that are not current")
    _add_run_arguments(run_parser)
    run_parser.set_defaults(command=_run)
    cases_parser = commands.add_parser("cases", help="list the cases")
    _add_cases(cases_parser)
    cases_parser.set_defaults(command=_cases)
    view_parser = commands.add_parser("view", help="open a case's recordings in the Rerun viewer")
    view_parser.add_argument("case", metavar="CASE")
    view_parser.add_argument(
        "--older", action="store_true", help="also open what is older than the case file"
    )
    _add_folders(view_parser)
    view_parser.set_defaults(command=_view)
    verify_parser = commands.add_parser(
        "verify", help="compare a case's files with what was written, and say what was touched"
    )
    verify_parser.add_argument("case", metavar="CASE")
    verify_parser.add_argument(
        "--accept", action="store_true", help="take the raw folder as it is from now on"
    )
    _add_folders(verify_parser)
    verify_parser.set_defaults(command=_verify)
    return whole


def run_main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``pipelines/run.py``: the same as ``pse run``."""
    return main(["run", *(sys.argv[1:] if arguments is None else arguments)])


def stage_main(stage: str) -> int:
    """Entry point of ``pipelines/<stage>.py``: run that stage alone."""
    return main(["run", "--only", stage, *sys.argv[1:]])


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", metavar="CASE", nargs="+", help="names of cases, or 'all'")
    last = parser.add_mutually_exclusive_group()
    last.add_argument("--until", metavar="STAGE", help=f"last stage to run: {', '.join(NAMES)}")
    last.add_argument("--only", metavar="STAGE", help="the one stage to run")
    parser.add_argument("--force", action="store_true", help="run stages although cached")
    parser.add_argument("--workers", metavar="N", type=int, help="processes for the estimators")
    _add_folders(parser)


def _add_cases(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", metavar="DIR", type=Path, help="folder of case files")
    parser.add_argument("--debug", action="store_true", help="show tracebacks of errors")


def _add_folders(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", metavar="DIR", type=Path, help="folder of data (default: data)")
    _add_cases(parser)


def _guarded(arguments: Sequence[str] | None) -> int:
    try:
        options = parser().parse_args(arguments)
        command: Callable[[argparse.Namespace], int] = options.command
        try:
            code = command(options)
        except BrokenPipeError:
            raise
        except Exception as error:
            code = _explain(error, options.debug)
        endings.check()
        return code
    except (endings.Ended, KeyboardInterrupt) as reason:
        # A new one: kept in a variable here, the raised one would hold what it interrupted.
        ended = endings.Ended(getattr(reason, "number", signal.SIGINT))
        print(f"\n{ended}", file=sys.stderr)
        return ended.code
    except BrokenPipeError:
        # Whoever read the output, for example `head`, has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _explain(error: Exception, debug: bool) -> int:
    endings.check()
    sys.stdout.flush()
    if debug:
        traceback.print_exception(error)
    elif isinstance(error, PseError):
        print(f"error: {error}", file=sys.stderr)
    elif isinstance(error, OSError):
        place = "" if error.filename is None else f"{error.filename}: "
        path = Path(error.filename) if isinstance(error.filename, str) else None
        advice = remedy(error.errno, path)
        print(f"error: {place}{error.strerror or error}{advice}", file=sys.stderr)
    elif memory.ran_out(error):
        print(f"error: {memory.explain(error, 'pse', 1)}", file=sys.stderr)
    else:
        print(
            f"error: {type(error).__name__}: {error}\nThis is a bug of pse_analysis, not of your "
            "data: --debug shows where it happened",
            file=sys.stderr,
        )
    return 1


def _run(options: argparse.Namespace) -> int:
    # The matrices are small: threads inside BLAS cost more than they bring, and results must not
    # depend on how many there are. It has no effect once numpy is imported, so it stands here.
    for name in THREADS:
        os.environ.setdefault(name, "1")
    wanted = Options(
        until=options.until,
        only=options.only,
        force=options.force,
        workers=options.workers,
        data=options.data,
        cases=options.cases,
    )
    if "all" in options.case:
        names = list_cases(options.cases)
        if not names:
            raise ParameterError("no cases: add a file NAME.toml to the folder of cases")
    else:
        names = tuple(dict.fromkeys(options.case))
    failed = []
    for name in names:
        try:
            runner.run(name, wanted, Bars() if sys.stdout.isatty() else Lines())
        except BrokenPipeError:
            raise
        except Exception as error:
            _explain(error, options.debug)
            failed.append(name)
    if failed and len(names) > 1:
        print(f"{len(failed)} of {len(names)} cases failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _cases(options: argparse.Namespace) -> int:
    names = list_cases(options.cases)
    code = 0
    for name in names:
        try:
            print(f"{name:<{max(map(len, names))}}  {load_case(name, options.cases).title}")
        except PseError as error:
            code = _explain(error, options.debug)
    return code


def _view(options: argparse.Namespace) -> int:
    case = load_case(options.case, options.cases)
    wanted = Options(data=options.data, cases=options.cases)
    folder = wanted.data_folder / "processed" / case.name
    entries, older, _ = stored(case, wanted)
    shown = {s: e for s, e in entries.items() if options.older or s not in older}
    result = Result(case, wanted.data_folder / "raw" / case.name, shown)
    for stage in (stage for stage in entries if stage in older):
        told = "is older" if options.older else "is left out, because it is older or damaged"
        print(f"{stage} {told}: {older[stage]}", file=sys.stderr)
    if not result.recordings:
        raise TableError(
            f"case {case.name!r} has no current recordings in {folder}: run it first, with "
            f"`pse run {case.name}`"
        )
    for path in result.recordings:
        facts = next(e.files[path.name] for e in shown.values() if e.folder == path.parent)
        check(path, facts, again(case.name))
    viewer.start(result.recordings)


def _verify(options: argparse.Namespace) -> int:
    case = load_case(options.case, options.cases)
    wanted = Options(data=options.data, cases=options.cases)
    if options.accept:
        from pse_analysis.telemetry import accept

        accept(wanted.data_folder / "raw" / case.name)
    count, findings = verify(case, wanted)
    for finding in findings:
        print(f"{'damaged' if finding.damage else 'note':<8} {_near(finding.path)} {finding.what}")
    damaged = sum(finding.damage for finding in findings)
    print(f"{count} files compared, {damaged} damaged or changed since they were written")
    return 1 if damaged else 0
