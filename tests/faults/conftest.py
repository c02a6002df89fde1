"""A finished run of the small case, and its copies."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from small_case import CASES, Place

from pse_analysis.pipeline import runner
from pse_analysis.pipeline.plan import NAMES


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """A finished run; nobody changes it."""
    place = Place(tmp_path_factory.mktemp("faults"))
    shutil.copytree(CASES, place.folder / "cases")
    assert runner.run("small", place.options).ran == NAMES
    return place


@pytest.fixture
def copy(whole: Place, tmp_path: Path) -> Callable[[str], Place]:
    """Copies of that run below a name of the test's choice."""

    def make(name: str) -> Place:
        shutil.copytree(whole.folder, tmp_path / name)
        return Place(tmp_path / name)

    return make


@pytest.fixture
def place(copy: Callable[[str], Place]) -> Place:
    """A copy of that run."""
    return copy("place")
