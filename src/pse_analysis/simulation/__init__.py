"""Raw telemetry of a simulated case: a grid under real load, a machine, or metered loads alone."""

from __future__ import annotations

from pse_analysis.simulation.case import simulate
from pse_analysis.simulation.machine_case import MachineSimulateParams, simulate_machine
from pse_analysis.simulation.series import SeriesSimulateParams, simulate_series
from pse_analysis.simulation.settings import SimulateParams

__all__ = [
    "MachineSimulateParams",
    "SeriesSimulateParams",
    "SimulateParams",
    "simulate",
    "simulate_machine",
    "simulate_series",
]
