"""Recordings of the telemetry: what the checks found, and what was put on the instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import GREEN, GREY, ORANGE, PURPLE, REASONS, SKY, SOURCES, VERMILION
from pse_analysis.recording import stream as marks
from pse_analysis.vocabulary import SEVERITY, Flag, Reason, usable

if TYPE_CHECKING:
    from pse_analysis.parameters import Study

MAX_LANES = 40
"""Channels in one picture of lanes; beyond this only those with findings are shown."""

MAX_SERIES = 8
"""Channels whose samples are drawn one by one."""

GOOD, MISSED, LOST = "good", "missed", "lost"
_QUIET = "#33403A"
_ORIGINS = {"measured": GREEN, "held": "#3B5A50", "pseudo": ORANGE, "replaced": PURPLE}
_AXIS = {
    "vm_pu": "|V| [p.u.]",
    "va_degree": "angle of V [rad]",
    "p_mw": "P [p.u.]",
    "q_mvar": "Q [p.u.]",
    "i_ka": "|I| [p.u.]",
    "ia_degree": "angle of I [rad]",
    "rotor_angle_rad": "rotor angle θ [rad]",
    "delta_m_pu": "ΔM [p.u.]",
}


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
        Not drawn here: a sample is compared with `sample_truth`, the value at its own time.
    sample_truth, faults : DataFrame, optional
        Known for simulated telemetry only.
    study : Study, optional
        The plots open on its window; without it, on the whole record.
    trial : int
        Trial to draw.
    """
    del truth
    samples = _coded(of_trial(validated, trial), "channel")
    samples = samples.sort_values("time_utc", kind="stable")
    injected = None if faults is None else of_trial(faults, trial)
    known = None if sample_truth is None else _coded(of_trial(sample_truth, trial), "channel")
    window = open_on(samples.time_utc, study)
    count = samples[samples.flag > Flag.GOOD].groupby("channel", observed=True).size()
    count = count.sort_values(ascending=False, kind="stable")
    shown = _lanes_shown(channels, count, injected)
    # The channels with most findings differ in nothing but bad luck: one per kind of channel first.
    kind = channels.set_index("channel")[["source", "quantity"]].astype(str).agg(" ".join, axis=1)
    order = list(count.index) or [str(name) for name in channels.channel]
    turn = pd.Series(order).groupby([kind.get(name, "") for name in order]).cumcount()
    rest = pd.Series([not name.endswith("vm_pu") for name in order])
    plotted = [order[i] for i in np.lexsort([rest, turn])][:MAX_SERIES]

    units = channels.set_index("channel").unit
    series = []
    for name in plotted:
        own = samples[
            (samples.channel == name) & samples.time_utc.between(window.start, window.end)
        ]
        title = f"{name.replace(':', ' ')} [{units.get(name, '')}]"
        series.append(window.plot(marks.entity_path("telemetry", name), title, own.value))
    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(*series, name="samples"),
                window.lanes("flags", "findings by channel"),
                row_shares=[2, 3],
            ),
            rrb.TextDocumentView(origin="text/validated", name="what was found"),
            column_shares=[5, 2],
        )
    )
    with marks.recording(path, case, blueprint) as stream:
        for name in plotted:
            own = samples[samples.channel == name]
            true = None if known is None else known[known.channel == name]
            _draw_samples(stream, name, own, true)
        for name in shown:
            own = samples[samples.channel == name]
            faulty = None if injected is None else injected[injected.channel == name]
            times, states, colours = _findings(own, faulty)
            marks.lane(stream, marks.entity_path("flags", name), times, states, colours, [GOOD])
        text = _findings_text(case, trial, samples, len(channels), injected, len(shown))
        marks.page(stream, "text/validated", text)


