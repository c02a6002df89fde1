"""How the state may move between two instants: process noise of the random walk x⁺ = x + w.

``scalar`` noise moves every voltage on its own. ``load`` noise moves the loads and the held
voltages and lets the grid carry that to the others, Q = S Σ_load Sᵀ + s Σ_held sᵀ, where S =
∂x/∂(P, Q) and s = ∂x/∂|V_held| at the forecast: where a change of load moves all voltages
together, as on a feeder, only the latter can be calibrated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import lapack

from pse_analysis.arrays import ComplexArray, FloatArray
from pse_analysis.errors import NotConverged
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network

KEPT_PU = 1e-2
"""Sensitivities are kept while no voltage moves by more. [p.u.]

Q then errs by up to 3 % as a whole on grids of 30 to 300 buses, and the σ of single voltages by
some 4 %, more only where a voltage hardly moves at all: less than loads are known to vary.
"""

OTHERS = 1e-2
"""Least movement of an injection, as a share of the root mean square of all.

Where nothing is connected no power changes, but the true grid bends and the sensitivities are as
old as `KEPT_PU` allows. A filter that rules such movement out becomes certain, in time, of what is
not so. 1 % is what the sensitivities err by.
"""

ProcessNoise = Callable[[ComplexArray, np.datetime64], FloatArray]
"""Covariance of x = [e; f] added by the step to an instant, (2N, 2N), at a forecast voltage."""


def scalar_noise(network: Network, variance: float) -> ProcessNoise:
    """Q = q·I: every voltage moves on its own. [p.u.²]"""
    noise = variance * np.eye(2 * network.n_bus)
    return lambda _voltage, _time: noise


@dataclass(frozen=True, eq=False)
class LoadStatistics:
    """How much the injections and the source voltage move in one step, learnt from history.

    Attributes
    ----------
    deviation : (n_slot, 2N) ndarray
        σ of the change of [P; Q] in one step, by slot of the day. [p.u.]
    correlation : (2N, 2N) ndarray
        Correlation of these changes.
    held : float or (n_held,) ndarray
        σ of the change of every held voltage in one step, see `Sensitivity.held`. [p.u.]
    slot_s : float
        Length of a slot. [s]
    """

    deviation: FloatArray
    correlation: FloatArray
    held: float | FloatArray
    slot_s: float

    def deviation_at(self, time: np.datetime64) -> FloatArray:
        """σ of the change in the step to an instant. (2N,) [p.u.]"""
        second = (time - time.astype("datetime64[D]")) / np.timedelta64(1, "s")
        return np.asarray(self.deviation[int(second // self.slot_s) % len(self.deviation)])

    def covariance(self, time: np.datetime64) -> FloatArray:
        """Σ_load of the step to an instant. (2N, 2N) [p.u.²]"""
        deviation = self.deviation_at(time)
        return np.asarray(self.correlation * np.outer(deviation, deviation))


class Sensitivity:
    """S and s: how the voltages of a grid follow its injections and its held voltages.

    Parameters
    ----------
    network : Network

    Notes
    -----
    From S = V conj(Y V), dS = conj(I) dV + V conj(Y dV). With the rows split by unknown voltages u
    and held magnitudes v, J_u du + J_v dv = d[P; Q], so S = J_u⁻¹ and s = -J_u⁻¹ J_v.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        n, kind = network.n_bus, network.buses.kind
        self.slack = network.slack
        # Every island has a bus that holds its voltage and its angle.
        reference = np.zeros(n, dtype=bool)
        reference[network.references] = True
        angle = np.flatnonzero(~reference)
        self._pq = np.flatnonzero((kind == BusKind.PQ) & ~reference)
        self._pv = np.flatnonzero((kind == BusKind.PV) & ~reference)
        self.held = np.flatnonzero((kind != BusKind.PQ) | reference)
        self.inputs = np.concatenate([angle, n + self._pq])  # rows of [P; Q] that are given
        self._admittance = np.asarray(network.y_bus.toarray().conj())

    def at(self, voltage: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """∂[e; f]/∂[P; Q] and ∂[e; f]/∂|V_held| at a voltage.

        Returns
        -------
        (2N, n_input) ndarray
            Columns follow ``inputs``: all injections but the slack's and Q of held buses.
        (2N, n_held) ndarray

        Raises
        ------
        NotConverged
            If the power flow is singular there.
        """
        n, pq, pv, held = len(voltage), self._pq, self._pv, self.held
        carried = voltage[:, None] * self._admittance
        current = self._admittance @ voltage.conj()
        jacobian = np.empty((2 * n, 2 * n))
        jacobian[:n, :n], jacobian[:n, n:] = carried.real, carried.imag
        jacobian[n:, :n], jacobian[n:, n:] = carried.imag, -carried.real
        bus = np.arange(n)
        jacobian[bus, bus] += current.real
        jacobian[bus, n + bus] -= current.imag
        jacobian[n + bus, bus] += current.imag
        jacobian[n + bus, n + bus] += current.real
        jacobian = jacobian[self.inputs]
        # A bus of held magnitude turns, dV = jV dθ, and follows its setting, dV = V/|V| d|V|.
        turned = jacobian[:, n + pv] * voltage.real[pv] - jacobian[:, pv] * voltage.imag[pv]
        along = voltage[held] / np.abs(voltage[held])
        grown = jacobian[:, held] * along.real + jacobian[:, n + held] * along.imag
        unknown = np.concatenate([jacobian[:, pq], jacobian[:, n + pq], turned], axis=1)
        right = np.concatenate([np.eye(len(self.inputs)), -grown], axis=1)
        _, _, solved, singular = lapack.dgesv(unknown, right, overwrite_a=1, overwrite_b=1)
        if singular:
            raise NotConverged(
                f"the power flow of {self._network.name} is singular at this voltage: give "
                'noise = "scalar"'
            )
        moved = np.zeros((2 * n, right.shape[1]))
        moved[pq], moved[n + pq] = solved[: len(pq)], solved[len(pq) : 2 * len(pq)]
        theta = solved[2 * len(pq) :]
        moved[pv], moved[n + pv] = -voltage.imag[pv, None] * theta, voltage.real[pv, None] * theta
        by_input, by_voltage = np.split(moved, [len(self.inputs)], axis=1)
        own = np.arange(len(held))
        by_voltage[held, own] += along.real
        by_voltage[n + held, own] += along.imag
        return by_input, by_voltage

    def renewed(self) -> Callable[[ComplexArray], tuple[FloatArray, FloatArray]]:
        """`at`, kept while no voltage moves by more than `KEPT_PU`.

        Voltages must be given in the frame of the source (`in_frame`): all that turns with it
        turns alike, and what is kept in another frame would turn the source.
        """
        kept: dict[str, Any] = {}

        def at(voltage: ComplexArray) -> tuple[FloatArray, FloatArray]:
            if "at" not in kept or np.abs(kept["at"] - voltage).max() > KEPT_PU:
                kept["moves"] = self.at(voltage)
                kept["at"] = voltage
            moves: tuple[FloatArray, FloatArray] = kept["moves"]
            return moves

        return at


def in_frame(voltage: ComplexArray, slack: int) -> tuple[ComplexArray, complex]:
    """Voltages in the frame of the source's angle, and that frame e^{jθ}."""
    source = complex(voltage[slack])
    if source.imag == 0.0 and source.real > 0.0:
        return voltage, 1.0 + 0.0j
    frame = source / abs(source)
    turned = voltage * frame.conjugate()
    turned[slack] = abs(source)
    return turned, frame


def turned_rows(rows: FloatArray, frame: complex) -> FloatArray:
    """Rows of [e; f] turned by a frame. (2N, …)"""
    if frame == 1.0:
        return rows
    e, f = np.split(rows, 2)
    return np.concatenate([frame.real * e - frame.imag * f, frame.imag * e + frame.real * f])


def to_rectangular(voltage: ComplexArray) -> FloatArray:
    """∂[e; f]/∂[θ; |V|] at a voltage. (2N, 2N)"""
    direction = voltage / np.abs(voltage)
    return _diagonals(-voltage.imag, direction.real, voltage.real, direction.imag)


def to_polar(voltage: ComplexArray) -> FloatArray:
    """∂[θ; |V|]/∂[e; f] at a voltage. (2N, 2N)"""
    size = np.abs(voltage)
    along, across = voltage.real / size, voltage.imag / size
    return _diagonals(-across / size, along / size, along, across)


def _diagonals(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """[[diag a, diag b], [diag c, diag d]]."""
    n = len(a)
    out, i = np.zeros((2 * n, 2 * n)), np.arange(n)
    out[i, i], out[i, n + i], out[n + i, i], out[n + i, n + i] = a, b, c, d
    return out


def at_least(size: FloatArray) -> FloatArray:
    """Sizes of movements with what all of them have in common, see `OTHERS`. (k,)"""
    return np.asarray(np.hypot(size, OTHERS * np.sqrt(np.mean(size**2))))


def load_noise(network: Network, statistics: LoadStatistics) -> ProcessNoise:
    """Loads and held voltages moved through the grid: Q = S Σ_load Sᵀ + s Σ_held sᵀ. [p.u.²]"""
    sensitivity = Sensitivity(network)
    moves = sensitivity.renewed()
    inside = sensitivity.inputs
    value, vector = np.linalg.eigh(statistics.correlation[np.ix_(inside, inside)])
    root = vector * np.sqrt(np.maximum(value, 0.0))

    last: dict[str, Any] = {"moves": None, "deviation": None}

    def noise(voltage: ComplexArray, time: np.datetime64) -> FloatArray:
        at_source, frame = in_frame(voltage, sensitivity.slack)
        by_input, by_voltage = at = moves(at_source)
        whole = statistics.deviation_at(time)
        if last["moves"] is at and np.array_equal(last["deviation"], whole):
            same: FloatArray = last["noise"]
            return _turned(same, frame)
        deviation = at_least(whole[inside])
        # A symmetric product of one factor: Q is symmetric and semi-definite whatever the rounding.
        half = np.concatenate([(by_input * deviation) @ root, by_voltage * statistics.held], axis=1)
        made = np.asarray(half @ half.T)
        made.flags.writeable = False
        last.update(moves=at, deviation=whole, noise=made)
        return _turned(made, frame)

    return noise


def _turned(Q: FloatArray, frame: complex) -> FloatArray:
    """Covariance of [e; f] turned by a frame, exactly symmetric. (2N, 2N)"""
    if frame == 1.0:
        return Q
    found = turned_rows(turned_rows(Q, frame).T, frame)
    return np.asarray(0.5 * (found + found.T))
