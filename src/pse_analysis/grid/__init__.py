"""Grid models: buses, branches, admittance, power flow and a small library of test grids."""

from __future__ import annotations

from pse_analysis.grid import library
from pse_analysis.grid.network import Branches, Buses, BusKind, Network
from pse_analysis.grid.power_flow import PowerFlow, solve

__all__ = ["Branches", "BusKind", "Buses", "Network", "PowerFlow", "library", "solve"]
