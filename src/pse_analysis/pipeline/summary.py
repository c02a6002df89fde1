"""The table that ends a run, as text, from the scores."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pse_analysis.vocabulary import markdown_text

WIDTH = 100
NOTHING = "–"
LONGEST = 7
"""Characters of a number; one of a filter that went astray loses decimals, not its end."""


def _mean(values: pd.Series[float]) -> float:
    return float(values.mean())


def _rms(values: pd.Series[float]) -> float:
    return float(values.pow(2).mean() ** 0.5)


def _largest(values: pd.Series[float]) -> float:
    return float(values.max())


def _sum(values: pd.Series[float]) -> float:
    return float(values.sum(min_count=1))


Columns: TypeAlias = "tuple[tuple[str, str, Callable[[pd.Series[float]], float], str], ...]"

COLUMNS: Columns = (
    ("vm_error_mean", "|V|\nmean", _mean, ".3f"),
    ("vm_error_max", "|V|\nlargest", _largest, ".2f"),
    ("va_error_mean", "∠V\nmean", _mean, ".1f"),
    ("va_error_max", "∠V\nlargest", _largest, ".0f"),
    ("nis_ratio", "NIS/m", _mean, ".2f"),
    ("nees_ratio", "NEES/n", _mean, ".2f"),
    ("coverage_vm", "|V| in\n±2σ", _mean, ".1%"),
    ("coverage_va", "∠V in\n±2σ", _mean, ".1%"),
    ("steps_not_ok", "steps\nnot ok", _sum, ".0f"),
    ("seconds", "time\n[s]", _sum, ".1f"),
)
"""Metric, heading, how trials become one number, and format."""

MACHINE_COLUMNS: Columns = (
    ("angle_rms", "θ RMS\n[mrad]", _rms, ".1f"),
    ("angle_rms_theory", "theory\n[mrad]", _mean, ".1f"),
    ("angle_settling", "settles\n[s]", _mean, ".2f"),
    ("speed_rms", "ω RMS\n[mrad/s]", _rms, ".1f"),
    ("speed_rms_theory", "theory\n[mrad/s]", _mean, ".1f"),
    ("speed_settling", "settles\n[s]", _mean, ".2f"),
    ("nis_ratio", "NIS/m", _mean, ".3g"),
    ("nees_ratio", "NEES/n", _mean, ".3g"),
    ("coverage_angle", "θ in\n±2σ", _mean, ".1%"),
    ("steps_not_ok", "steps\nnot ok", _sum, ".0f"),
)

CHECK_HEAD = (
    "faults by kind, then by channel",
    "injected",
    "found",
    "recall",
    "false\nalarms",
    "per 1000\ngood",
    "precision",
)

CHECKED = "What the checks found of the injected faults, all trials together"
UNITS = "Mean and largest error of |V| in 1e-3 pu, of its angle in 1e-3 degree"
ATTENTION = "attention"
NO_TRUTH = "The truth is not known, so there are no errors to show"
WITH_TRUTH = ("vm_error_mean", "angle_rms")
MACHINE_UNITS = "RMS error of rotor angle θ and speed ω, and when it settles into ±2σ of theory"

# Errors are small: shown in thousandths, and angles of buses in degrees, as everywhere a person
# reads them.
_SCALE = {"pu": 1e3, "rad": 1e3 * 180.0 / math.pi, "degree": 1e3}
_MACHINE_SCALE = {"rad": 1e3, "rad/s": 1e3}


def text(
    title: str,
    scored: pd.DataFrame,
    account: Sequence[str] = (),
    order: Sequence[str] = (),
    notices: Sequence[str] = (),
) -> str:
    """Scores of the methods and of the checks, as plain text.

    Parameters
    ----------
    title
        The case's title.
    scored
        Table of that name; only rows of the whole case (element "") are shown, and trials are
        brought together: largest errors by their maximum, times by their sum, others by their mean.
    account
        Sentences that follow, findings of `pse_analysis.pipeline.account.of_run`.
    order
        Methods as they are to stand; by default as they come.
    notices
        Sentences to be read before the scores, notices of the same; they stand under the title.
    """
    units, head, rows = _content(scored, order)
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 0, 0, 1))
    for heading in head:
        justify: Literal["left", "right"] = "left" if heading is head[0] else "right"
        table.add_column(Text(heading), justify=justify, no_wrap=True, vertical="bottom")
    # As `Text`, because a unit in square brackets would be read as a style.
    for row in rows:
        table.add_row(*map(Text, row))
    stored = io.StringIO()
    # A fixed width and no colours: the text is stored, and read again by runs of any terminal.
    # A notebook would take the text away from the file.
    console = Console(
        file=stored, width=WIDTH, color_system=None, force_terminal=False, force_jupyter=False
    )
    width = console.measure(table).maximum
    console.print(Text(_title(title, scored).center(width)))
    for sentence in notices:
        console.print()
        console.print(_wrapped(f"{ATTENTION}: {sentence}"))
    if notices:
        console.print()
    console.print(Text(units.center(width)))
    console.print()
    console.print(table)
    console.print()
    for sentence in _closing(scored, account):
        console.print(_wrapped(sentence))
    return "\n".join(line.rstrip() for line in stored.getvalue().strip("\n").splitlines()) + "\n"


def _wrapped(sentence: str) -> Text:
    return Text("\n".join(textwrap.wrap(sentence, WIDTH, subsequent_indent="  ")))


def markdown(
    title: str,
    scored: pd.DataFrame,
    account: Sequence[str] = (),
    order: Sequence[str] = (),
    notices: Sequence[str] = (),
) -> str:
    """The same for the page of a recording, names from data as they are and not as markup."""
    units, headings, rows = _content(scored, order)
    head = [" ".join(heading.split()) for heading in headings]
    rule = ["---", *("---:" for _ in head[1:])]
    lines = ["| " + " | ".join(map(markdown_text, row)) + " |" for row in rows]
    table = ["| " + " | ".join(h.replace("|", "\\|") for h in head) + " |", f"|{'|'.join(rule)}|"]
    closing = [
        line for sentence in _closing(scored, account) for line in ("", markdown_text(sentence))
    ]
    first = [
        line for sentence in notices for line in (f"**{ATTENTION}:** {markdown_text(sentence)}", "")
    ]
    top = [f"# {markdown_text(_title(title, scored))}", "", *first, f"{units}.", ""]
    return "\n".join([*top, *table, *lines, *closing])


def _closing(scored: pd.DataFrame, account: Sequence[str]) -> list[str]:
    """What follows the table."""
    found = detection(scored)
    return [*([found] if found else ()), *account]


def detection(scored: pd.DataFrame) -> str:
    """One line on the faults of telemetry, over all trials; "" where no record is kept of them."""
    rows = scored[(scored["method"] == "validate") & (scored["element"] == "")]

    def total(metric: str) -> float:
        return float(rows.loc[rows["metric"] == metric, "value"].sum())

    if rows.empty:
        return ""
    found, missed, false_alarms = (total(m) for m in ("found", "missed", "false_alarms"))
    injected, alarms = found + missed, found + false_alarms
    recall = f" (recall {found / injected:.0%})" if injected else ""
    precision = f" (precision {found / alarms:.0%})" if alarms else ""
    return (
        f"bad data: {found:.0f} of {injected:.0f} found{recall}, {missed:.0f} missed, "
        f"{false_alarms:.0f} false alarms{precision}"
    )


def _title(title: str, scored: pd.DataFrame) -> str:
    estimated = scored["method"] != "validate"
    trials = scored.loc[estimated if estimated.any() else ~estimated, "trial"].nunique()
    return f"{title} ({trials} trial{'s' if trials != 1 else ''})"


def _content(
    scored: pd.DataFrame, order: Sequence[str] = ()
) -> tuple[str, list[str], list[list[str]]]:
    """What the table is about, its head and its rows: of methods, or of checks alone."""
    if (scored["method"] == "validate").all() and len(scored):
        return CHECKED, list(CHECK_HEAD), _check_rows(scored)
    columns, units, _ = _form(scored)
    rows = _rows(scored, order)
    # Without a truth there are no errors, and nothing to say of them.
    every = range(len(columns) + 1)
    known = [k for k in every if not rows or any(row[k] != NOTHING for row in rows)]
    if not any(columns[k - 1][0] in WITH_TRUTH for k in known if k):
        units = NO_TRUTH
    head = ["method", *(heading for _, heading, _, _ in columns)]
    return units, [head[k] for k in known], [[row[k] for k in known] for row in rows]


def _check_rows(scored: pd.DataFrame) -> list[list[str]]:
    """A row per kind of fault, then one per channel, trials added up."""
    counts = scored.pivot_table(
        index="element", columns="metric", values="value", aggfunc="sum", sort=False
    )
    rates = scored[scored["metric"] == "false_alarm_rate"]
    parts = [name for name in counts.index if name]
    found = []
    for name in sorted(parts, key=lambda part: ":" in part):
        hits, missed, alarms = (counts[m].get(name) for m in ("found", "missed", "false_alarms"))
        injected, flagged = hits + missed, hits + alarms
        rate = rates.loc[rates["element"] == name, "value"].mean()
        cells = [
            name,
            f"{injected:.0f}",
            f"{hits:.0f}",
            f"{hits / injected:.1%}" if injected else NOTHING,
            f"{alarms:.0f}",
            f"{1e3 * rate:.2f}" if math.isfinite(rate) else NOTHING,
            f"{hits / flagged:.1%}" if flagged else NOTHING,
        ]
        found.append(cells)
    return found


def _form(scored: pd.DataFrame) -> tuple[Columns, str, dict[str, float]]:
    """Columns, what they say, and scales: those of a machine where there is a rotor's angle."""
    if (scored["metric"] == "angle_rmse").any():
        return MACHINE_COLUMNS, MACHINE_UNITS, _MACHINE_SCALE
    return COLUMNS, UNITS, _SCALE


def _short(value: float, form: str) -> str:
    """A number in the given format, or with so few digits that it fits into a column."""
    found = format(value, form)
    if len(found) > LONGEST and not form.endswith("%"):
        found = format(value, ".0f" if 1.0 <= abs(value) < 10**LONGEST else ".1e")
    return found


def _rows(scored: pd.DataFrame, order: Sequence[str]) -> list[list[str]]:
    columns, _, scales = _form(scored)
    whole = scored[(scored["element"] == "") & (scored["method"] != "validate")]
    there = list(dict.fromkeys(whole["method"]))
    found = []
    for method in sorted(there, key=lambda m: order.index(m) if m in order else len(order)):
        own = whole[whole["method"] == method]
        cells = [str(method)]
        for metric, _, together, form in columns:
            rows = own[own["metric"] == metric]
            scale = rows["unit"].map(scales).fillna(1.0).astype(float)
            value = together(rows["value"].astype(float) * scale) if len(rows) else math.nan
            cells.append(_short(value, form) if math.isfinite(value) else NOTHING)
        found.append(cells)
    return found
