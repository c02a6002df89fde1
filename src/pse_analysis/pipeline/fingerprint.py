"""Fingerprints: a stage whose inputs, parameters and code are unchanged need not run again.

Standard library only: checking a cached run must not wait for pandas. Versions of installed
libraries are not part of a fingerprint; ``--force`` runs a stage again after an upgrade.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import date, datetime, time
from functools import cache
from pathlib import Path
from typing import Any

from pse_analysis.files import digest_file

PACKAGE = "pse_analysis"
SOURCE_ROOT = Path(__file__).resolve().parents[2]
FINGERPRINT_BYTES = 10
ESTIMATORS = "pse_analysis.estimators"
"""Entry points by which installed packages offer methods."""
BUILT_IN = frozenset({"wls", "kalman", "ukf", "ekf", "observer"})
"""Methods of this package, whose code is that of the estimate stage."""

# Only absolute imports are allowed in this package, and each stands on lines of its own, so that
# this pattern finds what `ast` would (a test compares the two) at a tenth of its time.
_IMPORT = re.compile(
    rf"^[ \t]*(?:from[ \t]+({PACKAGE}(?:\.\w+)*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]+)"
    rf"|import[ \t]+({PACKAGE}[^\n]*))",
    re.MULTILINE,
)
_COMMENT = re.compile(r"#[^\n]*")


def module_file(module: str) -> Path | None:
    """Source file of a module of this package; None if there is no such module."""
    path = SOURCE_ROOT.joinpath(*module.split("."))
    if path.is_dir():
        init = path / "__init__.py"
        return init if init.is_file() else None
    path = path.with_suffix(".py")
    return path if path.is_file() else None


def imported_names(source: str) -> Iterator[str]:
    """Dotted names below this package that a module's import lines mention.

    ``from pse_analysis.a import b`` mentions ``pse_analysis.a`` and ``pse_analysis.a.b``; whether
    the second is a module or a function is for the caller to see.
    """
    for match in _IMPORT.finditer(source):
        origin, names, plain = match.groups()
        if plain is not None:
            for part in _COMMENT.sub("", plain).split(","):
                yield part.split(" as ")[0].strip()
            continue
        yield origin
        for part in _COMMENT.sub("", names).strip("() \t\n").split(","):
            name = part.split(" as ")[0].strip()
            if name:
                yield f"{origin}.{name}"


@cache
def _imports(module: str) -> frozenset[str]:
    path = module_file(module)
    if path is None:
        return frozenset()
    found: set[str] = set()
    for name in imported_names(path.read_text(encoding="utf-8")):
        parts = name.split(".")
        # Importing a.b runs a/__init__.py too, so that every parent counts.
        for depth in range(1, len(parts) + 1):
            parent = ".".join(parts[:depth])
            if module_file(parent) is not None:
                found.add(parent)
    return frozenset(found)


def closure(*modules: str) -> tuple[str, ...]:
    """Modules of this package that the given ones import, directly or not, themselves included.

    Raises
    ------
    ModuleNotFoundError
        If one of the given modules does not exist.
    """
    seen: set[str] = set()
    waiting = list(modules)
    for module in modules:
        if module_file(module) is None:
            raise ModuleNotFoundError(f"no module {module} below {SOURCE_ROOT}")
    while waiting:
        module = waiting.pop()
        if module not in seen:
            seen.add(module)
            waiting.extend(_imports(module) - seen)
    return tuple(sorted(seen))


def digest_code(modules: Iterable[str]) -> dict[str, str]:
    """Digest of the source file of each module."""
    digests = {}
    for module in modules:
        path = module_file(module)
        if path is not None:
            digests[module] = digest_file(path)
    return digests


def digest_installed(filters: Iterable[str]) -> dict[str, str]:
    """Digest of each source file of the installed packages that offer the given methods.

    Parameters
    ----------
    filters
        Names of methods as case files have them; those of this package are passed over.

    Notes
    -----
    A package is found without being imported, which would be too slow for a cached run and would
    run code of it before anyone asked for that.
    """
    wanted = set(filters) - BUILT_IN
    if not wanted:
        return {}
    # Both cost some time, and few cases need them.
    from importlib import metadata
    from importlib.util import find_spec

    digests: dict[str, str] = {}
    for point in metadata.entry_points(group=ESTIMATORS):
        spec = find_spec(point.module.split(".")[0]) if point.name in wanted else None
        if spec is None:
            continue
        folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
        files = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
        if not folders and spec.origin is not None:
            files = [Path(spec.origin)]
        for path in files:
            digests[f"{point.name}: {path.name} {len(digests)}"] = digest_file(path)
    return digests


def _plain(value: object) -> str:
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    raise TypeError(f"{value!r} cannot stand in a fingerprint")


def canonical(value: object) -> str:
    """JSON in which equal values have equal text."""
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, default=_plain
    )


def fingerprint(
    stage: str,
    *,
    parameters: Mapping[str, Any],
    inputs: Mapping[str, str],
    code: Mapping[str, str],
) -> str:
    """Fingerprint of one run of a stage.

    Parameters
    ----------
    stage
        Its name.
    parameters
        What it reads of the case file.
    inputs
        Digest of each file it reads, by name.
    code
        Digest of each module it uses, by name; `vocabulary`, among them, holds the schemas.

    Returns
    -------
    str
        Hexadecimal.
    """
    text = canonical(
        {
            "stage": stage,
            "parameters": dict(parameters),
            "inputs": dict(inputs),
            "code": dict(code),
        }
    )
    # Names of files need not be UTF-8.
    content = text.encode("utf-8", "surrogatepass")
    return hashlib.blake2b(content, digest_size=FINGERPRINT_BYTES).hexdigest()
