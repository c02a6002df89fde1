"""Claim: imports run one way, and importing anything does nothing but define names."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pse_analysis
from pse_analysis.pipeline import fingerprint
from pse_analysis.pipeline.plan import STAGES

ROOT = Path(pse_analysis.__file__).parent
MODULES = {
    ".".join(("pse_analysis", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(
        ".__init__"
    ): path
    for path in sorted(ROOT.rglob("*.py"))
    if "tables" not in path.relative_to(ROOT).parts
}

# A part may import itself and what stands in an earlier line.
LAYERS = (
    ("arrays", "errors"),
    ("leftovers",),
    ("files",),
    ("checksums",),
    ("parameters", "vocabulary"),
    ("grid", "machine", "measurement", "telemetry"),
    ("simulation", "validation"),
    ("alignment",),
    ("estimation",),
    ("scoring",),
    ("pipeline",),
)
LAYER = {part: level for level, parts in enumerate(LAYERS) for part in parts}
# Leaves read tables; within the package only the runner's stages call them.
LEAVES = {"drawing": (), "figures": ("drawing",), "recording": ("drawing",)}
CALLERS_OF_LEAVES = {"pse_analysis.pipeline.stages"}
# Within a line: the power flow solves the rows of the measurement model, for one.
WITHIN_LAYER = {("grid", "measurement"), ("measurement", "grid"), ("telemetry", "grid"),
                ("telemetry", "measurement"), ("telemetry", "machine"), ("measurement", "machine"),
                ("vocabulary", "parameters")}  # fmt: skip


def imported(module: str) -> set[str]:
    """Names below the package that a module imports, as `ast` reads them."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {a.name for a in node.names if a.name.split(".")[0] == "pse_analysis"}
        elif (
            isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "pse_analysis"
        ):
            assert node.level == 0
            assert node.module is not None
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def part(name: str) -> str:
    """The part of the package that a dotted name lies in."""
    return (*name.split("."), "")[1]


@pytest.mark.parametrize("module", MODULES)
def test_imports_run_one_way(module: str) -> None:
    own = part(module)
    if own == "":
        return
    for name in imported(module):
        other = part(name)
        if other in ("", own) or (other not in LAYER and other not in LEAVES):
            continue
        if other in LEAVES:
            allowed = own in LEAVES and other in LEAVES[own]
            assert allowed or module in CALLERS_OF_LEAVES, f"{module} imports the leaf {other}"
        elif own in LEAVES:
            assert LAYER[other] < LAYER["simulation"], f"leaf {module} imports {name}"
        else:
            downward = LAYER[other] < LAYER[own] or (own, other) in WITHIN_LAYER
            assert downward, f"{module} imports {name}, which stands above it"


def test_types_of_arrays_are_defined_once() -> None:
    again = re.compile(
        r"^\w+ *= *npt\.NDArray\[np\.(?:float64|complex128|int64|bool_)\]$", re.MULTILINE
    )
    found = {
        module for module, path in MODULES.items() if again.search(path.read_text(encoding="utf-8"))
    }
    assert found == {"pse_analysis.arrays"}


def test_every_part_has_a_layer() -> None:
    parts = {part(module) for module in MODULES} - {""}
    assert parts == set(LAYER) | set(LEAVES)


@pytest.mark.parametrize("module", MODULES)
def test_pattern_finds_the_imports_that_ast_finds(module: str) -> None:
    source = MODULES[module].read_text(encoding="utf-8")
    assert set(fingerprint.imported_names(source)) == imported(module)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_code_of_a_stage_is_all_that_it_imports(stage: object) -> None:
    module = stage.module  # type: ignore[attr-defined]
    code = (
        f"import sys, {module}\n"
        "print(*sorted(m for m in sys.modules if m.split('.')[0] == 'pse_analysis'))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert set(loaded) <= set(fingerprint.closure(module))


def test_nothing_is_printed_or_warned_on_import() -> None:
    names = ", ".join(MODULES)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", f"import {names}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_command_line_imports_the_standard_library_only() -> None:
    code = (
        "import sys\nbefore = set(sys.modules)\nimport pse_analysis.pipeline.cli\n"
        "print(*{m.split('.')[0] for m in set(sys.modules) - before})"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert set(loaded) <= set(sys.stdlib_module_names) | {"pse_analysis"}
