"""What telemetry before a study teaches about the movement of loads and of the source voltage."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import linalg

from pse_analysis.arrays import FloatArray
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.process.learn_source import learn_held
from pse_analysis.estimation.process.load_noise import LoadStatistics
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, P, Q, SensorLayout, standard_deviation

DAY_S = 86400.0
FEWEST_CHANGES = 24
"""Changes below which no correlation is learnt."""
SHRINKAGE = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0])
"""Shares of the mean correlation that are tried."""


def learn_load(
    history: Record,
    layout: SensorLayout,
    network: Network,
    step_s: float,
    *,
    slot_s: float = 900.0,
    bandwidth_s: float = 5400.0,
    source: float | None = None,
) -> LoadStatistics:
    """Learn how injections and the source voltage move from telemetry before the study.

    Parameters
    ----------
    history : Record
        Aligned telemetry before the first estimated instant.
    layout : SensorLayout
    network : Network
    step_s : float
        Step between instants. [s]
    slot_s, bandwidth_s : float
        Slots of the day, and how far (Gaussian) each one looks at its neighbours. [s]
    source : float, optional
        σ of the change per step of the voltage of every reference; learnt if not given, as those
        of other held voltages are. [p.u.]

    Returns
    -------
    LoadStatistics
        Injections without a meter move by the median relative change of the metered ones.

    Notes
    -----
    A load with variance rate r changes by r T between samples T apart. Means over T hide a part of
    that, and the more the faster the load reverts; but if its changes d between the ends of the
    intervals have autocovariances c₀, c₁, 0, …, and it moves as a Brownian bridge in between, then
    E(m₊ - 2m + m₋)² = c₀ whatever c₁ is. So means enter by their second difference, instantaneous
    samples by the first; 6σ² or 2σ² of the meter itself are taken off first. The correlation is
    shrunk towards its mean over all pairs as far as held-out days ask for, and the variances are
    enlarged where the changes of a day have a mean NIS above 1 under what the other days teach.
    """
    n = network.n_bus
    slots = round(DAY_S / slot_s)
    meters = _meters(history, layout, n)
    deviation = np.full((slots, 2 * n), np.nan)
    correlation = np.eye(2 * n)
    if len(meters.place):
        square, within = _fit(meters, slots, slot_s, bandwidth_s)
        shrinkage, ratio = _held_out(meters, slots, slot_s, bandwidth_s)
        square = square * ratio
        within = _shrunk(within, shrinkage)
        moving = np.maximum(square - meters.noise, 0.1 * square)
        deviation[:, meters.place] = np.sqrt(moving / meters.span_s * step_s)
        correlation[np.ix_(meters.place, meters.place)] = within
    _fill_unmetered(deviation, network)
    held = learn_held(history, layout, network, step_s, source)
    return LoadStatistics(deviation, correlation, held, slot_s)


@dataclass(frozen=True, eq=False)
class _Meters:
    """Increments of the metered injections.

    Attributes
    ----------
    place : (k,) ndarray
        Position in [P; Q].
    change : (T, k) ndarray
        First difference of instantaneous samples, second difference of means; NaN where there is
        none. [p.u.]
    second, day : (T,) ndarray
        Second of the day, and day.
    noise : (k,) ndarray
        Variance that the meter itself adds to a change. [p.u.²]
    span_s : (k,) ndarray
        Time over which a random walk would have the variance of the change. [s]
    """

    place: npt.NDArray[np.int64]
    change: FloatArray
    second: FloatArray
    day: npt.NDArray[np.int64]
    noise: FloatArray
    span_s: FloatArray

    def only(self, rows: npt.NDArray[np.bool_]) -> _Meters:
        """Some of the rows."""
        return replace(self, change=self.change[rows], second=self.second[rows], day=self.day[rows])


def _meters(history: Record, layout: SensorLayout, n_bus: int) -> _Meters:
    place, change, noise, span = [], [], [], []
    for row in np.flatnonzero(np.isin(layout.quantity, (P, Q)) & (layout.side == BUS)):
        use = np.flatnonzero(history.fresh[:, row])
        where = int(layout.position[row]) + (n_bus if layout.quantity[row] == Q else 0)
        if len(use) < 12 or where in place:
            continue
        elapsed = np.diff(history.time[use]) / np.timedelta64(1, "s")
        usual = float(np.median(elapsed))
        regular = elapsed < 1.5 * usual
        # Means of adjoining intervals share a move, which their second difference undoes.
        means = layout.window_s[row] > 0.5 * usual
        if means:
            difference = np.diff(history.z[use, row], n=2)
            regular, use = regular[1:] & regular[:-1], use[2:]
        else:
            difference, use = np.diff(history.z[use, row]), use[1:]
        column = np.full(len(history.time), np.nan)
        column[use[regular]] = difference[regular]
        known = history.fresh[:, row]
        sigma = standard_deviation(history.z[known, row], layout.sigma[row], layout.relative[row])
        place.append(where)
        change.append(column)
        noise.append((6.0 if means else 2.0) * float(np.mean(sigma**2)))
        span.append(usual)
    panel = np.array(change).reshape(len(place), len(history.time)).T
    rows = np.isfinite(panel).any(axis=1)
    time = history.time[rows]
    return _Meters(
        np.array(place, dtype=np.int64),
        panel[rows],
        np.asarray((time - time.astype("datetime64[D]")) / np.timedelta64(1, "s")),
        time.astype("datetime64[D]").astype(np.int64),
        np.array(noise),
        np.array(span),
    )


def _fit(
    meters: _Meters, slots: int, slot_s: float, bandwidth_s: float
) -> tuple[FloatArray, FloatArray]:
    """Mean square by slot of the day, (slots, k), and correlation, (k, k), of the changes.

    The mean square is smoothed around the clock and shrunk to that of the whole day by the number
    of samples it rests on.
    """
    centre = (np.arange(slots) + 0.5) * slot_s
    apart = np.abs(centre[:, None] - meters.second)
    apart = np.minimum(apart, DAY_S - apart)
    weight = np.exp(-0.5 * (apart / bandwidth_s) ** 2)
    known = np.isfinite(meters.change).astype(float)
    squared = np.where(known > 0, meters.change, 0.0) ** 2
    mass = np.maximum(weight @ known, 1e-12)
    effective = mass**2 / np.maximum(weight**2 @ known, 1e-12)
    trust = effective / (effective + 5.0)
    whole = squared.sum(axis=0) / known.sum(axis=0)
    square = np.maximum(trust * (weight @ squared) / mass + (1 - trust) * whole, 1e-16)
    return square, _correlation(_standardised(meters, square, slot_s))


def _standardised(meters: _Meters, square: FloatArray, slot_s: float) -> FloatArray:
    """Changes over their root mean square at that time of day, 0 where there is none. (T, k)"""
    slot = (meters.second // slot_s).astype(np.int64) % len(square)
    return np.nan_to_num(meters.change / np.sqrt(square[slot]))


def _correlation(panel: FloatArray) -> FloatArray:
    """Correlation of (T, k) values from the instants at which each pair has both, semi-definite."""
    together = np.maximum((panel != 0).astype(float).T @ (panel != 0), 1.0)
    product = panel.T @ panel / together
    # A meter that stands still has no correlation with any other.
    scale = np.sqrt(np.maximum(np.diagonal(product), 1e-12))
    product = product / np.outer(scale, scale)
    np.fill_diagonal(product, 1.0)
    value, vector = np.linalg.eigh(product)
    positive = (vector * np.maximum(value, 0.0)) @ vector.T
    scale = np.sqrt(np.diagonal(positive))
    return np.asarray(positive / np.outer(scale, scale))


def _shrunk(correlation: FloatArray, share: float) -> FloatArray:
    """Correlation drawn by a share towards one that is the same between all pairs, their mean."""
    k = len(correlation)
    mean = max((correlation.sum() - k) / max(k * (k - 1), 1), 0.0)
    # The last 2 % keep it positive definite even where all pairs move as one.
    alike = 0.98 * mean + (1.0 - 0.98 * mean) * np.eye(k)
    return np.asarray((1.0 - share) * correlation + share * alike)


def _held_out(
    meters: _Meters, slots: int, slot_s: float, bandwidth_s: float
) -> tuple[float, float]:
    """How far to shrink the correlation, and by what to scale the variances.

    Parts of the record (days, or four parts of a shorter one) are held out in turn. The shrinkage
    is the one under which they are likeliest; the scale is their mean NIS per meter under what the
    other parts teach, if that is more than 1. It is taken as 1 where there are not three days,
    because the hours of a day differ.
    """
    days = len(np.unique(meters.day))
    rows = np.arange(len(meters.day))
    if len(rows) < FEWEST_CHANGES:
        return 1.0, 1.0
    nis, log_determinant = np.zeros(len(SHRINKAGE)), np.zeros(len(SHRINKAGE))
    count = 0
    for held in np.array_split(rows, max(days, 4)):
        apart, rest = meters.only(np.isin(rows, held)), meters.only(~np.isin(rows, held))
        square, correlation = _fit(rest, slots, slot_s, bandwidth_s)
        white = _standardised(apart, square, slot_s)
        for i, share in enumerate(SHRINKAGE):
            chol_C = np.linalg.cholesky(_shrunk(correlation, share))
            nis[i] += np.sum(linalg.solve_triangular(chol_C, white.T, lower=True) ** 2)
            log_determinant[i] += 2.0 * len(held) * np.sum(np.log(np.diagonal(chol_C)))
        count += int(np.isfinite(apart.change).sum())
    best = int(np.argmin(nis + log_determinant))
    ratio = max(float(nis[best]) / count, 1.0) if days >= 3 else 1.0
    return float(SHRINKAGE[best]), ratio


def _fill_unmetered(deviation: FloatArray, network: Network) -> None:
    """Give injections without a meter the median relative change of those that have one."""
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    metered = ~np.isnan(deviation[0])
    known = metered & (nominal > 0)
    relative = (
        np.median(deviation[:, known] / nominal[known], axis=1) if known.any() else np.array([0.02])
    )
    rest = np.flatnonzero(~metered)
    deviation[:, rest] = relative[:, None] * nominal[rest]
