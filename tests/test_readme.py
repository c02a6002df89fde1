"""Claim: every command that the README shows is one that exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from pse_analysis.pipeline.case import list_cases
from pse_analysis.pipeline.cli import parser
from pse_analysis.pipeline.plan import NAMES

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r"^```(?:bash|sh|shell|console)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Lines of the README's shell blocks, without prompts and comments."""
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8") if readme.is_file() else ""
    lines = [line for block in FENCE.findall(text) for line in block.splitlines()]
    bare = [line.strip().removeprefix("$ ").split(" #")[0].strip() for line in lines]
    return [line for line in bare if line and not line.startswith("#")]


def arguments_of(words: list[str]) -> list[str] | None:
    """Arguments for ``pse`` if the line starts this program in one of its ways."""
    name = Path(words[0]).name
    if name == "pse":
        return words[1:]
    if name.startswith("python") and words[1:2] and words[1].startswith("pipelines/"):
        stage = Path(words[1]).stem
        assert (ROOT / words[1]).is_file(), words[1]
        return ["run", *words[2:], *([] if stage == "run" else ["--only", stage])]
    return None


@pytest.mark.parametrize("line", commands())
def test_command_exists(line: str) -> None:
    words = shlex.split(line)
    if words[0] == "make":
        targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
        assert {word for word in words[1:] if "=" not in word} <= targets
        return
    arguments = arguments_of(words)
    if arguments is None:
        return
    options = parser().parse_args(arguments)
    named = getattr(options, "case", [])
    known = {*list_cases(ROOT / "pipelines" / "cases"), "all", "CASE", "my_case"}
    assert set([named] if isinstance(named, str) else named) <= known
    assert getattr(options, "until", None) in {None, *NAMES}
