"""Recordings of a machine's case: the rotor beside its estimates, and their errors."""

from __future__ import annotations

import numpy as np
import pandas as pd
import rerun.blueprint as rrb

from pse_analysis.drawing import method_colours
from pse_analysis.machine import STATES
from pse_analysis.recording import marks, views
from pse_analysis.recording.steps import draw_measured, draw_statuses
from pse_analysis.recording.take import Take

_NAMES = dict(zip(STATES, ("rotor angle θ [rad]", "speed deviation ω [rad/s]"), strict=True))


def machine_estimated(
    take: Take,
    estimated: pd.DataFrame,
    steps: pd.DataFrame,
    *,
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    truth: pd.DataFrame | None = None,
) -> None:
    """Record θ, θ̂ ± σ, ω and ω̂ ± σ of every observer.

    Parameters
    ----------
    take : Take
    estimated, steps, aligned, channels : DataFrame
        Tables of these names.
    truth : DataFrame, optional
        Known for simulated cases only.
    """
    own = _beside_truth(take, estimated, truth)
    step = take.of(steps)
    measured = take.of(aligned).merge(channels[["channel", "source", "quantity"]])
    measured = measured[(measured.origin == "measured") & (measured.quantity == STATES[0])]
    methods = method_colours(dict.fromkeys(own.method))
    window = take.window(own.time_utc)
    first = min(3, len(methods) - 1)
    rows = []
    for quantity, title in _NAMES.items():
        part = own[own.quantity == quantity]
        shown = part.true if truth is not None else part.value
        symbol = " ".join(title.split()[-2:])
        tabs = [window.plot(marks.named_path(quantity, m), f"{m}: {title}", shown) for m in methods]
        rows.append(rrb.Tabs(*tabs, active_tab=first))
        if truth is not None:
            late = part[part.time_utc > window.start + 0.3 * (window.end - window.start)]
            ends = 1.2 * late.error.abs().groupby(late.method).max()
            errors = [
                window.plot(
                    marks.named_path(f"error/{quantity}", m),
                    f"{m}: error of {symbol}",
                    [-ends[m], ends[m]],
                )
                for m in methods
            ]
            rows.append(rrb.Tabs(*errors, active_tab=first))
    blueprint = views.columns(
        rrb.Vertical(
            *rows,
            window.lanes("status", "how each step ended"),
            row_shares=[3.0] * len(rows) + [4.0],
        ),
        views.page("text/estimated", "what is to be seen"),
        shares=[5, 2],
    )
    with take.open(blueprint) as stream:
        for name, colour in methods.items():
            mine = own[own.method == name]
            for quantity in STATES:
                part = mine[mine.quantity == quantity].set_index("time_utc").sort_index()
                entity = marks.named_path(quantity, name)
                if truth is not None:
                    true = part[["true"]]
                    marks.lines(stream, f"{entity}/1_true", true, [marks.TRUTH], width=3.0)
                    error = marks.named_path(f"error/{quantity}", name)
                    marks.band(stream, error, part.error, part.sigma, f"{name} ±σ", colour)
                if quantity == STATES[0]:
                    draw_measured(stream, f"{entity}/2_measured", measured, 1.2)
                where = marks.named_path(entity, f"3_{name}")
                marks.band(stream, where, part.value, part.sigma, f"{name} ±σ", colour)
        draw_statuses(stream, step)
        marks.page(stream, "text/estimated", _text(take, own, step, truth is not None))


def machine_scored(
    take: Take,
    estimated: pd.DataFrame,
    truth: pd.DataFrame | None,
    *,
    summary_markdown: str,
) -> None:
    """Record the scores of a machine's case, and how the errors settle.

    Parameters
    ----------
    take : Take
    estimated, truth : DataFrame
        Tables of these names; `truth` is None for real telemetry.
    summary_markdown : str
        The score table.
    """
    own = _beside_truth(take, estimated, truth)
    methods = method_colours(dict.fromkeys(own.method))
    window = take.window(own.time_utc)
    which = "error" if truth is not None else "sigma"
    shapes = {
        q: own[own.quantity == q].pivot_table(index="time_utc", columns="method", values=which)
        for q in STATES
    }
    decades = {q: np.log10(v[list(methods)].abs().clip(lower=1e-4)) for q, v in shapes.items()}
    title = "log10 of |error|" if truth is not None else "log10 of σ"
    smooth = {q: v.rolling(25, min_periods=1).median() for q, v in decades.items()}
    plots = [window.plot(f"settling/{q}", f"{title} of {_NAMES[q]}", v) for q, v in smooth.items()]
    blueprint = views.columns(views.page("text/scored", "score"), rrb.Vertical(*plots))
    with take.open(blueprint) as stream:
        for q, values in smooth.items():
            marks.lines(stream, f"settling/{q}", values, [methods[n] for n in values], width=2.0)
        guide = [
            summary_markdown.strip(),
            "## What is to be seen",
            "**Right**: how the errors of each observer settle, on a logarithmic scale, as running "
            f"medians over 25 instants of trial {take.trial}.",
        ]
        marks.page(stream, "text/scored", guide)


def _beside_truth(take: Take, estimated: pd.DataFrame, truth: pd.DataFrame | None) -> pd.DataFrame:
    own = take.of(estimated)
    if truth is None:
        return own.sort_values("time_utc")
    known = take.of(truth).rename(columns={"value": "true"}).drop(columns="trial")
    both = own.merge(known, on=["time_utc", "element", "quantity"], how="left")
    return both.assign(error=both.value - both.true).sort_values("time_utc")


def _text(take: Take, own: pd.DataFrame, step: pd.DataFrame, simulated: bool) -> list[str]:
    rows = []
    for name, ended in step.groupby("method", sort=False):
        known = ended[ended.dof > 0]
        mine = own[own.method == name]
        inside = float((mine.error.abs() <= 2 * mine.sigma).mean()) if simulated else np.nan
        rows.append(
            (
                str(name),
                f"{known.nis.sum() / max(known.dof.sum(), 1):.3g}",
                f"{100 * inside:.0f} %" if np.isfinite(inside) else "–",
                f"{int((ended.status == 'predicted').sum())} of {len(ended)}",
            )
        )
    return [
        f"# {take.case}: observers of the rotor",
        f"Trial {take.trial} of the case.",
        marks.markdown_table(("method", "NIS", "truth in ±2σ", "predicted"), rows),
        "A tab per observer. "
        + ("The true state in grey, " if simulated else "")
        + "measurements as dots, the estimate with the ±σ that its own Q and R give. NIS far "
        "from 1 says that those are not the true densities, whatever the gain is worth.",
        "**Below**: how each step ended; *predicted* is a sample that was missing or flagged.",
    ]
