"""Measurements in the form that is linear in x = [e; f]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, NamedTuple, TypeVar

import numpy as np
from scipy import sparse

from pse_analysis.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from pse_analysis.grid.network import Network
from pse_analysis.measurement.layout import (
    IA,
    IM,
    RELATIVE_FLOOR_PU,
    VA,
    VM,
    P,
    Q,
    SensorLayout,
    Terminals,
)

Linearisation = Literal["derivative", "transform"]
"""Whether a power's row follows the voltage at its meter, or takes it as predicted."""
BENT = 10.0
"""How many times M σ_φ² the σ of a magnitude is at least where its phasor is taken for a whole."""
SURE = 0.3
"""Largest σ of a magnitude, as a share of it, whose phasor is taken for a whole."""
Kept = TypeVar("Kept")


class RectangularModel:
    """Measurements that are linear in x = [e; f], one real row per channel.

    A phasor M∠φ of a complex c = y·V is two real rows of e^{-jφ}c, the one along φ with σ_M and the
    one across it with M σ_φ: in that frame their 2×2 covariance is diagonal. Powers are rows of the
    current: with the voltage |V|∠θ at the metered bus, e^{-jθ}c = (P - jQ)/|V|, whose covariance
    diag(σ_P², σ_Q²)/|V|² is diagonal too. A channel that lost its partner keeps its row: a
    magnitude alone is laid along the predicted angle, an angle alone is scaled by the predicted
    magnitude. So are both where the magnitude is far more exact than its angle, and where it is
    hardly known: M σ_φ would be as wrong as M.

    The current conj(S/V) of a power moves with the voltage too, dI = conj(dS)/conj(V) -
    conj(S) conj(dV)/conj(V)². ``derivative`` has both terms in its rows, so that a power says
    nothing of the angle that all buses share; ``transform`` leaves the second one out, and takes
    the current for one that is fixed in the frame of the predicted voltage.

    Parameters
    ----------
    network : Network
    layout : SensorLayout

    Notes
    -----
    ``transform`` is that of [qi2025], eqs. (8)–(14), with the full Y-bus for injections, which
    eq. (14) prints without its diagonal. A rotation of a pair of rows changes neither the
    gain nor the innovation's NIS, so the frame is chosen for the diagonal covariance.
    """

    def __init__(self, network: Network, layout: SensorLayout) -> None:
        self.network = network
        self.layout = layout
        n, m = network.n_bus, len(layout)
        t = Terminals(network, layout)
        quantity = layout.quantity
        electric, plain = np.flatnonzero(quantity >= P), np.flatnonzero(quantity < P)
        y_rows = t.y[t.of_row[electric]] if len(electric) else t.y[:0]
        row = np.concatenate([np.repeat(electric, np.diff(y_rows.indptr)), plain])
        col = np.concatenate([y_rows.indices, layout.position[plain]])
        value = np.concatenate([y_rows.data, np.ones(len(plain), dtype=complex)])
        self.functionals = sparse.csr_array((value, (row, col)), shape=(m, n))
        self.partner = _partners(layout)
        self._metered = np.where(quantity >= P, np.append(t.metered, 0)[t.of_row], layout.position)
        self._angle = layout.angular
        self._size = np.isin(quantity, (VM, IM))
        self._sign = np.where(quantity == Q, -1.0, 1.0)
        self._across = np.where(np.isin(quantity, (VA, IA, Q)), 1j, 1.0)
        self._patterns: Memo[Pattern] = Memo()

    def paired(self, available: BoolArray) -> BoolArray:
        """Rows that are available together with the other half of their phasor or power. (m,)"""
        return np.asarray((self.partner >= 0) & available & available[self.partner])

    def frame(
        self, z: FloatArray, sigma: FloatArray, available: BoolArray, rows: IntArray | None = None
    ) -> Frame:
        """Frames of some rows, so far as measured angles and magnitudes fix them.

        Parameters
        ----------
        z, sigma : (m,) ndarray
            Measured values and their σ. [p.u., rad]
        available : (m,) ndarray of bool
            Rows that carry a value.
        rows : (r,) ndarray of int, optional
            Rows that are wanted, which are available; all if not given.
        """
        rows = np.arange(len(self.layout)) if rows is None else rows
        paired = (self.paired(available) & self._round(z, sigma))[rows]
        pattern = self.pattern(rows, paired)
        value, spread, other = z[rows], sigma[rows], z[self.partner[rows]]
        unit = np.ones(len(rows), dtype=np.complex128)
        measured = np.where(pattern.is_angle, value, other)[pattern.known]
        unit[pattern.known] = np.exp(1j * measured)
        spread[pattern.both] *= np.maximum(np.abs(other[pattern.both]), RELATIVE_FLOOR_PU)
        return Frame(pattern, unit, pattern.sign * value, spread)

    def _round(self, z: FloatArray, sigma: FloatArray) -> BoolArray:
        """Rows whose phasor is nearly as uncertain along itself as across, and surely one. (m,)

        A phasor is laid along its measured angle, which is wrong by σ_φ. Its magnitude then reads
        M σ_φ² too little, and a share σ_φ of what lies across.
        """
        size = np.where(self._angle, self.partner, np.arange(len(z)))
        angle = np.where(self._angle, np.arange(len(z)), self.partner)
        bent = np.abs(z[size]) * sigma[angle] ** 2
        whole = (sigma[size] >= BENT * bent) & (sigma[size] <= SURE * z[size])
        return np.asarray(~(self._angle | self._size) | whole)

    def pattern(self, rows: IntArray, paired: BoolArray) -> Pattern:
        """What is common to all frames of some rows, of which some have their partner."""
        key = rows.tobytes() + paired.tobytes()
        return self._patterns.get(key, lambda: self._pattern(rows, paired))

    def _pattern(self, rows: IntArray, paired: BoolArray) -> Pattern:
        is_angle, is_size = self._angle[rows], self._size[rows]
        power = np.flatnonzero(~(is_angle | is_size))
        lone_size = np.flatnonzero(is_size & ~paired)
        lone_angle = np.flatnonzero(is_angle & ~paired)
        return Pattern(
            self.functionals[rows],
            self._across[rows],
            np.where(is_angle, 0.0, self._sign[rows]),
            is_angle,
            np.flatnonzero(is_angle | (is_size & paired)),
            np.flatnonzero(is_angle & paired),
            power,
            self._metered[rows[power]],
            lone_size,
            lone_angle,
        )

    def rows(
        self,
        z: FloatArray,
        sigma: FloatArray,
        available: BoolArray,
        voltage: ComplexArray,
        linearisation: Linearisation = "transform",
    ) -> tuple[sparse.csr_array, FloatArray, FloatArray]:
        """H, z and σ of the linear form at a predicted voltage; rows follow the layout.

        Parameters
        ----------
        z, sigma : (m,) ndarray
            Measured values and their σ. [p.u., rad]
        available : (m,) ndarray of bool
            Rows that carry a value; the others come out finite but mean nothing.
        voltage : (N,) ndarray of complex
            Predicted voltage. [p.u.]
        linearisation : {"transform", "derivative"}

        Returns
        -------
        H : (m, 2N) csr_array
        z_linear : (m,) ndarray
            What H [e; f] is compared with.
        sigma_linear : (m,) ndarray
        """
        frame = self.frame(z, sigma, available)
        pattern = frame.pattern
        found = frame.at(self.functionals @ voltage, voltage[pattern.metered], linearisation)
        w = sparse.csr_array(sparse.diags_array(found.turn.conj()) @ self.functionals).tolil()
        w[pattern.power, pattern.metered] += found.bend.conj()
        w = w.tocsr()
        # Re(w V) = Re(w)·e - Im(w)·f.
        H = sparse.csr_array(sparse.hstack([w.real, -w.imag]))
        return H, found.linear + found.offset, found.spread


