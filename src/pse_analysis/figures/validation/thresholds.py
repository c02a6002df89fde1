"""Thresholds by Bayes and minimax: densities of the increment, and risks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from pse_analysis.drawing import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from pse_analysis.figures.paper import DOUBLE, SINGLE, TRUTH, Paper, legend, paper, styled

_ORDER = (SKY, BLUE, GREEN, ORANGE, VERMILION, PURPLE)


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


def _key(ax: Axes) -> None:
    """A key above its own axes, where two panels show different things."""
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2,
              columnspacing=1.0, handlelength=1.5)  # fmt: skip
