"""Power-system state estimation from raw telemetry to a scored estimate."""

from __future__ import annotations

import importlib
from types import ModuleType

__version__ = "0.1.0"

_MODULES = (
    "alignment",
    "estimation",
    "figures",
    "grid",
    "measurement",
    "pipeline",
    "recording",
    "scoring",
    "simulation",
    "telemetry",
    "validation",
    "vocabulary",
)


def __getattr__(name: str) -> ModuleType:
    """Import a module on first use, so that a cached run does not wait for pandas."""
    if name in _MODULES:
        return importlib.import_module(f"pse_analysis.{name}")
    raise AttributeError(f"module 'pse_analysis' has no attribute {name!r}")
