"""Recording of the scores: the page a reader opens first, and where and when errors arise."""

from __future__ import annotations

import pandas as pd
import rerun.blueprint as rrb

from pse_analysis.drawing import method_colours
from pse_analysis.grid.network import Network
from pse_analysis.recording import marks, views
from pse_analysis.recording.take import Take
from pse_analysis.recording.voltage_errors import UNIT, VoltageErrors, voltages


def scored(
    take: Take,
    scored: pd.DataFrame,
    estimated: pd.DataFrame,
    truth: pd.DataFrame | None,
    network: Network,
    *,
    summary_markdown: str,
) -> None:
    """Record the scores: the page a reader opens first, and where and when the errors arise.

    Parameters
    ----------
    take : Take
    scored, estimated, truth : DataFrame
        Tables of these names; `truth` is None for real telemetry.
    network : Network
        The grid, to draw it.
    summary_markdown : str
        The score table and what the author of the case wants said.
    """
    vm = voltages(estimated, take)
    true = voltages(truth, take) if truth is not None else None
    methods = method_colours(dict.fromkeys(vm.method))
    window = take.window(vm.time_utc)
    errors = VoltageErrors.of(vm, true, network)
    shades, what = errors.by_method, errors.what
    over_time = {
        "mean": 1e3 * pd.DataFrame({name: v.mean(axis=1) for name, v in shades.items()}),
        "largest": 1e3 * pd.DataFrame({name: v.max(axis=1) for name, v in shades.items()}),
    }
    by_bus = scored[(scored.metric == "vm_error_mean") & scored.element.str.startswith("bus/")]
    bars = 1e3 * take.of(by_bus).pivot_table(
        index="element", columns="method", values="value"
    ).reindex([f"bus/{name}" for name in network.buses.name])  # fmt: skip

    plots = [
        window.plot(f"error/{kind}", f"{kind} {what} [{UNIT}]", values, zero=True)
        for kind, values in over_time.items()
    ]
    below: list[rrb.View] = []
    if bars.notna().any().any():
        legend = rrb.PlotLegend(visible=False)
        title = f"mean error of |V| by bus [{UNIT}]"
        below.append(rrb.BarChartView(origin="error/by_bus", name=title, plot_legend=legend))
    graphs = errors.views("score_grid", f", 0 to {1e3 * errors.largest:g} × {UNIT}")
    blueprint = views.columns(
        rrb.Vertical(views.page("text/scored", "score"), rrb.Tabs(*plots), row_shares=[5, 4]),
        rrb.Vertical(*graphs, *below),
        shares=[11, 9],
    )
    with take.open(blueprint) as stream:
        for kind, values in over_time.items():
            marks.lines(stream, f"error/{kind}", values, [methods[n] for n in values], width=2.0)
        errors.draw(stream, "score_grid")
        marks.bars(stream, "error/by_bus", bars[[n for n in methods if n in bars]], methods)
        guide = [
            summary_markdown.strip(),
            "## What is to be seen",
            f"The drawings show trial {take.trial} of the case.",
            f"**Grid**: {what} of each method on one scale. {errors.legend()}",
            f"**Below**: mean {what} over the buses at each instant; another tab has the largest.",
        ]
        if below:
            guide.append(
                "**Right, at the foot**: the mean over the study in the order of the buses, in "
                "the methods' colours."
            )
        marks.page(stream, "text/scored", guide)
