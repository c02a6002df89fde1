"""Gauss-Newton steps that never raise the objective, on whatever the measurements determine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.estimation.core.normal import (
    AugmentedFactor,
    Factor,
    NormalEquations,
    Pins,
    with_held,
)
from pse_analysis.estimation.static.observability import open_states
from pse_analysis.estimation.static.small_currents import SmallCurrents
from pse_analysis.measurement import IA, IM, MeasurementModel

COARSE = 1e-2
"""Largest step of a converged state whose rows are weighed by their residuals. [rad, p.u.]"""
_SHARES = tuple(0.5**k for k in range(13))
"""Shares of a step that are tried until one of them does not raise the objective."""
ROUNDING = 32 * np.finfo(float).eps
"""Error of h(x) by rounding, in units of the size of its terms."""
STRAIGHT = 4
"""Iterations after which small currents bend a step even if it leads down without that."""
PATIENCE, ASTRAY = 15, 0.3
"""Iterations after which steps so large lead nowhere. [rad, p.u.]"""
REMEMBERED = 256
"""Sets of available rows of which it is kept that they are stiff."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One snapshot to fit.

    Attributes
    ----------
    z : (m,) ndarray
        0 where not available. [p.u., rad]
    weight : (m,) ndarray
        1/σ; 0 where not available.
    rows : (m,) ndarray of bool
        Available.
    huber : float, optional
        Whitened residual beyond which the cost of a row grows with the residual, not its square.
    """

    z: FloatArray
    weight: FloatArray
    rows: BoolArray
    huber: float | None = None

    def without(self, waiting: BoolArray, silent: BoolArray) -> Problem:
        """Returns the problem with rows that have no tangent, and some that have no value."""
        weight = np.where(silent, 0.0, self.weight)
        return replace(self, weight=weight, rows=self.rows & ~waiting)

    def counted(self, residual: FloatArray) -> FloatArray:
        """Returns 1/σ of each row as its residual lets it count. (m,)"""
        if self.huber is None:
            return self.weight
        far = np.maximum(np.abs(self.weight * residual) / self.huber, 1.0)
        return np.asarray(self.weight / np.sqrt(far))

    def cost(self, residual: FloatArray) -> float:
        """Returns the sum of the squared whitened residuals, or of Huber's cost."""
        white = self.weight * residual
        if self.huber is None:
            return float(white @ white)
        size = np.abs(white)
        return float(
            np.where(size <= self.huber, size**2, self.huber * (2.0 * size - self.huber)).sum()
        )


class Descent(NamedTuple):
    """Where an iteration ended.

    Attributes
    ----------
    x : (2N,) ndarray
    iterations : int
    converged : bool
    factor : Factor
        Of the equations there.
    """

    x: FloatArray
    iterations: int
    converged: bool
    factor: Factor


class Singular(ArithmeticError):
    """The rows do not determine the state.

    Parameters
    ----------
    x : (2N,) ndarray
        Where that was found.
    rows : (m,) ndarray of bool
        Available rows that have a tangent there.
    """

    def __init__(self, x: FloatArray, rows: BoolArray) -> None:
        super().__init__("the gain is singular")
        self.x, self.rows = x, rows


class _Step(NamedTuple):
    """A full step.

    Attributes
    ----------
    step : (n,) ndarray
    factor : Factor
        Of the equations that it solves.
    bent : bool
        Small currents had a say.
    """

    step: FloatArray
    factor: Factor
    bent: bool = False


