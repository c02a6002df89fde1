"""Recording of the telemetry and of what the checks found."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import GREEN, GREY, ORANGE, REASONS, SKY, VERMILION
from pse_analysis.recording import marks, views
from pse_analysis.recording.take import MAX_LANES, MAX_SERIES, Take, coded
from pse_analysis.vocabulary import SEVERITY, Flag, Reason, usable

GOOD, MISSED, LOST = "good", "missed", "lost"
_QUIET = "#33403A"


def validated(
    take: Take,
    validated: pd.DataFrame,
    channels: pd.DataFrame,
    *,
    sample_truth: pd.DataFrame | None = None,
    faults: pd.DataFrame | None = None,
) -> None:
    """Record what the checks found in the telemetry.

    Parameters
    ----------
    take : Take
    validated, channels : DataFrame
        Tables of these names.
    sample_truth, faults : DataFrame, optional
        Known for simulated telemetry only.
    """
    samples = coded(take.of(validated), "channel")
    samples = samples.sort_values("time_utc", kind="stable")
    injected = None if faults is None else take.of(faults)
    known = None if sample_truth is None else coded(take.of(sample_truth), "channel")
    window = take.window(samples.time_utc)
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
    blueprint = views.columns(
        rrb.Vertical(
            rrb.Tabs(*series, name="samples"),
            window.lanes("flags", "findings by channel"),
            row_shares=[2, 3],
        ),
        views.page("text/validated", "what was found"),
        shares=[5, 2],
    )
    with take.open(blueprint) as stream:
        for name in plotted:
            own = samples[samples.channel == name]
            true = None if known is None else known[known.channel == name]
            _draw_samples(stream, name, own, true)
        for name in shown:
            own = samples[samples.channel == name]
            faulty = None if injected is None else injected[injected.channel == name]
            times, states, colours = _findings(own, faulty)
            marks.lane(stream, marks.entity_path("flags", name), times, states, colours, [GOOD])
        text = _findings_text(take, samples, len(channels), injected, len(shown))
        marks.page(stream, "text/validated", text)


def _draw_samples(
    stream: rr.RecordingStream, name: str, own: pd.DataFrame, true: pd.DataFrame | None
) -> None:
    entity = marks.entity_path("telemetry", name)
    # The viewer draws entities in the order of their names: the truth must not hide in the dots.
    if true is not None and len(true):
        line = true.sort_values("time_utc", kind="stable")
        frame = marks.named("true value", line.time_utc, line.value)
        marks.lines(stream, f"{entity}/2_true", frame, [marks.TRUTH], width=1.8)
    finite = own[np.isfinite(own.value)]
    good = usable(finite.flag)
    for part, label, chosen, colour, size in (
        ("1_usable", "usable sample", good, SKY, 2.0),
        ("3_bad", "flagged bad", ~good, VERMILION, 4.0),
    ):
        some = finite[chosen]
        frame = marks.named(label, some.time_utc, some.value)
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
    take: Take,
    samples: pd.DataFrame,
    n_channel: int,
    injected: pd.DataFrame | None,
    n_shown: int,
) -> list[str]:
    bits = samples.reasons.to_numpy()
    rows = []
    for reason in REASONS:
        hit = samples[(bits & int(reason)) != 0]
        if len(hit):
            rows.append((reason_text(int(reason)), f"{len(hit):,}", f"{hit.channel.nunique()}"))
    flags = [(flag.name.lower(), f"{int((samples.flag == flag).sum()):,}") for flag in Flag]
    some = " (those with findings)" if n_shown < n_channel else ""
    text = [
        f"# {take.case}: telemetry after the checks",
        f"Trial {take.trial} of the case, history before the study included: {len(samples):,} "
        f"samples of {n_channel} channels. {n_shown} channels have a lane{some}.",
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
    return text