class Pattern(NamedTuple):
    """What is common to all frames of the same rows with the same partners.

    Attributes
    ----------
    functionals : (r, N) csr_array of complex
        What the rows read: c = functionals V.
    across : (r,) ndarray of complex
        1 for a row along its direction, j for one across it.
    sign : (r,) ndarray
        Of the value in z: -1 for Q, 0 for an angle, which lies across what it measures.
    is_angle : (r,) ndarray of bool
    known, both, power, lone_size, lone_angle : ndarray of int
        Places of rows whose direction is measured, of angles with a magnitude, of powers, of
        magnitudes without an angle and of angles without a magnitude.
    metered : ndarray of int
        Buses of the powers.
    """

    functionals: sparse.csr_array
    across: ComplexArray
    sign: FloatArray
    is_angle: BoolArray
    known: IntArray
    both: IntArray
    power: IntArray
    metered: IntArray
    lone_size: IntArray
    lone_angle: IntArray


@dataclass(frozen=True, eq=False)
class Frame:
    """Rows of the linear form in so far as they do not depend on the predicted voltage.

    Attributes
    ----------
    pattern : Pattern
    unit : (r,) ndarray of complex
        e^{jα} of the direction where it is measured.
    linear, spread : (r,) ndarray
        z and σ, those of powers still to be divided by |V|.
    """

    pattern: Pattern
    unit: ComplexArray
    linear: FloatArray
    spread: FloatArray

    def at(
        self, current: ComplexArray, metered: ComplexArray, linearisation: Linearisation
    ) -> Linear:
        """The rows about predicted phasors.

        Parameters
        ----------
        current : (r,) ndarray of complex
            What the rows read, c = ``pattern.functionals`` V. [p.u.]
        metered : ndarray of complex
            Voltages where the powers are metered. [p.u.]
        linearisation : {"derivative", "transform"}

        Returns
        -------
        Linear
        """
        pattern = self.pattern
        unit, linear, spread = self.unit.copy(), self.linear.copy(), self.spread.copy()
        level = np.abs(metered)
        unit[pattern.power] = metered / level
        linear[pattern.power] /= level
        spread[pattern.power] /= level
        if len(pattern.lone_size):
            predicted = current[pattern.lone_size]
            size = np.abs(predicted)
            unit[pattern.lone_size] = np.where(size > 0, predicted, 1) / np.where(size > 0, size, 1)
        if len(pattern.lone_angle):
            size = np.abs(current[pattern.lone_angle])
            spread[pattern.lone_angle] *= np.maximum(size, RELATIVE_FLOOR_PU)
        turn = unit * pattern.across
        offset = np.zeros(len(linear))
        bend = np.zeros(len(pattern.power), dtype=np.complex128)
        if linearisation == "derivative":
            at_power = current[pattern.power]
            bend = at_power * pattern.across[pattern.power].conj() / level
            # At the predicted phasors the row reads twice the power, which is a product of two.
            offset[pattern.power] = (turn[pattern.power].conj() * at_power).real
        return Linear(turn, bend, linear, offset, spread)


