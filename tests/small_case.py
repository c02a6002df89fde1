"""The small case in a folder, and the command line on it in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pse_analysis
from pse_analysis.pipeline import runner
from pse_analysis.pipeline.plan import Options

CASES = Path(__file__).parent / "cases"
SOURCE = Path(pse_analysis.__file__).parents[1]
PATIENCE_S = 120.0
LAXER = "[[validate.rules]]\ncriterion = 'fixed'\nquantile = 6.0"

MAIN = "import sys; from pse_analysis.pipeline.cli import main; sys.exit(main(sys.argv[1:]))"


@dataclass(frozen=True)
class Place:
    """A folder with case files and the data of the small case."""

    folder: Path

    @property
    def data(self) -> Path:
        return self.folder / "data"

    @property
    def processed(self) -> Path:
        return self.data / "processed" / "small"

    @property
    def arguments(self) -> list[str]:
        folders = ["--data", str(self.data), "--cases", str(self.folder / "cases")]
        return ["run", "small", "--workers", "1", *folders]

    @property
    def options(self) -> Options:
        return Options(data=self.data, cases=self.folder / "cases", workers=1)

    def change(self) -> None:
        """Ask for other checks, so that every stage after the simulation has to run."""
        path = self.folder / "cases" / "small.toml"
        text = path.read_text(encoding="utf-8")
        assert "[validate]" in text
        path.write_text(text.replace("[validate]", LAXER, 1), encoding="utf-8")

    def run(
        self,
        *more: str,
        environment: dict[str, str] | None = None,
        prefix: Sequence[str] = (),
        code: str = MAIN,
    ) -> subprocess.CompletedProcess[str]:
        """Run the case in a process of its own."""
        known = dict(os.environ) if environment is None else environment
        return subprocess.run(
            [*prefix, sys.executable, "-c", code, *self.arguments, *more],
            capture_output=True,
            text=True,
            encoding="utf-8",
            env={**known, "PYTHONPATH": str(SOURCE)},
            timeout=PATIENCE_S,
            check=False,
        )

    def digests(self) -> dict[str, str]:
        """Digest of the values of every derived table; empty before a run."""
        entries = runner.Store(self.processed).entries()
        return {
            name: facts["content"]
            for entry in entries.values()
            for name, facts in entry.files.items()
            if name.endswith(".parquet")
        }

    def values(self) -> dict[str, str]:
        """Digests of the tables in which no time of computing stands."""
        timed = ("steps.parquet", "scored.parquet")
        return {name: digest for name, digest in self.digests().items() if name not in timed}

    def leftovers(self) -> list[Path]:
        """Files and folders of a run that did not end."""
        return [p for p in self.data.rglob("*") if ".tmp" in p.name or p.name.endswith(".part")]
