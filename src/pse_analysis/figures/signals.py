"""Signals over time: what was measured, what was flagged, what was estimated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from pse_analysis.drawing import REASONS, SOURCES, method_colours
from pse_analysis.errors import TableError
from pse_analysis.figures.paper import (
    DOUBLE,
    MEASURED,
    SINGLE,
    SYMBOL,
    TRUTH,
    UNIT,
    Paper,
    legend,
    paper,
    styled,
    time_axis,
)
from pse_analysis.vocabulary import UNITS, Flag, Quantity, Reason

_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "*", "h")


@styled
def voltage(
    estimated: pd.DataFrame,
    truth: pd.DataFrame | None,
    aligned: pd.DataFrame | None,
    element: str,
    *,
    channels: pd.DataFrame | None = None,
    methods: Sequence[str] | None = None,
    quantity: str = "vm_pu",
    trial: int = 0,
    width: float = DOUBLE,
) -> Paper:
    """What was measured at a bus, what was estimated with ±2σ, and what is true, over time.

    Parameters
    ----------
    estimated, truth, aligned : DataFrame
        Tables of these names; `truth` and `aligned` may be None.
    element : str
        Such as ``bus/18``.
    channels : DataFrame, optional
        Table ``channels``, which tells what is measured where; without it channels are known by
        their names, ``source:element:quantity``.
    methods : sequence of str, optional
        Methods to draw; default: all.
    quantity : str
        ``vm_pu`` or ``va_degree``.
    trial : int
        Trial to draw.
    width : float
        Of the figure. [inch]

    Raises
    ------
    TableError
        If the element has no estimate.
    """
    rows = estimated[(estimated.trial == trial) & (estimated.quantity == quantity)]
    own = rows[rows.element == element]
    if own.empty:
        known = ", ".join(rows.element.drop_duplicates().head(5))
        raise TableError(
            f"no estimate of {quantity} at {element!r} in trial {trial}; expected an element such "
            f"as {known}"
        )
    figure = paper(width, 2.7 if width > SINGLE else 2.5)
    ax = figure.subplots()
    colours = method_colours(dict.fromkeys(estimated.method))
    for name in methods if methods is not None else colours:
        one = own[own.method == name].sort_values("time_utc")
        low, high = one.value - 2 * one.sigma, one.value + 2 * one.sigma
        ax.fill_between(one.time_utc, low, high, color=colours[name], alpha=0.22, lw=0)
        ax.plot(one.time_utc, one.value, color=colours[name], label=f"{name} ±2σ")
    if truth is not None:
        true = truth[(truth.trial == trial) & (truth.element == element)]
        true = true[true.quantity == quantity].sort_values("time_utc")
        ax.plot(true.time_utc, true.value, color=TRUTH, lw=1.0, ls=(0, (4, 1.5)), label="true")
    if aligned is not None:
        source = _sources(aligned.channel, channels, element, quantity)
        inside = aligned.time_utc.between(own.time_utc.min(), own.time_utc.max())
        fresh = (aligned.trial == trial) & (aligned.origin == "measured")
        seen = aligned.assign(source=source)[source.notna() & inside & fresh]
        scale = 180.0 / np.pi if quantity == "va_degree" else 1.0
        for source, part in seen.groupby("source", sort=False):
            colour = SOURCES.get(str(source), MEASURED)
            label = f"measured, {source}"
            ax.plot(part.sample_utc, scale * part.value_pu, ".", ms=3, color=colour, label=label)
    unit = UNIT[UNITS[Quantity(quantity)][0]]
    ax.set_ylabel(f"{SYMBOL[quantity]} at {element.replace('/', ' ')} [{unit}]")
    time_axis(ax, width)
    legend(figure, ax)
    return figure


def _sources(
    named: pd.Series, channels: pd.DataFrame | None, element: str, quantity: str
) -> pd.Series:
    """Source of the channels that measure a quantity of an element, NaN for all others."""
    if channels is None:
        ends = named.str.endswith(f":{element}:{quantity}")
        return named.str.split(":").str[0].where(ends)
    own = channels[(channels.element == element) & (channels.quantity == quantity)]
    return named.map(dict(zip(own.channel, own.source, strict=True)))


@styled
def flags(
    validated: pd.DataFrame,
    channel: str,
    *,
    sample_truth: pd.DataFrame | None = None,
    window: tuple[pd.Timestamp, pd.Timestamp] | None = None,
    unit: str | None = None,
    trial: int = 0,
    width: float = DOUBLE,
) -> Paper:
    """The samples of a channel, with those that the checks flagged marked by reason.

    Parameters
    ----------
    validated : DataFrame
        Table of that name.
    channel : str
        Such as ``scada:bus/6:vm_pu``.
    sample_truth : DataFrame, optional
        Draws the true value of each sample.
    window : pair of Timestamp, optional
        Samples stamped from the first to the second are drawn; default: all.
    unit : str, optional
        The channel's unit; default: the one that its quantity's name carries.
    trial : int
        Trial to draw.
    width : float
        Of the figure. [inch]

    Raises
    ------
    TableError
        If the channel has no sample.
    """
    own = validated[(validated.trial == trial) & (validated.channel == channel)]
    own = own.sort_values("time_utc", kind="stable")
    if own.empty:
        known = ", ".join(validated.channel.drop_duplicates().head(5))
        raise TableError(
            f"no sample of channel {channel!r} in trial {trial}; expected a channel such as {known}"
        )
    if window is not None:
        own = own[own.time_utc.between(*map(pd.Timestamp, window))]
    figure = paper(width, 2.5)
    ax = figure.subplots()
    if sample_truth is not None:
        true = sample_truth[(sample_truth.trial == trial) & (sample_truth.channel == channel)]
        true = true[true.seq.isin(own.seq)].sort_values("time_utc")
        ax.plot(true.time_utc, true.value, color=TRUTH, lw=0.8, label="true", zorder=2.5)
    good = own[own.flag == Flag.GOOD]
    ax.plot(good.time_utc, good.value, ".", ms=2.5, color=MEASURED, label="good")
    bits = own.reasons.to_numpy()
    top = ax.get_xaxis_transform()
    for marker, reason in zip(_MARKERS, (r for r in Reason if r), strict=False):
        hit = own[((bits & int(reason)) != 0) & (own.flag > Flag.GOOD).to_numpy()]
        if hit.empty:
            continue
        name = str(reason.name).lower().replace("_", " ")
        colour = REASONS[reason] if reason != Reason.NOT_FINITE else TRUTH
        style: dict[str, Any] = {
            "ls": "none",
            "marker": marker,
            "mec": colour,
            "mfc": "none",
            "mew": 1.1,
            "ms": 5,
        }
        # A sample without a value is marked at the foot of the plot, at its time.
        known = hit[np.isfinite(hit.value)]
        label = f"{name} ({len(hit)})"
        ax.plot(known.time_utc, known.value, label=label, **style)
        absent = hit[~np.isfinite(hit.value)]
        if len(absent):
            ax.plot(absent.time_utc, np.full(len(absent), 0.03), transform=top, **style)
    quantity = channel.rsplit(":", 1)[-1]
    named = unit or (UNITS[Quantity(quantity)][0] if quantity in SYMBOL else "")
    symbol = SYMBOL.get(quantity, quantity)
    ax.set_ylabel(f"{symbol} [{UNIT.get(named, named)}]")
    ax.set_title(channel, loc="left")
    time_axis(ax, width)
    legend(figure, ax)
    return figure
