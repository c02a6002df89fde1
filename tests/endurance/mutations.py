"""Change every kind of input in odd ways, and see that each ends in a result or a clear error.

Two properties. *Refused or right*: whatever is done to a table, a case file or a parquet file, what
reads it returns something sound or raises a `PseError`, within a minute, and no estimate of status
``ok`` is anything but finite. *Meaning kept*: what changes only how a table is stored or ordered
changes no result. Hypothesis draws the changes and shrinks those that fail.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from tests.endurance import odd_case_files, odd_parameters, odd_parquet, odd_tables, same_meaning
from tests.endurance.outcomes import OK, OUTCOMES, REFUSED, outcome, place

SEED = 2026
BATCH = 500
"""Examples that one search of hypothesis draws."""


@dataclass(frozen=True)
class Target:
    """A kind of input, what is drawn for it, and what is done with that.

    Attributes
    ----------
    name : str
    share : float
        Of all examples.
    drawn : SearchStrategy
    work : callable
        Raises where the property does not hold.
    """

    name: str
    share: float
    drawn: st.SearchStrategy[Any]
    work: Callable[[Any], object]


TARGETS: tuple[Target, ...] = (
    Target("ingest", 0.16, odd_tables.INGEST, odd_tables.ingest_odd),
    Target("channels", 0.16, odd_tables.FRAME, odd_tables.read_channels),
    Target("grid", 0.12, odd_tables.GRID, odd_tables.read_grid),
    Target("machine", 0.06, odd_tables.FRAME, odd_tables.read_machine),
    Target("schema", 0.10, odd_tables.SCHEMA, odd_tables.check_schema),
    Target("parquet", 0.12, odd_parquet.FILES, odd_parquet.read_odd),
    Target("case text", 0.08, odd_case_files.TEXTS, odd_case_files.read_text),
    Target("case values", 0.10, odd_case_files.VALUES, odd_case_files.read_values),
    Target("parameters", 0.04, odd_parameters.PARAMETERS, odd_parameters.run_stage),
    Target("pipeline", 0.03, odd_tables.PIPELINE, odd_tables.run_odd),
    Target("meaning", 0.03, same_meaning.CHANGES, same_meaning.compare),
)
"""All properties; the last three run stages, which takes a tenth of a second or several."""


@dataclass
class Failure:
    """An input that ended as none should."""

    target: str
    outcome: str
    example: str
    error: BaseException

    def text(self) -> str:
        """Everything that is needed to see it again."""
        trace = "".join(traceback.format_exception(self.error))
        return f"{self.target}: {self.outcome}\n{self.example}\n\n{trace}"


def search(
    target: Target, examples: int, number: int, known: set[str]
) -> tuple[Counter[str], Failure | None]:
    """Draw examples of one target until one fails in a way that is not known yet.

    Parameters
    ----------
    target
    examples
        How many are drawn at most.
    number
        Seed of hypothesis.
    known
        Places that failed before; they are counted, and the search goes on.

    Returns
    -------
    Counter
        Outcomes of what was drawn, that for shrinking not counted.
    Failure or None
        The smallest example that fails.
    """
    counts: Counter[str] = Counter()
    found: list[Failure] = []

    @seed(number)
    @settings(
        max_examples=examples,
        database=None,
        deadline=None,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
        print_blob=False,
        report_multiple_bugs=False,
    )
    @given(target.drawn)
    def hold(drawn: Any) -> None:
        ended, error = outcome(lambda: target.work(drawn))
        if not found:
            counts[ended] += 1
        if error is not None and place(error) not in known:
            found.append(Failure(target.name, ended, repr(drawn), error))
            raise error

    try:
        hold()
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) or not found:
            raise
    return counts, found[-1] if found else None


def run(
    count: int, number: int, targets: Sequence[Target] = TARGETS
) -> tuple[dict[str, Counter[str]], list[Failure]]:
    """Search all targets by their shares; each new failure starts another search."""
    whole = sum(target.share for target in targets)
    counts: dict[str, Counter[str]] = {}
    failures: list[Failure] = []
    for target in targets:
        done: Counter[str] = Counter()
        known: set[str] = set()
        wanted = max(1, round(count * target.share / whole))
        seeds = random.Random(f"{number} {target.name}")
        while done.total() < wanted:
            part, failure = search(
                target, min(BATCH, wanted - done.total()), seeds.getrandbits(32), known
            )
            done += part
            if failure is not None:
                failures.append(failure)
                known.add(place(failure.error))
            if not part.total():
                break
        counts[target.name] = done
    return counts, failures


def main(count: int, number: int, names: Sequence[str] = ()) -> int:
    """Run, print a line for each target and one of all, and store examples that fail.

    Parameters
    ----------
    count
        Inputs, shared out among the targets.
    number
        Seed.
    names
        Targets; all by default.

    Returns
    -------
    int
        0 if every input ended in a result or a `PseError`.
    """
    whole: Counter[str] = Counter()
    stored: list[Path] = []
    chosen = [target for target in TARGETS if not names or target.name in names]
    shares = sum(target.share for target in chosen)
    for target in chosen:
        begun = time.monotonic()
        counts, failures = run(round(count * target.share / shares), number, [target])
        ended = counts[target.name]
        whole += ended
        rate = ended.total() / max(time.monotonic() - begun, 1e-9)
        print(f"{target.name}: {_line(ended)}, {rate:.0f}/s", flush=True)
        for failure in failures:
            folder = Path(tempfile.gettempdir()) / "pse_mutations"
            folder.mkdir(exist_ok=True)
            path = folder / f"{number}-{target.name.replace(' ', '_')}-{len(stored)}.txt"
            path.write_text(failure.text(), encoding="utf-8", errors="backslashreplace")
            stored.append(path)
            print(f"  {failure.outcome}: {place(failure.error)}; see {path}", file=sys.stderr)
    print(f"{whole.total()} mutated inputs with seed {number}: {_line(whole)}")
    return 0 if not stored and set(whole) <= {OK, REFUSED} else 1


def _line(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {counts[name]}" for name in OUTCOMES)
