"""The grid as a graph whose buses change their colour over time, with its colour scale below."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import layout, round_up, sequential
from pse_analysis.grid.network import Network
from pse_analysis.recording.marks import time_column

# Distance of neighbours, radius of a bus, and the row of discs below the grid that is its colour
# scale.
_HOP = 40.0
_DISC = 14.0
_SCALE_STEP = 2.2 * _DISC
_N_TICK = 6


def draw(
    stream: rr.RecordingStream,
    entity: str,
    network: Network,
    values: pd.DataFrame,
    *,
    largest: float,
    scale: float,
    unit: str,
) -> None:
    """Draw the grid.

    Parameters
    ----------
    stream : RecordingStream
        Where to.
    entity : str
        Entity path.
    network : Network
        Branches out of service are not drawn.
    values : (n_instant, n_bus) DataFrame
        Index: instants; columns: bus names in the grid's order.
    largest : float
        Value of the last colour, in the unit of `values`.
    scale : float
        Factor from `values` to `unit`, for the text of the colour scale.
    unit : str
        Unit that the colour scale is labelled with.
    """
    xy = layout(network)
    at = (xy - xy.min(axis=0)) * [_HOP, -_HOP]
    names = list(network.buses.name)
    live = network.branches.in_service
    pairs = zip(network.branches.from_bus[live], network.branches.to_bus[live], strict=True)
    ticks = np.linspace(0.0, largest, _N_TICK)
    foot = np.stack([_SCALE_STEP * np.arange(_N_TICK), np.full(_N_TICK, 1.8 * _HOP)], axis=1)
    # Discs carry no text: a node with text shows its colour in the letters only, and a second
    # entity with the names would be framed by the viewer. Pointing at a disc tells its name.
    nodes = rr.GraphNodes(
        node_ids=[*names, *(f"scale: {tick * scale:g} {unit}" for tick in ticks)],
        positions=np.concatenate([at, foot]),
        radii=[_DISC] * (len(names) + _N_TICK),
        show_labels=False,
    )
    edges = [(names[i], names[j]) for i, j in pairs]
    stream.log(entity, nodes, rr.GraphEdges(edges=edges, graph_type="undirected"), static=True)
    rgb = sequential(values.to_numpy(dtype=np.float64), largest)
    key = np.broadcast_to(sequential(ticks, largest), (len(rgb), _N_TICK, 3))
    colours = np.concatenate([rgb, key], axis=1)
    stream.send_columns(
        entity,
        indexes=[time_column(pd.DatetimeIndex(values.index))],
        columns=rr.GraphNodes.columns(colors=_packed(colours)).partition(
            [colours.shape[1]] * len(colours)
        ),
    )


def view(origin: str, name: str, network: Network) -> rrb.GraphView:
    """A view that holds the whole of what `draw` draws."""
    xy = layout(network)
    wide, high = (xy.max(axis=0) - xy.min(axis=0)) * _HOP
    wide = max(wide, _N_TICK * _SCALE_STEP)
    bounds = rrb.VisualBounds2D(x_range=(-40.0, wide + 40.0), y_range=(-high - 40.0, 2.8 * _HOP))
    return rrb.GraphView(origin=origin, name=name, visual_bounds=bounds)


def scale_end(values: npt.ArrayLike) -> float:
    """A round end for a colour scale that nearly all values lie below."""
    v = np.abs(np.asarray(values, dtype=np.float64))
    v = v[np.isfinite(v)]
    return round_up(float(np.quantile(v, 0.98))) if v.size else 1.0


def _packed(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint32]:
    """Colours as 0xRRGGBBFF, the form that Rerun takes without looking at each."""
    c = rgb.reshape(-1, 3).astype(np.uint32)
    return np.asarray((c[:, 0] << 24) | (c[:, 1] << 16) | (c[:, 2] << 8) | 0xFF, dtype=np.uint32)
