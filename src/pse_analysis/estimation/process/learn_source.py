"""What telemetry before a study teaches about the movement of held voltages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, signal, special

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.process.load_noise import Sensitivity, to_polar
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VM, P, Q, SensorLayout

USUAL_SOURCE = 1e-3
"""σ of the source voltage's change per step where history tells nothing. [p.u.]"""
FEWEST_READINGS = 24
"""Instants with a voltage reading below which nothing is learnt."""
SCALES = np.geomspace(1e-5, 3e-3, 11)
"""Scales that the movements of held voltages may have in common. [p.u.]"""
RATIOS = np.exp(np.linspace(-18.0, 4.0, 73))
"""Variances of a walk per reading that are tried, in units of the meter's."""


def learn_held(
    history: Record,
    layout: SensorLayout,
    network: Network,
    step_s: float,
    source: float | None = None,
) -> FloatArray:
    """Learn how far every held voltage moves in one step.

    Where the source alone is held, all voltages read it (`learn_source`). Generators that hold
    their own voltage do not follow the source, so that on a transmission grid each held voltage is
    told by its own meter. Whether generators move theirs at all is a matter of how a grid is run:
    what they have in common is learnt from all of them.

    Parameters
    ----------
    history : Record
        Aligned telemetry before the first estimated instant.
    layout : SensorLayout
    network : Network
    step_s : float
        Step between instants; readings may come less often. [s]
    source : float, optional
        σ of the references; learnt if not given. [p.u.]

    Returns
    -------
    (n_held,) ndarray
        σ of the change per step, in the order of `Sensitivity.held`. A reference without a meter
        moves by `USUAL_SOURCE`, another voltage as the others do on average. [p.u.]
    """
    held = Sensitivity(network).held
    reference = np.isin(held, network.references)
    if len(held) == 1:
        alone = learn_source(history, layout, network, step_s) if source is None else source
        return np.array([alone])
    walks = _Walks.of(history, layout, held, step_s)
    found = np.full(len(held), np.nan)
    own = reference & walks.seen
    found[own] = walks.expected(np.array([USUAL_SOURCE]), np.zeros(1))[own]
    others = ~reference & walks.seen
    found[others] = walks.expected(SCALES, walks.evidence(SCALES)[others].sum(axis=0))[others]
    found[reference & ~walks.seen] = USUAL_SOURCE
    usual = np.sqrt(np.mean(found[others] ** 2)) if others.any() else USUAL_SOURCE
    found[~reference & ~walks.seen] = usual
    if source is not None:
        found[reference] = source
    return found


@dataclass(frozen=True, eq=False)
class _Walks:
    """Random walks that some series of readings under white noise may be.

    Attributes
    ----------
    sigma : (k, r) ndarray
        σ of the change in one step, for r ratios of the walk to the noise. [p.u.]
    fit : (k, r) ndarray
        Logarithm of the likelihood; the noise's own variance is integrated out.
    seen : (k,) ndarray of bool
        Series that hold enough readings.
    """

    sigma: FloatArray
    fit: FloatArray
    seen: BoolArray

    @classmethod
    def of(cls, history: Record, layout: SensorLayout, buses: IntArray, step_s: float) -> _Walks:
        """Walks of the voltages of some buses, each read by its own meter."""
        z = np.full((len(history.time), len(buses)), np.nan)
        for place, bus in enumerate(buses):
            rows = np.flatnonzero((layout.quantity == VM) & (layout.position == bus))
            read = history.fresh[:, rows].any(axis=1)
            most = rows[history.fresh[:, rows].sum(axis=0).argmax()] if read.any() else -1
            if most >= 0:
                z[:, place] = np.where(history.fresh[:, most], history.z[:, most], np.nan)
        read = np.isfinite(z)
        count = read.sum(axis=0)
        # A walk that hardly moves takes long to settle: it starts with what one reading is.
        x, known = np.zeros((len(buses), len(RATIOS))), np.full((len(buses), len(RATIOS)), np.nan)
        square, size = np.zeros_like(x), np.zeros_like(x)
        for reading, now in zip(z, read, strict=True):
            first = now & np.isnan(known[:, 0])
            x[first], known[first] = reading[first, None], 1.0
            later = now & ~first
            spread = known[later] + RATIOS + 1.0
            eta = reading[later, None] - x[later]
            square[later] += eta**2 / spread
            size[later] += np.log(spread)
            known[later] = 1.0 - 1.0 / spread
            x[later] += known[later] * eta
        seen = (count >= FEWEST_READINGS) & (square > 0).all(axis=1)
        free = np.maximum(count - 1, 1)[:, None]
        # ∫ over the noise's own variance, of prior 1/r, leaves (Σ η²/v)^(-T/2) Π v^(-1/2).
        fit = -0.5 * (free * np.log(np.where(square > 0, square, 1.0)) + size)
        second = (history.time - history.time[:1]) / np.timedelta64(1, "s")
        apart = np.array([_usual_gap(second[one]) for one in read.T])[:, None]
        return cls(np.sqrt(RATIOS * square / free * (step_s / apart)), fit, seen)

    def evidence(self, scales: FloatArray) -> FloatArray:
        """Logarithm of the likelihood if σ is half-Cauchy of some scales. (k, c)"""
        return np.asarray(special.logsumexp(self._posterior(scales), axis=-1))

    def expected(self, scales: FloatArray, likely: FloatArray) -> FloatArray:
        """Mean of σ over scales of which the logarithm of the likelihood is given. (k,)

        A series that barely shows its walk leaves it open.
        """
        posterior = self._posterior(scales)
        weight = np.exp(posterior - posterior.max(axis=-1, keepdims=True))
        means = (weight * self.sigma[:, None]).sum(axis=-1) / weight.sum(axis=-1)
        return np.asarray(means @ special.softmax(likely))

    def _posterior(self, scales: FloatArray) -> FloatArray:
        """Logarithm of fit times prior, on a logarithmic grid of σ. (k, c, r)"""
        size = np.maximum(self.sigma[:, None], np.finfo(float).tiny) / scales[:, None]
        return np.asarray(self.fit[:, None] + np.log(size) - np.log1p(size**2))


