"""Raw telemetry of a simulated case, made from a grid, real load curves and a sensor layout."""

from __future__ import annotations

from pse_analysis.simulation.case import simulate
from pse_analysis.simulation.settings import SimulateParams

__all__ = ["SimulateParams", "simulate"]
