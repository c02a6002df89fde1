"""Moments of the rows that a snapshot reads, about voltages that may be renewed.

Every real row of the rectangular model is expanded about the phasors that it reads, each the mean
over its own interval. A power is a product of two phasors; all other rows are linear, or bend only
where half of a phasor is missing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse

from pse_analysis.arrays import ComplexArray, FloatArray
from pse_analysis.estimation.filters.augmented_state import AugmentedState, Belief, Reach, Rows
from pse_analysis.estimation.filters.conditioning import Moments
from pse_analysis.estimation.filters.linearised import linear_halves
from pse_analysis.measurement.rectangular import Frame, Linear, Linearisation

REFINE_PU = 1e-3
"""Transformed rows are renewed if an update moves a voltage by more than this. [p.u.]"""
REMAINDER = 0.1
"""Expanded rows are renewed if the remainder of one exceeds this share of its σ."""


class Phasors(NamedTuple):
    """What rows read at some voltages.

    Attributes
    ----------
    current : (r,) ndarray of complex
        c = y V, mean over the interval of each row.
    metered : ndarray of complex
        Voltages where the powers are metered, means likewise.
    product : ndarray of complex
        V conj(c) of the powers, means likewise.
    """

    current: ComplexArray
    metered: ComplexArray
    product: ComplexArray


class Expansion(NamedTuple):
    """Rows about some voltages.

    Attributes
    ----------
    instants : (N, K+1) ndarray of complex
        The voltages.
    about : Phasors
        What the rows read there.
    linear : Linear
    plane : (r, 2N) csr_array
        The rows as functionals of one instant's [e; f].
    eta : (r,) ndarray
        Innovation. [p.u.]
    moments : Moments
        Of the state and the rows.
    reach : Reach, optional
        How the rows reach into the past.
    """

    instants: ComplexArray
    about: Phasors
    linear: Linear
    plane: sparse.csr_array
    eta: FloatArray
    moments: Moments
    reach: Reach | None


class RowMoments:
    """Moments of the rows of one snapshot.

    Parameters
    ----------
    lagged : AugmentedState
    belief, prior : Belief
        Before the step, and what it has moved to.
    noise : (order·2N, order·2N) ndarray
        Q of the present.
    rows : Rows
    frame : Frame
        Of the measured values.
    reach : Reach, optional
        None if all rows read the present.
    linearisation : {"derivative", "transform"}
    """

    def __init__(
        self,
        lagged: AugmentedState,
        belief: Belief,
        prior: Belief,
        noise: FloatArray,
        rows: Rows,
        frame: Frame,
        reach: Reach | None,
        linearisation: Linearisation,
    ) -> None:
        self._lagged, self._given = lagged, (belief, prior, noise)
        self._rows, self._frame, self._reach = rows, frame, reach
        self._linearisation = linearisation
        self.instants = lagged.instants(belief, prior)
        self._before = self._phasors(self.instants)

    def _phasors(self, instants: ComplexArray) -> Phasors:
        pattern = self._frame.pattern
        current = self._rows.read(instants)
        metered = instants[pattern.metered]
        product = metered * current[pattern.power].conj()
        if self._reach is None:
            return Phasors(current[:, 0], metered[:, 0], product[:, 0])
        share = self._reach.share
        own = share[pattern.power]
        return Phasors(*(
            (part * weight).sum(axis=1)
            for part, weight in ((current, share), (metered, own), (product, own))
        ))  # fmt: skip

    def at(self, instants: ComplexArray) -> Expansion:
        """The rows about voltages of the present and the past instants (N, K+1)."""
        pattern, before = self._frame.pattern, self._before
        about = before if instants is self.instants else self._phasors(instants)
        if self._linearisation == "transform":
            current, metered = self._rows.read(instants[:, :1])[:, 0], instants[pattern.metered, 0]
        else:
            current, metered = about.current, about.metered
        linear = self._frame.at(current, metered, self._linearisation)
        mean = (linear.turn.conj() * before.current).real - linear.offset
        if self._linearisation == "derivative":
            # What varies over an interval adds to the mean of a product.
            beyond = before.product - before.metered * before.current[pattern.power].conj()
            across = pattern.across[pattern.power]
            mean[pattern.power] += (linear.bend.conj() * before.metered).real
            mean[pattern.power] += (across * beyond).real / np.abs(metered)
        plane = self._rows.plane(linear)
        expected = self._lagged.expect(*self._given, self._rows, plane, self._reach)
        halves = linear_halves(plane) if self._reach is None else None
        moments = Moments(mean, expected.own.T, expected.cross.T, halves=halves)
        return Expansion(instants, about, linear, plane, linear.linear - mean, moments, self._reach)

    def settled(self, expansion: Expansion, instants: ComplexArray) -> bool:
        """Whether an expansion still holds at the voltages (N, K+1) that it led to."""
        if self._linearisation == "transform":
            moved = (instants - expansion.instants)[:, 0]
            return bool(np.abs(moved).max() < REFINE_PU)
        pattern, about, after = self._frame.pattern, expansion.about, self._phasors(instants)
        current = np.abs(after.current - about.current)
        # |ΔV Δc| of a product, |Δc|² of the length or the angle of a phasor.
        remainder = np.zeros(len(current))
        moved = np.abs(after.metered - about.metered)
        remainder[pattern.power] = current[pattern.power] * moved / np.abs(about.metered)
        for lone in (pattern.lone_size, pattern.lone_angle):
            size = np.maximum(np.abs(about.current[lone]), current[lone])
            remainder[lone] = np.divide(
                current[lone] ** 2, size, out=np.zeros(len(lone)), where=size > 0
            )
        return bool((remainder <= REMAINDER * expansion.linear.spread).all())
