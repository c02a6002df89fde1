"""The checks side by side: what each asks of a sample, what it finds and what it costs.

The first-increment ("naive") check is orange, extrapolation blue, limits grey and their combination
green, in every figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import pandas as pd

from pse_analysis.drawing import BLUE, GREEN, ORANGE, VERMILION
from pse_analysis.figures.paper import (
    DOUBLE,
    MEASURED,
    SINGLE,
    TRUTH,
    Paper,
    legend,
    paper,
    styled,
)

CHECKS: Mapping[str, str] = MappingProxyType(
    {"limits": MEASURED, "increment": ORANGE, "extrapolation": BLUE, "combination": GREEN}
)
NAMES: Mapping[str, str] = MappingProxyType(
    {
        "limits": "limits",
        "increment": "first increment",
        "extrapolation": "extrapolation",
        "combination": "all together",
    }
)


@styled
def scheme(
    value: Sequence[float],
    k: float,
    gamma: float,
    limits: tuple[float, float],
    *,
    unit: str = "MW",
    width: float = SINGLE,
) -> Paper:
    """The three checks of one sample in one drawing: after Fig. 1 of [anishchenko2018].

    Parameters
    ----------
    value : (3,) sequence of float
        x(t − 2h), x(t − h), x(t), the last of them to be judged. [unit]
    k : float
        Coefficient of the extrapolation.
    gamma : float
        Threshold of both. [unit]
    limits : (2,) tuple of float
        [unit]
    """
    first, last, now = value
    ahead = last + k * (last - first)
    figure = paper(width, 2.7)
    ax = figure.subplots()
    ax.axhspan(*limits, color=MEASURED, alpha=0.12, lw=0, label="within limits")
    for at, centre, name in ((-0.13, last, "increment"), (0.13, ahead, "extrapolation")):
        colour = CHECKS[name]
        label = f"{NAMES[name]} ≤ γ"
        ax.errorbar(
            [at], [centre], yerr=gamma, fmt="o", ms=4, mfc="white", color=colour, capsize=4, lw=1.5,
            label=label,
        )  # fmt: skip
    ax.plot([-1, -0.13], [last, last], ls=":", color=ORANGE)
    ax.plot([-2, -1, 0.13], [first, last, ahead], ls=":", color=BLUE, zorder=1.5)
    ax.plot([-2, -1], [first, last], "o", color=TRUTH, ms=4)
    ax.plot([0], [now], "x", color=VERMILION, ms=7, mew=1.8, label="sample to judge")
    ax.set_xlim(-2.35, 0.5)
    ax.set_xticks([-2, -1, 0], ["t − 2h", "t − h", "t"])
    ax.set_xlabel("Time [sampling periods h]")
    ax.set_ylabel(f"Load [{unit}]")
    legend(figure, ax)
    return figure


@styled
def roc_curves(
    table: pd.DataFrame, predicted: pd.DataFrame | None = None, *, width: float = SINGLE
) -> Paper:
    """Detection against false alarms, a curve per check.

    Parameters
    ----------
    table : DataFrame
        Columns ``check``, ``false_alarm`` and ``detection``, as samples come.
    predicted : DataFrame, optional
        The same given good references; drawn dashed.
    """
    figure = paper(width, 2.9)
    ax = figure.subplots()
    markers = {"limits": "x", "increment": "s", "extrapolation": "^", "combination": "o"}
    for check, part in table.groupby("check", sort=False):
        name = str(check)
        shown = part[part.false_alarm > 0].sort_values("quantile")
        ax.semilogx(100 * shown.false_alarm, 100 * shown.detection, marker=markers[name], ms=3,
                    mfc="none", color=CHECKS[name], label=NAMES[name])  # fmt: skip
    if predicted is not None:
        for check, part in predicted.groupby("check", sort=False):
            ax.semilogx(100 * part.false_alarm, 100 * part.detection, "--", lw=0.9,
                        color=CHECKS[str(check)])  # fmt: skip
        ax.plot([], [], "--", lw=0.9, color=TRUTH, label="given good references")
    ax.set_xlim(0.02, 100)
    ax.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    ax.set_ylim(0, 100)
    ax.set_xlabel("Good samples flagged [%]")
    ax.set_ylabel("Gross errors found [%]")
    legend(figure, ax)
    return figure


@styled
def realised_rates(table: pd.DataFrame, *, width: float = DOUBLE) -> Paper:
    """Predicted and realised rates at Bayes thresholds against q: false alarms and misses.

    Parameters
    ----------
    table : DataFrame
        Columns ``check``, ``q``, ``rate``, ``predicted``, ``conditional``, ``conditional_error``
        and ``unconditional``.
    """
    figure = paper(width, 2.7)
    axes = figure.subplots(1, 2)
    titles = {"false_alarm": "Good samples flagged [%]", "miss": "Gross errors missed [%]"}
    for ax, (rate, title) in zip(axes, titles.items(), strict=True):
        for check, part in table[table.rate == rate].groupby("check", sort=True):
            colour, name = CHECKS[str(check)], NAMES[str(check)]
            ax.plot(part.q, 100 * part.predicted, color=colour, label=f"{name}, predicted")
            ax.errorbar(part.q, 100 * part.conditional, yerr=300 * part.conditional_error, fmt="o",
                        ms=4, mfc="white", color=colour, capsize=2)  # fmt: skip
            ax.plot(part.q, 100 * part.unconditional, "x", ms=5, mew=1.3, color=colour)
        ax.plot([], [], "o", ms=4, mfc="white", color=TRUTH, label="good references, ±3 s.e.")
        ax.plot([], [], "x", ms=5, mew=1.3, color=TRUTH, label="as samples come")
        ax.set_xscale("log")
        ticks = sorted(table.q.unique())
        ax.set_xticks(ticks, [f"{q:g}" for q in ticks])
        ax.minorticks_off()
        ax.set_xlabel("Prior probability q, and share of errors put in [1]")
        ax.set_ylabel(title)
    axes[0].set_yscale("log")
    values = [0.03, 0.1, 0.3, 1, 3, 10]
    axes[0].set_yticks(values, [f"{v:g}" for v in values])
    axes[0].minorticks_off()
    axes[1].set_ylim(0, 100)
    legend(figure, *axes)
    return figure


@styled
def margins(table: pd.DataFrame, *, width: float = DOUBLE) -> Paper:
    """What extrapolation finds more than first increments, a row per curve, by |ρ̂₁|.

    Parameters
    ----------
    table : DataFrame
        Index: curves; columns ``rho``, ``claimed``, ``margin``, ``error`` and ``as_they_come``.
    """
    rows = table.sort_values("rho", key=np.abs)
    at = np.arange(len(rows))
    figure = paper(width, 0.9 + 0.135 * len(rows))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1, 2])
    claimed = rows.claimed.to_numpy(dtype=bool)
    for chosen, colour, fill, label in (
        (claimed, BLUE, BLUE, "gain claimed from the history"),
        (~claimed, MEASURED, "white", "no gain claimed"),
    ):
        some = rows[chosen]
        left.plot(some.rho, at[chosen], "o", ms=3.5, mfc=fill, color=colour)
        right.errorbar(100 * some.margin, at[chosen], xerr=200 * some.error, fmt="o", ms=3.5,
                       mfc=fill, color=colour, capsize=1.5, lw=0.9, label=label)  # fmt: skip
    right.plot(100 * rows.as_they_come, at, "|", ms=6, mew=1.4, color=VERMILION,
               label="as samples come")  # fmt: skip
    for ax in (left, right):
        ax.axvline(0.0, color=TRUTH, lw=0.7)
    left.set_yticks(at, [str(name).removesuffix("_pload") for name in rows.index])
    left.set_ylim(-0.7, len(rows) - 0.3)
    left.set_xlim(-1, 1)
    left.set_ylabel("Load curve [name]")
    left.set_xlabel("ρ̂₁ of the history [1]")
    right.set_xlabel("Errors found, extrapolation less first increments [% of errors]")
    right.tick_params(labelleft=False)
    legend(figure, right)
    return figure
