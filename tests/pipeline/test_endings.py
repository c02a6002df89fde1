"""Claim: a signal ends a run at once, with one line and its exit code, and leaves nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pse_analysis.errors import OutOfMemory
from pse_analysis.pipeline import cli, endings, runner
from pse_analysis.pipeline.endings import CODES, Ended
from pse_analysis.pipeline.processes import each

NUMBERS = tuple(CODES)
PATIENCE_S = 10.0


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Handlers as they are in a program of its own, and afterwards as they were."""
    before = {number: signal.getsignal(number) for number in NUMBERS}
    for number in NUMBERS:
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, default)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("how", ["plain", "wrapped", "swallowed", "by a hook"])
def test_signal_counts_wherever_it_comes(
    number: signal.Signals,
    how: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    class Wraps:
        def __set_name__(self, *_: object) -> None:
            os.kill(os.getpid(), number)

    class Hook:
        def __del__(self) -> None:
            os.kill(os.getpid(), number)

    def run(_: str, __: object, reporter: runner.Reporter) -> None:
        if how == "wrapped":
            # Python 3.11 makes a RuntimeError of what is raised while a class is made.
            type("Made", (), {"field": Wraps()})
        elif how == "swallowed":
            try:
                os.kill(os.getpid(), number)
            except BaseException:
                reporter.progress("validate", 1, 2, "")
        elif how == "by a hook":
            Hook()
            reporter.started("align")
        else:
            os.kill(os.getpid(), number)
        raise AssertionError("went on")

    monkeypatch.setattr(runner, "run", run)
    assert cli.main(["run", "small"]) == CODES[number]
    text = capsys.readouterr().err.strip()
    assert text.splitlines() == [str(Ended(number))]


def test_second_signal_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    done = []

    def run(*_: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGHUP)
            done.append("cleaned up")

    monkeypatch.setattr(runner, "run", run)
    assert cli.main(["run", "small"]) == 143
    assert done == ["cleaned up"]


def test_what_a_signal_left_half_made_complains_to_nobody(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class HalfMade:
        def __init__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            self.stream = 1

        def __del__(self) -> None:
            assert self.stream == 1

    monkeypatch.setattr(runner, "run", lambda *_: HalfMade())
    assert cli.main(["run", "small"]) == 143
    assert capsys.readouterr().err.strip() == str(Ended(signal.SIGTERM))


def test_ignored_signal_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with endings.by_signal():
        os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def wait(seconds: float) -> None:
    time.sleep(seconds)


def end(_: int) -> None:
    os._exit(9)


def test_worker_that_is_killed_is_named() -> None:
    with pytest.raises(OutOfMemory, match=r"ended suddenly.*run again with fewer of them"):
        list(each(end, [1, 2], 2))


@pytest.mark.parametrize("number", NUMBERS)
def test_workers_end_with_the_run(number: signal.Signals, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from test_endings import wait\n"
        "from pse_analysis.pipeline import cli, runner\n"
        "from pse_analysis.pipeline.processes import each\n"
        "def run(*rest):\n"
        "    print('here', flush=True)\n"
        "    list(each(wait, [600.0, 600.0], 2))\n"
        "runner.run = run\n"
        "if __name__ == '__main__':\n"
        "    sys.exit(cli.main(['run', 'small']))\n"
    )
    program = tmp_path / "program.py"
    program.write_text(code)
    process = subprocess.Popen(
        [sys.executable, str(program)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "here\n"
    # While the workers start, a signal to all of them must not end in their tracebacks.
    time.sleep(0.2)
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == CODES[number]
    assert errors.strip().splitlines() == [str(Ended(number))]
    # Python's tracker of resources ends by itself once the last that it served is gone.
    patience = time.monotonic() + PATIENCE_S
    while alive(process.pid) and time.monotonic() < patience:
        time.sleep(0.05)
    assert alive(process.pid) == []


def alive(group: int) -> list[str]:
    """Numbers of the processes of a group that still run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] not in "ZX":
            found.append(path.parent.name)
    return found