def _draw_samples(
    stream: rr.RecordingStream, name: str, own: pd.DataFrame, true: pd.DataFrame | None
) -> None:
    entity = marks.entity_path("telemetry", name)
    # The viewer draws entities in the order of their names: the truth must not hide in the dots.
    if true is not None and len(true):
        line = true.sort_values("time_utc", kind="stable")
        frame = pd.DataFrame({"true value": line.value.to_numpy()}, index=line.time_utc)
        marks.lines(stream, f"{entity}/2_true", frame, [marks.TRUTH], width=1.8)
    finite = own[np.isfinite(own.value)]
    good = usable(finite.flag)
    for part, label, chosen, colour, size in (
        ("1_usable", "usable sample", good, SKY, 2.0),
        ("3_bad", "flagged bad", ~good, VERMILION, 4.0),
    ):
        some = finite[chosen]
        frame = pd.DataFrame({label: some.value.to_numpy()}, index=some.time_utc)
        marks.dots(stream, f"{entity}/{part}", frame, [colour], size)


def _findings(
    own: pd.DataFrame, faults: pd.DataFrame | None
) -> tuple[pd.DatetimeIndex, list[str], Mapping[str, str]]:
    """What a channel's lane says at each of its samples.

    Real telemetry shows the reasons of the checks. Where the injected faults are known the lane
    also says which of them were found, which were missed, and which findings are false alarms.
    """
    bits = own.reasons.to_numpy()
    names = {int(b): reason_text(int(b)) for b in np.unique(bits)}
    reasons = [names[int(b)] for b in bits]
    if faults is None:
        colours = {text: _reason_colour(b) for b, text in names.items()}
        return pd.DatetimeIndex(own.time_utc), reasons, colours
    kind_of = faults.dropna(subset=["seq"]).drop_duplicates("seq").set_index("seq").kind
    kinds = kind_of.reindex(own.seq).to_numpy()
    flagged = own.flag.to_numpy() > Flag.GOOD
    states, colours = [], {GOOD: _QUIET, LOST: GREY}
    for reason, kind, hit in zip(reasons, kinds, flagged, strict=True):
        if isinstance(kind, str):
            state = f"{kind}: {reason}" if hit else f"{kind}: {MISSED}"
            colours[state] = GREEN if hit else VERMILION
        elif hit:
            state = f"false alarm: {reason}"
            colours[state] = ORANGE
        else:
            state = GOOD
        states.append(state)
    never = faults[faults.seq.isna()]
    times = pd.DatetimeIndex(own.time_utc).append(pd.DatetimeIndex(never.time_utc))
    states += [LOST] * len(never)
    order = np.argsort(times.asi8, kind="stable")
    return times[order], [states[i] for i in order], colours


def reason_text(bits: int) -> str:
    """The reasons of a sample in words."""
    held = [r.name.lower().replace("_", " ") for r in Reason if r.name and bits & r]
    return " + ".join(held) or GOOD


def _reason_colour(bits: int) -> str:
    """Colour of the gravest reason."""
    held = [reason for reason in REASONS if bits & reason]
    return REASONS[max(held, key=lambda reason: SEVERITY[reason])] if held else _QUIET


def _lanes_shown(
    channels: pd.DataFrame, count: pd.Series, injected: pd.DataFrame | None
) -> list[str]:
    """Channels that get a lane, in the order of the channel table."""
    names = [str(name) for name in channels.channel]
    if len(names) <= MAX_LANES:
        return names
    faulty = [] if injected is None else list(dict.fromkeys(injected.channel))
    ranked = set(list(dict.fromkeys([*count.index, *faulty]))[:MAX_LANES])
    return [name for name in names if name in ranked] or names[:MAX_LANES]


