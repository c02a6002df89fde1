"""Weighted least squares on one snapshot: sparse Gauss-Newton in polar coordinates.

The rows are whitened (divided by σ) once per iteration; a step that would raise the objective is
halved. What the measurements leave open stays open beside what they determine, or ends the
estimate, as the caller asks (`pse_analysis.estimation.static.unobserved`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import Unobservable
from pse_analysis.estimation.core.normal import Factor, NormalEquations, Pins
from pse_analysis.estimation.static.cold_start import ColdStart
from pse_analysis.estimation.static.gauss_newton import (
    REMEMBERED,
    Descent,
    GaussNewton,
    Problem,
    Singular,
)
from pse_analysis.estimation.static.unobserved import Gap, Unobserved
from pse_analysis.grid.network import Network
from pse_analysis.measurement import IA, IM, MeasurementModel, SensorLayout
from pse_analysis.measurement.layout import metered_bus

ASSUMED = 1e-3
"""σ of a reference angle where nothing ever measured it. [rad]

It is taken for the reference then. A wide σ would be of no use to a filter that starts from it: its
powers are currents in the frame of the predicted voltage, which sees a turn of the whole grid.
"""
LOOKS = 4
"""How often a descent begins again because a current that had vanished has a tangent now."""


class Reference(NamedTuple):
    """What is known of the angles beside the measurements; those of `Network.references` count.

    Attributes
    ----------
    angle, sigma : (N,) ndarray
        [rad]
    """

    angle: FloatArray
    sigma: FloatArray


def state_columns(network: Network, layout: SensorLayout) -> IntArray:
    """Returns the columns of [θ; |V|] to be estimated.

    An island in which the layout measures an angle has all of them; the reference angle of any
    other island (`Network.references`) is fixed.
    """
    measured = network.references[angular_buses(network, layout)]
    fixed = np.setdiff1d(network.references, measured)
    return np.setdiff1d(np.arange(2 * network.n_bus), fixed)


def angular_buses(network: Network, layout: SensorLayout) -> IntArray:
    """Returns the bus at which each angle of a layout is measured, in the order of its rows."""
    rows = np.flatnonzero(layout.angular)
    return np.atleast_1d(metered_bus(network, layout.position[rows], layout.side[rows]))


@dataclass(frozen=True, eq=False)
class WlsSolution:
    """A weighted least-squares estimate.

    Attributes
    ----------
    x : (2N,) ndarray
        [θ; |V|]; open states are as nominal values would have them. [rad; p.u.]
    residual : (m,) ndarray
        z - h(x); NaN where nothing, or nothing but open states, was measured.
    objective : float
        Sum of the squared whitened residuals, χ² with ``dof`` degrees of freedom.
    dof : int
        Measurements that say anything, less the states that they fix.
    iterations : int
    converged : bool
    pinned : bool
        The measurements told no angle of an island, so a `Reference` did.
    open : (2N,) ndarray of bool
        States that the measurements leave open.
    """

    x: FloatArray
    residual: FloatArray
    objective: float
    dof: int
    iterations: int
    converged: bool
    pinned: bool
    open: BoolArray
    _factor: Factor
    _equations: NormalEquations

    @cached_property
    def _inverse(self) -> FloatArray:
        return self._factor.inverse()

    def covariance(self) -> FloatArray:
        """Returns the covariance of [θ; |V|]: zero where fixed, NaN where open. (2N, 2N)"""
        full, columns = np.zeros((len(self.x), len(self.x))), self._equations.model.columns
        full[np.ix_(columns, columns)] = self._inverse
        if self.open.any():
            full[self.open] = np.nan
            full[:, self.open] = np.nan
        return full

    def explained(self) -> FloatArray:
        """Returns the variance of h(x) of each row, by which residuals vary less than noise. (m,)

        What is open makes no difference to a measurement, so it adds nothing.
        """
        return self._equations.explained(self.x, self._inverse)[: len(self.residual)]


class _Fit(NamedTuple):
    """Where a descent ended, and what it took to get there."""

    found: Descent
    gap: Gap | None


class WeightedLeastSquares:
    """Static state estimation for one sensor layout.

    Parameters
    ----------
    network : Network
    layout : SensorLayout
    tolerance : float
        Largest step of a converged state. [rad, p.u.]
    max_iterations : int
        From each start.
    """

    def __init__(
        self,
        network: Network,
        layout: SensorLayout,
        *,
        tolerance: float = 1e-8,
        max_iterations: int = 50,
    ) -> None:
        self.network = network
        self.model = MeasurementModel(network, layout, state_columns(network, layout))
        self.tolerance = tolerance
        self.max_iterations = max_iterations
        self._steps = GaussNewton(self.model, tolerance, max_iterations)
        self._cold = ColdStart(network, layout)
        self._place = np.full(2 * network.n_bus, -1)
        self._place[self.model.columns] = np.arange(len(self.model.columns))
        self._angular = np.flatnonzero(layout.angular)
        self._size = layout.quantity == IM
        self._references = network.references[angular_buses(network, layout)]
        self._open = Unobserved(self.model, self._cold, tolerance, max_iterations)
        self._gaps: dict[bytes, Gap] = {}

    def flat_start(self) -> FloatArray:
        """[θ; |V|] with rated voltage and no angle but that of phase shifters. (2N,)"""
        return self._cold.flat()

    def solve(
        self,
        z: FloatArray,
        sigma: FloatArray,
        available: BoolArray | None = None,
        *,
        start: FloatArray | None = None,
        huber: float | None = None,
        reference: Reference | None = None,
        partial: bool = False,
    ) -> WlsSolution:
        """Estimate the state.

        Parameters
        ----------
        z, sigma : (m,) ndarray
            Measurements and their σ; only available rows are read. [p.u., rad]
        available : (m,) ndarray of bool, optional
            Rows that carry a value; all of them by default.
        start : (2N,) ndarray, optional
            [θ; |V|] to start from. By default the nominal state moved to what is measured, flat,
            or, where currents are measured, the solution of the linear form: whichever fits best,
            and the others and DC power flow in turn where that leads nowhere.
        huber : float, optional
            Residual, in units of σ, beyond which the cost of a row grows with the residual instead
            of its square, so that no row pulls harder; to `COARSE`, and with the covariance of the
            weights at the end.
        reference : Reference, optional
            What stands for the angle of an island if the layout measures some there and none is
            available; by default the angle of the start.
        partial : bool
            Estimate what can be estimated where the measurements leave states open.

        Returns
        -------
        WlsSolution
            ``converged`` is False if no start led anywhere.

        Raises
        ------
        Unobservable
            With the buses that the available measurements do not reach, and what would help; if
            ``partial``, only where they reach none.
        """
        m = self.model.shape[0]
        rows = np.ones(m, dtype=bool) if available is None else np.asarray(available, dtype=bool)
        weight = np.zeros(m)
        weight[rows] = 1.0 / sigma[rows]
        observed = np.where(rows, z, 0.0)
        # No current is negative: a noisy reading that is asks for none, without a kink in the cost.
        fitted = np.where(self._size, np.maximum(observed, 0.0), observed)
        problem = Problem(fitted, weight, rows, huber)
        starts = self._starts(problem, sigma) if start is None else iter([start.copy()])
        silent = np.setdiff1d(self._references, self._references[rows[self._angular]])
        fit, held = self._best(starts, problem, silent, reference, partial)
        return self._solution(fit, replace(problem, z=observed), held, partial)

    def _best(
        self,
        starts: Iterator[FloatArray],
        problem: Problem,
        silent: IntArray,
        reference: Reference | None,
        partial: bool,
    ) -> tuple[_Fit, Pins]:
        """Descend from one start after the other, until one of them leads to a minimum."""
        best: _Fit | None = None
        for x in starts:
            held = self._referred(x, silent, reference)
            try:
                fit = self._fitted(x, problem, held, partial)
            except Unobservable:
                # Some rows have no say at a flat start, so that one start alone proves nothing.
                if best is None:
                    raise
                continue
            if best is None or fit.found.converged:
                best = fit
            if fit.found.converged:
                break
        assert best is not None
        return best, held

    def _fitted(self, x: FloatArray, problem: Problem, held: Pins, partial: bool) -> _Fit:
        """Descend from a state, beside as many nominal values as the measurements need."""
        key = problem.rows.tobytes()
        try:
            if key in self._gaps and partial:
                gap = self._gaps[key]
                return _Fit(self._open.descend(x, problem, held, gap), gap)
            return self._looked_into(x, problem, held, partial)
        except Singular as error:
            raise self._open.explained(error.x, problem.rows, held) from error

    def _looked_into(self, x: FloatArray, problem: Problem, held: Pins, partial: bool) -> _Fit:
        """Descend, and look for what is open where that cannot be done."""
        for _ in range(LOOKS):
            try:
                return _Fit(self._steps.descend(x, problem, held), None)
            except Singular as error:
                waiting = bool((problem.rows & ~error.rows).any())
                if not (partial or waiting):
                    raise
                gap = self._open.gap(error, held)
                fit = _Fit(self._open.descend(error.x, problem, held, gap), gap)
            if not (waiting and fit.found.converged):
                break
            # A current that vanished may have one now, and with it a say.
            x = fit.found.x
        if not waiting:
            if len(self._gaps) >= REMEMBERED:
                self._gaps.clear()
            self._gaps[problem.rows.tobytes()] = gap
        return fit

    def _starts(self, problem: Problem, sigma: FloatArray) -> Iterator[FloatArray]:
        """Yields states to start from, of the likeliest the one that fits best first."""
        states = self._cold.states(problem.z, sigma, problem.rows)
        first = list(itertools.islice(states, 3 if self._steps.currents else 2))
        # Logarithms, so that neither one gross error nor one tiny σ decides.
        misfit = [
            np.log1p((problem.weight * self.model.residual(problem.z, x)) ** 2).sum() for x in first
        ]
        yield from (first[k] for k in np.argsort(misfit, kind="stable"))
        yield from states

    def _referred(self, x: FloatArray, silent: IntArray, reference: Reference | None) -> Pins:
        """Turn islands without an available angle to their references, which are held there."""
        if not len(silent):
            return Pins.none()
        if reference is not None:
            n, turn = self.network.n_bus, np.zeros(self.network.n_bus)
            turn[silent] = reference.angle[silent] - x[silent]
            x[:n] += turn[self.network.references]
        spread = np.full(len(silent), ASSUMED)
        if reference is not None:
            spread = np.where(reference.sigma[silent] > 0, reference.sigma[silent], ASSUMED)
        return Pins(self._place[silent], spread)

    def _solution(self, fit: _Fit, problem: Problem, held: Pins, partial: bool) -> WlsSolution:
        """Returns the solution where a descent ended, with what was open there."""
        found, gap, model = fit.found, fit.gap, self.model
        open_ = np.zeros(2 * self.network.n_bus, dtype=bool)
        rows, free = problem.rows, model.shape[1]
        if gap is not None:
            open_[model.columns] = self._open.following(found, gap)
            rows, free = rows & gap.kept, free - len(gap.closing)
            if not partial or np.delete(open_[model.columns], held.columns).all():
                raise self._open.explained(found.x, problem.rows, held)
        # The angle of a current that vanished says nothing.
        vanished = model.without_tangent(found.x)
        if vanished is not None:
            rows = rows & ~(vanished & (model.layout.quantity == IA))
        residual = model.residual(problem.z, found.x)
        white = np.where(rows, problem.weight, 0.0) * residual
        return WlsSolution(
            x=found.x,
            residual=np.where(rows, residual, np.nan),
            objective=float(white @ white),
            dof=max(int(rows.sum()) + len(held.columns) - free, 0),
            iterations=found.iterations,
            converged=found.converged,
            pinned=len(held.columns) > 0,
            open=open_,
            _factor=found.factor,
            _equations=(self._steps if gap is None else self._open.steps).equations,
        )
