"""The marks that recordings are made of: lines, dots, bands, lanes, a grid, a page of text.

Everything known about Rerun's archetypes is here, so that a change of its interface meets one file.
Samples go in as columns, never row by row, and several series of the same instants go into one
entity: the viewer slows down with the number of entities, not with the number of samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import layout, round_up, sequential
from pse_analysis.grid.network import Network

APPLICATION = "pse_analysis"
TIMELINE = "time"
TRUTH = "#B4B4B4"
BOUND = "#8C8C8C"

# Signs that the viewer's font lacks; its headless mode stops on them.
_SPELLED = {"∠": "angle "}

# Of the grid's drawing: distance of neighbours, radius of a bus, and the row of discs below it
# that is its colour scale.
_HOP = 40.0
_DISC = 14.0
_SCALE_STEP = 2.2 * _DISC
_N_TICK = 6


@contextmanager
def recording(
    path: str | Path, case: str, blueprint: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """A stream into one file; all files of a case share an id, so the viewer shows them as one.

    Parameters
    ----------
    path : str or Path
        The ``.rrd`` file to write; replaced if it exists.
    case : str
        Name of the case.
    blueprint : Blueprint
        What the viewer opens on.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=f"{APPLICATION}-{case}")
    stream.save(path, default_blueprint=blueprint)
    try:
        stream.send_recording_name(case)
        yield stream
    finally:
        stream.flush()
        stream.disconnect()


def time_column(times: pd.Series | pd.DatetimeIndex) -> rr.TimeColumn:
    """Instants as Rerun wants them: UTC without a time zone, in nanoseconds."""
    index = pd.DatetimeIndex(times)
    if index.tz is not None:
        index = index.tz_convert("UTC").tz_localize(None)
    return rr.TimeColumn(TIMELINE, timestamp=index.as_unit("ns").to_numpy())


def lines(
    stream: rr.RecordingStream,
    entity: str,
    frame: pd.DataFrame,
    colours: Sequence[str] | None = None,
    width: float = 1.5,
) -> None:
    """One line per column of the frame, all in one entity.

    Parameters
    ----------
    stream : RecordingStream
        Where to.
    entity : str
        Entity path.
    frame : (n_instant, n_series) DataFrame
        Index: instants; columns: what the legend says; NaN makes a gap.
    colours : sequence of str, optional
        One per column; the viewer's own where absent.
    width : float
        Of the stroke, in points.
    """
    if frame.empty:
        return
    style = rr.SeriesLines(
        names=[str(name) for name in frame.columns],
        widths=[width] * frame.shape[1],
        colors=None if colours is None else [_rgb(colour) for colour in colours],
    )
    stream.log(entity, style, static=True)
    _scalars(stream, entity, frame)


def dots(
    stream: rr.RecordingStream,
    entity: str,
    frame: pd.DataFrame,
    colours: Sequence[str],
    size: float = 2.5,
    marker: str = "circle",
) -> None:
    """One row of dots per column of the frame, all in one entity; see `lines`."""
    if frame.empty:
        return
    style = rr.SeriesPoints(
        names=[str(name) for name in frame.columns],
        colors=[_rgb(colour) for colour in colours],
        marker_sizes=[size] * frame.shape[1],
        markers=[marker] * frame.shape[1],
    )
    stream.log(entity, style, static=True)
    _scalars(stream, entity, frame)


def _scalars(stream: rr.RecordingStream, entity: str, frame: pd.DataFrame) -> None:
    columns = rr.Scalars.columns(scalars=frame.to_numpy(dtype=np.float64).reshape(-1))
    stream.send_columns(
        entity,
        indexes=[time_column(pd.DatetimeIndex(frame.index))],
        columns=columns.partition([frame.shape[1]] * len(frame)),
    )


def band(
    stream: rr.RecordingStream,
    entity: str,
    value: pd.Series,
    sigma: pd.Series,
    name: str,
    colour: str,
) -> None:
    """A line with its ±σ band; the only use of Rerun's ``Measurements``, which is marked unstable.

    Parameters
    ----------
    stream : RecordingStream
        Where to.
    entity : str
        Entity path.
    value, sigma : (n,) Series
        Index: instants. A value that is not finite is left out.
    name, colour : str
        For the legend.
    """
    known = np.isfinite(value.to_numpy())
    if not known.any():
        return
    style = rr.Measurements.from_fields(names=[name], colors=[_rgb(colour)])
    stream.log(entity, style, static=True)
    stream.send_columns(
        entity,
        indexes=[time_column(pd.DatetimeIndex(value.index[known]))],
        columns=rr.Measurements.columns(
            values=value.to_numpy(dtype=np.float64)[known],
            variances=sigma.fillna(0.0).to_numpy(dtype=np.float64)[known] ** 2,
        ),
    )


def lane(
    stream: rr.RecordingStream,
    entity: str,
    times: pd.DatetimeIndex,
    states: Sequence[str | None],
    colours: Mapping[str, str],
    quiet: Sequence[str] = (),
) -> None:
    """A lane of states, stored only where the state changes.

    Parameters
    ----------
    stream : RecordingStream
        Where to.
    entity : str
        Entity path; its last part names the lane.
    times : (n,) DatetimeIndex
        In ascending order.
    states : (n,) sequence of str or None
        None leaves a gap.
    colours : mapping
        Colour by state.
    quiet : sequence of str
        States whose name is not written into the lane, because they are the usual ones.
    """
    if not len(times):
        return
    # An empty string ends a state; None would become the word.
    state = np.array([s or "" for s in states], dtype=object)
    change = np.concatenate([[True], state[1:] != state[:-1]])
    seen = [s for s in dict.fromkeys(state) if s]
    stream.log(
        entity,
        rr.StateConfiguration(
            values=seen,
            labels=[" " if s in quiet else s for s in seen],
            colors=[_rgb(colours.get(s, BOUND)) for s in seen],
        ),
        static=True,
    )
    stream.send_columns(
        entity,
        indexes=[time_column(times[change])],
        columns=rr.StateChange.columns(state=list(state[change])),
    )


