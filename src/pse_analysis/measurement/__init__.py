"""The one measurement model: h(x), its Jacobian, and the boundary between units and per unit.

State of the polar model: x = [θ; |V|], 2N rows [rad; p.u.]. State of the rectangular model:
x = [e; f] with V = e + jf. Both read a `SensorLayout`, whose rows follow the channels table.

Everything but |V| and θ is a function of a *terminal current* c = y·V, where y is a row of Y-bus
(injection) or of the branch admittances (flow), and of the voltage V_m at the metered bus:
S = V_m c*, so P, Q, |I| and ∠I at every place share one formula.
"""

from __future__ import annotations

from pse_analysis.arrays import ComplexArray, FloatArray, IntArray
from pse_analysis.measurement.layout import (
    BUS,
    DELTA_M,
    FROM,
    IA,
    IM,
    QUANTITIES,
    RELATIVE_FLOOR_PU,
    ROTOR_ANGLE,
    ROTOR_SPEED,
    TO,
    VA,
    VM,
    Model,
    P,
    Q,
    SensorLayout,
    per_unit_factor,
    standard_deviation,
    wrap,
)
from pse_analysis.measurement.polar import MeasurementModel
from pse_analysis.measurement.rectangular import RectangularModel

__all__ = [
    "BUS",
    "DELTA_M",
    "FROM",
    "IA",
    "IM",
    "QUANTITIES",
    "RELATIVE_FLOOR_PU",
    "ROTOR_ANGLE",
    "ROTOR_SPEED",
    "TO",
    "VA",
    "VM",
    "ComplexArray",
    "FloatArray",
    "IntArray",
    "MeasurementModel",
    "Model",
    "P",
    "Q",
    "RectangularModel",
    "SensorLayout",
    "per_unit_factor",
    "standard_deviation",
    "wrap",
]
