"""Print the table of ratios; ``--write`` also puts it into README.md beside this file."""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import math
import os
import platform
import re
from importlib import metadata
from pathlib import Path

# One thread on both sides: the matrices are small, and ratios must not depend on idle cores.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

from rich.console import Console  # noqa: E402 (numpy must see the number of threads first)
from rich.table import Table  # noqa: E402

from benchmarks.timing import Row  # noqa: E402

README = Path(__file__).with_name("README.md")
BEGIN, END = "<!-- numbers -->", "<!-- end of numbers -->"
PARTS = ("grid", "wls", "kalman", "unscented", "validation", "alignment")
PACKAGES = ("numpy", "scipy", "pandapower", "filterpy")


def seconds(value: float) -> str:
    """A time in a unit that suits its size."""
    if math.isnan(value):
        return "–"
    unit, factor = ("ms", 1e3) if value < 1.0 else ("s", 1.0)
    return f"{value * factor:.3g} {unit}"


def times(row: Row) -> str:
    """How many times as long the peer takes."""
    return "–" if math.isnan(row.ratio) else f"{row.ratio:.1f} ×"


def machine() -> str:
    """Processor, system and versions."""
    cpu = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", cpu.read_text()) if cpu.exists() else None
    name = found.group(1).strip() if found else platform.processor() or platform.machine()
    installed = []
    for package in PACKAGES:
        try:
            installed.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            continue
    return (
        f"{name}, {os.cpu_count()} cores, {platform.system()}, Python "
        f"{platform.python_version()}, {', '.join(installed)}"
    )


def rows() -> list[Row]:
    """All comparisons, those of parts that are not there left out."""
    out: list[Row] = []
    for part in PARTS:
        if importlib.util.find_spec(f"benchmarks.{part}"):
            module = importlib.import_module(f"benchmarks.{part}")
            out.extend(Row(*row) for row in module.run())
    return out


def write(results: list[Row]) -> None:
    """Replace the numbers in README.md."""
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    lines = [
        f"{today}, {machine()}.",
        "",
        "| what | ours | peer | peer takes | note |",
        "|---|---|---|---|---|",
    ]
    for r in results:
        peer = f"{seconds(r.peer_s)} ({r.peer})"
        cells = (r.what, seconds(r.ours_s), peer, times(r), r.note)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    text = README.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    README.write_text(f"{head}{BEGIN}\n{chr(10).join(lines)}\n{END}{tail}", encoding="utf-8")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--write", action="store_true", help="put the numbers into README.md")
    write_too = parser.parse_args().write
    results = rows()
    table = Table("what", "ours", "peer", "time", "peer takes", "note")
    for r in results:
        table.add_row(r.what, seconds(r.ours_s), r.peer, seconds(r.peer_s), times(r), r.note)
    console = Console()
    console.print(table)
    console.print(machine())
    if write_too:
        write(results)
        console.print(f"wrote {README}")


if __name__ == "__main__":
    main()
