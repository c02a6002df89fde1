"""The marks that recordings are made of: lines, dots, bands, lanes, bars, a page of text.

What is known about Rerun is here, in `pse_analysis.recording.grid_graph` and in
`pse_analysis.recording.views`, so that a change of its interface meets few files. Samples go in as
columns, never row by row, and several series of the same instants go into one entity: the viewer
slows down with the number of entities, not with the number of samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import rerun as rr

from pse_analysis.vocabulary import markdown_text

TIMELINE = "time"
TRUTH = "#B4B4B4"
BOUND = "#8C8C8C"

# Signs that the viewer's font lacks; its headless mode stops on them.
_SPELLED = {"∠": "angle "}


def time_column(times: pd.Series | pd.DatetimeIndex) -> rr.TimeColumn:
    """Instants as Rerun wants them: UTC without a time zone, in nanoseconds."""
    index = pd.DatetimeIndex(times)
    if index.tz is not None:
        index = index.tz_convert("UTC").tz_localize(None)
    return rr.TimeColumn(TIMELINE, timestamp=index.as_unit("ns").to_numpy())


def named(label: str, times: pd.Series, values: pd.Series) -> pd.DataFrame:
    """One series as a frame, under the name that its legend shall have."""
    return pd.DataFrame({label: values.to_numpy()}, index=pd.DatetimeIndex(times))


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
        stream.log(named_path(entity, str(name)), chart, static=True)


def page(stream: rr.RecordingStream, entity: str, paragraphs: Sequence[str]) -> None:
    """A page of text from paragraphs of markdown."""
    markdown = "\n\n".join(paragraphs)
    for missing, spelled in _SPELLED.items():
        markdown = markdown.replace(missing, spelled)
    document = rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN)
    stream.log(entity, document, static=True)


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


def named_path(entity: str, name: str) -> str:
    """Entity path of something below another one, whatever its name holds."""
    return f"{entity}/{rr.escape_entity_path_part(name)}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table for a page of text; its cells may hold names from data."""
    ruler = ["---"] * len(head)
    cells = [[markdown_text(cell) for cell in row] for row in rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ruler, *cells))


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
