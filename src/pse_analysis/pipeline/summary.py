"""The table that ends a run, as text, from the scores."""

from __future__ import annotations

import io
import math
from collections.abc import Callable

import numpy as np
import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table

WIDTH = 100
NOTHING = "–"

Shown = tuple[str, str, Callable[[pd.Series], float], str]
"""Metric, heading, how trials become one number, and format."""


def _mean(values: pd.Series) -> float:
    return float(values.mean())


def _largest(values: pd.Series) -> float:
    return float(values.max())


def _sum(values: pd.Series) -> float:
    return float(values.sum(min_count=1))


COLUMNS: tuple[Shown, ...] = (
    ("vm_error_mean", "|V| error\nmean\n[1e-3 pu]", _mean, ".3f"),
    ("vm_error_max", "\nlargest\n[1e-3 pu]", _largest, ".2f"),
    ("va_error_mean", "angle error\nmean\n[1e-3 deg]", _mean, ".2f"),
    ("va_error_max", "\nlargest\n[1e-3 deg]", _largest, ".1f"),
    ("nis_ratio", "NIS/m", _mean, ".2f"),
    ("coverage_vm", "in ±2σ\n|V|", _mean, ".1%"),
    ("coverage_va", "in ±2σ\nangle", _mean, ".1%"),
    ("steps_not_ok", "steps\nnot ok", _sum, ".0f"),
    ("seconds", "time\n[s]", _sum, ".2f"),
)

# Errors are small: shown in thousandths, and angles in degrees, as everywhere a person reads them.
_SCALE = {"pu": 1e3, "rad": 1e3 * 180.0 / math.pi, "degree": 1e3}


def render(title: str, scored: pd.DataFrame) -> str:
    """Scores of the methods and of the checks, as plain text.

    Parameters
    ----------
    title
        The case's title.
    scored
        Table of that name; only rows of the whole case (element "") are shown, and trials are
        brought together: largest errors by their maximum, times by their sum, others by their mean.
    """
    whole = scored[scored["element"] == ""]
    estimates = whole[whole["method"] != "validate"]
    trials = estimates["trial"].nunique()
    caption = f"{trials} trial{'s' if trials != 1 else ''}"
    table = Table(title=f"{title} ({caption})", title_style="", box=box.SIMPLE_HEAD)
    table.add_column("method", vertical="bottom")
    for _, heading, _, _ in COLUMNS:
        table.add_column(heading, justify="right")
    for method in dict.fromkeys(estimates["method"]):
        rows = estimates[estimates["method"] == method]
        table.add_row(str(method), *(_cell(rows, shown) for shown in COLUMNS))
    text = io.StringIO()
    # A fixed width and no colours: the text is stored, and read again by runs of any terminal.
    console = Console(file=text, width=WIDTH, color_system=None, force_terminal=False)
    console.print(table)
    console.print(detection(whole[whole["method"] == "validate"]), highlight=False)
    return "\n".join(line.rstrip() for line in text.getvalue().strip("\n").splitlines()) + "\n"


def detection(rows: pd.DataFrame) -> str:
    """One line on the faults of telemetry: found, missed and false alarms, over all trials."""

    def total(metric: str) -> float:
        return float(rows.loc[rows["metric"] == metric, "value"].sum())

    if rows.empty:
        return "bad data: nothing to compare with, the case has no record of its faults"
    found, missed, false_alarms = (total(m) for m in ("found", "missed", "false_alarms"))
    injected, alarms = found + missed, found + false_alarms
    recall = f" (recall {found / injected:.0%})" if injected else ""
    precision = f" (precision {found / alarms:.0%})" if alarms else ""
    return (
        f"bad data: {found:.0f} of {injected:.0f} found{recall}, {missed:.0f} missed, "
        f"{false_alarms:.0f} false alarms{precision}"
    )


def _cell(rows: pd.DataFrame, shown: Shown) -> str:
    metric, _, together, form = shown
    chosen = rows[rows["metric"] == metric]
    values = chosen["value"].astype(float) * chosen["unit"].map(_SCALE).fillna(1.0).astype(float)
    value = together(values) if len(values) else np.nan
    return NOTHING if not np.isfinite(value) else format(value, form)
