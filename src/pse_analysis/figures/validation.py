"""Figures of the checks: thresholds, extrapolation and what both are worth.

Colours: the first-increment ("naive") check is orange, extrapolation blue, limits grey and their
combination green, in every figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes

from pse_analysis.drawing import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from pse_analysis.figures.paper import (
    DOUBLE,
    MEASURED,
    SINGLE,
    TRUTH,
    Paper,
    legend,
    paper,
    styled,
    time_axis,
)

Array = npt.NDArray[np.float64]

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
_ORDER = (SKY, BLUE, GREEN, ORANGE, VERMILION, PURPLE)


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
def variance_against_k(
    k: npt.ArrayLike,
    scanned: npt.ArrayLike,
    closed: npt.ArrayLike,
    k_opt: float,
    *,
    width: float = SINGLE,
) -> Paper:
    """Variance of the extrapolation error over σ² against k: Fig. 2 of [anishchenko2018].

    Parameters
    ----------
    k : (n,) array_like
    scanned, closed : (n,) array_like
        D(k)/σ² as found by trying each k, and as 1 − 2kρ₁ + k².
    k_opt : float
        Where the closed form is least.
    """
    u, found, form = (np.asarray(v, dtype=float) for v in (k, scanned, closed))
    figure = paper(width, 2.5)
    ax = figure.subplots()
    ax.plot(u, form, color=BLUE, label="closed form")
    every = max(1, len(u) // 30)
    ax.plot(u[::every], found[::every], "o", ms=3, mfc="none", color=ORANGE, label="scan")
    least, naive = float(form.min()), float(np.interp(0.0, u, form))
    ax.axhline(naive, color=MEASURED, lw=0.7, ls="--")
    ax.annotate(
        "", (k_opt, least), (k_opt, naive), arrowprops={"arrowstyle": "<->", "color": TRUTH}
    )
    gain = 100.0 * (naive - least) / naive
    ax.text(k_opt, 0.72 * least, f"ΔPC = {gain:.1f} %", va="top", ha="center")
    ax.plot([0.0], [naive], "s", ms=5, color=TRUTH, label="k = 0, no change")
    ax.plot([k_opt], [least], "D", ms=5, color=TRUTH, label=f"k_opt = {k_opt:.2f}")
    ax.set_ylim(0.0, float(form.max()) * 1.04)
    ax.set_xlabel("Coefficient k of the last increment [1]")
    ax.set_ylabel("Variance of the error / σ² [1]")
    legend(figure, ax)
    return figure


@styled
def extrapolated(
    time: npt.ArrayLike,
    measured: npt.ArrayLike,
    naive: npt.ArrayLike,
    optimal: npt.ArrayLike,
    *,
    unit: str = "MW",
    width: float = DOUBLE,
) -> Paper:
    """A load with its two extrapolations, and their errors: Fig. 3 of [anishchenko2018].

    Parameters
    ----------
    time : (n,) array_like
        Times in UTC.
    measured, naive, optimal : (n,) array_like
        [unit]
    """
    figure = paper(width, 3.3)
    ax, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    x, plain, sharp = (np.asarray(v, dtype=float) for v in (measured, naive, optimal))
    t = pd.DatetimeIndex(time)
    ax.plot(t, x, "o-", ms=3, color=TRUTH, label="1 measured")
    ax.plot(t, plain, "s--", ms=3, mfc="none", color=ORANGE, label="2 no change, k = 0")
    ax.plot(t, sharp, "^-", ms=3, mfc="none", color=BLUE, label="3 extrapolated, k = k_opt")
    ax.set_ylabel(f"Load [{unit}]")
    below.axhline(0.0, color=TRUTH, lw=0.6)
    below.plot(t, x - plain, "s--", ms=3, mfc="none", color=ORANGE)
    below.plot(t, x - sharp, "^-", ms=3, mfc="none", color=BLUE)
    below.set_ylabel(f"Error [{unit}]")
    time_axis(below, width)
    ax.tick_params(labelbottom=False)
    legend(figure, ax)
    return figure


@styled
def share_against_threshold(
    gamma: npt.ArrayLike,
    naive: npt.ArrayLike,
    optimal: npt.ArrayLike,
    *,
    faulty: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    width: float = SINGLE,
) -> Paper:
    """Share r of samples beyond γ (17): Fig. 4 of [anishchenko2018].

    Parameters
    ----------
    gamma : (n,) array_like
        Thresholds over σ of the increment.
    naive, optimal : (n,) array_like
        Shares of a load without errors. [1]
    faulty : pair of (n,) array_like, optional
        The same of a load with gross errors.
    """
    g = np.asarray(gamma, dtype=float)
    figure = paper(width, 2.5)
    ax = figure.subplots()
    for share, name, colour in (
        (optimal, "1 extrapolation", BLUE),
        (naive, "2 no change", ORANGE),
    ):
        ax.semilogy(g, _percent(share), color=colour, label=name)
    if faulty is not None:
        for share, colour in zip(faulty, (ORANGE, BLUE), strict=True):
            ax.semilogy(g, _percent(share), color=colour, ls="--")
        ax.plot([], [], "--", color=TRUTH, label="with gross errors")
    ax.set_ylim(0.01, 100)
    ax.set_yticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    ax.set_xlabel("Threshold γ/σ [1]")
    ax.set_ylabel("Samples beyond γ, r [%]")
    legend(figure, ax)
    return figure


@styled
def densities(
    x: npt.ArrayLike, curves: Mapping[str, tuple[npt.ArrayLike, float]], *, width: float = SINGLE
) -> Paper:
    """Densities of the increment over σ, each with its mass in the legend.

    Parameters
    ----------
    x : (n,) array_like
        Increment over σ.
    curves : mapping of str to (density, mass)
        By name, in order; the density is an (n,) array.
    """
    figure = paper(width, 2.6)
    ax = figure.subplots()
    styles = (("-", TRUTH), ("-", BLUE), ("--", GREEN), (":", VERMILION))
    for (name, (density, mass)), (line, colour) in zip(curves.items(), styles, strict=False):
        y = np.asarray(density, dtype=float)
        ax.plot(np.asarray(x, dtype=float), y, line, color=colour, lw=1.4,
                label=f"{name}: mass {mass:.2f}")  # fmt: skip
    ax.set_xlabel("Increment / σ [1]")
    ax.set_ylabel("Density [1]")
    ax.set_ylim(bottom=0.0)
    legend(figure, ax)
    return figure


@styled
def risk_curves(
    k: npt.ArrayLike,
    risks: Mapping[float, npt.ArrayLike],
    bayes: Mapping[float, tuple[float, float]],
    q: npt.ArrayLike,
    by_prior: Mapping[str, npt.ArrayLike],
    minimax: tuple[float, float],
    *,
    width: float = DOUBLE,
) -> Paper:
    """Risk against the threshold with the Bayes points, and against q with the minimax point.

    Parameters
    ----------
    k : (n,) array_like
        Thresholds γ/σ.
    risks : mapping of float to (n,) array_like
        Risk by k, for each prior q; in costs of a false alarm.
    bayes : mapping of float to (k, risk)
        Optimum of each prior.
    q : (n_q,) array_like
    by_prior : mapping of str to (n_q,) array_like
        Risk against q: ``bayes`` (its own threshold at each q), ``minimax``, and any other name.
    minimax : (q₀, risk)
    """
    figure = paper(width, 2.8)
    left, right = figure.subplots(1, 2)
    for (prior, risk), colour in zip(risks.items(), _ORDER, strict=False):
        left.plot(k, np.asarray(risk, dtype=float), color=colour, label=f"q = {prior:g}")
        left.plot(*bayes[prior], "o", ms=4.5, mfc="white", color=colour)
    left.plot([], [], "o", ms=4.5, mfc="white", color=TRUTH, label="Bayes")
    left.set_xlabel("Threshold k = γ/σ [1]")
    left.set_ylabel("Risk [cost of a false alarm]")
    left.set_ylim(bottom=0.0)
    colours = dict(zip(by_prior, (TRUTH, VERMILION, PURPLE, GREEN), strict=False))
    for name, risk in by_prior.items():
        style = {"bayes": "-", "minimax": "--"}.get(name, ":")
        shown = {"bayes": "Bayes at each q", "minimax": "minimax threshold"}.get(name, name)
        right.plot(q, np.asarray(risk, dtype=float), style, color=colours[name], label=shown)
    right.plot(*minimax, "D", ms=5, color=VERMILION, label=f"q₀ = {minimax[0]:.3f}")
    right.set_xlabel("Prior probability q of a gross error [1]")
    right.set_ylabel("Risk [cost of a false alarm]")
    right.set_ylim(0.0, 1.6 * minimax[1])
    for ax in (left, right):
        _key(ax)
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
def gain_against_autocorrelation(table: pd.DataFrame, *, width: float = SINGLE) -> Paper:
    """Gain in resolution ΔPC (16) against ρ₁: simulated with ±2 standard errors, and 100·ρ₁².

    Parameters
    ----------
    table : DataFrame
        Columns ``rho``, ``simulated`` and ``error``. [%]
    """
    figure = paper(width, 2.5)
    ax = figure.subplots()
    rho = np.linspace(-1.0, 1.0, 201)
    ax.plot(rho, 100 * rho**2, color=BLUE, label="100·ρ₁²")
    ax.errorbar(table.rho, table.simulated, yerr=2 * table.error, fmt="o", ms=3.5, mfc="white",
                color=ORANGE, capsize=2, label="simulated")  # fmt: skip
    ax.plot([0.5], [25.0], "*", ms=9, color=VERMILION, label="published")
    ax.set_xlabel("Autocorrelation ρ₁ of the increments [1]")
    ax.set_ylabel("Gain in resolution ΔPC [%]")
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


def _percent(share: npt.ArrayLike) -> Array:
    """Percent, NaN instead of 0, which a logarithm has no place for."""
    v = 100.0 * np.asarray(share, dtype=float)
    return np.where(v > 0.0, v, np.nan)


def _key(ax: Axes) -> None:
    """A key above its own axes, where two panels show different things."""
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2,
              columnspacing=1.0, handlelength=1.5)  # fmt: skip
