"""Recording of a case that is about the checks alone: what was found, and from which size on."""

from __future__ import annotations

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import BLUE, GREEN, ORANGE, VERMILION
from pse_analysis.recording import marks, views
from pse_analysis.recording.take import MAX_SERIES, Take
from pse_analysis.vocabulary import FaultKind, Flag

N_BIN = 12
"""Bars of the share found by size."""

_KEY = ["trial", "channel", "seq"]


def detected(
    take: Take,
    validated: pd.DataFrame,
    channels: pd.DataFrame,
    faults: pd.DataFrame | None,
    *,
    summary_markdown: str,
) -> None:
    """Record how well the checks did: the score, the statistic they decide by, and spikes by size.

    Parameters
    ----------
    take : Take
        Its trial is drawn; summary and bars speak of all.
    validated, channels : DataFrame
        Tables of these names.
    faults : DataFrame, optional
        Known for simulated telemetry only.
    summary_markdown : str
        The table of detection.
    """
    window = take.window(validated.time_utc)
    known = (
        validated.iloc[:0].assign(kind="", size=0.0)
        if faults is None
        else _paired(validated, faults)
    )
    names = [str(name) for name in channels.channel][:MAX_SERIES]
    own = take.of(validated).sort_values("time_utc", kind="stable")
    units = channels.set_index("channel").unit
    plots = []
    for name in names:
        part = own[own.channel == name]
        limit = part.threshold.where(part.time_utc >= window.start)
        top = [0.0, 3.0 * float(limit.median())] if limit.notna().any() else [0.0, 1.0]
        title = f"{name.replace(':', ' ')}: surprise and threshold [{units[name]}]"
        plots.append(window.plot(marks.entity_path("decided", name), title, top, zero=True))
    charts: list[rrb.View] = []
    sizes = {name: _by_size(known[known.channel == name]) for name in names}
    sizes = {name: table for name, table in sizes.items() if len(table)}
    for name, table in sizes.items():
        legend = rrb.PlotLegend(visible=True)
        end = f"{table.index[-1]:.3g} {units[name]}"
        title = f"{name.replace(':', ' ')}: spikes by size, in {N_BIN} groups from 0 to {end}"
        charts.append(
            rrb.BarChartView(
                origin=marks.entity_path("sizes", name), name=title, plot_legend=legend
            )
        )
    lower: list[rrb.Container] = [rrb.Tabs(*charts)] if charts else []
    blueprint = views.columns(
        views.page("text/scored", "score"), rrb.Vertical(rrb.Tabs(*plots), *lower), shares=[1, 1]
    )
    with take.open(blueprint) as stream:
        for name in names:
            kinds = take.of(known[known.channel == name]).set_index("seq").kind
            _draw(stream, name, own[own.channel == name], kinds)
        for name, table in sizes.items():
            entity = marks.entity_path("sizes", name)
            marks.bars(stream, entity, table, {"found": GREEN, "missed": VERMILION})
        marks.page(stream, "text/scored", _text(summary_markdown, take, bool(sizes)))


def _paired(validated: pd.DataFrame, faults: pd.DataFrame) -> pd.DataFrame:
    """Faults that arrived as a sample, with the flag that the sample got."""
    present = faults[faults.seq.notna() & (faults.kind != FaultKind.LOST)]
    present = present.assign(seq=present.seq.astype("int64"))[[*_KEY, "kind", "size"]]
    return present.merge(validated, on=_KEY, how="inner")


def _by_size(known: pd.DataFrame) -> pd.DataFrame:
    """Found and missed spikes in `N_BIN` bins of |size|; index: upper end of the bin."""
    spikes = known[known.kind == FaultKind.SPIKE]
    if spikes.empty:
        return pd.DataFrame()
    size = spikes["size"].abs().to_numpy()
    edges = np.linspace(0.0, size.max(), N_BIN + 1)
    at = np.clip(np.digitize(size, edges) - 1, 0, N_BIN - 1)
    found = (spikes.flag > Flag.GOOD).to_numpy()
    return pd.DataFrame(
        {
            "found": np.bincount(at[found], minlength=N_BIN),
            "missed": np.bincount(at[~found], minlength=N_BIN),
        },
        index=pd.Index(edges[1:], name="size"),
    )


def _draw(stream: rr.RecordingStream, name: str, own: pd.DataFrame, kinds: pd.Series) -> None:
    """What the checks compared, and the threshold; a dot per finding, coloured by its rightness."""
    entity = marks.entity_path("decided", name)
    decided = own[own.statistic.notna() & own.threshold.notna()]
    line = marks.named("threshold", decided.time_utc, decided.threshold)
    marks.lines(stream, f"{entity}/2_threshold", line, [marks.BOUND], width=1.5)
    faulty = decided.seq.isin(kinds.index).to_numpy()
    flagged = (decided.flag > Flag.GOOD).to_numpy()
    for part, label, chosen, colour, size in (
        ("1_good", "good, passed", ~faulty & ~flagged, BLUE, 1.2),
        ("3_found", "fault, found", faulty & flagged, GREEN, 4.0),
        ("4_missed", "fault, missed", faulty & ~flagged, VERMILION, 4.0),
        ("5_alarm", "false alarm", ~faulty & flagged, ORANGE, 4.0),
    ):
        some = decided[chosen]
        frame = marks.named(label, some.time_utc, some.statistic)
        marks.dots(stream, f"{entity}/{part}", frame, [colour], size)


def _text(summary: str, take: Take, sized: bool) -> list[str]:
    text = [
        summary.strip(),
        "## What is to be seen",
        f"**Right, above**, a tab per channel, trial {take.trial}: the surprise of each sample, "
        "its deviation from the last good value or from the extrapolation, and the grey "
        "threshold. *Green* is a fault that was found, *vermilion* one that was missed, *orange* "
        "a false alarm. A gap raises the threshold; a true step raises alarms until it is "
        "confirmed.",
    ]
    if sized:
        text.append(
            "**Right, below**, a tab per channel: injected spikes of all trials by size, found in "
            "green and missed in vermilion. Small ones hide in the load's own movement."
        )
    return text
