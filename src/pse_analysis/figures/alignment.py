"""Figures of what alignment and screening do to single channels, and what is left at every bus."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.drawing import BLUE, GREEN, GREY, ORANGE, VERMILION
from pse_analysis.figures.paper import DOUBLE, MEASURED, Paper, legend, paper, styled

APART = 4.0
"""Distance between two curves of z-scores, in σ."""
SHOWN = {
    "vm_pu": (1e3, "error of |V| [10⁻³ p.u.]"),
    "va_degree": (1e3 * np.pi / 180.0, "error of the angle [10⁻³ rad]"),
}


class Match(Protocol):
    """What is read of `pse_analysis.alignment.dtw.Match`."""

    @property
    def time(self) -> FloatArray:
        """Grid of both series. [s]"""

    @property
    def device(self) -> FloatArray:
        """Z-scores of the device."""

    @property
    def reference(self) -> FloatArray:
        """Z-scores of its partner."""

    @property
    def path(self) -> npt.NDArray[np.int64]:
        """Matched positions of the two. (k, 2)"""


class Decision(Protocol):
    """What is read of `pse_analysis.validation.adaptive.Decision`; arrays (n, 1)."""

    @property
    def statistic(self) -> FloatArray:
        """What is compared."""

    @property
    def threshold(self) -> FloatArray:
        """What it is compared with."""

    @property
    def flagged(self) -> npt.NDArray[np.bool_]:
        """What was found."""


@styled
def warped(
    match: Match, device: str, reference: str, *, every: int = 10, width: float = DOUBLE
) -> Paper:
    """One window as time warping sees it, with the pairs that it found.

    Parameters
    ----------
    match : Match
    device, reference : str
        What the legend calls the two.
    every : int
        Of so many pairs one is drawn.
    width : float
        [inch]
    """
    figure = paper(width, 2.4)
    ax = figure.subplots()
    minute = (match.time - match.time[0]) / 60.0
    for i, j in match.path[::every]:
        ends = match.device[i], match.reference[j] + APART
        ax.plot(minute[[i, j]], ends, color=GREY, linewidth=0.4, zorder=1)
    ax.plot(minute, match.reference + APART, color=BLUE, label=f"{reference}, + {APART:g}")
    ax.plot(minute, match.device, color=ORANGE, label=device)
    ax.set_xlabel("minutes of the window")
    ax.set_ylabel("z-score")
    legend(figure, ax)
    return figure


@styled
def errors_at_instant(
    paired: pd.DataFrame, names: Mapping[str, str], *, width: float = DOUBLE
) -> Paper:
    """Size of the errors of |V| and angle at every bus, at one instant.

    Parameters
    ----------
    paired : DataFrame
        From `pse_analysis.scoring.errors.against_truth`, one instant and trial.
    names : mapping of str to str
        Methods that are shown, and what the legend calls them.
    width : float
        [inch]
    """
    figure = paper(width, 2.4)
    axes = figure.subplots(1, 2)
    for ax, (quantity, (factor, label)) in zip(axes, SHOWN.items(), strict=True):
        for (method, name), colour in zip(names.items(), (BLUE, ORANGE, GREEN), strict=False):
            own = paired[(paired["method"] == method) & (paired["quantity"] == quantity)]
            bus = own["element"].str.removeprefix("bus/").astype(int)
            size = factor * own["error"].abs()
            ax.plot(bus, size, ".", color=colour, label=name)
        ax.set_ylim(bottom=0)
        ax.set_xlabel("bus")
        ax.set_ylabel(label)
    legend(figure, *axes)
    return figure


@styled
def screened(
    step: npt.NDArray[np.int64],
    shown: Mapping[str, tuple[FloatArray, Decision]],
    *,
    label: str,
    unit: str,
    window: tuple[int, int],
    bad: tuple[int, int],
    width: float = DOUBLE,
) -> Paper:
    """A channel and its threshold, as Fig. 5 of [qi2025] has them: a column for each record.

    Parameters
    ----------
    step : (n,) ndarray of int
    shown : mapping of str to (values (n, 1), Decision)
        By the title of the column.
    label, unit : str
        Of the channel.
    window, bad : (int, int)
        Steps that are shown, and those that are shaded.
    width : float
        [inch]
    """
    figure = paper(width, 3.6)
    axes = figure.subplots(2, len(shown), sharex=True, sharey="row", squeeze=False)
    inside = (step >= window[0]) & (step <= window[1])
    for column, (title, (value, decision)) in zip(axes.T, shown.items(), strict=True):
        column[0].plot(step[inside], value[inside, 0], color=MEASURED)
        column[0].set_title(title)
        size, threshold = decision.statistic[inside, 0], decision.threshold[inside, 0]
        column[1].plot(step[inside], size, color=BLUE, label="|residual|")
        column[1].plot(step[inside], threshold, color=ORANGE, label="threshold")
        hit = decision.flagged[inside, 0]
        column[1].plot(step[inside][hit], size[hit], "x", color=VERMILION, label="flagged")
        column[1].set_xlabel("step")
        for ax in column:
            ax.axvspan(*bad, color="#EEEEEE", zorder=0)
    axes[1, 0].set_ylim(bottom=0)
    axes[0, 0].set_ylabel(f"{label} [{unit}]")
    axes[1, 0].set_ylabel(f"[{unit}]")
    legend(figure, axes[1, -1])
    return figure
