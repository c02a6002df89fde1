"""Claim: a run needs no home, no terminal, no locale and no true clock; paths may be anything."""

from __future__ import annotations

import datetime
import locale
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from small_case import MAIN, PATIENCE_S, SOURCE, Place

from pse_analysis.errors import ParameterError
from pse_analysis.pipeline import cache, runner
from pse_analysis.pipeline.plan import NAMES, Options

DAY_S = 86_400
BARE = {"PATH": os.environ["PATH"]}


def test_run_without_home_in_ascii_below_spaces_and_umlauts_gives_the_same_values(
    whole: Place, copy: Callable[[str], Place]
) -> None:
    place = copy("Übung 1 – Größen/mit 'Anführung' und $HOME")
    shutil.rmtree(place.data)
    done = place.run(environment={**BARE, "LANG": "C", "PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii()
    assert place.values() == whole.values()
    assert place.leftovers() == []


def test_name_that_the_locale_cannot_read_is_refused_with_the_remedy(
    copy: Callable[[str], Place],
) -> None:
    place = copy("Übung")
    strict = {**BARE, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = place.run(environment=strict)
    assert done.returncode == 1
    assert "not UTF-8 where the locale's encoding is ascii: set LANG=C.UTF-8" in done.stderr
    assert "bug" not in done.stderr


def test_name_of_bytes_that_are_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"\\udcff: this name is not UTF-8"):
        Options(data=Path(os.fsdecode(bytes(tmp_path) + b"/\xff")))


@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_run_with_closed_streams_and_no_home_ends_well_and_writes_whole_files(
    place: Place, closed: str
) -> None:
    """What is opened next would get a closed stream's number, and what is printed with it."""
    place.change()
    home = place.folder / "nowhere"
    command = [sys.executable, "-c", MAIN, *place.arguments, "--until", "validate"]
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}', "sh", *command],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(SOURCE), "HOME": str(home)},
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert not home.exists()
    only = Options(**{**vars(place.options), "until": "validate"})
    assert runner.run("small", only).cached == NAMES[:2]
    (entry,) = (e for s, e in runner.Store(place.processed).entries().items() if s == "validate")
    assert entry.damaged(thorough=True) == ()


@pytest.mark.parametrize("days", [-400, 400])
def test_clock_that_jumped_between_two_runs_changes_no_result(
    place: Place, monkeypatch: pytest.MonkeyPatch, days: int
) -> None:
    """Files seem to be of another year, and so is today for the run that follows."""
    for path in place.data.rglob("*"):
        os.utime(path, (time.time() + days * DAY_S,) * 2)

    class Jumped(datetime.datetime):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> Jumped:
            return super().now(tz) - datetime.timedelta(days=days)

    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() - days * DAY_S)
    monkeypatch.setattr(cache, "datetime", Jumped)
    before = place.digests()
    assert runner.run("small", place.options).cached == NAMES
    forced = Options(**{**vars(place.options), "until": "align", "force": True})
    assert runner.run("small", forced).ran == NAMES[:3]
    assert runner.run("small", place.options).cached == NAMES
    assert place.digests() == before


def test_locale_with_decimal_commas_gives_the_same_values(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the system has no such locale, what Python says of it is replaced."""
    before = place.values()
    kept = locale.setlocale(locale.LC_ALL)
    try:
        locale.setlocale(locale.LC_ALL, "de_DE.UTF-8")
    except locale.Error:
        commas = {**locale.localeconv(), "decimal_point": ",", "thousands_sep": "."}
        monkeypatch.setattr(locale, "localeconv", lambda: commas)
    try:
        assert locale.localeconv()["decimal_point"] == ","
        runner.run("small", Options(**{**vars(place.options), "force": True}))
    finally:
        locale.setlocale(locale.LC_ALL, kept)
    assert place.values() == before
    assert "," not in next(place.processed.rglob("summary.txt")).read_text().split("wls")[1][:30]


def test_reader_that_leaves_early_ends_the_run_without_a_traceback(place: Place) -> None:
    place.change()
    command = [sys.executable, "-c", MAIN, *place.arguments, "--until", "validate"]
    done = subprocess.run(
        ["sh", "-c", '"$@" | head -n 1', "sh", *command],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(SOURCE)},
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stdout.startswith("small")
    assert done.stderr == ""
    assert place.leftovers() == []
