"""Kill runs and writers at random instants, and look at what they leave behind.

Every piece of work runs in a child that is forked from a process which has imported everything and
used nothing, so that a kill meets the work and not the imports. After each kill the stored tables
must be whole and be those of the run before or of the killed one, a thorough comparison must find
no damage, nothing unknown may lie about, and the next run must end with exactly the results that
an undisturbed run of the same parameters has.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

# Imported here, so that the children have it: the work itself asks for it when it needs it.
import pse_analysis.pipeline.stages
from pse_analysis import telemetry
from pse_analysis.pipeline import runner
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.plan import NAMES, Options
from pse_analysis.pipeline.results import load
from pse_analysis.pipeline.verify import verify
from pse_analysis.vocabulary import KEYS, schema

CASE = Path(__file__).parents[1] / "cases" / "small.toml"
SEED = 1147
PATIENCE_S = 120.0
"""A child that takes longer hangs."""

EDITS = (
    *(("seed = 14", f"seed = {seed}") for seed in range(15, 20)),
    *(
        ("[validate]", f"[[validate.rules]]\ncriterion = 'fixed'\nquantile = {quantile}")
        for quantile in (5.0, 6.0)
    ),
    *(("[align]", f"[align]\nlatency_s = {latency}") for latency in (60, 120)),
    ('filter = "kalman"', 'filter = "kalman"\nnoise = "scalar"'),
    ("[score]", "[score]\nby_hour = false"),
)
"""Ways to change the case file before a run; the first make all stages run."""

WRITERS = 0.15
"""Share of kills that meet `telemetry.write_raw` rather than a run."""

WORKERS = 0.15
"""Share of runs that estimate with two processes, each killed alone or with its workers."""


class Failure(AssertionError):
    """Something that a kill must not leave behind."""


@contextmanager
def child(work: Callable[[], Any]) -> Iterator[tuple[int, int]]:
    """Run work in a forked process; gives its number and a pipe with the JSON that it returns."""
    reading, writing = os.pipe()
    number = os.fork()
    if number == 0:
        os.setsid()
        os.close(reading)
        code = 0
        try:
            os.write(writing, json.dumps(work()).encode())
        except BaseException as error:
            os.write(writing, json.dumps({"error": f"{type(error).__name__}: {error}"}).encode())
            code = 1
        finally:
            os._exit(code)
    os.close(writing)
    try:
        yield number, reading
    finally:
        os.close(reading)


def finish(work: Callable[[], Any]) -> Any:
    """Run work in a child to its end and return what it returned."""
    with child(work) as (number, reading):
        value = json.loads(_read(reading) or b"null")
        os.waitpid(number, 0)
    if isinstance(value, dict) and "error" in value:
        raise Failure(value["error"])
    return value


def killed(work: Callable[[], Any], after_s: float, *, group: bool) -> bool:
    """Run work in a child and kill it after a time; returns whether it was still running."""
    with child(work) as (number, _):
        deadline = time.monotonic() + after_s
        while time.monotonic() < deadline:
            if os.waitpid(number, os.WNOHANG) != (0, 0):
                return False
            time.sleep(0.0005)
        try:
            (os.killpg if group else os.kill)(number, signal.SIGKILL)
        except ProcessLookupError:
            # It has not come to lead a group of its own yet, and has no workers.
            os.kill(number, signal.SIGKILL)
        os.waitpid(number, 0)
    return True


def _read(reading: int) -> bytes:
    parts = []
    while part := os.read(reading, 2**16):
        parts.append(part)
    return b"".join(parts)


def contents(options: Options, *, older: bool) -> dict[str, str]:
    """Digest of the values of every whole table of the case, but for how long a step took."""
    tables = load("small", data=options.data, cases=options.cases, older=older)
    for stage in tables.recordings:
        _ = tables.recordings[stage]
    found = {}
    for name in tables.files:
        table = tables[name].drop(columns="seconds", errors="ignore")
        if "metric" in table.columns:
            table = table[table["metric"] != "seconds"]
        rows = pd.util.hash_pandas_object(table, index=False).to_numpy()
        found[name] = hashlib.blake2b(rows.tobytes(), digest_size=16).hexdigest()
    return found


def inspect(options: Options) -> dict[str, str]:
    """Compare everything that is stored; returns the contents of the tables."""
    case = load_case("small", options.cases)
    _, findings = verify(case, options)
    damaged = [f"{finding.path} {finding.what}" for finding in findings if finding.damage]
    if damaged:
        raise Failure(f"damaged after a kill: {damaged[0]}")
    return contents(options, older=True)


def complete(options: Options) -> dict[str, str]:
    """Run the case to its end; returns the contents of its tables."""
    runner.run("small", options)
    left = [
        path
        for path in (*options.data_folder.rglob(".*"), *options.data_folder.rglob("*.kept"))
        if path.name != ".lock"
    ]
    if left:
        raise Failure(f"left behind: {left[0]}")
    return contents(options, older=False)


class Killer:
    """Kills runs of one case, again and again, and counts what they met."""

    def __init__(self, folder: Path, seed: int = SEED, edits: int = len(EDITS)) -> None:
        self._draw = np.random.default_rng(seed)
        self._folder = folder
        (folder / "cases").mkdir(parents=True)
        self._case = folder / "cases" / "small.toml"
        text = CASE.read_text(encoding="utf-8")
        self._texts = [text, *(text.replace(*edit, 1) for edit in EDITS[:edits])]
        self._known: dict[str, Any] = {}
        self._case.write_text(text, encoding="utf-8")
        self.options = Options(data=folder / "data", cases=folder / "cases", workers=1)
        self.met: Counter[str] = Counter()
        begun = time.monotonic()
        self._now = finish(lambda: complete(self.options))
        self._seconds = time.monotonic() - begun

    def kill_run(self) -> None:
        """Change the case file, kill the run that follows, inspect, and run to the end."""
        old = self._now
        texts = [text for text in self._texts if text != self._case.read_text(encoding="utf-8")]
        text = texts[self._draw.integers(len(texts))]
        self._case.write_text(text, encoding="utf-8")
        workers = 2 if self._draw.random() < WORKERS else 1
        options = Options(**{**vars(self.options), "workers": workers})
        after = float(self._draw.uniform(0.0, self._seconds))
        group = bool(self._draw.random() < 0.5)
        if killed(lambda: runner.run("small", options).summary, after, group=group):
            self.met["runs killed"] += 1
        else:
            self.met["runs that had ended"] += 1
        found = finish(lambda: inspect(self.options))
        new = finish(lambda: complete(self.options))
        undisturbed = self._undisturbed()
        if new != undisturbed:
            raise Failure(f"the next run gave other results after a kill at {after:.3f} s")
        for name, digest in found.items():
            if digest not in (old.get(name), new[name]):
                raise Failure(f"{name} is neither the old nor the new result")
            self.met["tables of before" if digest == old.get(name) else "tables of after"] += 1
        self._now = new

    def _undisturbed(self) -> Any:
        """Contents of the tables of a run of the same case file in a folder of its own."""
        text = self._case.read_text(encoding="utf-8")
        if text not in self._known:
            folder = self._folder / "undisturbed"
            options = Options(data=folder, cases=self.options.cases, workers=1)
            self._known[text] = finish(lambda: complete(options))
            shutil.rmtree(folder)
        return self._known[text]

    def kill_writer(self) -> None:
        """Kill a writer of raw data; the folder must be whole or not readable, and writable."""
        source = self.options.data_folder / "raw" / "small"
        folder = self._folder / "written" / "case"
        beside = bool(self._draw.random() < 0.5)
        if beside:
            folder.mkdir(parents=True)
            (folder / "NOTES.md").write_text("mine")
        after = float(self._draw.uniform(0.0, 0.25))
        work = lambda: telemetry.write_raw(folder, telemetry.read_raw(source))  # noqa: E731
        self.met["writers killed" if killed(work, after, group=True) else "writers that ended"] += 1

        def look() -> bool:
            if not (folder / "telemetry").exists():
                telemetry.write_raw(folder, telemetry.read_raw(source))
            one, two = telemetry.read_raw(folder), telemetry.read_raw(source)
            return bool(
                one.telemetry.equals(two.telemetry)
                and one.channels.equals(two.channels)
                and one.truth is not None
                and one.truth.equals(two.truth)
                and (not beside or (folder / "NOTES.md").read_text() == "mine")
            )

        if not finish(look):
            raise Failure(f"a writer killed at {after:.3f} s left other tables")
        left = [p for p in folder.parent.iterdir() if p != folder]
        if left:
            raise Failure(f"left behind by a writer: {left[0]}")
        shutil.rmtree(folder.parent)

    def run(self, count: int, report: Callable[[str], None] = lambda _: None) -> Counter[str]:
        """Kill as often as that."""
        for number in range(1, count + 1):
            if self._draw.random() < WRITERS:
                self.kill_writer()
            else:
                self.kill_run()
            if number % 50 == 0:
                report(f"{number} of {count}: {dict(self.met)}")
        return self.met


def main(count: int, seed: int = SEED) -> int:
    """Kill as often as that in a temporary folder and print what was met; returns an exit code."""
    assert pse_analysis.pipeline.stages.WORK.keys() == set(NAMES)
    for table in KEYS:
        schema(table)
    with tempfile.TemporaryDirectory() as folder:
        # Each edit costs an undisturbed run to compare with.
        killer = Killer(Path(folder), seed, edits=max(2, count // 20))
        try:
            met = killer.run(count, lambda text: print(text, flush=True))
        except Failure as failure:
            print(f"after {dict(killer.met)}: {failure}", file=sys.stderr)
            return 1
    print(f"{count} kills, nothing half, nothing different: {dict(met)}")
    return 0
