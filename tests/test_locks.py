"""Claim: what `make` installs is pinned and has a hash, and it is all that the project asks for."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LOCKS = ("build", "run", "dev")


def pins(path: Path) -> dict[tuple[str, str], str]:
    """Requirement lines of a file without their hashes: text by name and marker."""
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [re.sub(r"\s*--hash=\S+", "", line).strip() for line in text.splitlines()]
    found = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {(canonicalize_name(r.name), str(r.marker)): str(r.specifier) for r in found}


def asked(*extras: str) -> list[Requirement]:
    """What pyproject.toml asks for, the extras that one names of itself included."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts = [*project["dependencies"]]
    waiting = [*extras]
    while waiting:
        for text in project["optional-dependencies"][waiting.pop()]:
            requirement = Requirement(text)
            if requirement.name == "pse-analysis":
                waiting += requirement.extras
            else:
                texts.append(text)
    return [Requirement(text) for text in texts]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_line_is_one_version_with_hashes(lock: str) -> None:
    text = (ROOT / "requirements" / f"{lock}.txt").read_text(encoding="utf-8")
    entries = [e for e in text.replace("\\\n", " ").splitlines() if e and not e.startswith("#")]
    assert entries
    for entry in entries:
        assert re.fullmatch(
            r"[a-z0-9.-]+==[\w.]+( ; [^\\]+?)?( +--hash=sha256:[0-9a-f]{64})+", entry
        ), entry


@pytest.mark.parametrize("lock", LOCKS)
def test_pins_are_those_of_the_constraints(lock: str) -> None:
    constraints = pins(ROOT / "constraints.txt")
    for (name, marker), version in pins(ROOT / "requirements" / f"{lock}.txt").items():
        versions = [v for (n, m), v in constraints.items() if n == name and marker in (m, "None")]
        versions = versions or [v for (n, _), v in constraints.items() if n == name]
        assert versions == [version], f"{name}: run `make lock`"


@pytest.mark.parametrize(("lock", "extras"), [("run", ()), ("dev", ("dev",))])
def test_everything_that_the_project_asks_for_is_pinned(lock: str, extras: tuple[str, ...]) -> None:
    versions = {name: v for (name, _), v in pins(ROOT / "requirements" / f"{lock}.txt").items()}
    for requirement in asked(*extras):
        name = canonicalize_name(requirement.name)
        assert name in versions, f"{name} is not in requirements/{lock}.txt: run `make lock`"
        assert requirement.specifier.contains(versions[name].removeprefix("==")), name


def test_what_builds_the_package_is_pinned() -> None:
    table = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]
    versions = {name: v for (name, _), v in pins(ROOT / "requirements" / "build.txt").items()}
    for requirement in map(Requirement, table["requires"]):
        assert requirement.specifier.contains(versions[requirement.name].removeprefix("=="))


@pytest.mark.parametrize("name", ["constraints.txt", *(f"requirements/{n}.txt" for n in LOCKS)])
def test_no_file_says_where_packages_come_from(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert "://" not in text
    assert "index" not in text
