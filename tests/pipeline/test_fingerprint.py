"""Claim: a fingerprint changes exactly when a parameter, an input or used source code changes."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from pse_analysis import files
from pse_analysis.pipeline import fingerprint as fp

BASE: dict[str, Any] = {
    "parameters": {"align": {"max_age_s": 900, "start": datetime(2016, 6, 9, tzinfo=UTC)}},
    "inputs": {"raw/channels.parquet": "aa"},
    "code": {"pse_analysis.alignment": "bb"},
}


def test_order_of_keys_does_not_matter() -> None:
    turned = {"start": datetime(2016, 6, 9, tzinfo=UTC), "max_age_s": 900}
    assert fp.fingerprint("align", **BASE) == fp.fingerprint(
        "align", **{**BASE, "parameters": {"align": turned}}
    )


@pytest.mark.parametrize(
    "change",
    [
        {"parameters": {"align": {"max_age_s": 901}}},
        {"inputs": {"raw/channels.parquet": "ab"}},
        {"inputs": {"raw/channels.parquet": "aa", "raw/more.parquet": "aa"}},
        {"code": {"pse_analysis.alignment": "bc"}},
    ],
)
def test_any_change_changes_it(change: dict[str, Any]) -> None:
    assert fp.fingerprint("align", **BASE) != fp.fingerprint("align", **{**BASE, **change})


def test_stage_is_part_of_it() -> None:
    assert fp.fingerprint("align", **BASE) != fp.fingerprint("validate", **BASE)


def test_file_digest_follows_content_not_name(tmp_path: Path) -> None:
    for name, content in (("a", b"1"), ("b", b"1"), ("c", b"2")):
        (tmp_path / name).write_bytes(content)
    digest = {name: facts["digest"] for name, facts in files.describe_folder(tmp_path).items()}
    assert digest["a"] == digest["b"]
    assert digest["a"] != digest["c"]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    root = tmp_path / "pse_analysis"
    (root / "a").mkdir(parents=True)
    for name, text in {
        "__init__.py": "",
        "a/__init__.py": "from pse_analysis.c import (\n  f,  # pse_analysis.no\n  g as h,\n)\n",
        "a/b.py": "import pse_analysis.d as d, pse_analysis.e\n",
        "c.py": "def k():\n    from pse_analysis.f import thing\n",
        "d.py": "# from pse_analysis.unused import x\n",
        "e.py": "",
        "f.py": "",
        "unused.py": "",
        "user.py": "from pse_analysis.a import b\n",
    }.items():
        (root / name).write_text(text, encoding="utf-8")
    monkeypatch.setattr(fp, "SOURCE_ROOT", tmp_path)
    fp._imports.cache_clear()
    yield root
    fp._imports.cache_clear()


def test_closure_follows_packages_modules_and_imports_inside_functions(package: Path) -> None:
    names = [
        name.removeprefix("pse_analysis").lstrip(".") for name in fp.closure("pse_analysis.user")
    ]
    assert names == ["", "a", "a.b", "c", "d", "e", "f", "user"]


def test_closure_of_an_unknown_module_is_an_error(package: Path) -> None:
    with pytest.raises(ModuleNotFoundError, match=r"pse_analysis\.nowhere"):
        fp.closure("pse_analysis.nowhere")


def test_code_digest_changes_with_a_module_that_is_imported_indirectly(package: Path) -> None:
    before = fp.digest_code(fp.closure("pse_analysis.user"))
    (package / "f.py").write_text("x = 1\n", encoding="utf-8")
    (package / "unused.py").write_text("x = 1\n", encoding="utf-8")
    after = fp.digest_code(fp.closure("pse_analysis.user"))
    assert {name for name in after if after[name] != before[name]} == {"pse_analysis.f"}
