"""Claim: where memory runs out the run says what needs less, and loses nothing that was there."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType

import pyarrow as pa
import pytest
from numpy.exceptions import DTypePromotionError
from small_case import MAIN, Place

from pse_analysis.errors import OutOfMemory
from pse_analysis.pipeline import cli, memory, runner
from pse_analysis.pipeline.plan import Job
from pse_analysis.pipeline.processes import each

REMEDY = "what needs less: a shorter [study] or history_s, fewer trials, fewer methods"


def limited(size: int) -> str:
    """Code that runs the command line where the process may use that much address space."""
    return f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({size},) * 2)\n{MAIN}"


def test_limit_below_what_the_libraries_need_is_refused_before_they_are_loaded(
    place: Place,
) -> None:
    before = place.digests()
    place.change()
    done = place.run(code=limited(600_000_000))
    assert done.returncode == 1
    assert "this process may use 600.0 MB of memory (ulimit -v)" in done.stderr
    assert "raise that limit" in done.stderr
    assert place.digests() == before
    assert place.leftovers() == []


def test_cached_run_needs_little_memory(place: Place) -> None:
    done = place.run(code=limited(600_000_000))
    assert done.returncode == 0, done.stderr


def numpy_refused(job: Job) -> None:
    import numpy as np

    np.ones(10**14)


def arrow_refused(job: Job) -> None:
    pa.allocate_buffer(10**14)


def thread_refused(job: Job) -> None:
    raise RuntimeError("can't start new thread")


def fork_refused(job: Job) -> None:
    raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))


@pytest.mark.parametrize("work", [numpy_refused, arrow_refused, thread_refused, fork_refused])
def test_stage_that_is_refused_memory_says_what_needs_less(
    place: Place,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    work: Callable[[Job], None],
) -> None:
    from pse_analysis.pipeline import stages

    before = place.digests()
    changed = MappingProxyType({**stages.WORK, "align": work})
    monkeypatch.setattr(stages, "WORK", changed)
    assert cli.main([*place.arguments, "--only", "align", "--force"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: align: out of memory")
    assert REMEDY in said
    assert place.digests() == before
    assert place.leftovers() == []
    monkeypatch.undo()
    assert runner.run("small", place.options).cached[:3] == ("simulate", "validate", "align")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), True),
        (pa.ArrowMemoryError("malloc of size 64 failed"), True),
        (ImportError("libgfortran.so.5: failed to map segment from shared object"), True),
        (pa.ArrowException("Failed to launch worker thread: Resource temporarily …"), True),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), True),
        (OSError(errno.ENOSPC, "No space left on device"), False),
        (DTypePromotionError("no common type"), False),
        (ImportError("No module named 'scipy'"), False),
        (ZeroDivisionError("division by zero"), False),
    ],
)
def test_only_what_says_that_memory_ran_out_counts_as_that(
    error: Exception, expected: bool
) -> None:
    assert memory.ran_out(error) is expected


def test_fewer_processes_are_named_where_there_are_several() -> None:
    assert "--workers 1, now 4" in str(memory.explain(MemoryError("x"), "estimate", 4))
    assert "--workers" not in str(memory.explain(MemoryError("x"), "estimate", 1))


def test_own_limit_is_named() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (10**12, hard))
    try:
        assert "1,000,000.0 MB: ulimit -v" in str(memory.explain(MemoryError(), "align", 1))
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def test_process_that_the_system_kills_is_an_error_that_says_what_needs_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A process that is started anew finds the function below its module's name.
    (tmp_path / "killed_task.py").write_text(
        "import os, signal\n\n\ndef killed(number):\n"
        "    if number == 1:\n        os.kill(os.getpid(), signal.SIGKILL)\n    return number\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    import killed_task

    with pytest.raises(OutOfMemory, match=r"ended suddenly.*--workers 1, now 2"):
        list(each(killed_task.killed, [0, 1, 2, 3], workers=2))
