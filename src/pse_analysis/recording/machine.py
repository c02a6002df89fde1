"""Recordings of a machine's case: the rotor beside its estimates, and their errors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import GREEN, GREY, ORANGE, SOURCES, VERMILION, method_colours
from pse_analysis.machine import STATES
from pse_analysis.recording import stream as marks
from pse_analysis.recording.tables import of_trial, open_on

if TYPE_CHECKING:
    from pse_analysis.parameters import Study

_NAMES = dict(zip(STATES, ("rotor angle θ [rad]", "speed deviation ω [rad/s]"), strict=True))
_STATUS = {"ok": GREEN, "predicted": GREY, "restarted": ORANGE}


def machine_estimated(
    path: str | Path,
    case: str,
    estimated: pd.DataFrame,
    steps: pd.DataFrame,
    *,
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    truth: pd.DataFrame | None = None,
    study: Study | None = None,
    trial: int = 0,
) -> None:
    """Record θ, θ̂ ± σ, ω and ω̂ ± σ of every observer.

    Parameters
    ----------
    path : str or Path
        The ``.rrd`` file to write.
    case : str
        Name of the case.
    estimated, steps, aligned, channels : DataFrame
        Tables of these names.
    truth : DataFrame, optional
        Known for simulated cases only.
    study : Study, optional
        The plots open on its window; without it, on everything estimated.
    trial : int
        Trial to draw.
    """
    own = _beside_truth(estimated, truth, trial)
    step = of_trial(steps, trial)
    measured = of_trial(aligned, trial).merge(channels[["channel", "source", "quantity"]])
    measured = measured[(measured.origin == "measured") & (measured.quantity == STATES[0])]
    methods = method_colours(dict.fromkeys(own.method))
    window = open_on(own.time_utc, study)
    first = min(3, len(methods) - 1)
    rows = []
    for quantity, title in _NAMES.items():
        part = own[own.quantity == quantity]
        shown = part.true if truth is not None else part.value
        symbol = " ".join(title.split()[-2:])
        tabs = [window.plot(f"{quantity}/{m}", f"{m}: {title}", shown) for m in methods]
        rows.append(rrb.Tabs(*tabs, active_tab=first))
        if truth is not None:
            late = part[part.time_utc > window.start + 0.3 * (window.end - window.start)]
            ends = 1.2 * late.error.abs().groupby(late.method).max()
            errors = [
                window.plot(f"error/{quantity}/{m}", f"{m}: error of {symbol}", [-ends[m], ends[m]])
                for m in methods
            ]
            rows.append(rrb.Tabs(*errors, active_tab=first))
    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.Vertical(
                *rows,
                window.lanes("status", "how each step ended"),
                row_shares=[3.0] * len(rows) + [4.0],
            ),
            rrb.TextDocumentView(origin="text/estimated", name="what is to be seen"),
            column_shares=[5, 2],
        )
    )
    with marks.recording(path, case, blueprint) as stream:
        for name, colour in methods.items():
            mine = own[own.method == name]
            for quantity in STATES:
                part = mine[mine.quantity == quantity].set_index("time_utc").sort_index()
                entity = f"{quantity}/{name}"
                if truth is not None:
                    true = part[["true"]]
                    marks.lines(stream, f"{entity}/1_true", true, [marks.TRUTH], width=3.0)
                    error = f"error/{quantity}/{name}"
                    marks.band(stream, error, part.error, part.sigma, f"{name} ±σ", colour)
                if quantity == STATES[0]:
                    _draw_measured(stream, entity, measured)
                marks.band(
                    stream, f"{entity}/3_{name}", part.value, part.sigma, f"{name} ±σ", colour
                )
            ended = step[step.method == name]
            colours = {s: _STATUS.get(s, VERMILION) for s in ended.status.unique()}
            times = pd.DatetimeIndex(ended.time_utc)
            marks.lane(stream, f"status/{name}", times, ended.status.tolist(), colours)
        marks.page(stream, "text/estimated", _text(case, trial, own, step, truth is not None))


def machine_scored(
    path: str | Path,
    case: str,
    estimated: pd.DataFrame,
    truth: pd.DataFrame | None,
    *,
    summary_markdown: str,
    study: Study | None = None,
    trial: int = 0,
) -> None:
    """Record the scores of a machine's case, and how the errors settle.

    Parameters
    ----------
    path : str or Path
        The ``.rrd`` file to write.
    case : str
        Name of the case.
    estimated, truth : DataFrame
        Tables of these names; `truth` is None for real telemetry.
    summary_markdown : str
        The score table.
    study : Study, optional
        The plots open on its window; without it, on everything estimated.
    trial : int
        Trial to draw; the summary speaks of all.
    """
    own = _beside_truth(estimated, truth, trial)
    methods = method_colours(dict.fromkeys(own.method))
    window = open_on(own.time_utc, study)
    which = "error" if truth is not None else "sigma"
    shapes = {
        q: own[own.quantity == q].pivot_table(index="time_utc", columns="method", values=which)
        for q in STATES
    }
    decades = {q: np.log10(v[list(methods)].abs().clip(lower=1e-4)) for q, v in shapes.items()}
    title = "log10 of |error|" if truth is not None else "log10 of σ"
    smooth = {q: v.rolling(25, min_periods=1).median() for q, v in decades.items()}
    plots = [window.plot(f"settling/{q}", f"{title} of {_NAMES[q]}", v) for q, v in smooth.items()]
    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="text/scored", name="score"), rrb.Vertical(*plots)
        )
    )
    with marks.recording(path, case, blueprint) as stream:
        for q, values in smooth.items():
            marks.lines(stream, f"settling/{q}", values, [methods[n] for n in values], width=2.0)
        guide = (
            "## What is to be seen\n\n**Right**: how the errors of each observer settle, on a "
            f"logarithmic scale, as running medians over 25 instants of trial {trial}."
        )
        marks.page(stream, "text/scored", f"{summary_markdown.strip()}\n\n{guide}")


def _beside_truth(estimated: pd.DataFrame, truth: pd.DataFrame | None, trial: int) -> pd.DataFrame:
    own = of_trial(estimated, trial)
    if truth is None:
        return own.sort_values("time_utc")
    known = of_trial(truth, trial).rename(columns={"value": "true"}).drop(columns="trial")
    both = own.merge(known, on=["time_utc", "element", "quantity"], how="left")
    return both.assign(error=both.value - both.true).sort_values("time_utc")


def _draw_measured(stream: rr.RecordingStream, entity: str, measured: pd.DataFrame) -> None:
    for source, part in measured.groupby("source", sort=False):
        label = f"measured, {source}"
        frame = pd.DataFrame({label: part.value_pu.to_numpy()}, index=part.time_utc)
        marks.dots(stream, f"{entity}/2_measured", frame, [SOURCES.get(str(source), GREY)], 1.2)


def _text(case: str, trial: int, own: pd.DataFrame, step: pd.DataFrame, simulated: bool) -> str:
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
    return "\n\n".join(
        [
            f"# {case}: observers of the rotor",
            f"Trial {trial} of the case.",
            marks.markdown_table(("method", "NIS", "truth in ±2σ", "predicted"), rows),
            "A tab per observer. "
            + ("The true state in grey, " if simulated else "")
            + "measurements as dots, the estimate with the ±σ that its own Q and R give. NIS far "
            "from 1 says that those are not the true densities, whatever the gain is worth.",
            "**Below**: how each step ended; *predicted* is a sample that was missing or flagged.",
        ]
    )
