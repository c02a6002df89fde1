"""Recording of the estimates: against truth and measurements, and in the grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from scipy.stats import chi2

from pse_analysis.drawing import method_colours
from pse_analysis.grid.network import Network
from pse_analysis.recording import marks, views
from pse_analysis.recording.steps import draw_measured, draw_statuses
from pse_analysis.recording.take import Take
from pse_analysis.recording.voltage_errors import VoltageErrors, voltages

BOUNDS = (0.005, 0.995)
"""Quantiles of chi-square between which NIS should lie 99 times in 100."""


def estimated(
    take: Take,
    estimated: pd.DataFrame,
    steps: pd.DataFrame,
    residuals: pd.DataFrame,
    *,
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    network: Network,
    truth: pd.DataFrame | None = None,
    elements: Sequence[str] | None = None,
) -> None:
    """Record the estimates of every method beside what was measured and what is true.

    Parameters
    ----------
    take : Take
    estimated, steps, residuals, aligned, channels : DataFrame
        Tables of these names.
    network : Network
        The grid, to draw it.
    truth : DataFrame, optional
        Known for simulated cases only; without it the grid shows the estimate's own σ.
    elements : sequence of str, optional
        Buses to plot, such as ``bus/18``; default: the one with the lowest voltage and three with
        a measured one.
    """
    vm = voltages(estimated, take)
    true = voltages(truth, take) if truth is not None else None
    step = take.of(steps)
    residual = take.of(residuals)
    methods = method_colours(dict.fromkeys(vm.method))
    window = take.window(vm.time_utc)
    measured = take.of(aligned).merge(
        channels[["channel", "source", "quantity", "element"]], on="channel"
    )
    measured = measured[(measured.quantity == "vm_pu") & (measured.origin == "measured")]
    chosen = list(elements) if elements is not None else _chosen_buses(vm, measured)
    nis = _ratio(step)
    score = (
        residual[residual.used].assign(z=lambda r: r.innovation / r.sigma_innovation)
    ).pivot_table(index="time_utc", columns=["method", "channel"], values="z")
    named = set(score.columns.get_level_values("method"))
    errors = VoltageErrors.of(vm, true, network)

    buses = []
    for element in chosen:
        own = vm[vm.element == element]
        origin = marks.entity_path("vm", element)
        buses.append(window.plot(origin, f"{element.replace('/', ' ')} |V| [p.u.]", own.value))
    everything = [
        window.plot(
            marks.named_path("normalised", name),
            f"{name}: innovation / σ [1]",
            [-6.0, 6.0],
            legend=False,
        )
        # Smoothed estimates and forecasts have no innovations, nor has a method without estimates.
        for name in ([n for n in methods if n in named] or methods)
    ]
    top = float(np.nanquantile(nis, 0.995)) if nis.size and nis.notna().any().any() else 1.0
    graphs = errors.views("grid")
    blueprint = views.columns(
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
            views.page("text/estimated", "what is to be seen"),
            row_shares=[2, 3],
        ),
        shares=[5, 3],
    )
    with take.open(blueprint) as stream:
        for element in chosen:
            _draw_bus(stream, element, vm, true, measured, methods)
        for name, colour in methods.items():
            if name in named:
                one = score[name]
                where = marks.named_path("normalised", name)
                marks.dots(stream, where, one, [colour] * one.shape[1], 1.2)
        _draw_nis(stream, step, nis, methods)
        draw_statuses(stream, step)
        errors.draw(stream, "grid")
        text = _estimated_text(take, step, score, nis, errors, true is not None)
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
        frame = marks.named("true", line.time_utc, line.value)
        marks.lines(stream, f"{entity}/1_true", frame, [marks.TRUTH], width=3.0)
    draw_measured(stream, f"{entity}/2_measured", measured[measured.element == element], 2.2)
    for number, (name, colour) in enumerate(methods.items(), start=3):
        one = vm[(vm.element == element) & (vm.method == name)].set_index("time_utc")
        where = marks.named_path(entity, f"{number}_{name}")
        marks.band(stream, where, one.value, one.sigma, f"{name} ±σ", colour)


def _draw_nis(
    stream: rr.RecordingStream, step: pd.DataFrame, nis: pd.DataFrame, methods: dict[str, str]
) -> None:
    marks.lines(stream, "nis/methods", nis, [methods[name] for name in nis.columns])
    dof = step.pivot_table(index="time_utc", columns="method", values="dof")
    groups: dict[tuple[float, ...], list[str]] = {}
    for name in (one for one in dof.columns if (dof[one] > 0).any()):
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


def _chosen_buses(vm: pd.DataFrame, measured: pd.DataFrame, limit: int = 4) -> list[str]:
    """The weakest bus, then measured ones spread over the grid's order."""
    mean = vm.groupby("element").value.mean().dropna()
    if mean.empty:
        return []
    metered = [e for e in dict.fromkeys(vm.element) if e in set(measured.element)]
    places = np.linspace(0, len(metered) - 1, limit - 1).astype(int)
    spread = [metered[i] for i in places] if metered else []
    return list(dict.fromkeys([str(mean.idxmin()), *spread]))[:limit]


def _estimated_text(
    take: Take,
    step: pd.DataFrame,
    score: pd.DataFrame,
    nis: pd.DataFrame,
    errors: VoltageErrors,
    simulated: bool,
) -> list[str]:
    rows = []
    for name, one in step.groupby("method", sort=False):
        z = score[name].to_numpy() if name in score.columns.get_level_values(0) else np.array([])
        inside = np.mean(np.abs(z[np.isfinite(z)]) <= 2.0) if np.isfinite(z).any() else np.nan
        rows.append(
            (
                str(name),
                f"{nis[name].mean():.2f}" if name in nis else "–",
                f"{100 * inside:.0f} %" if np.isfinite(inside) else "–",
                f"{int((one.status != 'ok').sum())} of {len(one)}",
                f"{1e3 * one.seconds.mean():.1f} ms",
            )
        )
    head = ("method", "NIS/m", "innovations in ±2σ", "not ok", "per step")
    return [
        f"# {take.case}: estimates",
        f"Trial {take.trial} of the case.",
        marks.markdown_table(head, rows),
        "**Above**, a tab per bus: "
        + ("the true |V| in grey, " if simulated else "")
        + "measurements as dots, each estimate with its ±σ band.",
        "**Middle**, a tab per method: every innovation over its own σ; 95 of 100 should lie "
        "within ±2.",
        "**Below**: NIS over its degrees of freedom, which should be about 1 and leave the "
        "grey bounds once in a hundred instants. A method above them trusts itself too much. "
        "The other tab tells how each step ended.",
        f"**Grid**, a tab per method: {errors.what}. {errors.legend()}",
    ]
