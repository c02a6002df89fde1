"""The grid as a drawing."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize

from pse_analysis.drawing import layout, sequential
from pse_analysis.figures.paper import DOUBLE, Paper, paper, styled
from pse_analysis.grid.network import Network


@styled
def grid(
    network: Network,
    values: npt.ArrayLike | None = None,
    label: str = "",
    *,
    largest: float | None = None,
    width: float = DOUBLE,
) -> Paper:
    """One-line drawing of the grid, its buses coloured by a value.

    Parameters
    ----------
    network : Network
        Branches out of service are drawn dotted.
    values : (n_bus,) array_like, optional
        From zero up; NaN is drawn grey.
    label : str
        What the colours mean, with the unit.
    largest : float, optional
        End of the colour scale; default: the largest value.
    width : float
        Of the figure. [inch]
    """
    xy = layout(network)
    span = xy.max(axis=0) - xy.min(axis=0) + 1.2
    height = float(np.clip(width * span[1] / span[0], 1.3, 1.1 * width))
    figure = paper(width, height + (0.55 if values is not None else 0.0))
    ax = figure.subplots()
    ends = np.stack([network.branches.from_bus, network.branches.to_bus], axis=1)
    live = network.branches.in_service
    ax.add_collection(LineCollection(list(xy[ends[live]]), colors="#444444", lw=1.0, zorder=1))
    ax.add_collection(
        LineCollection(list(xy[ends[~live]]), colors="#BBBBBB", lw=0.8, ls=":", zorder=0)
    )
    points_per_hop = 72.0 * min(width / span[0], height / span[1])
    size = float(np.clip(0.62 * points_per_hop, 3.0, 15.0))
    if values is None:
        colours = np.full((network.n_bus, 3), 235, dtype=np.uint8)
        end = 1.0
    else:
        v = np.asarray(values, dtype=np.float64)
        end = float(largest if largest is not None else np.nanmax(v))
        colours = sequential(v, end)
        steps = ListedColormap(sequential(np.linspace(0, 1, 256), 1.0) / 255.0)
        scale = mpl.cm.ScalarMappable(Normalize(0.0, end), steps)
        figure.colorbar(
            scale, ax=ax, orientation="horizontal", label=label, fraction=0.06, pad=0.02, aspect=50
        )
    ax.scatter(
        xy[:, 0],
        xy[:, 1],
        s=size**2,
        c=colours / 255.0,
        edgecolors="#444444",
        linewidths=0.5,
        zorder=2,
    )
    dark = colours @ np.array([0.299, 0.587, 0.114]) < 128
    if size >= 7.0:
        for (x, y), name, on_dark in zip(xy, network.buses.name, dark, strict=True):
            colour = "white" if on_dark else "black"
            letters = min(0.52 * size, 7.0)
            ax.text(x, y, name, color=colour, zorder=3, ha="center", va="center", size=letters)
    ax.set_aspect("equal")
    low, high = xy.min(axis=0) - 0.6, xy.max(axis=0) + 0.6
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.axis("off")
    return figure