def _findings_text(
    case: str,
    trial: int,
    samples: pd.DataFrame,
    n_channel: int,
    injected: pd.DataFrame | None,
    n_shown: int,
) -> str:
    bits = samples.reasons.to_numpy()
    rows = []
    for reason in REASONS:
        hit = samples[(bits & int(reason)) != 0]
        if len(hit):
            rows.append((reason_text(int(reason)), f"{len(hit):,}", f"{hit.channel.nunique()}"))
    flags = [(flag.name.lower(), f"{int((samples.flag == flag).sum()):,}") for flag in Flag]
    some = " (those with findings)" if n_shown < n_channel else ""
    text = [
        f"# {case}: telemetry after the checks",
        f"Trial {trial} of the case, history before the study included: {len(samples):,} samples "
        f"of {n_channel} channels. "
        f"{n_shown} channels have a lane{some}.",
        marks.markdown_table(("flag", "samples"), flags),
        marks.markdown_table(("reason", "samples", "channels"), rows)
        if rows
        else "**No sample was flagged.**",
    ]
    if injected is not None:
        sizes = injected.groupby("kind").size()
        kinds = [(str(kind), f"{n:,}") for kind, n in sizes.items()]
        text.append(marks.markdown_table(("injected fault", "samples"), kinds))
        text.append("**Above**, one tab each: the channels with most findings. Small dots are "
                    "usable samples, large vermilion dots were flagged bad, the grey line is the "
                    "true value.")  # fmt: skip
        text.append("**Below**, a lane per channel: *green* is an injected fault that a check "
                    "found, *vermilion* one that was missed, *orange* a false alarm, *grey* a "
                    "sample that never arrived.")  # fmt: skip
    else:
        text.append("**Above**, one tab each: the channels with most findings. Small dots are "
                    "usable samples, large vermilion dots were flagged bad.")  # fmt: skip
        text.append("**Below**, a lane per channel, coloured where a check found something. "
                    "There is no record of true faults to compare with.")  # fmt: skip
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
        Elements to plot, such as ``bus/18``; default: four, those with a measured voltage first.
    variant : str, optional
        Variant to draw; default: the first.
    trial : int
        Trial to draw.
    """
    table = of_trial(aligned, trial)
    if variant is None and len(table):
        variant = str(table.variant.iloc[0])
    table = table[table.variant == variant].merge(
        channels[["channel", "source", "quantity", "element"]], on="channel", how="left"
    )
    table = _coded(table, "channel", "source", "quantity", "element", "origin")
    true = None if truth is None else of_trial(truth, trial)
    window = open_on(table.time_utc, study)
    chosen = list(elements) if elements is not None else _best_metered(table)
    pairs = [
        (element, str(quantity))
        for quantity in _AXIS
        for element in chosen
        if ((table.element == element) & (table.quantity == quantity)).any()
    ]
    series = []
    for element, quantity in pairs:
        own = table[(table.element == element) & (table.quantity == quantity)]
        origin = marks.entity_path("aligned", element, quantity)
        spread = [own.value_pu - own.sigma_pu, own.value_pu + own.sigma_pu]
        title = f"{element.replace('/', ' ')} {_AXIS[quantity]}"
        series.append(window.plot(origin, title, pd.concat(spread)))
    sources = [source for source in SOURCES if (table.source == source).any()]
    by_source = table.pivot_table(
        index="time_utc", columns="source", values="age_s", aggfunc=["count", "mean"], observed=True
    )
    number = by_source["count"].reindex(columns=sources).fillna(0.0)
    age = by_source["mean"].reindex(columns=sources)
    oldest = (
        table.groupby("channel", observed=True)
        .age_s.mean()
        .sort_values(ascending=False, kind="stable")
    )
    few = set(oldest.index[:MAX_LANES])
    shown = [str(name) for name in channels.channel if name in few]

    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(*series, name="values"),
                rrb.Horizontal(
                    window.plot("available", "channels with a value", number, zero=True),
                    window.plot("age", "mean age of the values [s]", age, zero=True),
                ),
                window.lanes("origin", "origin by channel"),
                row_shares=[4, 3, 5],
            ),
            rrb.TextDocumentView(origin="text/aligned", name="what the instants hold"),
            column_shares=[5, 2],
        )
    )
    with marks.recording(path, case, blueprint) as stream:
        for element, quantity in pairs:
            own = table[(table.element == element) & (table.quantity == quantity)]
            _draw_aligned(stream, marks.entity_path("aligned", element, quantity), own, true)
        colours = [SOURCES[source] for source in sources]
        marks.lines(stream, "available", number, colours, width=2.0)
        marks.lines(stream, "age", age, colours, width=2.0)
        instants = pd.DatetimeIndex(table.time_utc.drop_duplicates().sort_values())
        for name in shown:
            own = table[table.channel == name].set_index("time_utc").origin.reindex(instants)
            states = own.astype(object).fillna("").tolist()
            marks.lane(
                stream,
                marks.entity_path("origin", name),
                instants,
                states,
                _ORIGINS,
                list(_ORIGINS)[:2],
            )
        text = _aligned_text(case, trial, variant, table, len(channels), len(shown), true)
        marks.page(stream, "text/aligned", text)


def _draw_aligned(
    stream: rr.RecordingStream, entity: str, own: pd.DataFrame, true: pd.DataFrame | None
) -> None:
    quantity = own.quantity.iloc[0]
    # Of a grid's true values only |V| has the unit of the aligned ones without the base power.
    if true is not None and quantity in ("vm_pu", "rotor_angle_rad"):
        line = true[(true.element == own.element.iloc[0]) & (true.quantity == quantity)]
        frame = pd.DataFrame({"true value": line.value.to_numpy()}, index=line.time_utc)
        marks.lines(stream, f"{entity}/true", frame, [marks.TRUTH], width=2.5)
    for channel, one in own.groupby("channel", sort=False, observed=True):
        source = str(one.source.iloc[0])
        usual = f"{source}:{one.element.iloc[0]}:{quantity}"
        label = source if str(channel) == usual else str(channel)
        line = one.set_index("time_utc").sort_index()
        colour = SOURCES.get(source, GREY)
        where = marks.entity_path(entity, str(channel))
        marks.band(stream, where, line.value_pu, line.sigma_pu, f"{label} ±σ", colour)


def _aligned_text(
    case: str,
    trial: int,
    variant: str | None,
    table: pd.DataFrame,
    n_channel: int,
    n_shown: int,
    true: pd.DataFrame | None,
) -> str:
    rows = [
        (
            str(source),
            f"{part.channel.nunique()}",
            f"{len(part):,}",
            f"{100 * float((part.origin == 'measured').mean()):.0f} %",
            f"{part.age_s.mean():.0f} s",
            f"{part.age_s.max():.0f} s",
        )
        for source, part in table.groupby("source", sort=False, observed=True)
    ]
    some = " (those with the oldest values)" if n_shown < table.channel.nunique() else ""
    head = ("source", "channels", "values", "new", "mean age", "oldest")
    return "\n\n".join(
        [
            f"# {case}: values at the instants",
            f"Trial {trial} of the case, variant `{variant}`: {table.time_utc.nunique():,} "
            f"instants. {table.channel.nunique()} of {n_channel} channels ever have a value; "
            f"{n_shown} have a lane{some}.",
            marks.markdown_table(head, rows),
            "**Above**, one tab each: values in per unit with their ±σ band, which grows with age."
            + ("" if true is None else " The grey line is the true value."),
            "**Middle**: how many channels of each source have a value, and how old it is.",
            "**Below**, a lane per channel: bright green is a new measurement, dark green one that "
            "is used again; a gap means that no value was young enough.",
        ]
    )


def _best_metered(table: pd.DataFrame, limit: int = 4) -> list[str]:
    """Elements with a measured voltage first, then those with most quantities."""
    kinds = table.groupby("element", sort=False, observed=True).quantity.unique()
    rank = {str(e): ("vm_pu" in set(q), len(q)) for e, q in kinds.items()}
    return sorted(rank, key=lambda element: rank[element], reverse=True)[:limit]


def of_trial(table: pd.DataFrame, trial: int) -> pd.DataFrame:
    """Rows of one trial."""
    return table[table.trial == trial]


def _coded(table: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """The table with texts as categories, among which a search is many times faster."""
    return table.assign(**{name: table[name].astype("category") for name in columns})


def open_on(times: pd.Series, study: Study | None) -> marks.Window:
    """The study window, or everything there is where no study is given."""
    if study is not None:
        return marks.Window(pd.Timestamp(study.start), pd.Timestamp(study.end))
    return marks.Window(times.min(), times.max())
