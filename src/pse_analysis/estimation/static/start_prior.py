"""What is known of a grid before any snapshot: usual injections and the voltages that are held.

Loads have a usual size, from telemetry before the study or from the grid's own tables, and they do
not stray from it without bounds. Said as measurements with a large σ, this closes what a first
snapshot leaves open, and leaves it as uncertain as it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.process.load_noise import Sensitivity
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, VM, P, Q, SensorLayout
from pse_analysis.vocabulary import Source

SHARE = 0.5
"""σ of an injection in its usual size where a day of history does not tell it: loads of nothing and
of twice their usual size are then within 2σ."""
LEAST_SHARE = 0.05
"""Least σ of an injection in its usual size, whatever history says; and, in the mean size of all,
of one that no table has a load at."""
HELD_PU = 0.03
"""σ of a held voltage about its set-point. [p.u.]"""
FEWEST_SAMPLES = 12
"""Samples of a meter from which its usual value and spread are taken."""
ASSUMED_AGAIN = 4.0
"""Factor on σ where a pseudo-measurement says the same: what is usual must not count twice."""
DAY_S = 86400.0


class StartPrior(NamedTuple):
    """Holds usual injections and held voltages as if they were measured.

    Attributes
    ----------
    layout : SensorLayout
        Injections, and held voltages.
    z, sigma : (k,) ndarray
        Usual values, and σ of what each does by itself. [p.u.]
    together : float
        σ of the share of their size by which all loads differ from what is usual.
    """

    layout: SensorLayout
    z: FloatArray
    sigma: FloatArray
    together: float

    def beside(self, layout: SensorLayout, snapshot: Snapshot) -> tuple[FloatArray, FloatArray]:
        """Returns usual values and their σ, scaled by what the metered loads of a snapshot show.

        Loads rise and fall together. Those that are metered tell by how much, and the others are
        taken to do the same; what is left of the doubt is common to them.

        Parameters
        ----------
        layout : SensorLayout
            Of the snapshot.
        snapshot : Snapshot

        Returns
        -------
        z, sigma : (k,) ndarray
            [p.u.]

        Notes
        -----
        With metered loads at r = P/c - 1 of their usual c, each by itself within s of all, the
        common share is N(v Σr/s², v), 1/v = 1/t² + k/s². Independent σ² = v |c| Σ|c| over the loads
        that are not metered have a sum that is as uncertain as theirs is, and so has every part.
        """
        z, variance = self.z.copy(), self.sigma**2
        for quantity in (P, Q):
            load = np.flatnonzero((self.layout.quantity == quantity) & (self.z < 0))
            at = np.full(layout.position.max(initial=0) + 1, -1)
            rows = np.flatnonzero((layout.quantity == quantity) & (layout.side == BUS))
            rows = rows[snapshot.available[rows]]
            at[layout.position[rows]] = rows
            bus = self.layout.position[load]
            row = np.where(bus < len(at), at[np.minimum(bus, len(at) - 1)], -1)
            seen, rest = load[row >= 0], load[row < 0]
            usual = self.z[seen]
            # Gross errors must not move what is taken for usual elsewhere.
            ratio = np.median(snapshot.z[row[row >= 0]] / usual) - 1.0 if len(seen) else 0.0
            own = float(np.mean(self.sigma[seen] ** 2 / usual**2)) if len(seen) else 1.0
            doubt = 1.0 / (self.together**-2 + len(seen) / own)
            z[rest] *= 1.0 + np.clip(ratio, -1.0, 1.0) * doubt * len(seen) / own
            variance[rest] += doubt * np.abs(self.z[rest]) * np.abs(self.z[rest]).sum()
        return z, np.sqrt(variance)


class _Usual(NamedTuple):
    """Usual [P; Q] of all buses, own σ of each, and where a meter told them. (2N,) [p.u.]"""

    centre: FloatArray
    spread: FloatArray
    metered: BoolArray


def start_prior(network: Network, layout: SensorLayout, history: Record) -> StartPrior | None:
    """Find what is known of a grid before any snapshot.

    Parameters
    ----------
    network : Network
        Its nominal injections and set-points count where history tells none.
    layout : SensorLayout
    history : Record
        Aligned telemetry before the study.

    Returns
    -------
    StartPrior or None
        None where neither says how large any load is, or a part of the grid has no supply.

    """
    n = network.n_bus
    if (network.buses.kind[network.references] == BusKind.PQ).any():
        return None
    usual, together = _usual(network, layout, history)
    sensitivity = Sensitivity(network)
    inside = sensitivity.inputs
    centre, spread = usual.centre[inside], usual.spread[inside]
    if not centre.any():
        return None
    active = inside < n
    spread[_stated_again(layout, n)[inside] & ~usual.metered[inside]] *= ASSUMED_AGAIN
    held = sensitivity.held
    volts = _usual_voltages(network, layout, history)[held]
    rows = SensorLayout.of(
        network,
        (P, inside[active], BUS),
        (Q, inside[~active] - n, BUS),
        (VM, held, BUS),
    )
    sigma = np.concatenate([spread, np.full(len(held), HELD_PU)])
    return StartPrior(rows, np.concatenate([centre, volts]), sigma, together)


def _usual(network: Network, layout: SensorLayout, history: Record) -> tuple[_Usual, float]:
    """Usual injections, and by which share of their size all of them move together."""
    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    centre, spread = nominal.copy(), SHARE * np.abs(nominal)
    metered, shares = np.zeros(len(nominal), dtype=bool), []
    time = history.time
    span_s = float((time[-1] - time[0]) / np.timedelta64(1, "s")) if len(time) else 0.0
    # Less than a day does not show by how much loads vary.
    unseen = SHARE**2 * max(1.0 - span_s / DAY_S, 0.0) + LEAST_SHARE**2
    for row in _injections(layout, pseudo=False):
        read = history.fresh[:, row] & history.available[:, row]
        where = _place(layout, network.n_bus, row)
        if np.count_nonzero(read) < FEWEST_SAMPLES or metered[where]:
            continue
        values = history.z[read, row]
        middle = float(np.median(values))
        # Half of them lie nearer than 0.67σ, whatever the gross errors among them read.
        own = float(np.median(np.abs(values - middle))) / 0.6745
        spread[where] = np.sqrt(own**2 + unseen * middle**2)
        centre[where], metered[where] = middle, True
        if middle != 0.0:
            shares.append(spread[where] / abs(middle))
    if centre.any():
        size = float(np.mean(np.abs(centre[centre != 0])))
        # Where no table knows a load, a bus without a meter may draw as much as the others.
        unknown = ~metered & (nominal == 0)
        spread[unknown] = (LEAST_SHARE if nominal.any() else 1.0) * size
    together = float(np.median(shares)) if shares else SHARE
    return _Usual(centre, spread, metered), together


def _place(layout: SensorLayout, n_bus: int, row: int) -> int:
    """Place of an injection in [P; Q]."""
    return int(layout.position[row]) + (n_bus if layout.quantity[row] == Q else 0)


def _injections(layout: SensorLayout, *, pseudo: bool) -> IntArray:
    """Rows of injections, of meters or of pseudo-measurements."""
    assumed = np.array([source == Source.PSEUDO for source in layout.source], dtype=bool)
    rows = np.isin(layout.quantity, (P, Q)) & (layout.side == BUS) & (assumed == pseudo)
    return np.flatnonzero(rows)


def _stated_again(layout: SensorLayout, n_bus: int) -> BoolArray:
    """Injections that pseudo-measurements of the layout state. (2N,)"""
    out = np.zeros(2 * n_bus, dtype=bool)
    out[[_place(layout, n_bus, row) for row in _injections(layout, pseudo=True)]] = True
    return out


def _usual_voltages(network: Network, layout: SensorLayout, history: Record) -> FloatArray:
    """Median |V| where a meter tells it, the set-point elsewhere. (N,) [p.u.]"""
    out = network.buses.vm_set_pu.copy()
    for row in np.flatnonzero(layout.quantity == VM):
        read = history.fresh[:, row] & history.available[:, row]
        if np.count_nonzero(read) >= FEWEST_SAMPLES:
            out[layout.position[row]] = np.median(history.z[read, row])
    return out
