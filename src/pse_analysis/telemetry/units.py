"""Whether values look as if they were in another unit than the one their channel states."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.measurement.layout import metered_bus, per_unit_factor
from pse_analysis.vocabulary import Quantity

log = logging.getLogger(__name__)

BAND_PU = (0.7, 1.5)
"""Voltages of a grid in operation, and of one in distress. [p.u.]"""
NEAR_PU = (0.8, 1.2)
"""Voltages near enough to the rated one to tell the unit that they are in. [p.u.]"""
FAR = 50.0
"""How many times all nominal loads and generation together a measured flow may be."""


class _Reading(NamedTuple):
    """A unit that a voltage may have been read in: size of the rated voltage, and the remedy."""

    rated: float
    name: str
    remedy: str


def check_units(telemetry: pd.DataFrame, channels: pd.DataFrame, network: Network) -> None:
    """Refuse voltages that are in another unit than the channel's, and warn of such powers.

    A voltage is refused where the median of its channel lies outside `BAND_PU` as its unit is
    stated, and within `NEAR_PU` of the bus's rated voltage in another one. Where no other unit
    fits, a warning says so: one broken meter stops nothing.

    Parameters
    ----------
    telemetry : DataFrame
        ``channel`` and ``value`` as the source gives them, in the unit of ``channels``.
    channels : DataFrame
        Table ``channels`` as the source describes it.
    network : Network

    Raises
    ------
    TableError
        With the channel, its median, the rated voltage and the unit to write.
    """
    finite = np.isfinite(telemetry["value"].to_numpy())
    size = telemetry["value"].abs().where(finite).groupby(telemetry["channel"]).median()
    typical = size.reindex(channels["channel"]).to_numpy(dtype=float)
    # No value says nothing, and zero is zero in every unit.
    for at in np.flatnonzero(typical > 0):
        channel = channels.iloc[int(at)]
        if channel["quantity"] == Quantity.VM_PU:
            _check_voltage(channel, float(typical[at]), network)
        elif channel["quantity"] in (Quantity.VA_DEGREE, Quantity.IA_DEGREE):
            if channel["unit"] == "rad" and typical[at] > 2.0 * np.pi:
                _warn(channel, float(typical[at]), "more than a full turn", "degree")
        elif channel["quantity"] in (Quantity.P_MW, Quantity.Q_MVAR, Quantity.I_KA):
            _check_flow(channel, float(typical[at]), network)


def _check_voltage(channel: pd.Series, typical: float, network: Network) -> None:
    bus = network.bus(str(channel["element"]).partition("/")[2])
    kv, unit = float(network.buses.vn_kv[bus]), str(channel["unit"])
    per_unit = typical * per_unit_factor(network, unit, bus)
    if BAND_PU[0] <= per_unit <= BAND_PU[1]:
        return
    phase = kv / np.sqrt(3.0)
    for reading in (
        _Reading(kv, "kV", "write unit = 'kv'"),
        _Reading(1.0, "p.u.", "write unit = 'pu'"),
        _Reading(1e3 * kv, "V", "divide values, sigma and limits by 1000 and write unit = 'kv'"),
        _Reading(100.0, "per cent", "divide values, sigma and limits by 100 and write unit = 'pu'"),
        _Reading(
            phase,
            "kV from phase to ground",
            "multiply values, sigma and limits by √3 and write unit = 'kv'",
        ),
        _Reading(
            1e3 * phase,
            "V from phase to ground",
            "multiply values, sigma and limits by √3/1000 and write unit = 'kv'",
        ),
    ):
        if NEAR_PU[0] <= typical / reading.rated <= NEAR_PU[1]:
            raise TableError(
                f"telemetry: {channel['channel']!r} has a median of {typical:.5g} {unit} at "
                f"{channel['element']}, which is rated {kv:g} kV: expected about "
                f"{1.0 / per_unit_factor(network, unit, bus):.5g} {unit}; these values look like "
                f"{reading.name}: {reading.remedy}. If they really are {unit}, pass units='accept'"
            )
    if per_unit > BAND_PU[1]:
        log.warning(
            "telemetry: %r has a median of %.5g %s = %.4g p.u. at %s, rated %g kV: no voltage is "
            "so high, and no other unit fits; check the channel's unit and vn_kv of the bus",
            *(channel["channel"], typical, unit, per_unit, channel["element"], kv),
        )


def _check_flow(channel: pd.Series, typical: float, network: Network) -> None:
    """Warn of a flow that dwarfs the grid, as kW read as MW do."""
    buses = network.buses
    whole = float(np.hypot(buses.p_load_mw, buses.q_load_mvar).sum() + np.abs(buses.p_gen_mw).sum())
    if not (whole > 0 and np.isfinite(whole)):
        return
    kind, _, name = str(channel["element"]).partition("/")
    side = {"from": 1, "to": 2}.get(str(channel["side"]), 0)
    position = network.bus(name) if kind == "bus" else network.branch(name)
    bus = int(metered_bus(network, np.int64(position), np.int64(side)))
    power = typical * per_unit_factor(network, str(channel["unit"]), bus) * network.base_mva
    smaller = {"mw": "kw", "mvar": "kvar", "ka": "a"}.get(str(channel["unit"]))
    if smaller and power > FAR * whole:
        _warn(
            channel,
            typical,
            f"{power:.4g} MVA in a grid whose loads and generation sum up to {whole:.4g} MVA",
            smaller,
        )


def _warn(channel: pd.Series, typical: float, why: str, unit: str) -> None:
    log.warning(
        "telemetry: %r has a median of %.5g %s at %s, %s: if these values are in %s, write "
        "unit = %r",
        *(channel["channel"], typical, channel["unit"], channel["element"], why, unit, unit),
    )
