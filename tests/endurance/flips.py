"""Turn single bits of stored files, and see that no number of a turned file is used."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pse_analysis import telemetry
from pse_analysis.errors import DamagedFile
from pse_analysis.pipeline import runner
from pse_analysis.pipeline.plan import NAMES, Options
from pse_analysis.pipeline.results import load

CASES = Path(__file__).parents[1] / "cases"
SEED = 8

Use = Callable[[], object]


def flips(path: Path, count: int, generator: np.random.Generator) -> Iterator[bytes]:
    """Contents of a file, each with one bit turned."""
    content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    for bit in generator.integers(0, 8 * len(content), count):
        turned = content.copy()
        turned[bit // 8] ^= 1 << (bit % 8)
        yield turned.tobytes()


def uses(options: Options) -> Iterator[tuple[Path, Use]]:
    """Every table and recording of a finished case, and how its numbers are come by."""

    def derived(table: str) -> Use:
        results = load("small", data=options.data, cases=options.cases)
        return lambda: results[table]

    def recorded(stage: str) -> Use:
        results = load("small", data=options.data, cases=options.cases)
        return lambda: results.recordings[stage].read_bytes()

    results = load("small", data=options.data, cases=options.cases)
    for table, path in results.files.items():
        yield path, derived(table)
    for stage, path in results.recordings.items():
        yield path, recorded(stage)
    raw = options.data_folder / "raw" / "small"
    for path in sorted(raw.rglob("*.parquet")):
        yield path, lambda: telemetry.read_raw(raw)


def unnoticed(path: Path, use: Use, count: int, generator: np.random.Generator) -> int:
    """Number of turned bits of a file after which its numbers were used all the same.

    Size and time of the file stay as they were: damage of a disk moves neither.
    """
    before, like = path.read_bytes(), path.stat()
    passed = 0
    for turned in flips(path, count, generator):
        path.write_bytes(turned)
        os.utime(path, ns=(like.st_atime_ns, like.st_mtime_ns))
        try:
            use()
            passed += 1
        except DamagedFile:
            continue  # That is what is asked for: the damage was seen.
        finally:
            path.write_bytes(before)
            os.utime(path, ns=(like.st_atime_ns, like.st_mtime_ns))
    return passed


def main(count: int, seed: int = SEED) -> int:
    """Turn that many bits over all files of a case and print what passed; returns an exit code."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(CASES, Path(folder, "cases"))
        options = Options(data=Path(folder, "data"), cases=Path(folder, "cases"), workers=1)
        assert runner.run("small", options).ran == NAMES
        generator, met = np.random.default_rng(seed), Counter[str]()
        files = list(uses(options))
        each = -(-count // len(files))
        for path, use in files:
            kind = "recordings" if path.suffix == ".rrd" else "tables"
            met[f"bits of {kind}"] += each
            met["unnoticed"] += unnoticed(path, use, each, generator)
    print(f"{each * len(files)} bits turned in {len(files)} files: {dict(met)}")
    return 1 if met["unnoticed"] else 0
