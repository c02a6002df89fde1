"""Figures of a machine's observers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import NullLocator

from pse_analysis.arrays import FloatArray
from pse_analysis.drawing import BLUE, GREEN, ORANGE, SKY, VERMILION
from pse_analysis.errors import TableError
from pse_analysis.figures.paper import (
    DOUBLE,
    MEASURED,
    TRUTH,
    Paper,
    legend,
    paper,
    styled,
)
from pse_analysis.machine import INPUT, STATES

_LABEL = dict(zip(STATES, ("θ [rad]", "ω [rad/s]"), strict=True))
_TIME = "Time since the start [s]"


@styled
def scheme(
    aligned: pd.DataFrame, *, until_s: float = 20.0, trial: int = 0, width: float = DOUBLE
) -> Paper:
    """What the three parts of the study hand to each other, and the torque that drives them.

    Parameters
    ----------
    aligned : DataFrame
        Table of that name; ΔM is drawn from it.
    until_s : float
        End of the time axis. [s]
    trial : int
        Trial to draw.
    width : float
        Of the figure. [inch]
    """
    figure = paper(width, 3.6)
    top, below = figure.subplots(2, 1, height_ratios=[1.0, 1.15])
    parts = ("power system\n(non-linear)", "generator\n$\\dot x = Ax + Bu + f$",
             "observer\n$\\dot{\\hat x} = A\\hat x + Bu + L(\\hat y - y)$")  # fmt: skip
    for column, words in enumerate(parts):
        box = FancyBboxPatch((4 * column, 0), 2.4, 1.2, boxstyle="round,pad=0.1", fc="#F2F2F2")
        top.add_patch(box)
        top.text(4 * column + 1.2, 0.6, words, ha="center", va="center")
    arrows = (
        (2.5, 0.8, 3.9, 0.8, "u = ΔM"), (6.5, 0.8, 7.1, 0.8, "θ"), (7.3, 0.8, 7.9, 0.8, "y"),
        (10.5, 0.6, 11.7, 0.6, "θ̂, ω̂"), (5.2, 2.1, 5.2, 1.35, "f"), (7.2, 2.1, 7.2, 0.9, "ξ"),
        (1.2, 2.1, 1.2, 1.35, "+10 MW at 5 s"),
    )  # fmt: skip
    style = {"arrowstyle": "->", "lw": 0.9, "color": TRUTH}
    for x0, y0, x1, y1, name in arrows:
        top.annotate("", (x1, y1), (x0, y0), arrowprops=style)
        across = y0 == y1
        where = ((x0 + x1) / 2, y0 + 0.12) if across else (x0, y0 + 0.05)
        top.text(*where, name, ha="center", va="bottom")
    top.plot(7.2, 0.8, "o", ms=6, mfc="white", mec=TRUTH, mew=0.9)
    top.annotate("", (7.9, 0.25), (7.4, 0.25), arrowprops=style)
    top.plot([3.2, 3.2, 7.4, 7.4], [0.8, -0.45, -0.45, 0.25], color=TRUTH, lw=0.9)
    top.text(5.2, -0.42, "u", ha="center", va="bottom")
    top.set(xlim=(-0.3, 12), ylim=(-0.7, 2.6))
    top.axis("off")
    own = aligned[(aligned.trial == trial) & aligned.channel.str.endswith(INPUT)]
    own = own[own.origin == "measured"]
    since = _since(own.time_utc, own.time_utc.min())
    below.plot(since, own.value_pu, color=BLUE, lw=0.8)
    below.set(xlabel=_TIME, ylabel="ΔM [p.u.]", xlim=(0, until_s))
    return figure


@styled
def oscillogram(
    estimated: pd.DataFrame,
    truth: pd.DataFrame,
    aligned: pd.DataFrame,
    method: str,
    *,
    until_s: float | None = None,
    trial: int = 0,
    width: float = DOUBLE,
) -> Paper:
    """Output and states with their estimates, as Figs. 2–4 of [frolov2025] show them.

    Parameters
    ----------
    estimated, truth, aligned : DataFrame
        Tables of these names.
    method : str
        Observer to draw.
    until_s : float, optional
        End of the time axis; default: everything. [s]
    trial : int
        Trial to draw.
    width : float
        Of the figure. [inch]

    Raises
    ------
    TableError
        If there is no estimate of that method.
    """
    own = estimated[(estimated.method == method) & (estimated.trial == trial)]
    if own.empty:
        known = ", ".join(map(str, dict.fromkeys(estimated.method)))
        raise TableError(f"no estimate of method {method!r} in trial {trial}; expected {known}")
    begin = own.time_utc.min()
    figure = paper(width, 4.6)
    axes = figure.subplots(3, 1, sharex=True)
    angle, speed = (_state(own, q, begin) for q in STATES)
    seen = aligned[(aligned.trial == trial) & (aligned.origin == "measured")]
    seen = seen[seen.channel.str.endswith(STATES[0])]
    measured = _since(seen.sample_utc, begin)
    axes[0].plot(measured, seen.value_pu, color="#BBBBBB", lw=2.2, label="y, measured")
    axes[0].plot(*angle, color=BLUE, lw=0.7, label="ŷ, observed")
    axes[0].set_ylabel("y [rad]")
    pairs = zip(axes[1:], STATES, (angle, speed), (GREEN, VERMILION), strict=True)
    for ax, quantity, (time, value), colour in pairs:
        real = truth[(truth.trial == trial) & (truth.quantity == quantity)]
        symbol = _LABEL[quantity][0]
        ax.plot(time, value, color=colour, lw=0.8, label=f"{symbol}, observed")
        ax.plot(
            _since(real.time_utc, begin), real.value, color=TRUTH, lw=0.9, label=f"{symbol}, true"
        )
        ax.set_ylabel(_LABEL[quantity])
    if until_s is not None:
        for ax in axes:
            _fit(ax, until_s)
    axes[-1].set_xlabel(_TIME)
    axes[-1].set_xlim(0, until_s or float(angle[0][-1]))
    for ax in axes:
        ax.legend(loc="upper right", ncols=2)
    return figure


@styled
def through_gap(
    estimated: pd.DataFrame,
    truth: pd.DataFrame,
    validated: pd.DataFrame,
    method: str,
    window_s: tuple[float, float],
    *,
    trial: int = 0,
    width: float = DOUBLE,
) -> Paper:
    """Error of an observer with its ±2σ while samples are flagged or missing.

    Parameters
    ----------
    estimated, truth, validated : DataFrame
        Tables of these names.
    method : str
        Observer to draw.
    window_s : (2,) tuple of float
        Part of the study to draw. [s]
    trial : int
        Trial to draw.
    width : float
        Of the figure. [inch]
    """
    figure = paper(width, 3.2)
    axes = figure.subplots(2, 1, sharex=True)
    own = estimated[(estimated.method == method) & (estimated.trial == trial)]
    begin = own.time_utc.min()
    flagged = validated[(validated.trial == trial) & (validated.flag > 0)]
    for ax, quantity, colour in zip(axes, STATES, (GREEN, VERMILION), strict=True):
        real = truth[(truth.trial == trial) & (truth.quantity == quantity)]
        both = own[own.quantity == quantity].merge(
            real[["time_utc", "value"]], on="time_utc", suffixes=("", "_true")
        )
        time = _since(both.time_utc, begin)
        here = (time >= window_s[0]) & (time <= window_s[1])
        error, sigma = both.value - both.value_true, 2.0 * both.sigma
        time, error, sigma = time[here], error[here], sigma[here]
        ax.fill_between(time, -sigma, sigma, color=colour, alpha=0.22, lw=0, label="±2σ")
        ax.plot(time, error, color=colour, lw=0.8, label="error")
        for at in _since(flagged.time_utc, begin):
            ax.axvline(at, color=ORANGE, lw=1.0, ls="--", label="flagged sample")
        ax.set_ylabel(f"Error of {_LABEL[quantity]}")
    axes[-1].set(xlabel=_TIME, xlim=window_s)
    legend(figure, *axes)
    return figure


@styled
def ratio_curve(
    ratios: npt.ArrayLike,
    rms: Mapping[str, FloatArray],
    simulated: pd.DataFrame,
    true_ratio: float,
    marks: Mapping[str, float],
    *,
    width: float = DOUBLE,
) -> Paper:
    """Stationary RMS error against Q/R: theory, simulation, and where the least one lies.

    Parameters
    ----------
    ratios : (r,) array_like
        Q/R of the theory's curves.
    rms : mapping of str to (r, 2) ndarray
        Theory's curves by name; θ and ω. [rad, rad/s]
    simulated : DataFrame
        ``ratio``, ``quantity``, ``rms`` and ``standard_error``.
    true_ratio : float
        Ratio of the true densities.
    marks : mapping of str to float
        Ratios to name.
    width : float
        Of the figure. [inch]
    """
    figure = paper(width, 2.9)
    axes = figure.subplots(1, 2)
    styles = ("-", "--", ":")
    for state, (ax, quantity) in enumerate(zip(axes, STATES, strict=True)):
        for (name, curve), style in zip(rms.items(), styles, strict=False):
            ax.plot(ratios, curve[:, state], color=BLUE, ls=style, label=f"theory, {name}")
        own = simulated[simulated.quantity == quantity]
        ax.errorbar(
            own.ratio, own.rms, 3.0 * own.standard_error, fmt="o", ms=3, color=VERMILION, lw=0.9,
            label="simulated ± 3 standard errors",
        )  # fmt: skip
        ax.axvline(true_ratio, color=GREEN, lw=0.9, ls="--", label="true ratio")
        ax.set(xscale="log", yscale="log", xlabel="Q/R [1/s² of θ, 1/s⁴ of ω]")
        ax.set_ylabel(f"RMS error of {_LABEL[quantity]}")
        for name, at in marks.items():
            ax.annotate(
                name, (at, 0.97), xycoords=("data", "axes fraction"), ha="center", va="top",
                fontsize=7, rotation=90, color=MEASURED,
            )  # fmt: skip
    legend(figure, *axes)
    return figure


@styled
def model_cost(
    factor: npt.ArrayLike,
    curves: Mapping[str, FloatArray],
    matched: Sequence[float],
    *,
    width: float = DOUBLE,
) -> Paper:
    """What a wrong parameter adds to the RMS error, against the assumed value over the true one.

    Parameters
    ----------
    factor : (r,) array_like
        Assumed over true.
    curves : mapping of str to (r, 2) ndarray
        RMS errors of θ and ω by what is unknown. [rad, rad/s]
    matched : (2,) sequence of float
        RMS errors with the true machine. [rad, rad/s]
    width : float
        Of the figure. [inch]
    """
    figure = paper(width, 2.9)
    axes = figure.subplots(1, 2)
    colours = (VERMILION, ORANGE, BLUE, SKY)
    for state, (ax, quantity) in enumerate(zip(axes, STATES, strict=True)):
        for (name, curve), colour in zip(curves.items(), colours, strict=False):
            added = 100.0 * (curve[:, state] / matched[state] - 1.0)
            ax.plot(factor, np.where(added > 0, added, np.nan), color=colour, label=name)
        ax.set(xscale="log", yscale="log", xlabel="Assumed value over true one [1]")
        ax.set_ylim(bottom=1e-3)
        ax.set_xticks([0.25, 0.5, 1.0, 2.0, 4.0], labels=["¼", "½", "1", "2", "4"])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.set_ylabel(f"Added to the RMS error of {_LABEL[quantity][0]} [%]")
    legend(figure, *axes)
    return figure


def _since(times: pd.Series, begin: pd.Timestamp) -> FloatArray:
    return np.asarray((times - begin).dt.total_seconds().to_numpy(dtype=np.float64))


def _state(own: pd.DataFrame, quantity: str, begin: pd.Timestamp) -> tuple[FloatArray, FloatArray]:
    part = own[own.quantity == quantity].sort_values("time_utc")
    return _since(part.time_utc, begin), part.value.to_numpy(dtype=np.float64)


def _fit(ax: Axes, until_s: float) -> None:
    """Hold the vertical axis to what lies on the visible part of the horizontal one."""
    drawn = np.concatenate([np.asarray(line.get_xydata()) for line in ax.lines])
    seen = drawn[drawn[:, 0] <= until_s, 1]
    low, high = float(np.nanmin(seen)), float(np.nanmax(seen))
    margin = 0.05 * (high - low)
    ax.set_ylim(low - margin, high + margin)
