"""h at all sigma points of a state at once, as its odd and even parts along each direction.

A pair of points x ± δ turns a voltage by ± dθ and lengthens it by ± dV, so that mean and half
difference of the pair have closed forms. Currents are linear in the voltages, powers are products
of both, and their odd and even parts follow from those of the phasors: one cosine serves both
points, nothing large is subtracted, and the directions that turn no angle are cheaper still. Every
phasor stands in the frame of a bus's own angle, where its voltage is real; the admittances are
turned into these frames instead.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pse_analysis.estimation.conditioning import Prior
from pse_analysis.measurement import IM, VA, VM, MeasurementModel, P, Q
from pse_analysis.measurement.layout import Terminals

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
Parts = tuple[FloatArray, FloatArray]
Rows = slice | IntArray


class Spread(NamedTuple):
    """h around a mean.

    Attributes
    ----------
    square : float
        s: the points stand √s columns of chol(P) from the mean.
    centre : (m,) ndarray
        γ₀.
    linear, entry : (m-k,) ndarray of int
        Rows that read one entry of s each, and which; -1 for one that is fixed.
    curved : (k,) ndarray of int
        The other rows.
    odd, even, shift : (k, n), (k, n), (k,) ndarray
        d_i and e_i in columns, and ē, of the curved rows.
    """

    square: float
    centre: FloatArray
    linear: IntArray
    entry: IntArray
    curved: IntArray
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

    def take(self, rows: Rows) -> _Pairs:
        rise = None if self.rise is None else self.rise[rows]
        return _Pairs(self.centre[rows], self.odd[rows], rise)

    def ends(self) -> tuple[ComplexArray, ComplexArray]:
        middle = self.centre if self.rise is None else self.centre + self.rise
        return middle + self.odd, middle - self.odd


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
        n, a = prior.n, self._angles
        straight = self._straight[rows]
        linear, curved = np.flatnonzero(straight), np.flatnonzero(~straight)
        odd, even = np.empty((2, len(curved), n))
        if len(curved):
            step = np.sqrt(square) * prior.chol_P[:n, :n]
            quantity = self.model.layout.quantity[rows[curved]]
            terminal = self._terminals.of_row[rows[curved]]
            rows_of = {q: np.flatnonzero(quantity == q) for q in np.unique(quantity)}
            kinds = [(q, run(at), run(terminal[at])) for q, at in rows_of.items()]
            turned, stretched = self._phasors(prior, step)
            for columns, phasors in ((slice(0, a), turned), (slice(a, n), stretched)):
                found = _Parts(*phasors)
                for q, at, source in kinds:
                    first, second = found.of(q)
                    odd[at, columns], even[at, columns] = first[source], second[source]
        return Spread(
            square,
            self.model.h(prior.x)[rows],
            linear,
            self._entry[rows[linear]],
            curved,
            odd,
            even,
            even.sum(axis=1) / square,
        )

    def _phasors(
        self, prior: Prior, step: FloatArray
    ) -> tuple[tuple[_Pairs, _Pairs], tuple[_Pairs, _Pairs]]:
        """Voltages and currents of the terminals, along directions that turn angles and others."""
        n_bus, a, y = self.model.network.n_bus, self._angles, self._terminals
        ahead, size = np.exp(1j * prior.x[:n_bus]), prior.x[n_bus:, None]
        full = np.zeros((2 * n_bus, step.shape[1]))
        full[prior.columns] = step
        # L is triangular, and the angles come first.
        turn, along, across = full[:n_bus, :a], full[n_bus:, :a], full[n_bus:, a:]
        sine, cosine = np.sin(0.5 * turn), np.cos(0.5 * turn)
        fall, sine = 2.0 * sine * sine, 2.0 * sine * cosine  # 1 - cos dθ and sin dθ
        odd = _complex(along - along * fall, size * sine)
        rise = _complex(-size * fall, along * sine)
        real = size.astype(np.complex128)
        turned = y.y.data * ahead[y.entry_col] * ahead.conj()[y.metered[y.entry_row]]
        admittance = sparse.csr_array((turned, y.y.indices, y.y.indptr), shape=y.y.shape)
        current = admittance @ np.hstack([real, odd, rise, across])
        middle, by_odd, by_rise, by_size = np.split(current, (1, 1 + a, 1 + 2 * a), axis=1)
        metered = run(y.metered)
        stretched = _Pairs(real, across.astype(np.complex128), None)
        return (
            (_Pairs(real, odd, rise).take(metered), _Pairs(middle, by_odd, by_rise)),
            (stretched.take(metered), _Pairs(middle, by_size, None)),
        )


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


def _complex(real: FloatArray, imaginary: FloatArray) -> ComplexArray:
    out = np.empty(real.shape, dtype=np.complex128)
    out.real, out.imag = real, imaginary
    return out
