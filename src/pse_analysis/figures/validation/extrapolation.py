"""Extrapolation beside the assumption of no change: what it gains on one load."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.drawing import BLUE, ORANGE, VERMILION
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


def _percent(share: npt.ArrayLike) -> FloatArray:
    """Percent, NaN instead of 0, which a logarithm has no place for."""
    v = 100.0 * np.asarray(share, dtype=float)
    return np.where(v > 0.0, v, np.nan)
