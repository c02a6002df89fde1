"""The look that all figures share: size, type, colours of axes, and where legends stand."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

SINGLE = 3.5
"""Width of one column of a journal page. [inch]"""

DOUBLE = 7.16
"""Width of both columns. [inch]"""

TRUTH = "#000000"
MEASURED = "#777777"
SYMBOL: Mapping[str, str] = {
    "vm_pu": "|V|",
    "va_degree": "Angle of V",
    "p_mw": "P",
    "q_mvar": "Q",
    "i_ka": "|I|",
    "ia_degree": "Angle of I",
}
UNIT: Mapping[str, str] = {
    "pu": "p.u.",
    "degree": "°",
    "rad": "rad",
    "mw": "MW",
    "mvar": "Mvar",
    "ka": "kA",
    "kv": "kV",
    "kw": "kW",
    "kvar": "kvar",
    "a": "A",
}
_STYLE: Mapping[str, Any] = {
    "font.size": 8.0,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.color": "#DDDDDD",
    "lines.linewidth": 1.0,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "figure.dpi": 150.0,
    "timezone": "UTC",
}
P = ParamSpec("P")


class Paper(Figure):  # type: ignore[misc]
    """A figure that a notebook shows without pyplot having been imported."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png", bbox_inches="tight")
        return stream.getvalue()


def styled(draw: Callable[P, Paper]) -> Callable[P, Paper]:
    @functools.wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> Paper:
        with mpl.rc_context(dict(_STYLE)):
            figure = draw(*args, **kwargs)
            # Some texts read the style when they are laid out: do that once in here.
            figure.draw_without_rendering()
            return figure

    return inside


def paper(width: float, height: float) -> Paper:
    return Paper(figsize=(width, height), layout="constrained")


def thousandths(unit: str) -> tuple[float, str]:
    """Factor and unit in which a person reads small errors; angles in degrees."""
    if unit == "pu":
        return 1e3, "10⁻³ p.u."
    if unit == "rad":
        return 1e3 * 180.0 / np.pi, "10⁻³ °"
    if unit == "degree":
        return 1e3, "10⁻³ °"
    return 1.0, unit


def time_axis(ax: Axes, width: float) -> None:
    """Ticks in UTC, short where the day need not be said again."""
    locator = AutoDateLocator(minticks=3, maxticks=9 if width > SINGLE else 5)
    ax.xaxis.set_major_locator(locator)
    # The offset would repeat the date of the last tick; only the year is missing at the ticks.
    formatter = ConciseDateFormatter(
        locator,
        zero_formats=["", "%Y", "%b", "%-d %b", "%H:%M", "%H:%M"],
        offset_formats=["", "%Y", "%b %Y", "%Y", "%Y", "%Y"],
    )
    ax.xaxis.set_major_formatter(formatter)
    ax.set_xlabel("Time [UTC]")
    ax.margins(x=0.01)


def legend(figure: Paper, *axes: Axes) -> None:
    """Above the axes, in as many columns as fit, so that it never hides data."""
    named: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    if not named:
        return
    # Bounds are read after the methods that they are compared with.
    labels = sorted(named, key=lambda label: label.startswith(("95", "99")))
    # A letter is about 0.058 inch wide; handle and gap take 0.5 inch.
    wide = [0.058 * len(label) + 0.5 for label in labels]
    fits = sum(wide) <= figure.get_figwidth()
    columns = len(labels) if fits else max(1, int(figure.get_figwidth() / max(wide)))
    handles = [named[label] for label in labels]
    figure.legend(handles, labels, loc="outside upper center", ncols=columns)
