"""Recordings of the telemetry: what the checks found, and what was put on the instants."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import rerun.blueprint as rrb

from pse_analysis.drawing import GREEN, GREY, ORANGE, PURPLE, REASONS, SKY, SOURCES, VERMILION
from pse_analysis.recording import stream as marks
from pse_analysis.vocabulary import Flag, Reason, usable

if TYPE_CHECKING:
    from pse_analysis.parameters import Study

MAX_LANES = 40
"""Channels in one picture of lanes; beyond this only those with findings are shown."""

MAX_SERIES = 8

GOOD = "good"
_GOOD_COLOUR = "#3A4A42"
_FAULTS = {
    "spike": VERMILION,
    "stale": GREEN,
    "lost": GREY,
    "duplicated": PURPLE,
    "delayed": SKY,
}
_ORIGINS = {"measured": GREEN, "held": "#4F6B60", "pseudo": ORANGE, "replaced": PURPLE}


def validated(
    path: str | Path,
    case: str,
    validated: pd.DataFrame,
    channels: pd.DataFrame,
    *,
    truth: pd.DataFrame | None = None,
    sample_truth: pd.DataFrame | None = None,
    faults: pd.DataFrame | None = None,
    study: Study | None = None,
    trial: int = 0,
) -> None:
    """Record what the checks found in the telemetry.

    Parameters
    ----------
    path : str or Path
        The ``.rrd`` file to write.
    case : str
        Name of the case; it names the recording.
    validated, channels : DataFrame
        Tables of these names.
    truth : DataFrame, optional
        Accepted for symmetry with the other stages; samples are compared with `sample_truth`.
    sample_truth, faults : DataFrame, optional
        Known for simulated telemetry only.
    study : Study, optional
        The plots open on its window; without it, on the whole record.
    trial : int
        Trial to draw.
    """
    del truth
    samples = _of_trial(validated, trial)
    injected = _of_trial(faults, trial)
    start, end = _window(samples.time_utc, study)
    found = samples[samples.flag > Flag.GOOD]
    count = found.groupby("channel").size().sort_values(ascending=False, kind="stable")
    shown = _shown(channels, count, injected)
    plotted = [c for c in shown if c in count.index][:MAX_SERIES] or shown[:MAX_SERIES]
    plotted = sorted(plotted, key=lambda c: -int(count.get(c, 0)))

    axis = marks.window(start, end)
    by_name = channels.set_index("channel")
    series = [
        rrb.TimeSeriesView(
            origin=f"telemetry/{channel}",
            name=f"{channel} [{by_name.unit.get(channel, '')}]",
            axis_x=axis,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
        )
        for channel in plotted
    ]
    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(*series, name="samples"),
                rrb.StateTimelineView(
                    origin="flags", name="flags by channel", time_view=marks.window(start, end)
                ),
                row_shares=[2, 3],
            ),
            rrb.TextDocumentView(origin="text/validated", name="what was found"),
            column_shares=[5, 2],
        )
    )
    with marks.recording(path, case, blueprint) as stream:
        for channel in plotted:
            _series(stream, channel, samples, sample_truth, trial)
        for channel in shown:
            _flag_lanes(stream, channel, samples, injected, by_name, simulated=faults is not None)
        text = _findings_text(case, trial, samples, channels, injected, faults is not None, shown)
        marks.page(stream, "text/validated", text)


def _series(stream, channel, samples, sample_truth, trial):  # type: ignore[no-untyped-def]
    one = samples[samples.channel == channel].sort_values("time_utc", kind="stable")
    entity = f"telemetry/{channel}"
    known = _of_trial(sample_truth, trial)
    if len(known):
        true = known[known.channel == channel].sort_values("time_utc", kind="stable")
        frame = pd.DataFrame({"true": true.value.to_numpy()}, index=true.time_utc)
        marks.lines(stream, f"{entity}/true", frame, [marks.TRUTH], width=2.5)
    finite = one[np.isfinite(one.value)]
    good = finite[usable(finite.flag)]
    bad = finite[~usable(finite.flag)]
    for name, part, colour, size in (
        ("usable", good, SKY, 2.0),
        ("flagged bad", bad, VERMILION, 4.5),
    ):
        frame = pd.DataFrame({name: part.value.to_numpy()}, index=part.time_utc)
        marks.dots(stream, f"{entity}/{name.split()[0]}", frame, [colour], size)


def _flag_lanes(stream, channel, samples, injected, by_name, *, simulated):  # type: ignore[no-untyped-def]
    one = samples[samples.channel == channel].sort_values("time_utc", kind="stable")
    bits = one.reasons.to_numpy()
    kinds = {int(b): _reason_text(int(b)) for b in np.unique(bits)}
    colours = {text: _reason_colour(b) for b, text in kinds.items()}
    states = [kinds[int(b)] for b in bits]
    entity = f"flags/{channel}"
    if simulated:
        marks.lane(stream, f"{entity}/found", pd.DatetimeIndex(one.time_utc), states, colours)
        own = injected[injected.channel == channel]
        times, kinds_at = _intervals(own, float(by_name.period_s.get(channel, 60.0)))
        marks.lane(stream, f"{entity}/injected", times, kinds_at, _FAULTS)
    else:
        marks.lane(stream, entity, pd.DatetimeIndex(one.time_utc), states, colours)


def _intervals(faults: pd.DataFrame, period_s: float) -> tuple[pd.DatetimeIndex, list[str | None]]:
    """Each fault as a state that lasts one period, with a gap after it unless the next follows."""
    own = faults.sort_values("time_utc", kind="stable")
    begin = pd.DatetimeIndex(own.time_utc)
    period = pd.Timedelta(seconds=period_s)
    times: list[pd.Timestamp] = []
    states: list[str | None] = []
    for number, (moment, kind) in enumerate(zip(begin, own.kind, strict=True)):
        times.append(moment)
        states.append(str(kind))
        following = begin[number + 1] if number + 1 < len(begin) else None
        if following is None or following > moment + 1.5 * period:
            times.append(moment + period)
            states.append(None)
    return pd.DatetimeIndex(times), states


def _reason_text(bits: int) -> str:
    text = " + ".join(r.name.lower().replace("_", " ") for r in Reason if bits & r and r.name)
    return text or GOOD


def _reason_colour(bits: int) -> str:
    """Colour of the gravest reason."""
    from pse_analysis.vocabulary import SEVERITY

    held = [reason for reason in REASONS if bits & reason]
    return REASONS[max(held, key=lambda r: SEVERITY[r])] if held else _GOOD_COLOUR


def _shown(channels: pd.DataFrame, count: pd.Series, injected: pd.DataFrame) -> list[str]:
    """Channels that get a lane, in the order of the channel table."""
    names = [str(c) for c in channels.channel]
    if len(names) <= MAX_LANES:
        return names
    with_faults = [c for c in dict.fromkeys(injected.channel) if c not in count.index]
    ranked = [*count.index, *with_faults][:MAX_LANES]
    return [c for c in names if c in set(ranked)] or names[:MAX_LANES]


def _findings_text(case, trial, samples, channels, injected, simulated, shown):  # type: ignore[no-untyped-def]
    rows = []
    for reason in REASONS:
        hit = samples[(samples.reasons.to_numpy() & int(reason)) != 0]
        if len(hit):
            name = reason.name.lower().replace("_", " ")
            rows.append(f"| {name} | {len(hit):,} | {hit.channel.nunique()} |")
    flags = [f"| {flag.name.lower()} | {int((samples.flag == flag).sum()):,} |" for flag in Flag]
    text = [
        f"# {case}: telemetry after the checks",
        f"Trial {trial} of this case; {len(samples):,} samples of {len(channels)} channels, "
        f"{len(shown)} of them drawn"
        + (" (those with most findings)." if len(shown) < len(channels) else "."),
        "| flag | samples |\n|---|---|\n" + "\n".join(flags),
    ]
    if rows:
        text.append("| reason | samples | channels |\n|---|---|---|\n" + "\n".join(rows))
    else:
        text.append("**No sample was flagged.**")
    if simulated:
        kinds = injected.groupby("kind").size()
        lines = [f"| {kind} | {n:,} |" for kind, n in kinds.items()]
        text.append("| injected fault | samples |\n|---|---|\n" + "\n".join(lines))
    text.append(
        "**Above:** samples of the channels with most findings, one tab each; "
        "flagged samples are large and vermilion"
        + (", the true value is the grey line." if simulated else ".")
    )
    text.append(
        "**Below:** a lane per channel, coloured where a check found something"
        + ("; beside it the faults that were put in." if simulated else ".")
    )
    return "\n\n".join(text)


def aligned(
    path: str | Path,
    case: str,
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    *,
    truth: pd.DataFrame | None = None,
    study: Study | None = None,
    elements: Sequence[str] | None = None,
    variant: str | None = None,
    trial: int = 0,
) -> None:
    """Record what each instant had to work with.

    Parameters
    ----------
    path : str or Path
        The ``.rrd`` file to write.
    case : str
        Name of the case.
    aligned, channels, truth : DataFrame
        Tables of these names; `truth` is known for simulated cases only.
    study : Study, optional
        The plots open on its window; without it, on the whole record.
    elements : sequence of str, optional
        Elements to plot, such as ``bus/18``; default: those with the most channels of different
        quantities.
    variant : str, optional
        Variant to draw; default: the first.
    trial : int
        Trial to draw.
    """
    table = _of_trial(aligned, trial)
    if variant is None and len(table):
        variant = str(table.variant.iloc[0])
    table = table[table.variant == variant].merge(
        channels[["channel", "source", "quantity", "element"]], on="channel", how="left"
    )
    start, end = _window(table.time_utc, study)
    chosen = list(elements) if elements is not None else _metered(table)
    quantities = {
        element: list(dict.fromkeys(table.quantity[table.element == element]))
        for element in chosen
    }
    age = table.groupby("channel").age_s.max()
    shown = [str(c) for c in channels.channel if c in age.index]
    if len(shown) > MAX_LANES:
        oldest = set(age.sort_values(ascending=False, kind="stable").index[:MAX_LANES])
        shown = [c for c in shown if c in oldest]

    def plot(origin: str, name: str) -> rrb.TimeSeriesView:
        legend = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
        axis = marks.window(start, end)
        return rrb.TimeSeriesView(origin=origin, name=name, axis_x=axis, plot_legend=legend)

    series = [
        plot(f"aligned/{element}/{quantity}", f"{element} {_label(quantity)}")
        for element in chosen
        for quantity in quantities[element]
    ]
    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(*series, name="values"),
                rrb.Horizontal(
                    plot("available", "channels with a value at the instant"),
                    plot("age", "mean age of the values [s]"),
                ),
                rrb.StateTimelineView(
                    origin="origin", name="origin by channel", time_view=marks.window(start, end)
                ),
                row_shares=[4, 3, 5],
            ),
            rrb.TextDocumentView(origin="text/aligned", name="what the instants hold"),
            column_shares=[5, 2],
        )
    )
    with marks.recording(path, case, blueprint) as stream:
        for element in chosen:
            for quantity in quantities[element]:
                _aligned_series(stream, table, element, quantity, _of_trial(truth, trial))
        sources = [s for s in SOURCES if s in set(table.source)]
        number = table.pivot_table(index="time_utc", columns="source", values="channel",
                                   aggfunc="count")  # fmt: skip
        mean_age = table.pivot_table(index="time_utc", columns="source", values="age_s")
        colours = [SOURCES[s] for s in sources]
        if sources:
            marks.lines(stream, "available", number[sources].fillna(0.0), colours)
            marks.lines(stream, "age", mean_age[sources], colours)
        instants = pd.DatetimeIndex(np.sort(table.time_utc.unique()))
        for channel in shown:
            one = table[table.channel == channel].set_index("time_utc").origin
            states = [s if isinstance(s, str) else None for s in one.reindex(instants)]
            marks.lane(stream, f"origin/{channel}", instants, states, _ORIGINS)
        text = _aligned_text(case, trial, variant, table, channels, shown, truth is not None)
        marks.page(stream, "text/aligned", text)


def _aligned_series(stream, table, element, quantity, truth):  # type: ignore[no-untyped-def]
    entity = f"aligned/{element}/{quantity}"
    # Only |V| has the same unit in both tables: p.u. of the grid's own base.
    true = truth[(truth.element == element) & (truth.quantity == quantity)] if len(truth) else truth
    if quantity == "vm_pu" and len(true):
        frame = pd.DataFrame({"true": true.value.to_numpy()}, index=true.time_utc)
        marks.lines(stream, f"{entity}/true", frame, [marks.TRUTH], width=2.5)
    own = table[(table.element == element) & (table.quantity == quantity)]
    for channel, one in own.groupby("channel", sort=False):
        source = str(one.source.iloc[0])
        colour = SOURCES.get(source, GREY)
        line = one.set_index("time_utc").sort_index()
        name = str(channel).split(":")[0]
        marks.band(stream, f"{entity}/{name}", line.value_pu, line.sigma_pu, name, colour, "p.u.")


def _label(quantity: str) -> str:
    return {
        "vm_pu": "|V| [p.u.]",
        "va_degree": "angle [rad]",
        "p_mw": "P [p.u.]",
        "q_mvar": "Q [p.u.]",
        "i_ka": "|I| [p.u.]",
        "ia_degree": "angle of I [rad]",
    }.get(quantity, quantity)


def _aligned_text(case, trial, variant, table, channels, shown, simulated):  # type: ignore[no-untyped-def]
    rows = []
    for source, part in table.groupby("source", sort=False):
        share = (part.origin == "measured").mean()
        rows.append(
            f"| {source} | {part.channel.nunique()} | {len(part):,} | {100 * share:.0f} % "
            f"| {part.age_s.mean():.0f} s | {part.age_s.max():.0f} s |"
        )
    return "\n\n".join(
        [
            f"# {case}: values at the instants",
            f"Trial {trial}, variant `{variant}`: {table.time_utc.nunique():,} instants, "
            f"{table.channel.nunique()} of {len(channels)} channels ever have a value; "
            f"{len(shown)} are drawn.",
            "| source | channels | values | measured | mean age | oldest |\n|---|---|---|---|---|---|\n"
            + "\n".join(rows),
            "**Above:** values with their ±σ band, which grows with age"
            + ("; the true voltage is the grey line." if simulated else "."),
            "**Middle:** how many channels have a value, and how old it is.",
            "**Below:** where each value comes from; a gap means there was none young enough.",
        ]
    )


def _metered(table: pd.DataFrame, limit: int = 4) -> list[str]:
    """Elements with a measured voltage first, then those with most quantities."""
    kinds = table.groupby("element", sort=False).quantity.unique()
    rank = {str(e): ("vm_pu" in set(q), len(q)) for e, q in kinds.items()}
    return sorted(rank, key=lambda e: rank[e], reverse=True)[:limit]


def _of_trial(table: pd.DataFrame | None, trial: int) -> pd.DataFrame:
    if table is None:
        return pd.DataFrame({"channel": [], "kind": [], "time_utc": []})
    return table[table.trial == trial]


def _window(times: pd.Series, study: Study | None) -> tuple[pd.Timestamp, pd.Timestamp]:
    if study is not None:
        return pd.Timestamp(study.start), pd.Timestamp(study.end)
    return times.min(), times.max()
