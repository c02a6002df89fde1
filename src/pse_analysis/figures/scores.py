"""Scores: where errors arise, and whether a method knows how large they are."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.stats import chi2

from pse_analysis.drawing import method_colours
from pse_analysis.errors import TableError
from pse_analysis.figures.paper import (
    DOUBLE,
    SINGLE,
    TRUTH,
    Paper,
    legend,
    paper,
    styled,
    thousandths,
    time_axis,
)
from pse_analysis.vocabulary import FaultKind

BOUNDS = (0.005, 0.995)
"""Quantiles of chi-square between which NIS should lie 99 times in 100."""


@styled
def errors_by_bus(
    scored: pd.DataFrame, *, metric: str = "vm_error_mean", width: float = DOUBLE
) -> Paper:
    """Error at each bus by method; the bar is the mean over the trials.

    Parameters
    ----------
    scored : DataFrame
        Table of that name.
    metric : str
        ``vm_error_mean``, ``vm_error_max``, ``va_error_mean`` or ``va_error_max``.
    width : float
        Of the figure. [inch]
    """
    rows = scored[(scored.metric == metric) & scored.element.str.startswith("bus/")]
    if rows.empty:
        raise TableError(
            f"scored has no {metric!r} by bus; expected rows with element 'bus/…': score with "
            "by_element = true, and with a known truth"
        )
    factor, unit = thousandths(rows.unit.iloc[0])
    table = factor * rows.pivot_table(index="element", columns="method", values="value")
    table = table.reindex(sorted(table.index, key=_by_number))
    colours = method_colours(dict.fromkeys(scored.method[scored.method != "validate"]))
    figure = paper(width, 2.4)
    ax = figure.subplots()
    names = [name for name in colours if name in table]
    share = 0.8 / len(names)
    at = np.arange(len(table))
    for number, name in enumerate(names):
        offset = share * (number - (len(names) - 1) / 2)
        ax.bar(at + offset, table[name], share, color=colours[name], label=name)
    step = max(1, int(np.ceil(len(table) / (6.5 * width))))
    ax.set_xticks(at[::step], [e.removeprefix("bus/") for e in table.index[::step]])
    ax.set_xlim(-0.7, len(table) - 0.3)
    ax.grid(axis="x", visible=False)
    ax.set_xlabel("Bus [name]")
    which = "Largest" if metric.endswith("max") else "Mean"
    what = "|V|" if metric.startswith("vm") else "angle"
    ax.set_ylabel(f"{which} error of {what} [{unit}]")
    legend(figure, ax)
    return figure


@styled
def consistency(
    steps: pd.DataFrame,
    scored: pd.DataFrame | None = None,
    *,
    trial: int = 0,
    width: float = DOUBLE,
) -> Paper:
    """NIS over its degrees of freedom with its 99 % bounds, and how often the truth lies in ±2σ.

    Parameters
    ----------
    steps : DataFrame
        Table of that name.
    scored : DataFrame, optional
        Table of that name; adds the coverage of |V| by hour of day, over all trials.
    trial : int
        Trial whose NIS is drawn.
    width : float
        Of the figure. [inch]
    """
    two = scored is not None and (scored.metric == "coverage_vm").any()
    figure = paper(width, 4.0 if two else 2.4)
    axes = figure.subplots(2 if two else 1, 1, squeeze=False)[:, 0]
    ax = axes[0]
    own = steps[(steps.trial == trial) & (steps.dof > 0)].sort_values("time_utc")
    colours = method_colours(dict.fromkeys(steps.method))
    alike: dict[tuple[int, ...], list[str]] = {}
    for name, colour in colours.items():
        one = own[own.method == name]
        ax.plot(one.time_utc, one.nis / one.dof, color=colour, lw=0.9, label=name)
        alike.setdefault(tuple(one.dof), []).append(name)
    for names in alike.values():
        one = own[own.method == names[0]]
        m = one.dof.to_numpy()
        line, label = TRUTH, "99 % bounds"
        if len(alike) > 1:
            line, label = colours[names[-1]], f"99 % bounds of {', '.join(names)}"
        for q in BOUNDS:
            ax.plot(one.time_utc, chi2.ppf(q, m) / m, color=line, lw=0.8, ls=":", label=label)
    ax.set_ylabel("NIS / degrees of freedom [1]")
    ax.set_ylim(bottom=0)
    time_axis(ax, width)
    if two and scored is not None:
        _coverage(axes[1], scored, colours)
    legend(figure, *axes)
    return figure


@styled
def coverage_by_hour(
    scored: pd.DataFrame, *, metric: str = "coverage_vm", width: float = SINGLE
) -> Paper:
    """Share of instants and buses whose true value lies within ±2σ, by hour of day.

    Parameters
    ----------
    scored : DataFrame
        Table of that name.
    metric : str
        ``coverage_vm`` or ``coverage_va``.
    width : float
        Of the figure. [inch]
    """
    figure = paper(width, 2.5)
    ax = figure.subplots()
    _coverage(
        ax,
        scored,
        method_colours(dict.fromkeys(scored.method[scored.method != "validate"])),
        metric,
    )
    legend(figure, ax)
    return figure


def _coverage(
    ax: Axes, scored: pd.DataFrame, colours: Mapping[str, str], metric: str = "coverage_vm"
) -> None:
    rows = scored[(scored.metric == metric) & scored.element.str.startswith("hour/")]
    if rows.empty:
        raise TableError(
            f"scored has no {metric!r} by hour; expected rows with element 'hour/00' … 'hour/23': "
            "coverage needs a known truth"
        )
    table = 100 * rows.pivot_table(index="element", columns="method", values="value")
    hours = [int(str(e).removeprefix("hour/")) for e in table.index]
    for name in [n for n in colours if n in table]:
        ax.plot(hours, table[name], "o-", ms=2.5, color=colours[name], label=name)
    ax.axhline(95.45, color=TRUTH, lw=0.8, ls=":", label="95.4 % of a Gaussian")
    ax.set_xticks(range(0, 25, 4))
    ax.set_xlim(-0.5, 23.5)
    ax.set_ylim(min(80.0, float(np.nanmin(table)) - 3.0), 101.0)
    ax.set_xlabel("Hour of day [h, UTC]")
    ax.set_ylabel(f"{'|V|' if metric.endswith('vm') else 'Angle'} within ±2σ [%]")


def _by_number(element: str) -> list[tuple[int, str]]:
    """Sorts ``bus/2`` before ``bus/10``."""
    return [
        (int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", element)
    ]


def score_table(scored: pd.DataFrame) -> pd.DataFrame:
    """Scores of the whole case, a row per method; trials are brought together.

    Parameters
    ----------
    scored : DataFrame
        Table of that name.

    Returns
    -------
    DataFrame
        Index: methods. Errors in thousandths of p.u. and of a degree, the largest of all trials
        where a column says so; times and steps are sums, everything else means.
    """
    rows = scored[(scored.element == "") & (scored.method != "validate")]
    columns = {
        "vm_error_mean": ("mean |V| error [{}]", "mean"),
        "vm_error_max": ("largest |V| error [{}]", "max"),
        "va_error_mean": ("mean angle error [{}]", "mean"),
        "va_error_max": ("largest angle error [{}]", "max"),
        "nis_ratio": ("NIS/m [1]", "mean"),
        "nees_ratio": ("NEES/n [1]", "mean"),
        "coverage_vm": ("|V| in ±2σ [%]", "mean"),
        "coverage_va": ("angle in ±2σ [%]", "mean"),
        "steps_not_ok": ("steps not ok", "sum"),
        "seconds": ("time [s]", "sum"),
    }
    table = pd.DataFrame(index=pd.Index(list(method_colours(rows.method)), name="method"))
    for metric, (title, how) in columns.items():
        own = rows[rows.metric == metric]
        if own.empty or own.value.isna().all():
            continue
        factor, unit = thousandths(own.unit.iloc[0])
        factor = 100.0 if metric.startswith("coverage") else factor
        table[title.format(unit)] = factor * own.groupby("method").value.agg(how)
    return table


def detection_table(scored: pd.DataFrame) -> pd.DataFrame:
    """How many injected faults the checks found, a row per kind; trials are added up.

    Parameters
    ----------
    scored : DataFrame
        Table of that name.

    Returns
    -------
    DataFrame
        Index: kinds of faults and ``all``; empty where the faults are not known.
    """
    rows = scored[(scored.method == "validate") & scored.element.isin(["", *FaultKind])]
    counts = ["found", "missed", "false_alarms"]
    table = rows[rows.metric.isin(counts)].pivot_table(
        index="element", columns="metric", values="value", aggfunc="sum", dropna=False
    )
    table = table.reindex(columns=counts)
    known = table.found + table.missed
    table["recall [%]"] = 100 * table.found / known.where(known > 0)
    raised = table.found + table.false_alarms
    table["precision [%]"] = 100 * table.found / raised.where(raised > 0)
    kinds = [kind for kind in table.index if kind]
    table = table.reindex([*kinds, ""] if "" in table.index else kinds)
    index = [str(k).split("/")[-1] or "all" for k in table.index]
    table.index = pd.Index(index, name="fault")
    table.columns.name = None
    return table.rename(columns={"false_alarms": "false alarms"})
