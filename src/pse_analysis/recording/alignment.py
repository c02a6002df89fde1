"""Recording of what was put on the instants."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import GREEN, GREY, ORANGE, PURPLE, SOURCES
from pse_analysis.recording import marks, views
from pse_analysis.recording.take import MAX_LANES, Take, coded

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


def aligned(
    take: Take,
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    *,
    truth: pd.DataFrame | None = None,
    elements: Sequence[str] | None = None,
    variant: str | None = None,
) -> None:
    """Record what each instant had to work with.

    Parameters
    ----------
    take : Take
    aligned, channels, truth : DataFrame
        Tables of these names; `truth` is known for simulated cases only.
    elements : sequence of str, optional
        Elements to plot, such as ``bus/18``; default: four, those with a measured voltage first.
    variant : str, optional
        Variant to draw; default: the first.
    """
    table = take.of(aligned)
    if variant is None and len(table):
        variant = str(table.variant.iloc[0])
    table = table[table.variant == variant].merge(
        channels[["channel", "source", "quantity", "element"]], on="channel", how="left"
    )
    table = coded(table, "channel", "source", "quantity", "element", "origin")
    true = None if truth is None else take.of(truth)
    window = take.window(table.time_utc)
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

    blueprint = views.columns(
        rrb.Vertical(
            rrb.Tabs(*series, name="values"),
            rrb.Horizontal(
                window.plot("available", "channels with a value", number, zero=True),
                window.plot("age", "mean age of the values [s]", age, zero=True),
            ),
            window.lanes("origin", "origin by channel"),
            row_shares=[4, 3, 5],
        ),
        views.page("text/aligned", "what the instants hold"),
        shares=[5, 2],
    )
    with take.open(blueprint) as stream:
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
        text = _aligned_text(take, variant, table, len(channels), len(shown), true)
        marks.page(stream, "text/aligned", text)


def _draw_aligned(
    stream: rr.RecordingStream, entity: str, own: pd.DataFrame, true: pd.DataFrame | None
) -> None:
    quantity = own.quantity.iloc[0]
    # Of a grid's true values only |V| has the unit of the aligned ones without the base power.
    if true is not None and quantity in ("vm_pu", "rotor_angle_rad"):
        line = true[(true.element == own.element.iloc[0]) & (true.quantity == quantity)]
        frame = marks.named("true value", line.time_utc, line.value)
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
    take: Take,
    variant: str | None,
    table: pd.DataFrame,
    n_channel: int,
    n_shown: int,
    true: pd.DataFrame | None,
) -> list[str]:
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
    return [
        f"# {take.case}: values at the instants",
        f"Trial {take.trial} of the case, variant `{variant}`: {table.time_utc.nunique():,} "
        f"instants. {table.channel.nunique()} of {n_channel} channels ever have a value; "
        f"{n_shown} have a lane{some}.",
        marks.markdown_table(head, rows),
        "**Above**, one tab each: values in per unit with their ±σ band, which grows with age."
        + ("" if true is None else " The grey line is the true value."),
        "**Middle**: how many channels of each source have a value, and how old it is.",
        "**Below**, a lane per channel: bright green is a new measurement, dark green one that "
        "is used again, orange a forecast in its place; a gap means that no value was young "
        "enough.",
    ]


def _best_metered(table: pd.DataFrame, limit: int = 4) -> list[str]:
    """Elements with a measured voltage first, then those with most quantities."""
    kinds = table.groupby("element", sort=False, observed=True).quantity.unique()
    rank = {str(e): ("vm_pu" in set(q), len(q)) for e, q in kinds.items()}
    return sorted(rank, key=lambda element: rank[element], reverse=True)[:limit]
