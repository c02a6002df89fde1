"""A traced curve: its points, its nose, states located on it, and how they move with the base."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import NotConverged
from pse_analysis.grid.continuation.base import LOWER, UPPER, VOLTAGE, StatusArray
from pse_analysis.grid.continuation.equations import (
    Condition,
    LoadedGrid,
    coordinate,
    distance,
)


class EndKind(enum.StrEnum):
    """How a grid's load reaches its limit."""

    SADDLE_NODE = "saddle_node"
    LIMIT_INDUCED = "limit_induced"


@dataclass(frozen=True, eq=False)
class Located:
    """A state on a curve that a condition singles out.

    Attributes
    ----------
    grid : LoadedGrid
    y : (2N + 2,) ndarray
    status : (N,) ndarray of int
    gradient : (2N + 2,) ndarray
        Of the condition by y.
    base_gradient : (2N,) ndarray
        Of the condition by the base state, at fixed y.
    """

    grid: LoadedGrid
    y: FloatArray
    status: StatusArray
    gradient: FloatArray
    base_gradient: FloatArray

    @property
    def loading(self) -> float:
        """λ of the state."""
        return float(self.y[-1])

    def with_base_gradient(self, base_gradient: FloatArray) -> Located:
        """The same state, with what its condition owes to the base state."""
        return replace(self, base_gradient=base_gradient)

    def sensitivity(self, output: FloatArray) -> FloatArray:
        """Returns how a quantity of the located state moves with the base state. (2N,)

        Parameters
        ----------
        output : (2N + 2,) ndarray
            Gradient of the quantity by y.

        Returns
        -------
        (2N,) ndarray
            Total derivative by [θ; |V|] of the base state, by one adjoint solution.
        """
        factor = self.grid.factor(self.y, self.status, self.gradient)
        if factor is None:
            raise NotConverged(
                f"{self.grid.network.name}: a limit has no sensitivity at λ = {self.loading:g}, "
                "where the condition that defines it is degenerate: estimate σ by sampling"
            )
        adjoint = factor.solve(output, trans="T")
        return np.asarray(
            -self.grid.base_derivative(adjoint[:-1], self.status) - adjoint[-1] * self.base_gradient
        )


