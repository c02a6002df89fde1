"""Moments of the rows that a snapshot reads, about voltages that may be renewed.

Every real row of the rectangular model is expanded about the phasors that it reads, each the mean
over its own interval. A power is a product of two phasors; all other rows are linear, or bend only
where half of a phasor is missing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse

from pse_analysis.arrays import BoolArray, ComplexArray, FloatArray
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters import intervals
from pse_analysis.estimation.filters.augmented_state import AugmentedState, Belief, Reach, Rows
from pse_analysis.estimation.filters.conditioning import Moments
from pse_analysis.estimation.filters.linearised import linear_halves
from pse_analysis.measurement import RectangularModel
from pse_analysis.measurement.rectangular import Frame, Linear, Linearisation, Memo

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


class Interval(NamedTuple):
    """How samples cover the past.

    Attributes
    ----------
    window_s : (m,) ndarray
        Length of the interval that a sample of each row averages. [s]
    step_s : float
        Between instants. [s]
    lags : int
        Steps back up to which samples are read.
    """

    window_s: FloatArray
    step_s: float
    lags: int


class Reader:
    """Chooses the rows of snapshots that a filter reads, and how they reach into the past.

    Parameters
    ----------
    model : RectangularModel
    lagged : AugmentedState
    linearisation : {"derivative", "transform"}
    interval : Interval, optional
        Every value counts as one of the present instant, as often as it stands there, without it.
    """

    def __init__(
        self,
        model: RectangularModel,
        lagged: AugmentedState,
        linearisation: Linearisation,
        interval: Interval | None,
    ) -> None:
        self._model, self._lagged, self._linearisation = model, lagged, linearisation
        self._interval = interval
        # The same channels report again and again, often at the same age.
        self._rows: Memo[Rows] = Memo()
        self._reaches: Memo[Reach] = Memo()

    def usable(self, snapshot: Snapshot) -> tuple[BoolArray, FloatArray]:
        """Rows that are used, and their σ. (m,), (m,)"""
        if self._interval is None:
            return snapshot.available, snapshot.sigma
        near = intervals.covered(snapshot.age_s, *self._interval)
        return snapshot.available & snapshot.fresh & near, snapshot.sigma_own

    def moments(
        self,
        belief: Belief,
        prior: Belief,
        noise: FloatArray,
        snapshot: Snapshot,
        sigma: FloatArray,
        used: BoolArray,
    ) -> RowMoments:
        """Moments of the used rows; see `RowMoments` for the states."""
        at, key = np.flatnonzero(used), used.tobytes()
        frame = self._model.frame(snapshot.z, sigma, used, at)
        rows = self._rows.get(key, lambda: Rows(frame.pattern))
        reach: Reach | None = None
        if self._interval is not None:
            ages = snapshot.age_s[at]
            between = ages, self._interval.window_s[at], self._interval.step_s
            reach = self._reaches.get(key + ages.tobytes(), lambda: self._reach(*between))
        return RowMoments(
            self._lagged, belief, prior, noise, rows, frame, reach, self._linearisation
        )

    def _reach(self, age_s: FloatArray, window_s: FloatArray, step_s: float) -> Reach:
        ages, windows, kind = intervals.kinds(age_s, window_s)
        between = ages, windows, step_s, self._lagged.lags
        bridge = intervals.bridge_covariance(*between)
        return Reach(intervals.weights(*between)[kind], bridge[kind[:, None], kind])
