"""Physical limits for channels that state none, from the grid or the machine they belong to.

A limit from here says "no plant can have had this value", never "this value is unusual": overload,
reverse flow, feed-in of many times the load, a voltage that has almost broken down, and the current
of a short circuit lie inside. What lies outside is a wrong unit (W for MW, kV for p.u.), a lost
decimal point or a number that stands for "no value". Sharper limits belong into the table of
channels or into ``[validate.rules]``.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.measurement import (
    DELTA_M,
    IA,
    IM,
    QUANTITIES,
    ROTOR_ANGLE,
    ROTOR_SPEED,
    VA,
    VM,
    Model,
    P,
    Q,
    SensorLayout,
)
from pse_analysis.measurement.layout import metered_bus
from pse_analysis.parameters import Unbounded
from pse_analysis.vocabulary import Quantity

NORMAL_KA = 4.0
"""Largest rated normal current of usual switchgear, from the series of IEC 62271-1. [kA]"""

_FREE_UNITS = {"pu": 1.0, "rad": 1.0, "degree": np.pi / 180.0}
"""Units whose value in p.u. or rad needs no grid, where the quantity is named with them."""
_FREE = (Quantity.VM_PU, Quantity.VA_DEGREE, Quantity.IA_DEGREE, Quantity.DELTA_M_PU)


@dataclass(frozen=True)
class DefaultLimits:
    """How wide the limits are that a channel gets where neither it nor a rule states one.

    Each width may be ``inf``, which leaves that quantity without default limits.

    Attributes
    ----------
    apply : bool
        Whether there are default limits at all.
    voltage_pu : float
        Upper limit of |V|; any magnitude above 0 is possible. Overvoltages of power frequency stay
        below √3 p.u. even at an earth fault, and a voltage transformer saturates beyond its rated
        voltage factor, 1.9 at most (IEC 61869-3). A kV for a p.u. is above it in grids of more than
        2 kV; the 0.4 kV of a low-voltage grid look like 0.4 p.u. [p.u.]
    power : float
        Limit of |P| and |Q|, as a multiple of the reference power, √3 V_n times `NORMAL_KA`. It
        does not look at the bus's own nominal load, because any bus may get a plant many times
        its load, or a transit; the default of 10 stands for 40 kA at rated voltage, which no
        conductor carries but in a short circuit, where the voltage is not there. At 20 kV that is
        1386 MW, so W for MW are out from 1.4 kW on. Ratings of branches would be sharper, but a
        `Network` knows none. Grid models that put whole regions behind a bus of low voltage exceed
        that: where the nominal load or generation of any bus of the same rated voltage is above
        the reference power, the nominal power of the whole grid (loads, plants, shunts and line
        charging added up without sign) takes its place.
    current : float
        Limit of |I|, as a multiple of the reference power's current at rated voltage. The default
        of 20 stands for 80 kA: currents, other than powers, do reach the level of short circuits.
    angle_turns : float
        Limit of the angles of voltages and currents, to both sides. Sources give −180 … 180 or
        0 … 360 degrees; the default of 2 turns leaves room for a vector group that was added
        without folding. State limits of their own for angles that are never folded. [turns]
    torque_pu : float
        Limit of |ΔM| of a machine. A lost load is 1 p.u., the air-gap torque of a short circuit or
        of faulty synchronisation about 10 p.u. [p.u.]
    speed : float
        Limit of a rotor's deviation from nominal speed, as a multiple of that speed. Standstill is
        −1, a pump turbine in reverse −2, the runaway of a Kaplan turbine +2 at most.
    clock_error_s : float
        Limit of a rotor's angle, as the time in which nominal speed turns it so far. The angle sums
        the error of frequency, as a synchronous clock does; the largest one on record, in
        continental Europe in 2018, came to 6 minutes. [s]

    Raises
    ------
    ParameterError
        If a width is not above 0.
    """

    apply: bool = True
    voltage_pu: Unbounded = 2.0
    power: Unbounded = 10.0
    current: Unbounded = 20.0
    angle_turns: Unbounded = 2.0
    torque_pu: Unbounded = 20.0
    speed: Unbounded = 3.0
    clock_error_s: Unbounded = 1800.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self)[1:]:
            value = getattr(self, field.name)
            if not value > 0.0:
                raise ParameterError(
                    f"[validate.default_limits] {field.name} must be above 0, received {value}: "
                    "inf leaves the quantity without default limits, apply = false all of them"
                )


@dataclass(frozen=True, eq=False)
class PhysicalLimits:
    """Default limits of every channel, in the channel's own unit.

    Attributes
    ----------
    lower, upper : (n_channel,)
        NaN where there is none. [unit]
    origin : (n_channel,) tuple of str
        What each follows from, for messages; "" where there is none.
    """

    lower: FloatArray
    upper: FloatArray
    origin: tuple[str, ...]

    def of(self, at: int) -> tuple[float, float]:
        """Returns both limits of a channel; NaN where there is none. [unit]"""
        return float(self.lower[at]), float(self.upper[at])

    def beside(
        self, at: int, lower: float | None, upper: float | None
    ) -> tuple[float | None, float | None]:
        """Returns stated limits of a channel with the default ones in place of absent ones.

        A stated limit always holds. Where a default one would leave no value between the two, the
        stated one is in another unit or means what the default does not know, so it stands alone.
        """
        low, high = self.of(at)
        # Comparisons with NaN, which stands for no default limit, are false.
        return (
            low if lower is None and low < (np.inf if upper is None else upper) else lower,
            high if upper is None and high > (-np.inf if lower is None else lower) else upper,
        )


def physical_limits(
    channels: pd.DataFrame, model: Model | None, params: DefaultLimits
) -> PhysicalLimits:
    """Returns the limits that no real value of each channel can exceed.

    Parameters
    ----------
    channels : DataFrame
        Of schema ``channels``, in any unit.
    model : Network or Machine, optional
        Without it powers, currents and a rotor have no limits, nor has a voltage in kV.
    params : DefaultLimits
        Their widths.

    Returns
    -------
    PhysicalLimits
        An upper limit of |V|; limits of equal size to both sides for the rest, so that a channel's
        sign does not matter. Those of |I| as well: telecontrol may give currents a direction.

    Raises
    ------
    GridError, TableError
        If a channel's element is not in the model, or its unit does not fit its quantity.
    """
    n = len(channels)
    span, origin = np.full(n, np.nan), np.full(n, "", dtype=object)
    if not params.apply or not n:
        return PhysicalLimits(span, span.copy(), tuple(origin))
    quantity = np.array([QUANTITIES.index(Quantity(q)) for q in channels["quantity"]])
    if model is None:
        free = channels["quantity"].isin(_FREE).to_numpy()
        scale = channels["unit"].map(_FREE_UNITS).where(free).to_numpy(dtype=float)
    else:
        layout = SensorLayout.from_channels(channels, model)
        scale = np.abs(layout.scale)
    for which, width, text in (
        (VM, params.voltage_pu, f"{params.voltage_pu:g} p.u."),
        (VA, 2.0 * np.pi * params.angle_turns, f"{params.angle_turns:g} turns"),
        (IA, 2.0 * np.pi * params.angle_turns, f"{params.angle_turns:g} turns"),
        (DELTA_M, params.torque_pu, f"{params.torque_pu:g} p.u."),
    ):
        span[quantity == which], origin[quantity == which] = width, text
    if isinstance(model, Machine):
        _of_machine(model, params, quantity, span, origin)
    elif isinstance(model, Network):
        _of_grid(model, layout, params, span, origin)
    upper = span / scale
    upper[~np.isfinite(upper)] = np.nan
    lower = np.where(quantity == VM, np.nan, -upper)
    return PhysicalLimits(lower, upper, tuple(map(str, np.where(np.isnan(upper), "", origin))))


def nominal_mva(network: Network) -> float:
    """Returns the nominal power of a grid: of all loads, plants, shunts and lines, without sign."""
    bus, branch = network.buses, network.branches
    injected = _own_mva(network).sum()
    shunt = np.hypot(bus.g_shunt_pu, bus.b_shunt_pu).sum()
    charging = np.hypot(branch.g_pu, branch.b_pu)[branch.in_service].sum()
    return float(injected + network.base_mva * (shunt + charging))


def _own_mva(network: Network) -> FloatArray:
    """Nominal apparent power of each bus, load and generation added without sign. (n_bus,)"""
    bus = network.buses
    return np.asarray(np.hypot(np.abs(bus.p_load_mw) + np.abs(bus.p_gen_mw), bus.q_load_mvar))


def _of_grid(
    network: Network,
    layout: SensorLayout,
    params: DefaultLimits,
    span: FloatArray,
    origin: npt.NDArray[np.object_],
) -> None:
    """Write the limits of powers and currents, in p.u., and what they follow from."""
    at = np.atleast_1d(metered_bus(network, layout.position, layout.side))
    total = nominal_mva(network)
    rated = np.sqrt(3.0) * network.buses.vn_kv * NORMAL_KA
    _, level = np.unique(network.buses.vn_kv, return_inverse=True)
    largest = np.zeros(network.n_bus)
    np.maximum.at(largest, level, _own_mva(network))
    aggregated = (largest[level] > rated)[at]
    reference = np.where(aggregated, np.maximum(total, rated[at]), rated[at])
    of_power = np.isin(layout.quantity, (P, Q))
    of_current = layout.quantity == IM
    span[of_power] = params.power * reference[of_power] / network.base_mva
    # In p.u. the current of a power at rated voltage is that power.
    span[of_current] = params.current * reference[of_current] / network.base_mva
    for rows, width in ((of_power, params.power), (of_current, params.current)):
        by_total = f"{width:g} × {total:.4g} MVA, the nominal power of the whole grid"
        by_rated = f"{width:g} × {NORMAL_KA:g} kA at rated voltage"
        origin[rows] = np.where(aggregated[rows], by_total, by_rated)


def _of_machine(
    machine: Machine,
    params: DefaultLimits,
    quantity: npt.NDArray[np.int64],
    span: FloatArray,
    origin: npt.NDArray[np.object_],
) -> None:
    """Write the limits of a rotor's speed and angle, in rad/s and rad."""
    speed, angle = quantity == ROTOR_SPEED, quantity == ROTOR_ANGLE
    span[speed] = params.speed * machine.omega0
    origin[speed] = f"{params.speed:g} × the nominal speed"
    span[angle] = params.clock_error_s * machine.omega0
    origin[angle] = f"{params.clock_error_s:g} s of nominal speed"
