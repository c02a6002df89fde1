"""Claim: the examples of the guide to transfer limits run and print what it says."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
from pathlib import Path

from pse_analysis.scoring.transfer_limit import Criterion

GUIDE = (Path(__file__).parents[2] / "docs" / "transfer_limit.md").read_text(encoding="utf-8")


def test_examples_of_the_guide_print_what_it_says() -> None:
    fences = re.findall(r"^```pycon\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    assert len(fences) == 6
    text = "\n".join(fences)
    example = doctest.DocTestParser().get_doctest(text, {}, "transfer_limit.md", None, 0)
    said: list[str] = []
    doctest.DocTestRunner(verbose=False).run(example, out=said.append)
    assert "".join(said) == ""


def test_guide_names_every_criterion() -> None:
    rows = re.findall(r"^\| `(\w+)` \|", GUIDE, re.MULTILINE)
    assert rows == ["stability", "voltage", "stability_after_outage", "voltage_after_outage",
                    "current", "current_after_outage"]  # fmt: skip
    assert set(rows) == set(Criterion)


def test_scoring_offers_it_without_importing_it_first() -> None:
    code = (
        "import sys, pse_analysis.scoring as s\n"
        "assert 'pse_analysis.scoring.transfer_limit' not in sys.modules\n"
        "print(s.transfer_limit.transfer_limit.__name__, hasattr(s, 'nothing'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["transfer_limit", "False"]
