"""Figures that hold several filters beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from pse_analysis.arrays import FloatArray
from pse_analysis.drawing import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from pse_analysis.errors import TableError
from pse_analysis.figures.paper import DOUBLE, MEASURED, TRUTH, Paper, legend, paper, styled

_COLOURS = (BLUE, SKY, ORANGE, GREEN, VERMILION, PURPLE)
_OWN = {"true": TRUTH, "measured": MEASURED}


@styled
def curves(
    x: FloatArray,
    panels: Mapping[str, Mapping[str, FloatArray]],
    label: str,
    *,
    log_x: bool = False,
    log_y: bool = False,
    order: Sequence[str] = (),
    width: float = DOUBLE,
) -> Paper:
    """Curves by name in panels side by side, with one colour per name.

    Parameters
    ----------
    x : (k,) ndarray
        Common axis.
    panels : mapping of str to mapping of str to (k,) ndarray
        Curves by name, by the label of the vertical axis; "true" is black, "measured" grey.
    label : str
        Of the horizontal axis.
    log_x, log_y : bool
    order : sequence of str
        Names in the order of their colours, so that a filter looks alike in every figure.
    width : float
        Of the figure. [inch]

    Raises
    ------
    TableError
        If a curve is not as long as the axis.
    """
    figure = paper(width, 2.6)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    shown = (*order, *(name for part in panels.values() for name in part))
    names = [name for name in dict.fromkeys(shown) if name not in _OWN]
    colour = {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(names)} | _OWN
    for ax, (title, part) in zip(axes, panels.items(), strict=True):
        for name, y in part.items():
            if np.shape(y) != np.shape(x):
                raise TableError(
                    f"curves: {name!r} has shape {np.shape(y)}: expected that of x, {np.shape(x)}"
                )
            marker = "o" if len(x) <= 12 else ""
            ax.plot(x, y, color=colour[name], label=name, marker=marker, markersize=3.0)
        ax.set_xlabel(label)
        ax.set_ylabel(title)
        if log_x:
            ax.set_xscale("log")
            if len(x) <= 6:
                ax.set_xticks(x, [f"{value:g}" for value in x])
                ax.xaxis.set_minor_locator(NullLocator())
        elif np.issubdtype(np.asarray(x).dtype, np.integer):
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        if log_y:
            _logarithmic(ax)
    legend(figure, *axes)
    return figure


def _logarithmic(ax: Axes) -> None:
    """Label 1, 2 and 5 where there are few decades, and powers of ten where there are many."""
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    if high < 500.0 * low:
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(LogLocator(subs="all"))
    ax.yaxis.set_minor_formatter(NullFormatter())