def grid(
    stream: rr.RecordingStream,
    entity: str,
    network: Network,
    values: pd.DataFrame,
    *,
    largest: float,
    scale: float,
    unit: str,
) -> None:
    """The grid as a graph whose buses change their colour over time, with its colour scale below.

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


def grid_view(origin: str, name: str, network: Network) -> rrb.GraphView:
    """A view that holds the whole of what `grid` draws."""
    xy = layout(network)
    wide, high = (xy.max(axis=0) - xy.min(axis=0)) * _HOP
    wide = max(wide, _N_TICK * _SCALE_STEP)
    bounds = rrb.VisualBounds2D(x_range=(-40.0, wide + 40.0), y_range=(-high - 40.0, 2.8 * _HOP))
    return rrb.GraphView(origin=origin, name=name, visual_bounds=bounds)


def bars(
    stream: rr.RecordingStream, entity: str, values: pd.DataFrame, colours: Mapping[str, str]
) -> None:
    """Bars side by side: a group per row, numbered from 1, and in it a bar per column."""
    share = 0.8 / max(values.shape[1], 1)
    for number, name in enumerate(values.columns):
        height = np.nan_to_num(values[name].to_numpy(dtype=np.float64))
        left = np.arange(1, len(height) + 1) + share * (number - (values.shape[1] - 1) / 2)
        chart = rr.BarChart(
            height, abscissa=left, widths=[share] * len(height), color=_rgb(colours[name])
        )
        stream.log(f"{entity}/{name}", chart, static=True)


def page(stream: rr.RecordingStream, entity: str, markdown: str) -> None:
    """A page of text."""
    for missing, spelled in _SPELLED.items():
        markdown = markdown.replace(missing, spelled)
    document = rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN)
    stream.log(entity, document, static=True)


@dataclass(frozen=True)
class Window:
    """The time that plots open on."""

    start: pd.Timestamp
    end: pd.Timestamp

    def axis(self) -> rrb.TimeAxis:
        """Time axis with a small margin, without which the labels at both ends are cut off."""
        margin = 0.04 * (self.end - self.start)
        bounds = [
            rr.TimeRangeBoundary.absolute(nanos=moment.as_unit("ns").value)
            for moment in (self.start - margin, self.end + margin)
        ]
        return rrb.TimeAxis(view_range=rr.TimeRange(start=bounds[0], end=bounds[1]))

    def plot(
        self,
        origin: str,
        name: str,
        values: npt.ArrayLike,
        *,
        zero: bool = False,
        legend: bool = True,
        contents: Sequence[str] | None = None,
    ) -> rrb.TimeSeriesView:
        """A plot whose vertical axis holds the given values.

        Parameters
        ----------
        origin : str
            Entity path that the plot shows.
        name : str
            Title, with the unit.
        values : array_like
            What must be visible.
        zero : bool
            Whether the axis starts at zero.
        legend : bool
            Whether to name the series.
        contents : sequence of str, optional
            Query of the entities to show; default: everything below the origin.
        """
        v = np.asarray(values, dtype=np.float64)
        v = v[np.isfinite(v)]
        low, high = (float(v.min()), float(v.max())) if v.size else (0.0, 1.0)
        low = 0.0 if zero else low
        margin = 0.06 * (high - low) or 0.05 * max(abs(high), 1e-3)
        return rrb.TimeSeriesView(
            origin=origin,
            contents=contents if contents is not None else "$origin/**",
            name=name,
            axis_x=self.axis(),
            axis_y=rrb.ScalarAxis(range=(low if zero else low - margin, high + margin)),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
        )

    def lanes(self, origin: str, name: str) -> rrb.StateTimelineView:
        """The lanes below an entity path."""
        return rrb.StateTimelineView(origin=origin, name=name, time_view=self.axis())


def entity_path(*parts: str) -> str:
    """Entity path of the parts; ``:`` and ``/`` in a part part it again.

    The viewer prints other signs than letters, digits, ``_``, ``-`` and ``.`` with a backslash.
    """
    return "/".join(
        rr.escape_entity_path_part(piece)
        for part in parts
        for piece in part.replace(":", "/").split("/")
        if piece
    )


def panels(*parts: rrb.BlueprintPart) -> rrb.Blueprint:
    """A blueprint with the panels at the sides folded away."""
    return rrb.Blueprint(
        *parts,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
    )


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table for a page of text."""
    ruler = ["---"] * len(head)
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ruler, *rows))


def scale_end(values: npt.ArrayLike) -> float:
    """A round end for a colour scale that nearly all values lie below."""
    v = np.abs(np.asarray(values, dtype=np.float64))
    v = v[np.isfinite(v)]
    return round_up(float(np.quantile(v, 0.98))) if v.size else 1.0


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def _packed(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint32]:
    """Colours as 0xRRGGBBFF, the form that Rerun takes without looking at each."""
    c = rgb.reshape(-1, 3).astype(np.uint32)
    return np.asarray((c[:, 0] << 24) | (c[:, 1] << 16) | (c[:, 2] << 8) | 0xFF, dtype=np.uint32)
