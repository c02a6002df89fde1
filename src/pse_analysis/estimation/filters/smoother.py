"""Looks back and ahead from a filter: what later instants tell of earlier ones, and forecasts.

The analysis is offline, so an estimate need not rest on the past alone. The smoother of Rauch, Tung
and Striebel goes back over a filter's own states. States are large and there are many, so only some
are kept on the way, and those between two of them are made again when they are needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from pse_analysis.arrays import FloatArray
from pse_analysis.estimation.core.cholesky import cholesky, solve
from pse_analysis.estimation.core.interface import (
    FAILURES,
    Dynamics,
    Estimate,
    Estimator,
    Info,
    Snapshot,
    Transition,
)
from pse_analysis.vocabulary import Status

AGREE = 4.0
"""σ by which later instants may differ from a forecast and still confirm what it came from."""
WIDENED = 1.0 + 1e-6
"""σ² after an instant over that before it from which a filter has been made less certain."""


class Smoothed(NamedTuple):
    """Mean s (N,) and covariance P (N, N) of a state given all instants."""

    s: FloatArray
    P: FloatArray


def look_back(
    belief: tuple[FloatArray, FloatArray],
    transition: Transition,
    later: Smoothed,
    difference: Any = np.subtract,
) -> Smoothed:
    """Estimate of a state that knows what was learnt after it.

    Parameters
    ----------
    belief : tuple of (N,) and (N, N) ndarray
        s and P of the filter.
    transition : Transition
        From this state to the next one.
    later : Smoothed
        Of the next state.
    difference : callable
        s₁ - s₂.

    Returns
    -------
    Smoothed

    Notes
    -----
    Rauch, Tung & Striebel 1965: s + G (s⁺ - s⁻) and P + G (P⁺ - P⁻) Gᵀ with G = P Fᵀ (P⁻)⁻¹.
    Entries that are certain before the next instant is measured learn nothing and are left out;
    the others are scaled to unit variance before P⁻ is factored.
    """
    s, P = belief
    sigma = np.sqrt(np.maximum(np.diagonal(transition.covariance), 0.0))
    free = np.flatnonzero(sigma > 0)
    inside, scale = np.ix_(free, free), sigma[free]
    chol = cholesky(transition.covariance[inside] / np.outer(scale, scale))
    # (P⁻)⁻¹ F P, column by column of the earlier state.
    half = solve(chol, transition.cross[:, free].T / scale[:, None])
    gain = solve_triangular(chol, half, lower=True, trans=1, check_finite=False).T / scale
    moved = difference(later.s, transition.mean)[free]
    learnt = later.P[inside] - transition.covariance[inside]
    found = P + gain @ learnt @ gain.T
    return Smoothed(s + gain @ moved, 0.5 * (found + found.T))


@dataclass
class Trail:
    """The way of a filter, with every c-th of its states.

    Attributes
    ----------
    estimator : Estimator
    snapshots : sequence of Snapshot
    """

    estimator: Estimator
    snapshots: Sequence[Snapshot]
    _kept: dict[int, Any] = field(default_factory=dict)
    _follows: list[bool] = field(default_factory=list)
    _before: Any = None

    @property
    def span(self) -> int:
        """c, instants from one kept state to the next."""
        return max(isqrt(len(self.snapshots)), 1)

    def watch(self, k: int, state: Any, info: Info) -> None:
        """Take in the state after an instant; called with k = 0, 1, …"""
        # What starts again, or has been widened, knows nothing that came from before.
        follows = self._before is not None and state is not None
        follows = follows and info.status is not Status.RESTARTED
        if follows:
            follows = self._narrowed(k, state)
        self._follows.append(follows)
        if k % self.span == 0 or not follows:
            self._kept[k] = state
        self._before = state

    def _narrowed(self, k: int, state: Any) -> bool:
        """Whether a state is no less certain than what was expected of it before the instant."""
        dynamics = _dynamics(self.estimator)
        state = dynamics.undoubted(state) or state
        try:
            ahead = dynamics.predict(self._before, self.snapshots[k]).covariance
        except FAILURES:
            # A state that cannot be moved has no later one that looks back on it.
            return False
        after = dynamics.belief(state)[1]
        return len(ahead) == len(after) and bool(
            (np.diagonal(after) <= WIDENED * np.diagonal(ahead)).all()
        )

    def _segment(self, first: int, last: int) -> list[Any]:
        """States of the instants first … last; the first is a kept one."""
        states = [self._kept[first]]
        for k in range(first + 1, last + 1):
            if k in self._kept:
                states.append(self._kept[k])
            elif states[-1] is None:
                states.append(None)
            else:
                states.append(self.estimator.step(states[-1], self.snapshots[k])[0])
        return states

    def smoothed(self) -> list[Estimate | None]:
        """Estimate of every instant given all of them; None where the filter has none.

        A snapshot that the filter doubted (`pse_analysis.estimation.filters.restart`) is believed
        if the later ones confirm it; if not, nothing is known of what came before it.
        """
        dynamics = _dynamics(self.estimator)
        out: list[Estimate | None] = [None] * len(self._follows)
        later: Smoothed | None = None
        doubted = False
        last = len(self._follows) - 1
        for first in sorted(self._kept, reverse=True):
            for k, state in reversed(list(enumerate(self._segment(first, last), first))):
                if state is None:
                    later = None
                    continue
                known = None if later is None or doubted or not self._follows[k + 1] else later
                before = dynamics.undoubted(state)
                doubted = before is not None and not self._confirmed(k, before, known)
                state = state if before is None or doubted else before
                alone = Smoothed(*dynamics.belief(state))
                later = alone if known is None else self._looked_back(k, state, known, alone)
                out[k] = dynamics.read(state, later.s, later.P)
            last = first - 1
        return out

    def _confirmed(self, k: int, state: Any, later: Smoothed | None) -> bool:
        """Whether the later instants lead to about what a state makes one expect."""
        if later is None:
            return False
        dynamics = _dynamics(self.estimator)
        try:
            ahead = dynamics.predict(state, self.snapshots[k + 1])
        except FAILURES:
            return False
        off = dynamics.difference(later.s, ahead.mean)
        return bool((off**2 <= AGREE**2 * np.diagonal(ahead.covariance)).all())

    def _looked_back(self, k: int, state: Any, later: Smoothed, alone: Smoothed) -> Smoothed:
        """A state given the later ones; by itself where their numbers do not allow more."""
        dynamics = _dynamics(self.estimator)
        try:
            transition = dynamics.predict(state, self.snapshots[k + 1])
            found = look_back(alone, transition, later, dynamics.difference)
        except FAILURES:
            return alone
        sound = np.isfinite(found.s).all() and np.isfinite(found.P).all()
        return found if sound and (np.diagonal(found.P) >= 0).all() else alone


@dataclass
class Ahead:
    """Forecasts of a filter, some steps ahead.

    Attributes
    ----------
    estimator : Estimator
    snapshots : sequence of Snapshot
    steps : tuple of int
    """

    estimator: Estimator
    snapshots: Sequence[Snapshot]
    steps: tuple[int, ...]
    found: dict[int, dict[int, Estimate]] = field(default_factory=dict)
    """Forecasts by steps ahead and by the instant that they are about."""

    def watch(self, k: int, state: Any, _info: Info) -> None:
        """Forecast from the state after an instant."""
        for ahead in range(1, max(self.steps) + 1):
            if state is None or k + ahead >= len(self.snapshots):
                return
            try:
                state, _ = self.estimator.step(state, self.snapshots[k + ahead].silent())
            except FAILURES:
                # Nothing can be said of this instant, nor of those behind it.
                return
            if ahead in self.steps and state is not None:
                made = self.estimator.read(state)
                if made is not None:
                    self.found.setdefault(ahead, {})[k + ahead] = made


def _dynamics(estimator: Estimator) -> Dynamics:
    if estimator.dynamics is None:
        raise TypeError(f"{estimator.name} does not say how its state moves")
    return estimator.dynamics
