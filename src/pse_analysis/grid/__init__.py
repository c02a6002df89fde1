"""Grid models: buses, branches, admittance, and a small library of test grids.

Power flow stands in `pse_analysis.grid.power_flow` and continuation power flow in
`pse_analysis.grid.continuation`; they use the measurement model, so they come after it.
"""

from __future__ import annotations

from pse_analysis.grid import library
from pse_analysis.grid.elements import Branches, Buses, BusKind
from pse_analysis.grid.network import Network

__all__ = ["Branches", "BusKind", "Buses", "Network", "library"]
