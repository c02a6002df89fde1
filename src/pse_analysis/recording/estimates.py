"""Recordings of the estimates: against truth and measurements, in the grid, and scored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from scipy.stats import chi2

from pse_analysis.drawing import GREEN, GREY, ORANGE, SOURCES, VERMILION, method_colours
from pse_analysis.grid.network import Network
from pse_analysis.recording import stream as marks
from pse_analysis.recording.tables import of_trial, open_on

if TYPE_CHECKING:
    from pse_analysis.parameters import Study

BOUNDS = (0.005, 0.995)
"""Quantiles of chi-square between which NIS should lie 99 times in 100."""

_STATUS = {"ok": GREEN, "predicted": GREY, "restarted": ORANGE}
_UNIT = "10⁻³ p.u."


def estimated(
    path: str | Path,
    case: str,
    estimated: pd.DataFrame,
    steps: pd.DataFrame,
    residuals: pd.DataFrame,
    *,
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    network: Network,
    truth: pd.DataFrame | None = None,
    study: Study | None = None,
    elements: Sequence[str] | None = None,
    trial: int = 0,
) -> None:
    """Record the estimates of every method beside what was measured and what is true.

    Parameters
    ----------
    path : str or Path
        The ``.rrd`` file to write.
    case : str
        Name of the case.
    estimated, steps, residuals, aligned, channels : DataFrame
        Tables of these names.
    network : Network
        The grid, to draw it.
    truth : DataFrame, optional
        Known for simulated cases only; without it the grid shows the estimate's own σ.
    study : Study, optional
        The plots open on its window; without it, on everything estimated.
    elements : sequence of str, optional
        Buses to plot, such as ``bus/18``; default: the one with the lowest voltage and three with
        a measured one.
    trial : int
        Trial to draw.
    """
    vm = _voltages(estimated, trial)
    true = _voltages(truth, trial) if truth is not None else None
    step = of_trial(steps, trial)
    residual = of_trial(residuals, trial)
    methods = method_colours(dict.fromkeys(vm.method))
    window = open_on(vm.time_utc, study)
    measured = of_trial(aligned, trial).merge(
        channels[["channel", "source", "quantity", "element"]], on="channel"
    )
    measured = measured[(measured.quantity == "vm_pu") & (measured.origin == "measured")]
    chosen = list(elements) if elements is not None else _chosen_buses(vm, measured)
    nis = _ratio(step)
    score = (
        residual[residual.used].assign(z=lambda r: r.innovation / r.sigma_innovation)
    ).pivot_table(index="time_utc", columns=["method", "channel"], values="z")
    shades = _errors(vm, true, network)
    largest = marks.scale_end(pd.concat(shades.values())) if shades else 1.0
    what = "error of |V|" if true is not None else "σ of |V|"

    buses = []
    for element in chosen:
        own = vm[vm.element == element]
        origin = marks.entity_path("vm", element)
        buses.append(window.plot(origin, f"{element.replace('/', ' ')} |V| [p.u.]", own.value))
    everything = [
        window.plot(f"normalised/{name}", f"{name}: innovation / σ [1]", [-6.0, 6.0], legend=False)
        for name in methods
    ]
    top = float(np.nanquantile(nis, 0.995)) if nis.size and nis.notna().any().any() else 1.0
    graphs = [marks.grid_view(f"grid/{n}", f"{n}: {what}", network) for n in shades]
    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(*buses, name="|V|"),
                rrb.Tabs(*everything, name="innovations"),
                rrb.Tabs(
                    window.plot("nis", "NIS / degrees of freedom [1]", [0.0, top], zero=True),
                    window.lanes("status", "how each step ended"),
                ),
                row_shares=[5, 3, 3],
            ),
            rrb.Vertical(
                rrb.Tabs(*graphs, active_tab=len(graphs) - 1),
                rrb.TextDocumentView(origin="text/estimated", name="what is to be seen"),
                row_shares=[2, 3],
            ),
            column_shares=[5, 3],
        )
    )  # fmt: skip
    with marks.recording(path, case, blueprint) as stream:
        for element in chosen:
            _draw_bus(stream, element, vm, true, measured, methods)
        for name, colour in methods.items():
            if name in score.columns.get_level_values("method"):
                one = score[name]
                marks.dots(stream, f"normalised/{name}", one, [colour] * one.shape[1], 1.2)
        _draw_nis(stream, step, nis, methods)
        for name, one in step.groupby("method", sort=False):
            colours = {s: _STATUS.get(s, VERMILION) for s in one.status.unique()}
            times = pd.DatetimeIndex(one.time_utc)
            marks.lane(stream, f"status/{name}", times, one.status.tolist(), colours)
        for name, values in shades.items():
            marks.grid(
                stream,
                f"grid/{name}",
                network,
                values,
                largest=largest,
                scale=1e3,
                unit=_UNIT,
            )
        text = _estimated_text(case, trial, step, score, nis, what, largest, true is not None)
        marks.page(stream, "text/estimated", text)


def _draw_bus(
    stream: rr.RecordingStream,
    element: str,
    vm: pd.DataFrame,
    true: pd.DataFrame | None,
    measured: pd.DataFrame,
    methods: dict[str, str],
) -> None:
    entity = marks.entity_path("vm", element)
    # The viewer draws entities in the order of their names: the numbers put the truth at the back.
    if true is not None:
        line = true[true.element == element]
        frame = pd.DataFrame({"true": line.value.to_numpy()}, index=line.time_utc)
        marks.lines(stream, f"{entity}/1_true", frame, [marks.TRUTH], width=3.0)
    own = measured[measured.element == element]
    for source, part in own.groupby("source", sort=False):
        frame = pd.DataFrame({f"measured, {source}": part.value_pu.to_numpy()}, index=part.time_utc)
        colour = SOURCES.get(str(source), GREY)
        marks.dots(stream, f"{entity}/2_measured/{source}", frame, [colour], 2.2)
    for number, (name, colour) in enumerate(methods.items(), start=3):
        one = vm[(vm.element == element) & (vm.method == name)].set_index("time_utc")
        marks.band(stream, f"{entity}/{number}_{name}", one.value, one.sigma, f"{name} ±σ", colour)


def _draw_nis(
    stream: rr.RecordingStream, step: pd.DataFrame, nis: pd.DataFrame, methods: dict[str, str]
) -> None:
    marks.lines(stream, "nis/methods", nis, [methods[name] for name in nis.columns])
    dof = step.pivot_table(index="time_utc", columns="method", values="dof")
    groups: dict[tuple[float, ...], list[str]] = {}
    for name in dof.columns:
        groups.setdefault(tuple(dof[name].fillna(0.0)), []).append(str(name))
    for number, names in enumerate(groups.values()):
        m = dof[names[0]].where(dof[names[0]] > 0)
        label = "99 %" if len(groups) == 1 else f"99 % {', '.join(names)}"
        bounds = np.stack([chi2.ppf(q, m) / m for q in BOUNDS], axis=1)
        limits = pd.DataFrame(bounds, index=dof.index, columns=[label, label])
        marks.lines(stream, f"nis/bounds_{number}", limits, [marks.BOUND] * 2, width=1.2)


def _ratio(step: pd.DataFrame) -> pd.DataFrame:
    """NIS over its degrees of freedom, one column per method."""
    known = step[step.dof > 0]
    ratio = known.assign(ratio=known.nis / known.dof)
    table = ratio.pivot_table(index="time_utc", columns="method", values="ratio")
    return table.reindex(columns=[name for name in dict.fromkeys(step.method) if name in table])


def _voltages(table: pd.DataFrame, trial: int) -> pd.DataFrame:
    return of_trial(table, trial)[lambda rows: rows.quantity == "vm_pu"].sort_values("time_utc")


def _errors(
    vm: pd.DataFrame, true: pd.DataFrame | None, network: Network
) -> dict[str, pd.DataFrame]:
    """|error| of |V| at each instant and bus by method, or σ where the truth is not known."""
    buses = [f"bus/{name}" for name in network.buses.name]
    shades = {}
    if true is not None:
        table = true.pivot_table(index="time_utc", columns="element", values="value")
    for name in method_colours(vm.method.unique()):
        one = vm[vm.method == name]
        which = "value" if true is not None else "sigma"
        values = one.pivot_table(index="time_utc", columns="element", values=which, dropna=False)
        values = values.reindex(columns=buses)
        if true is not None:
            values = (values - table.reindex(index=values.index, columns=buses)).abs()
        shades[name] = values
    return shades


def _chosen_buses(vm: pd.DataFrame, measured: pd.DataFrame, limit: int = 4) -> list[str]:
    """The weakest bus, then measured ones spread over the grid's order."""
    mean = vm.groupby("element").value.mean().dropna()
    if mean.empty:
        return []
    metered = [e for e in dict.fromkeys(vm.element) if e in set(measured.element)]
    spread = [metered[i] for i in np.linspace(0, len(metered) - 1, limit - 1).astype(int)] if metered else []  # fmt: skip # noqa: E501
    return list(dict.fromkeys([str(mean.idxmin()), *spread]))[:limit]


