"""Raw telemetry of a simulated case: of a grid under real load curves, or of a machine on load."""

from __future__ import annotations

from pse_analysis.simulation.case import simulate
from pse_analysis.simulation.machine_case import MachineSimulateParams, simulate_machine
from pse_analysis.simulation.settings import SimulateParams

__all__ = ["MachineSimulateParams", "SimulateParams", "simulate", "simulate_machine"]
