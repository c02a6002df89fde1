"""Power-flow equations of a grid under a growing load, bordered so that the nose is regular.

The unknowns are y = [θ; |V|; σ; λ]: all angles and magnitudes, the imbalance σ that the grid's
distributed slack takes up, and the loading λ. The equations are

    P_i(x) - P_i0 - λ ΔP_i - σ α_i = 0                  at every bus,
    Q_i(x) - Q_i0 + λ ΔQ_load,i = 0                     at load buses,
    |V_i| - V_set,i = 0                                 at buses that hold their voltage,
    Q_i(x) - Q_lim,i + λ ΔQ_load,i = 0                  at buses that stand at a reactive limit,
    θ_ref = θ_ref0,                                     and one condition g(y) = 0 more,

which says where on the curve the state lies. With all 2N angles and magnitudes among the unknowns
the pattern never changes: a bus that gives up its voltage exchanges a row.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import GridError
from pse_analysis.grid.continuation.base import LOAD, LOWER, UPPER, VOLTAGE, BaseState, StatusArray
from pse_analysis.grid.continuation.loading import Direction
from pse_analysis.grid.network import Network
from pse_analysis.grid.newton import rounding_pu
from pse_analysis.measurement import BUS, MeasurementModel, P, Q, SensorLayout

Condition = Callable[[FloatArray], tuple[float, FloatArray]]
"""Function of y that gives g(y) and its gradient (2N + 2,); a located state has g(y) = 0."""

_CURVATURE_STEP = 1e-5
"""Step of the central difference of the analytic Jacobian along a null vector. [rad, p.u.]"""


class LoadedGrid:
    """A grid with the base state and loading vector that its curve starts from.

    Parameters
    ----------
    network : Network
        May be the base grid with a branch open; what that cuts off from the largest part of the
        grid counts as dead, and its injections are lost.
    base : BaseState
    direction : Direction

    Raises
    ------
    GridError
        If no bus of the largest part of the grid holds a voltage.
    """

    def __init__(self, network: Network, base: BaseState, direction: Direction) -> None:
        self.network, self.base = network, base
        n = self.n = network.n_bus
        self.alive, self.reference = _largest_part(network)
        buses = np.arange(n)
        self.model = MeasurementModel(
            network, SensorLayout.of(network, (P, buses, BUS), (Q, buses, BUS))
        )
        self.d_p = np.where(self.alive, direction.p_pu, 0.0)
        self.d_q = np.where(self.alive, -direction.q_load_pu, 0.0)
        share = np.where(self.alive, direction.share, 0.0)
        if not share.any():
            share[self.reference] = 1.0
        self.share = share / share.sum()
        self.status = np.where(self.alive, base.status, VOLTAGE).astype(np.int8)
        self.status[self.reference] = VOLTAGE
        # A reference, or a generator without any reactive range, never changes what it holds.
        self.controlled = self.alive & (base.status != LOAD) & (base.upper - base.lower > 1e-9)
        self.controlled[self.reference] = False
        self._compile()

    # ---------------------------------------------------------------------------- equations

    def residual(self, y: FloatArray, status: StatusArray) -> FloatArray:
        """Returns the residuals of the equations, without the condition. (2N + 1,) [p.u., rad]"""
        n, base = self.n, self.base
        theta, vm, sigma, loading = y[:n], y[n : 2 * n], y[2 * n], y[2 * n + 1]
        power = self.model.h(y[: 2 * n])
        p = power[:n] - base.p_pu - loading * self.d_p - sigma * self.share
        p[~self.alive] = (theta - base.theta)[~self.alive]
        q = power[n:] - self.q_given(status) - loading * self.d_q
        held = status == VOLTAGE
        q[held] = (vm - base.vm_set)[held]
        return np.concatenate([p, q, [theta[self.reference] - base.theta[self.reference]]])

    def q_given(self, status: StatusArray) -> FloatArray:
        """Returns the reactive injections that buses without voltage control have at λ = 0."""
        at_lower = np.where(status == LOWER, self.base.lower, self.base.q_pu)
        return np.where(status == UPPER, self.base.upper, at_lower)

    def _solved(self, y: FloatArray, residual: FloatArray, tolerance: float) -> bool:
        """Returns whether residuals are as small as asked for, or as rounding allows."""
        size = np.abs(residual)
        worst = float(size.max())
        if worst <= tolerance:
            return True
        if not worst <= 1e3 * tolerance:
            return False
        n = self.n
        rounding = rounding_pu(self.network, y[n : 2 * n])
        least = np.maximum(np.concatenate([rounding, rounding, [0.0]]), tolerance)
        return bool((size <= least).all())

    def q_margin(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns what is left to the upper and to the lower reactive limit. (N,), (N,) [p.u.]"""
        n = self.n
        generated = self.model.h(y[: 2 * n])[n:] - y[-1] * self.d_q
        return self.base.upper - generated, generated - self.base.lower

    def _compile(self) -> None:
        """Number the entries of the bordered matrix once."""
        n, model = self.n, self.model
        size = 2 * n + 2
        buses, every = np.arange(n), np.arange(2 * n)
        blocks = [  # rows and columns of: Jacobian, -α, -Δ, θ_ref, condition
            (model.row_of_entry, model.indices.astype(np.int64)),
            (buses, np.full(n, 2 * n)),
            (every, np.full(2 * n, 2 * n + 1)),
            (np.array([2 * n]), np.array([self.reference])),
            (np.full(size, 2 * n + 1), np.arange(size)),
        ]
        rows, cols = (np.concatenate([b[k] for b in blocks]) for k in (0, 1))
        self._order = np.lexsort((rows, cols))
        starts = np.searchsorted(cols[self._order], np.arange(size + 1))
        # One matrix whose entries are replaced: its pattern is checked once.
        self._matrix = sparse.csc_array(
            (np.zeros(len(rows)), rows[self._order], starts), shape=(size, size)
        )
        own = (model.indices == model.row_of_entry) & (model.row_of_entry < n)
        self._own_angle = np.flatnonzero(own)
        own = (model.indices == model.row_of_entry) & (model.row_of_entry >= n)
        self._own_size = np.flatnonzero(own)

    def jacobian_data(self, x: FloatArray, status: StatusArray) -> FloatArray:
        """Returns ∂(P, Q)/∂x with unit rows where a bus holds its voltage or is dead. (nnz,)"""
        unit = np.concatenate([~self.alive, status == VOLTAGE])
        data = np.where(unit[self.model.row_of_entry], 0.0, self.model.jacobian_data(x))
        data[self._own_angle[unit[: self.n]]] = 1.0
        data[self._own_size[unit[self.n :]]] = 1.0
        return data

    def factor(
        self, y: FloatArray, status: StatusArray, gradient: FloatArray
    ) -> sparse_linalg.SuperLU | None:
        """Returns the factorised matrix [∂F/∂y; ∂g/∂y], or None where it is singular.

        Parameters
        ----------
        y : (2N + 2,) ndarray
        status : (N,) ndarray of int
        gradient : (2N + 2,) ndarray
            Of the condition.
        """
        n = self.n
        unit_q = status == VOLTAGE
        d_q = np.where(unit_q, 0.0, self.d_q)
        data = np.concatenate(
            [
                self.jacobian_data(y[: 2 * n], status),
                -self.share,
                -self.d_p,
                -d_q,
                [1.0],
                gradient,
            ]
        )
        if not np.isfinite(data).all():
            return None
        self._matrix.data = data[self._order]
        try:
            return sparse_linalg.splu(self._matrix)
        except RuntimeError:  # exactly singular
            return None

    # ---------------------------------------------------------------------------- solutions

    def solve(
        self,
        y: FloatArray,
        status: StatusArray,
        condition: Condition,
        *,
        tolerance: float = 1e-10,
        max_iterations: int = 8,
        halvings: int = 0,
    ) -> FloatArray | None:
        """Newton's method for the equations and one condition.

        Parameters
        ----------
        y : (2N + 2,) ndarray
            To start from.
        status : (N,) ndarray of int
        condition : Condition
        tolerance : float
            Largest residual of a solved state, where rounding allows it.
        max_iterations : int
        halvings : int
            How often a step that raises the residual is halved.

        Returns
        -------
        (2N + 2,) ndarray or None
            None where it does not converge.
        """
        with np.errstate(all="ignore"):
            value, gradient = condition(y)
            residual = np.append(self.residual(y, status), value)
            for _ in range(max_iterations + 1):
                if not np.isfinite(residual).all():
                    return None
                met = abs(value) <= _condition_tolerance(y, gradient)
                if met and self._solved(y, residual[:-1], tolerance):
                    return y
                factor = self.factor(y, status, gradient)
                if factor is None:
                    return None
                step = factor.solve(residual)
                before = np.linalg.norm(residual)
                for halving in range(halvings + 1):
                    moved = y - 0.5**halving * step
                    value, gradient = condition(moved)
                    residual = np.append(self.residual(moved, status), value)
                    if np.linalg.norm(residual) <= before:
                        break
                y = moved
        return None

    def tangent(self, y: FloatArray, status: StatusArray, along: FloatArray) -> FloatArray | None:
        """Returns the direction of the curve whose product with ``along`` is 1. (2N + 2,)"""
        factor = self.factor(y, status, along)
        if factor is None:
            return None
        right = np.zeros(len(y))
        right[-1] = 1.0
        found = factor.solve(right)
        return np.asarray(found) if np.isfinite(found).all() else None

    def left_null(self, y: FloatArray, status: StatusArray, tangent: FloatArray) -> FloatArray:
        """Returns w with wᵀ ∂F/∂(x, σ) = 0 and wᵀ ∂F/∂λ = 1 at a saddle node. (2N + 1,)

        Parameters
        ----------
        y, status
            The saddle node.
        tangent : (2N + 2,) ndarray
            Of the curve there: the right null vector, with no part in λ.
        """
        factor = self.factor(y, status, tangent)
        if factor is None:
            raise GridError("the curve has no tangent at its nose: the loading is degenerate")
        right = np.zeros(len(y))
        right[-1] = 1.0
        return np.asarray(factor.solve(right, trans="T")[:-1])

    def nose_gradient(
        self, y: FloatArray, status: StatusArray, tangent: FloatArray, left: FloatArray
    ) -> FloatArray:
        """Returns the gradient of wᵀ J(y) r, which vanishes at a saddle node. (2N + 2,)

        The second derivative is a central difference of the analytic Jacobian along r.
        """
        n2 = 2 * self.n
        along = tangent[:n2]
        step = _CURVATURE_STEP / np.abs(along).max()
        after, before = (
            self.jacobian_data(y[:n2] + sign * step * along, status) for sign in (1.0, -1.0)
        )
        change = self.model.matrix((after - before) / (2.0 * step))
        return np.concatenate([left[:n2] @ change, [0.0, 0.0]])

    def base_derivative(self, adjoint: FloatArray, status: StatusArray) -> FloatArray:
        """Returns νᵀ ∂F/∂x0, the effect of the base state on the equations. (2N,)

        Parameters
        ----------
        adjoint : (2N + 1,) ndarray
            Weights ν of the equations.
        status : (N,) ndarray of int
        """
        n, base = self.n, self.base
        on_p = np.where(self.alive, adjoint[:n], 0.0)
        reads = (status == LOAD) | ((status == UPPER) & base.upper_is_base)
        reads |= (status == LOWER) & base.lower_is_base
        on_q = np.where(reads, adjoint[n : 2 * n], 0.0)
        out = -(np.concatenate([on_p, on_q]) @ base.jacobian)
        out[:n] -= np.where(self.alive, 0.0, adjoint[:n])
        held = (status == VOLTAGE) & base.vm_set_is_base
        out[n:] -= np.where(held, adjoint[n : 2 * n], 0.0)
        out[self.reference] -= adjoint[2 * n]
        return np.asarray(out)