def _estimated_text(
    case: str,
    trial: int,
    step: pd.DataFrame,
    score: pd.DataFrame,
    nis: pd.DataFrame,
    what: str,
    largest: float,
    simulated: bool,
) -> str:
    rows = []
    for name, one in step.groupby("method", sort=False):
        z = score[name].to_numpy() if name in score.columns.get_level_values(0) else np.array([])
        inside = np.mean(np.abs(z[np.isfinite(z)]) <= 2.0) if np.isfinite(z).any() else np.nan
        rows.append(
            (
                str(name),
                f"{nis[name].mean():.2f}" if name in nis else "–",
                f"{100 * inside:.0f} %",
                f"{int((one.status != 'ok').sum())} of {len(one)}",
                f"{1e3 * one.seconds.mean():.1f} ms",
            )
        )
    head = ("method", "NIS/m", "innovations in ±2σ", "not ok", "per step")
    return "\n\n".join(
        [
            f"# {case}: estimates",
            f"Trial {trial} of the case.",
            marks.markdown_table(head, rows),
            "**Above**, a tab per bus: "
            + ("the true |V| in grey, " if simulated else "")
            + "measurements as dots, each estimate with its ±σ band.",
            "**Middle**, a tab per method: every innovation over its own σ; 95 of 100 should lie "
            "within ±2.",
            "**Below**: NIS over its degrees of freedom, which should be about 1 and leave the "
            "grey bounds once in a hundred instants. A method above them trusts itself too much. "
            "The other tab tells how each step ended.",
            f"**Grid**, a tab per method: {what}. {_grid_text(largest)}",
        ]
    )


