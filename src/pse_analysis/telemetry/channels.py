"""Whether channels fit the grid or machine, and whether injections are free of shunts."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

import numpy as np
import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.machine import INPUT, STATES, Machine
from pse_analysis.measurement import Model
from pse_analysis.vocabulary import (
    UNITS,
    Quantity,
    SigmaKind,
    as_number,
    check,
    plain_columns,
    schema,
    shown,
    unwritable,
)

SIGMA = (1e-12, 1e12)
"""Standard deviations that leave a weight 1/σ² which numbers can hold, in any unit."""

_VOLTAGES = (Quantity.VM_PU, Quantity.VA_DEGREE)
_OF_MACHINE = (INPUT, *STATES)


def check_channels(channels: pd.DataFrame, model: Model) -> pd.DataFrame:
    """The channels table, with its columns, elements, sides and units checked.

    Raises
    ------
    TableError
        On the first channel that does not fit, with what was expected.
    """
    channels = plain_columns("channels", channels, list(schema("channels").columns))
    _check_sigma(channels)
    checked = check("channels", channels)
    damaged = unwritable([*checked["channel"], *checked["element"]])
    if damaged:
        raise TableError(
            f"channels: {damaged[0]!r} holds damaged bytes or control characters: read the source "
            "with its own encoding, e.g. encoding='cp1252', or clean the name"
        )
    crossed = checked["lower"] > checked["upper"]
    if crossed.any():
        row = checked.loc[crossed].iloc[0]
        raise TableError(
            f"channels: lower = {row['lower']:g} of {row['channel']!r} lies above upper = "
            f"{row['upper']:g}: swap them"
        )
    names: dict[str, tuple[str, ...]] = (
        {"machine": (model.name,)}
        if isinstance(model, Machine)
        else {"bus": model.buses.name, "branch": model.branches.name}
    )
    owner = model.element if isinstance(model, Machine) else model.name
    known = {kind: set(of) for kind, of in names.items()}
    for channel, quantity, element, side, unit in zip(
        *(checked[c] for c in ("channel", "quantity", "element", "side", "unit")), strict=True
    ):
        kind, _, name = element.partition("/")
        if name not in known.get(kind, ()):
            near = names.get(kind) or [f"{k}/{n}" for k, of in names.items() for n in of]
            raise TableError(
                f"channels: {channel!r} stands at {element!r}, but {owner} has no {kind} "
                f"{name!r}: {suggest(name, near)}"
            )
        if (side == "") != (kind != "branch"):
            raise TableError(
                f"channels: side of {channel!r} at {element!r}: expected "
                f"{'from or to' if kind == 'branch' else repr('')}, received {side!r}"
            )
        if (kind == "machine") != (quantity in _OF_MACHINE):
            raise TableError(
                f"channels: {channel!r} measures {quantity} at {element!r}: of a machine expected "
                f"{', '.join(_OF_MACHINE)}, of a grid any other quantity"
            )
        if kind == "branch" and quantity in _VOLTAGES:
            raise TableError(
                f"channels: {channel!r} measures {quantity} at {element!r}: a voltage belongs to "
                "a bus; name the bus at that end"
            )
        units = UNITS[Quantity(quantity)]
        if unit not in units:
            raise TableError(
                f"channels: unit of {channel!r} does not fit {quantity}: expected "
                f"{' or '.join(map(repr, units))}, received {unit!r}; convert the values, or mend "
                "the unit"
            )
    return checked


def _check_sigma(channels: pd.DataFrame) -> None:
    """Refuse a standard deviation that no sensor has; whether there is one says the schema."""
    if "sigma" not in channels.columns or "channel" not in channels.columns:
        return
    sigma = np.array([_number(cell) for cell in channels["sigma"]])
    bad = ~((sigma > 0) & np.isfinite(sigma))
    if bad.any():
        row = channels.loc[bad].iloc[0]
        raise TableError(
            f"channels: sigma of {row['channel']!r} must be a finite standard deviation above "
            f"0, received {shown(row['sigma'])}; take it from the sensor's accuracy class"
        )
    bad = ~((sigma >= SIGMA[0]) & (sigma <= SIGMA[1]))
    if bad.any():
        row = channels.loc[bad].iloc[0]
        raise TableError(
            f"channels: sigma of {row['channel']!r} is {shown(row['sigma'])}, expected "
            f"{SIGMA[0]:g} … {SIGMA[1]:g}: its square is the weight of a measurement; take it from "
            "the sensor's accuracy class"
        )
    if "sigma_kind" not in channels.columns:
        return
    kinds = channels["sigma_kind"]
    relative = [isinstance(kind, str) and kind == SigmaKind.RELATIVE for kind in kinds]
    bad = np.array(relative, dtype=bool) & (sigma > 1.0)
    if bad.any():
        row = channels.loc[bad].iloc[0]
        raise TableError(
            f"channels: sigma of {row['channel']!r} is relative, a fraction of the magnitude: "
            f"expected at most 1, received {shown(row['sigma'])}; divide per cent by 100 (1 % is "
            "0.01), or write sigma_kind = 'absolute' if it is in the channel's unit"
        )


def _number(cell: object) -> float:
    """A cell as a number, NaN where it is none."""
    try:
        return as_number(cell)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def suggest(name: str, names: Iterable[str]) -> str:
    """What to write instead of an unknown name."""
    names = [str(n) for n in names]
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    if close:
        return f"did you mean {' or '.join(map(repr, close))}?"
    return f"expected one of {', '.join(names[:6])}{', …' if len(names) > 6 else ''}"


def check_known(telemetry: pd.DataFrame, channels: pd.DataFrame) -> None:
    """Refuse telemetry of a channel that the channels table does not describe.

    Raises
    ------
    TableError
        With the channel and a close match.
    """
    received = pd.unique(telemetry["channel"])
    known = set(channels["channel"])
    unknown = [c for c in received if c not in known]
    if unknown:
        raise TableError(
            f"telemetry: channel {unknown[0]!r} is not in the channels table "
            f"({len(unknown)} such): {suggest(str(unknown[0]), known)} Add it to the channels, or "
            "leave its rows out"
        )


def check_shunts(telemetry: pd.DataFrame, channels: pd.DataFrame, network: Network) -> None:
    """Refuse injections that look as if they contained the bus's own shunt.

    Other tools report a bus result as load plus shunt; here the shunt belongs to the grid model,
    and copying such results is a silent error. The check compares medians at buses without
    generation that have a shunt, an injection channel and a voltage channel: it refuses when the
    injection lies within a tenth of the shunt's power of *a credible load plus the shunt*, and
    further than half of the shunt's power from any credible load alone. A credible load is 0 … 1.5
    of the nominal one; for Q, where P is measured too, 0.8 … 1.25 of the nominal Q times the share
    of the nominal P.

    Parameters
    ----------
    telemetry, channels
        In this project's units and signs (``sign`` = 1, first unit of each quantity).
    network
        The grid.

    Raises
    ------
    TableError
        With the bus, the median, and the shunt's power.
    """
    buses = network.buses
    shunted = (buses.b_shunt_pu != 0) | (buses.g_shunt_pu != 0)
    quiet = shunted & (buses.kind == BusKind.PQ) & (buses.p_gen_mw == 0)
    if not quiet.any():
        return
    at = channels[channels["element"].isin([f"bus/{buses.name[i]}" for i in np.flatnonzero(quiet)])]
    wanted = at[at["quantity"].isin([Quantity.VM_PU, Quantity.P_MW, Quantity.Q_MVAR])]
    if wanted.empty:
        return
    part = telemetry[telemetry["channel"].isin(wanted["channel"])]
    median = part["value"].where(np.isfinite(part["value"])).groupby(part["channel"]).median()
    for element, group in wanted.groupby("element"):
        i = network.bus(str(element).partition("/")[2])
        by_quantity = {
            q: median.reindex(c["channel"]).dropna().to_numpy()
            for q, c in group.groupby("quantity")
        }
        voltage = by_quantity.get(Quantity.VM_PU)
        if voltage is None or not len(voltage):
            continue
        share = (0.0, 1.5)
        power = by_quantity.get(Quantity.P_MW)
        if power is not None and len(power) and buses.p_load_mw[i] > 0:
            with np.errstate(over="ignore"):
                measured = max(float(-np.median(power) / buses.p_load_mw[i]), 0.0)
            share = (0.8 * measured, 1.25 * measured)
        with np.errstate(all="ignore"):  # no load is near a shunt of infinite power
            square = np.square(np.median(voltage)) * network.base_mva
            active, reactive = -buses.g_shunt_pu[i] * square, buses.b_shunt_pu[i] * square
        for quantity, nominal, shares, shunt, unit in (
            (Quantity.P_MW, -buses.p_load_mw[i], (0, 1.5), active, "MW"),
            (Quantity.Q_MVAR, -buses.q_load_mvar[i], share, reactive, "Mvar"),
        ):
            for value in by_quantity.get(quantity, ()):
                low, high = sorted(s * float(nominal) for s in shares)
                with np.errstate(all="ignore"):
                    plain = abs(value - np.clip(value, low, high))
                    with_shunt = abs(value - shunt - np.clip(value - shunt, low, high))
                if with_shunt < 0.1 * abs(shunt) and plain > 0.5 * abs(shunt):
                    raise TableError(
                        f"telemetry: {quantity} at {element} has a median of {value:.4g} {unit}, "
                        f"which looks like the load (nominal {nominal:.4g}) plus the bus's own "
                        f"shunt ({shunt:.4g} {unit}): shunts belong to the grid model. Subtract it "
                        "from the values; or, if the injection really is that, pass "
                        "shunts='accept'"
                    )