@dataclass(frozen=True, eq=False)
class Curve:
    """States of a grid along a loading direction, through the nose and a little past it.

    Attributes
    ----------
    grid : LoadedGrid
    y : (2N + 2, n_points) ndarray
        [θ; |V|; σ; λ] of each point.
    slope : (n_points,) ndarray
        dλ/ds in the direction of travel: positive before the nose, negative past it.
    status : (n_points, N) ndarray of int
        What each bus holds from this point to the next.
    event : tuple of str
        What happened at each point, such as ``bus 8 at its upper reactive limit``; "" for nothing.
    nose : int
        The point of the largest λ.
    end : EndKind
    nose_bus : int
        Bus whose reactive limit ends a limit-induced curve; -1 on others.
    nose_tangent : (2N + 2,) ndarray
        Of the branch that arrives at the nose.
    tolerance : float
    """

    grid: LoadedGrid
    y: FloatArray
    slope: FloatArray
    status: StatusArray
    event: tuple[str, ...]
    nose: int
    end: EndKind
    nose_bus: int
    nose_tangent: FloatArray
    tolerance: float

    @property
    def loading(self) -> FloatArray:
        """λ of each point. (n_points,)"""
        return np.asarray(self.y[-1])

    @property
    def theta(self) -> FloatArray:
        """Voltage angles. (N, n_points) [rad]"""
        return self.y[: self.grid.n]

    @property
    def vm(self) -> FloatArray:
        """Voltage magnitudes. (N, n_points) [p.u.]"""
        return self.y[self.grid.n : 2 * self.grid.n]

    @property
    def x(self) -> FloatArray:
        """States [θ; |V|]. (2N, n_points)"""
        return self.y[: 2 * self.grid.n]

    @property
    def limit(self) -> float:
        """Largest λ."""
        return float(self.y[-1, self.nose])

    @property
    def stable(self) -> BoolArray:
        """Points from the start to the nose. (n_points,)"""
        return np.arange(self.y.shape[1]) <= self.nose

    def jacobian(self, point: int) -> FloatArray:
        """Returns the Jacobian of the power flow at a point, by θ, |V| and σ. (2N + 1, 2N + 1)

        Its least singular value tends to zero at a saddle node.
        """
        grid, n2 = self.grid, 2 * self.grid.n
        status = self.status[max(point - 1, 0)] if point == self.nose else self.status[point]
        data = grid.jacobian_data(self.y[:n2, point], status)
        out = np.zeros((n2 + 1, n2 + 1))
        out[:n2, :n2] = grid.model.matrix(data).toarray()
        out[: grid.n, n2] = -grid.share
        out[n2, grid.reference] = 1.0
        return out

    def located(self, condition: Condition, segment: int, fraction: float) -> Located | None:
        """Returns the state in one segment of the curve that meets a condition.

        Parameters
        ----------
        condition : Condition
        segment : int
            Between this point and the next.
        fraction : float
            Guess of where in it.

        Returns
        -------
        Located or None
            Without the condition's own dependence on the base state; None where Newton's method
            finds no such state.
        """
        start = self.y[:, segment] + fraction * (self.y[:, segment + 1] - self.y[:, segment])
        status = self.status[segment]
        y = self.grid.solve(start, status, condition, tolerance=self.tolerance, halvings=4)
        if y is None:
            return None
        return Located(self.grid, y, status, condition(y)[1], np.zeros(2 * self.grid.n))

    def between(self, segment: int, fraction: float) -> Located | None:
        """Returns the state at a share of the way from a point to the next one."""
        start, end = self.y[:, segment], self.y[:, segment + 1]
        chord = end - start
        chord[2 * self.grid.n :] = 0.0
        size = float(np.linalg.norm(chord))
        if size == 0.0:
            return None
        return self.located(distance(start, chord / size, fraction * size), segment, fraction)

    def at(self, loading: float) -> Located | None:
        """Returns the state before the nose at a loading; None beyond what was traced."""
        before = self.y[-1, : self.nose + 1]
        if not before[0] <= loading <= before[-1]:
            return None
        segment = int(np.clip(np.searchsorted(before, loading) - 1, 0, max(self.nose - 1, 0)))
        width = before[segment + 1] - before[segment]
        fraction = (loading - before[segment]) / width if width > 0 else 0.0
        return self.located(coordinate(len(self.y) - 1, loading), segment, fraction)

    def at_nose(self) -> Located:
        """Returns the nose with the condition that defines it.

        At a saddle node that is wᵀ J r = 0 with the null vectors w and r of the Jacobian; at a
        limit-induced end a bus stands at its reactive limit and its voltage set-point at once.
        """
        grid, y = self.grid, self.y[:, self.nose]
        status = self.status[max(self.nose - 1, 0)].copy()
        base_gradient = np.zeros(2 * grid.n)
        if self.end == EndKind.SADDLE_NODE:
            left = grid.left_null(y, status, self.nose_tangent)
            gradient = grid.nose_gradient(y, status, self.nose_tangent, left)
        else:
            # The bus that ends it stands at its limit on one side of the nose.
            if self.status[self.nose, self.nose_bus] in (UPPER, LOWER):
                status = self.status[self.nose].copy()
            gradient = np.zeros(len(y))
            gradient[grid.n + self.nose_bus] = 1.0
            if grid.base.vm_set_is_base[self.nose_bus]:
                base_gradient[grid.n + self.nose_bus] = -1.0
        return Located(grid, y, status, gradient, base_gradient)


def switching(grid: LoadedGrid, bus: int, status: int) -> str:
    """Returns the sentence that tells of a bus that takes up or gives up voltage control."""
    name = grid.network.buses.name[bus]
    if status == VOLTAGE:
        return f"bus {name} holds its voltage again"
    return f"bus {name} at its {'upper' if status == UPPER else 'lower'} reactive limit"