class GaussNewton:
    """Steps for one sensor layout.

    Parameters
    ----------
    model : MeasurementModel
    tolerance : float
        Largest step of a converged state. [rad, p.u.]
    max_iterations : int
    """

    def __init__(self, model: MeasurementModel, tolerance: float, max_iterations: int) -> None:
        self.model, self.tolerance, self.max_iterations = model, tolerance, max_iterations
        self.currents = SmallCurrents(model) if (model.layout.quantity == IM).any() else None
        self.equations = NormalEquations(model)
        self._rounding = ROUNDING * model.gross
        # Derivatives of ∠I grow as I vanishes; all others are as large as the terms of h(x).
        least = np.where(model.layout.quantity == IA, 0.0, self._rounding)
        self._nothing = least[model.row_of_entry]
        self._angle_of_current = model.layout.quantity == IA
        self._stiff: set[bytes] = set()

    def descend(self, x: FloatArray, problem: Problem, held: Pins) -> Descent:
        """Iterate from a state.

        Parameters
        ----------
        x : (2N,) ndarray
            [θ; |V|]. [rad, p.u.]
        problem : Problem
        held : Pins
            States that the measurements leave where they are.

        Returns
        -------
        Descent

        Raises
        ------
        Singular
            If the measurements leave more states open.
        """
        model, bend = self.model, False
        tolerance = self.tolerance if problem.huber is None else COARSE
        residual = model.residual(problem.z, x)
        for iteration in range(1, self.max_iterations + 1):
            # A current that vanishes has no angle and no tangent: its rows wait.
            waiting = model.without_tangent(x)
            current = problem
            if waiting is not None:
                current = problem.without(waiting, waiting & self._angle_of_current)
            try:
                found = self._step(x, current, residual, held, bend)
            except Singular:
                # The rows determine the state; the way led where they do not.
                if iteration > 1:
                    return Descent(x, iteration, False, found.factor)
                raise
            largest = np.abs(found.step).max(initial=0.0)
            if largest < tolerance:
                return self._ended(x, current, residual, held, found, iteration)
            if not np.isfinite(largest) or (iteration > PATIENCE and largest > ASTRAY):
                break
            moved = self._moved(x, found.step, current, residual, _SHARES[:1])
            if moved is None:
                if not bend and self.currents is not None:
                    found = self._step(x, current, residual, held, True)
                moved = self._moved(x, found.step, current, residual, _SHARES)
            if moved is None:
                break
            bend = bend or iteration >= STRAIGHT
            x, residual = moved
        return Descent(x, iteration, False, found.factor)

    def _ended(
        self,
        x: FloatArray,
        problem: Problem,
        residual: FloatArray,
        held: Pins,
        found: _Step,
        iteration: int,
    ) -> Descent:
        """Returns the end of an iteration, with the factor of Gauss-Newton itself."""
        if found.bent:
            counted = problem.counted(residual)
            found = self._solved(x, counted, residual, problem, held)._replace(step=found.step)
        x = x.copy()
        x[self.model.columns] += found.step
        return Descent(x, iteration, True, found.factor)

    def _step(
        self, x: FloatArray, problem: Problem, residual: FloatArray, held: Pins, bend: bool
    ) -> _Step:
        """Returns the full step from a state, with the curvature of small currents."""
        counted, currents = problem.counted(residual), self.currents
        curved = (
            None if currents is None or not bend else currents.curved(counted, residual, problem.z)
        )
        if currents is not None and curved is not None:
            for rows in (curved, curved.convex):
                whitened = currents.jacobian_data(x) * rows.weight[currents.model.row_of_entry]
                factor = currents.equations.factorise(whitened, held, rows.sign)
                # As long as the gain stays positive definite, Newton's step leads down.
                if factor is not None:
                    return _Step(factor.step(whitened, rows.white), factor, True)
        return self._solved(x, counted, residual, problem, held)

    def _solved(
        self, x: FloatArray, weight: FloatArray, residual: FloatArray, problem: Problem, held: Pins
    ) -> _Step:
        """Returns the full step of Gauss-Newton from a state."""
        whitened = self._jacobian_data(x) * weight[self.model.row_of_entry]
        factor = self._factorised(x, whitened, problem.rows, held)
        return _Step(factor.step(whitened, weight * residual), factor)

    def jacobian(self, x: FloatArray) -> sparse.csr_array:
        """Returns ∂h/∂x of the layout's rows, zero where it is nothing but rounding. (m, n)"""
        return self.model.matrix(self._jacobian_data(x))

    def _jacobian_data(self, x: FloatArray) -> FloatArray:
        data = self.model.jacobian_data(x)
        data[np.abs(data) < self._nothing] = 0.0
        return data

    def _moved(
        self,
        x: FloatArray,
        step: FloatArray,
        problem: Problem,
        residual: FloatArray,
        shares: tuple[float, ...],
    ) -> tuple[FloatArray, FloatArray] | None:
        """Returns the state after a step, halved while it raises the cost, and its residual."""
        model, n = self.model, self.model.network.n_bus
        before = problem.cost(residual)
        for share in shares:
            moved = x.copy()
            moved[model.columns] += share * step
            if not moved[n:].min() > 0.0:
                continue
            found = model.residual(problem.z, moved)
            if problem.cost(found) <= before or self._as_good(problem, before, found):
                return moved, found
        return None

    def _as_good(self, problem: Problem, before: float, residual: FloatArray) -> bool:
        """Whether the cost of residuals is larger than before by no more than rounding."""
        floor = float(np.sum((problem.weight * self._rounding) ** 2))
        return bool(problem.cost(residual) <= before + floor + 2.0 * np.sqrt(floor * before))

    def _factorised(
        self, x: FloatArray, whitened: FloatArray, available: BoolArray, held: Pins
    ) -> Factor:
        """Returns the factorised gain or, where that is too stiff, the augmented equations."""
        key = available.tobytes()
        if key not in self._stiff:
            factor = self.equations.factorise(whitened, held)
            if factor is not None:
                return factor
            rows = self.model.matrix(whitened)[np.flatnonzero(available)]
            if open_states(with_held(rows, held.columns, np.ones(len(held.columns)))).any():
                raise Singular(x, available)
            if len(self._stiff) >= REMEMBERED:
                self._stiff.clear()
            self._stiff.add(key)
        try:
            return AugmentedFactor(self.model, whitened, held)
        except RuntimeError as error:
            raise Singular(x, available) from error
