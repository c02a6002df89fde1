"""What every derived table says of its origin. Standard library only."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pse_analysis import __version__
from pse_analysis.pipeline.case import Case
from pse_analysis.pipeline.descent import read_parameters
from pse_analysis.pipeline.plan import Stage

LIBRARIES = ("numpy", "pandas", "pyarrow", "scipy", "rerun-sdk")
"""Libraries whose versions a derived table names."""


def versions() -> dict[str, str]:
    """Versions of what a result was made with."""
    found = {"pse_analysis": __version__, "python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


def provenance(
    case: Case, stage: Stage, fingerprint: str, read: Mapping[str, str]
) -> dict[str, Any]:
    """Origin of a stage's result, as `pse_analysis.telemetry.read_provenance` gives it back.

    Parameters
    ----------
    case, stage, fingerprint
        What ran.
    read
        Digest of every file that it read, by name.
    """
    return {
        "case": case.name,
        "stage": stage.name,
        "fingerprint": fingerprint,
        "parameters": read_parameters(case, stage),
        "inputs": dict(read),
        "versions": versions(),
    }
