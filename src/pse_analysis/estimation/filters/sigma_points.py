"""h at all sigma points of a state at once, as its odd and even parts along each direction.

A pair of points x ± δ turns a voltage by ± dθ and lengthens it by ± dV, so that mean and half
difference of the pair have closed forms. Currents are linear in the voltages, powers are products
of both, and their odd and even parts follow from those of the phasors: one cosine serves both
points, nothing large is subtracted, and the directions that turn no angle are cheaper still. Every
phasor stands in the frame of its bus's angle, or of the bus where it is metered, so that the
voltage at the centre is real.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import ComplexArray, FloatArray, IntArray
from pse_analysis.estimation.filters.conditioning import Prior, Rows
from pse_analysis.measurement import IM, VA, VM, MeasurementModel, P, Q
from pse_analysis.measurement.layout import Terminals

Parts = tuple[FloatArray, FloatArray]


class Spread(NamedTuple):
    """h around a mean.

    Attributes
    ----------
    square : float
        s: the points stand √s columns of chol(P) from the mean.
    centre : (m,) ndarray
        γ₀.
    linear : slice or ndarray of int
        Rows that read one entry of s each.
    entry : ndarray of int
        Which they read.
    curved : slice or (k,) ndarray of int
        Rows that are not linear in x. What reads an angle that is fixed is neither.
    odd, even, shift : (k, n), (k, n), (k,) ndarray
        d_i and e_i in columns, and ē, of the curved rows.
    """

    square: float
    centre: FloatArray
    linear: Rows
    entry: IntArray
    curved: Rows
    odd: FloatArray
    even: FloatArray
    shift: FloatArray

    @property
    def mean(self) -> FloatArray:
        """ŷ. (m,)"""
        out = self.centre.copy()
        out[self.curved] += self.shift
        return out


def run(rows: IntArray) -> Rows:
    """Rows as a slice where they follow each other, which spares a copy."""
    if len(rows) and rows[-1] - rows[0] + 1 == len(rows) and (np.diff(rows) == 1).all():
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows


class _Pairs(NamedTuple):
    """Phasors centre + rise ± odd; the centre is (k, 1), the others have a column by direction.

    Without any rise it is None.
    """

    centre: ComplexArray
    odd: ComplexArray
    rise: ComplexArray | None

    def ends(self) -> tuple[ComplexArray, ComplexArray]:
        middle = self.centre if self.rise is None else self.centre + self.rise
        return middle + self.odd, middle - self.odd


class _Pattern(NamedTuple):
    """What some rows of a layout read.

    ``kinds`` has for every quantity of the curved rows: which of these they are, and their
    terminals.
    """

    rows: IntArray
    linear: Rows
    entry: IntArray
    curved: Rows
    kinds: list[tuple[int, Rows, Rows]]


class SigmaPoints:
    """h at all sigma points of a state at once.

    Parameters
    ----------
    model : MeasurementModel
        Its columns are the voltages that are estimated, all angles before all magnitudes.
    """

    def __init__(self, model: MeasurementModel) -> None:
        self.model = model
        layout, n_bus = model.layout, model.network.n_bus
        self._angles = int(np.count_nonzero(model.columns < n_bus))
        self._straight = np.isin(layout.quantity, (VM, VA))
        place = np.full(2 * n_bus, -1, dtype=np.int64)
        place[model.columns] = np.arange(len(model.columns))
        bus = np.where(self._straight, layout.position, 0)
        self._entry = place[bus + np.where(layout.quantity == VM, n_bus, 0)]
        self._terminals = Terminals(model.network, layout)
        self._metered = run(self._terminals.metered)
        self._columns = run(model.columns)
        self._pattern = self._pattern_of(np.arange(len(layout)))

    def _pattern_of(self, rows: IntArray) -> _Pattern:
        entry, straight = self._entry[rows], self._straight[rows]
        linear, curved = np.flatnonzero(straight & (entry >= 0)), np.flatnonzero(~straight)
        quantity = self.model.layout.quantity[rows[curved]]
        terminal = self._terminals.of_row[rows[curved]]
        rows_of = {int(q): np.flatnonzero(quantity == q) for q in np.unique(quantity)}
        kinds = [(q, run(at), run(terminal[at])) for q, at in rows_of.items()]
        return _Pattern(rows, run(linear), entry[linear], run(curved), kinds)

    def spread(self, prior: Prior, square: float, rows: IntArray) -> Spread:
        """Odd and even parts of h along the columns of √s chol(P), for some rows of the layout.

        Parameters
        ----------
        prior : Prior
        square : float
            s.
        rows : (m,) ndarray of int

        Returns
        -------
        Spread
        """
        if not np.array_equal(rows, self._pattern.rows):
            # Mostly the same channels report at every instant.
            self._pattern = self._pattern_of(rows)
        _, linear, entry, curved, kinds = self._pattern
        n, a = prior.n, self._angles
        centre = self.model.h(prior.x)[rows]
        odd, even = np.empty((2, len(centre[curved]), n))
        if kinds:
            turned, stretched = self._phasors(prior, np.sqrt(square) * prior.chol_P[:n, :n])
            for columns, phasors in ((slice(0, a), turned), (slice(a, n), stretched)):
                found = _Parts(*phasors)
                for q, at, source in kinds:
                    first, second = found.of(q)
                    odd[at, columns], even[at, columns] = first[source], second[source]
        return Spread(square, centre, linear, entry, curved, odd, even, even.sum(axis=1) / square)

    def _phasors(
        self, prior: Prior, step: FloatArray
    ) -> tuple[tuple[_Pairs, _Pairs], tuple[_Pairs, _Pairs]]:
        """Voltages and currents of the terminals, along directions that turn angles and others."""
        n_bus, a, n = self.model.network.n_bus, self._angles, step.shape[1]
        size = prior.x[n_bus:, None]
        full = np.zeros((2 * n_bus, n))
        full[self._columns] = step
        # L is triangular, and the angles come first.
        turn, along, across = full[:n_bus, :a], full[n_bus:, :a], full[n_bus:, a:]
        sine, cosine = np.sin(0.5 * turn), np.cos(0.5 * turn)
        fall, sine = 2.0 * sine * sine, 2.0 * sine * cosine  # 1 - cos dθ and sin dθ
        # Centre, rise and odd part of the first directions, odd part of the others.
        voltage = np.zeros((n_bus, 1 + a + n), dtype=np.complex128)
        voltage.real[:, :1] = size
        voltage.real[:, 1 : 1 + a], voltage.imag[:, 1 : 1 + a] = -size * fall, along * sine
        voltage.real[:, 1 + a : 1 + 2 * a] = along - along * fall
        voltage.imag[:, 1 + a : 1 + 2 * a] = size * sine
        voltage.real[:, 1 + 2 * a :] = across
        ahead = np.exp(1j * prior.x[:n_bus, None])
        current = self._terminals.y @ (voltage * ahead)
        current *= ahead.conj()[self._metered]
        found = []
        for phasors in (voltage[self._metered], current):
            centre, rise = phasors[:, :1], phasors[:, 1 : 1 + a]
            found.append(_Pairs(centre, phasors[:, 1 + a : 1 + 2 * a], rise))
            found.append(_Pairs(centre, phasors[:, 1 + 2 * a :], None))
        return (found[0], found[2]), (found[1], found[3])


class _Parts:
    """Odd and even parts of what the terminals' voltages and currents give."""

    def __init__(self, voltage: _Pairs, current: _Pairs) -> None:
        self._voltage, self._current = voltage, current
        self._power: tuple[ComplexArray, ComplexArray] | None = None

    def of(self, quantity: int) -> Parts:
        if quantity in (P, Q):
            odd, even = self._power = self._power or _product(self._voltage, self._current)
            return (odd.real, even.real) if quantity == P else (odd.imag, even.imag)
        centre = self._current.centre
        first, second = self._current.ends()
        if quantity == IM:
            return _halves(np.abs(first), np.abs(second), np.abs(centre))
        # Against the centre, so that no angle passes the end of its turn.
        one, other = np.angle(first * centre.conj()), np.angle(second * centre.conj())
        return _halves(one, other, np.zeros(1))


def _product(voltage: _Pairs, current: _Pairs) -> tuple[ComplexArray, ComplexArray]:
    """V I*."""
    v, i, dv, di = voltage.centre, current.centre.conj(), voltage.odd, current.odd.conj()
    if voltage.rise is None or current.rise is None:
        return v * di + dv * i, dv * di
    rise = current.rise.conj()
    middle = i + rise
    return (v + voltage.rise) * di + dv * middle, v * rise + voltage.rise * middle + dv * di


def _halves(first: FloatArray, second: FloatArray, centre: FloatArray) -> Parts:
    return 0.5 * (first - second), 0.5 * (first + second) - centre