class Linear(NamedTuple):
    """Rows about predicted phasors: Re(conj(turn) c) + Re(conj(bend) V) = z + offset + noise.

    Attributes
    ----------
    turn : (r,) ndarray of complex
    bend : ndarray of complex
        Of the voltages where the powers are metered; 0 for ``transform``.
    linear : (r,) ndarray
        Measured values, along the rows. [p.u.]
    offset : (r,) ndarray
        The constant of the expansion. [p.u.]
    spread : (r,) ndarray
        σ of the noise. [p.u.]
    """

    turn: ComplexArray
    bend: ComplexArray
    linear: FloatArray
    offset: FloatArray
    spread: FloatArray


class Memo(Generic[Kept]):
    """What was made for a few hundred keys; all of it is forgotten when there are more."""

    def __init__(self, most: int = 256) -> None:
        self._most = most
        self._made: dict[bytes, Kept] = {}

    def get(self, key: bytes, make: Callable[[], Kept]) -> Kept:
        """What belongs to a key, made if it is new."""
        if key not in self._made:
            if len(self._made) >= self._most:
                self._made.clear()
            self._made[key] = make()
        return self._made[key]


def _partners(layout: SensorLayout) -> IntArray:
    """Row that holds the other half of each row's phasor, or -1; -1 too where several could."""
    other = {VM: VA, VA: VM, IM: IA, IA: IM, P: Q, Q: P}
    places = list(zip(layout.source, layout.position, layout.side, strict=True))
    where: dict[tuple[str, int, int, int], list[int]] = {}
    for i, (place, q) in enumerate(zip(places, layout.quantity, strict=True)):
        where.setdefault((*place, int(q)), []).append(i)
    partner = np.full(len(layout), -1, dtype=np.int64)
    for (source, position, side, q), rows in where.items():
        match = where.get((source, position, side, other[q]), [])
        if len(rows) == len(match) == 1:
            partner[rows[0]] = match[0]
    return partner