def _grid_text(largest: float) -> str:
    end = 1e3 * largest
    return (
        f"The colours are those of the time cursor: violet is 0, yellow {end:g} × {_UNIT} or more, "
        f"grey not known; the discs below the grid show the scale in steps of {end / 5:g}. Point "
        "at a bus for its name. Drag the cursor, or press play, to watch the day."
    )


def scored(
    path: str | Path,
    case: str,
    scored: pd.DataFrame,
    estimated: pd.DataFrame,
    truth: pd.DataFrame | None,
    network: Network,
    *,
    summary_markdown: str,
    study: Study | None = None,
    trial: int = 0,
) -> None:
    """Record the scores: the page a reader opens first, and where and when the errors arise.

    Parameters
    ----------
    path : str or Path
        The ``.rrd`` file to write.
    case : str
        Name of the case.
    scored, estimated, truth : DataFrame
        Tables of these names; `truth` is None for real telemetry.
    network : Network
        The grid, to draw it.
    summary_markdown : str
        The score table and what the author of the case wants said.
    study : Study, optional
        The plots open on its window; without it, on everything estimated.
    trial : int
        Trial to draw; the summary speaks of all.
    """
    vm = _voltages(estimated, trial)
    true = _voltages(truth, trial) if truth is not None else None
    methods = method_colours(dict.fromkeys(vm.method))
    window = open_on(vm.time_utc, study)
    shades = _errors(vm, true, network)
    largest = marks.scale_end(pd.concat(shades.values())) if shades else 1.0
    what = "error of |V|" if true is not None else "σ of |V|"
    scale = f"0 to {1e3 * largest:g} × {_UNIT}"
    over_time = {
        "mean": 1e3 * pd.DataFrame({name: v.mean(axis=1) for name, v in shades.items()}),
        "largest": 1e3 * pd.DataFrame({name: v.max(axis=1) for name, v in shades.items()}),
    }
    by_bus = scored[(scored.metric == "vm_error_mean") & scored.element.str.startswith("bus/")]
    bars = 1e3 * by_bus[by_bus.trial == trial].pivot_table(
        index="element", columns="method", values="value"
    ).reindex([f"bus/{name}" for name in network.buses.name])  # fmt: skip

    errors = [
        window.plot(f"error/{kind}", f"{kind} {what} [{_UNIT}]", values, zero=True)
        for kind, values in over_time.items()
    ]
    below: list[rrb.View] = []
    if bars.notna().any().any():
        legend = rrb.PlotLegend(visible=False)
        title = f"mean error of |V| by bus [{_UNIT}]"
        below.append(rrb.BarChartView(origin="error/by_bus", name=title, plot_legend=legend))
    graphs = [marks.grid_view(f"score_grid/{n}", f"{n}: {what}, {scale}", network) for n in shades]
    blueprint = marks.panels(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.TextDocumentView(origin="text/scored", name="score"),
                rrb.Tabs(*errors),
                row_shares=[5, 4],
            ),
            rrb.Vertical(*graphs, *below),
            column_shares=[11, 9],
        )
    )
    with marks.recording(path, case, blueprint) as stream:
        for kind, values in over_time.items():
            marks.lines(stream, f"error/{kind}", values, [methods[n] for n in values], width=2.0)
        for name, values in shades.items():
            marks.grid(
                stream, f"score_grid/{name}", network, values,
                largest=largest, scale=1e3, unit=_UNIT,
            )  # fmt: skip
        marks.bars(stream, "error/by_bus", bars[[n for n in methods if n in bars]], methods)
        guide = [
            summary_markdown.strip(),
            "## What is to be seen",
            f"The drawings show trial {trial} of the case.",
            f"**Grid**: {what} of each method on one scale. {_grid_text(largest)}",
            f"**Below**: mean {what} over the buses at each instant; another tab has the largest.",
        ]
        if below:
            guide.append(
                "**Right, at the foot**: the mean over the study in the order of the buses, in "
                "the methods' colours."
            )
        marks.page(stream, "text/scored", "\n\n".join(guide))