def _usual_gap(second: FloatArray) -> float:
    """Median time between readings. [s]"""
    return float(np.median(np.diff(second))) if len(second) > 1 else 1.0


def learn_source(history: Record, layout: SensorLayout, network: Network, step_s: float) -> float:
    """Learn σ of the source voltage's change per step as a local level under white noise.

    Every voltage reading, less the part that the metered injections explain (by the sensitivities
    at the nominal state), reads the source; their mean follows a random walk plus noise. The ratio
    of the two variances maximises the likelihood, in which the scale is concentrated out: what the
    meters between two samples do not tell is then counted as noise, not as movement of the source.

    Parameters
    ----------
    history : Record
    layout : SensorLayout
    network : Network
    step_s : float
        Step between instants; readings may come less often. [s]

    Returns
    -------
    float
        `USUAL_SOURCE` if there are fewer than `FEWEST_READINGS` instants with a voltage reading.
        [p.u.]
    """
    rows = np.flatnonzero(layout.quantity == VM)
    rows = rows[history.fresh[:, rows].any(axis=0)]
    fresh = history.fresh[:, rows]
    if fresh.any(axis=1).sum() < FEWEST_READINGS:
        return USUAL_SOURCE
    explained = _explained_voltage(history, layout, network)
    reading = history.z[:, rows] - explained[:, layout.position[rows]]
    reading = np.where(fresh, reading, 0.0)
    reading = reading - reading.sum(axis=0) / np.maximum(fresh.sum(axis=0), 1)
    count = fresh.sum(axis=1)
    level = np.where(fresh, reading, 0.0).sum(axis=1)[count > 0] / count[count > 0]

    def innovation(log_ratio: float) -> tuple[FloatArray, float]:
        """Innovations of the steady-state filter, and their variance in units of the noise's."""
        ratio = np.exp(log_ratio)
        prior = 0.5 * (ratio + np.sqrt(ratio**2 + 4.0 * ratio))
        gain = prior / (prior + 1.0)
        forecast = signal.lfilter([gain], [1.0, gain - 1.0], level, zi=[(1 - gain) * level[0]])[0]
        return level[1:] - forecast[:-1], float(prior + 1.0)

    def cost(log_ratio: float) -> float:
        # With the scale s² = mean(η²)/v, n log s² + n log v leaves n log mean(η²).
        return float(np.log(np.mean(innovation(log_ratio)[0] ** 2)))

    found = optimize.minimize_scalar(cost, bounds=(-12.0, 4.0), method="bounded")
    eta, variance = innovation(float(found.x))
    apart = np.diff(history.time[count > 0]) / np.timedelta64(1, "s")
    steps = float(np.median(apart)) / step_s  # the walk moved so long between two readings
    return float(np.sqrt(np.exp(found.x) * np.mean(eta**2) / variance / steps))


def _explained_voltage(history: Record, layout: SensorLayout, network: Network) -> FloatArray:
    """Part of |V| that the metered injections explain at every instant. (T, N) [p.u.]

    All of this is history, so a mean counts at the middle of its interval and the time between two
    samples is interpolated.
    """
    n = network.n_bus
    sensitivity = Sensitivity(network)
    flow = solve(network, own_references=True)
    voltage = flow.vm * np.exp(1j * flow.theta)
    by_input = np.zeros((n, 2 * n))
    by_input[:, sensitivity.inputs] = (to_polar(voltage) @ sensitivity.at(voltage)[0])[n:]
    explained = np.zeros((len(history.time), n))
    second = (history.time - history.time[0]) / np.timedelta64(1, "s")
    for row in np.flatnonzero(np.isin(layout.quantity, (P, Q)) & (layout.side == BUS)):
        use = history.fresh[:, row]
        if not use.any():
            continue
        middle = second[use] - history.age_s[use, row] - 0.5 * layout.window_s[row]
        value = np.interp(second, middle, history.z[use, row])
        place = layout.position[row] + (n if layout.quantity[row] == Q else 0)
        explained += np.outer(value, by_input[:, place])
    return explained