def coordinate(index: int, target: float) -> Condition:
    """Returns the condition that one unknown has a value."""

    def condition(y: FloatArray) -> tuple[float, FloatArray]:
        gradient = np.zeros(len(y))
        gradient[index] = 1.0
        return float(y[index] - target), gradient

    return condition


def distance(origin: FloatArray, weighted: FloatArray, length: float) -> Condition:
    """Returns the condition that a state lies so far from another along a direction."""

    def condition(y: FloatArray) -> tuple[float, FloatArray]:
        return float(weighted @ (y - origin) - length), weighted

    return condition


def _condition_tolerance(y: FloatArray, gradient: FloatArray) -> float:
    """Returns what rounding leaves of a condition."""
    return float(1e-12 + 1e-14 * (np.abs(gradient) @ np.abs(y)))


def _largest_part(network: Network) -> tuple[BoolArray, int]:
    """Returns the buses of the largest part of a grid, and the bus that stands for its angle."""
    island = network.islands()
    labels, counts = np.unique(island, return_counts=True)
    # Of two parts of one size the one with the slack bus.
    own = labels == island[network.slack]
    label = labels[int(np.argmax(counts + 0.5 * own))]
    alive = island == label
    if label == island[network.slack]:
        return alive, network.slack
    reference = int(network.references[int(np.argmax(alive))])
    if network.buses.kind[reference] == 1:
        raise GridError(
            f"{network.name}: no bus of its largest part ({int(alive.sum())} buses) holds a "
            "voltage: nothing keeps it alive; close a branch to the slack bus"
        )
    return alive, reference
