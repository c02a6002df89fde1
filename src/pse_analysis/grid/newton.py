"""Newton's method for power flow: many states at once, with steps that never raise the mismatch."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import NotConverged
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, MeasurementModel, P, Q, SensorLayout

_ROUNDING = 8 * np.finfo(float).eps
"""Mismatch that rounding may leave, in units of the sum of |V_i Y_ij V_j| over j."""
_HALVINGS = 10
"""How often a step that raises the mismatch is halved."""
_BLOCK = 64
"""States solved in one block-diagonal factorisation; more gain nothing and cost memory."""


def rounding_pu(network: Network, vm: FloatArray) -> FloatArray:
    """Returns how large the error of each bus's power may be by rounding alone. [p.u.]

    It is a sum of terms V_i Y_ij V_j, each of which carries an error in its last digit.

    Parameters
    ----------
    network : Network
    vm : (n_bus, n_state) ndarray
        [p.u.]
    """
    return np.asarray(_ROUNDING * vm * (abs(network.y_bus) @ vm))


class NewtonPowerFlow:
    """Newton's method for the states that share one set of voltage-controlled buses.

    Parameters
    ----------
    network : Network
    held : (n_bus,) ndarray of bool
        Buses whose voltage is given, beside the references.
    tolerance : float
        Largest mismatch of a solved state, where rounding allows it. [p.u.]
    """

    def __init__(
        self,
        network: Network,
        held: BoolArray,
        tolerance: float,
    ) -> None:
        n = network.n_bus
        self.network, self.tolerance = network, tolerance
        reference = np.zeros(n, dtype=bool)
        reference[network.references] = True
        self.angle = np.flatnonzero(~reference)
        self.size = np.flatnonzero(~reference & ~held)
        self.given = np.flatnonzero(reference | held)
        self.references = np.flatnonzero(reference)
        self.model = MeasurementModel(
            network,
            SensorLayout.of(network, (P, self.angle, BUS), (Q, self.size, BUS)),
            columns=np.concatenate([self.angle, n + self.size]),
        )
        gross = abs(network.y_bus).sum(axis=1)
        self._gross = np.concatenate([gross[self.angle], gross[self.size]])

    def solve(
        self,
        p: FloatArray,
        q: FloatArray,
        vm_set: FloatArray,
        x: FloatArray,
        max_iterations: int,
    ) -> tuple[FloatArray, int, IntArray, FloatArray]:
        """Solve several states.

        Parameters
        ----------
        p, q, vm_set : (n_bus, n_state) ndarray
            Net injections, and the voltages of references and held buses. [p.u.]
        x : (2 n_bus, n_state) ndarray
            [θ; |V|] to start from. [rad, p.u.]
        max_iterations : int

        Returns
        -------
        x : (2 n_bus, n_state) ndarray
        iterations : int
        failed : (k,) ndarray of int
            States that are not solved.
        mismatch : (m, k) ndarray
            Of these. [p.u.]
        """
        target = np.concatenate([p[self.angle], q[self.size]])
        x = x.copy()
        x[self.network.n_bus + self.given] = vm_set[self.given]
        x[self.references] = 0.0
        active = np.arange(x.shape[1])
        with np.errstate(all="ignore"):  # a diverging state ends in NotConverged, not in warnings
            mismatch = self.model.h(x) - target
            for iteration in range(max_iterations + 1):
                open_ = self._open(x[:, active], mismatch)
                active, mismatch = active[open_], mismatch[:, open_]
                if not len(active) or iteration == max_iterations:
                    break
                step = np.concatenate(
                    [
                        _block_solve(
                            self.model, x[:, active[k : k + _BLOCK]], mismatch[:, k : k + _BLOCK]
                        )
                        for k in range(0, len(active), _BLOCK)
                    ],
                    axis=1,
                )
                x[:, active], mismatch = self._moved(
                    x[:, active], step, target[:, active], mismatch
                )
                if not np.isfinite(mismatch).any():
                    break
        return x, iteration, active, mismatch

    def _open(self, x: FloatArray, mismatch: FloatArray) -> BoolArray:
        """Returns which states are not solved as well as asked for, and as rounding allows."""
        size = np.abs(mismatch)
        worst = size.max(axis=0, initial=0.0)
        open_ = ~(worst <= self.tolerance)
        near = open_ & (worst < 1e3 * _ROUNDING * self._gross.max(initial=0.0))
        if near.any():
            rounding = rounding_pu(self.network, x[self.network.n_bus :, near])
            own = np.concatenate([rounding[self.angle], rounding[self.size]])
            open_[near] = (size[:, near] > np.maximum(own, self.tolerance)).any(axis=0)
        return np.asarray(open_)

    def _moved(
        self, x: FloatArray, step: FloatArray, target: FloatArray, mismatch: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns states after a step that is halved where it raises the mismatch, and theirs.

        Mismatches are measured in units of the power that goes in and out of their buses, so that
        the rounding of the largest does not outweigh the others.
        """
        columns = self.model.columns

        def size_of(mismatch: FloatArray) -> FloatArray:
            return np.asarray(np.sum((mismatch / self._gross[:, None]) ** 2, axis=0))

        before = size_of(mismatch) + len(mismatch) * _ROUNDING**2
        moved = x.copy()
        moved[columns] -= step
        found = self.model.h(moved) - target
        share = np.ones(x.shape[1])
        for _ in range(_HALVINGS):
            worse = ~(size_of(found) <= before)
            if not worse.any():
                break
            share[worse] *= 0.5
            moved[np.ix_(columns, worse)] = (
                x[np.ix_(columns, worse)] - share[worse] * step[:, worse]
            )
            found[:, worse] = self.model.h(moved[:, worse]) - target[:, worse]
        return moved, found

    def complaint(
        self, mismatch: FloatArray, failed: IntArray, count: int, iterations: int
    ) -> NotConverged:
        """Returns the error that tells of the worst mismatch of the states that failed."""
        size = np.where(np.isfinite(mismatch), np.abs(mismatch), np.inf)
        row, column = np.unravel_index(int(np.argmax(size)), size.shape)
        kind = "P" if row < len(self.angle) else "Q"
        bus = np.concatenate([self.angle, self.size])[row]
        return NotConverged(
            f"power flow of {self.network.name} did not converge in {iterations} iterations: "
            f"{len(failed)} of {count} states are open, worst mismatch of {kind} "
            f"{size[row, column]:.3g} p.u. at bus {self.network.buses.name[bus]!r} "
            f"(state {failed[column]}): lower the load or start closer to the solution"
        )


def _block_solve(model: MeasurementModel, x: FloatArray, mismatch: FloatArray) -> FloatArray:
    """Newton steps of several states by one factorisation of their block-diagonal Jacobian.

    They are NaN where the Jacobian is singular or not finite.
    """
    data = model.jacobian_data(x)
    m, count = model.shape[0], x.shape[1]
    good = np.isfinite(data).all(axis=0)
    if not good.all():
        step = np.full(mismatch.shape, np.nan)
        if good.any():
            step[:, good] = _block_solve(model, x[:, good], mismatch[:, good])
        return step
    nnz = data.shape[0]
    # The CSR pattern read as CSC is the transpose, which SuperLU solves just as well.
    indices = (model.indices[None, :] + m * np.arange(count)[:, None]).ravel()
    indptr = (model.indptr[None, :-1] + nnz * np.arange(count)[:, None]).ravel()
    transposed = sparse.csc_array(
        (data.T.ravel(), indices, np.append(indptr, nnz * count)), shape=(m * count, m * count)
    )
    try:
        factor = sparse_linalg.splu(transposed)
    except RuntimeError:  # exactly singular
        if count == 1:
            return np.full(mismatch.shape, np.nan)
        parts = [_block_solve(model, x[:, [k]], mismatch[:, [k]]) for k in range(count)]
        return np.concatenate(parts, axis=1)
    return np.asarray(factor.solve(mismatch.T.ravel(), trans="T").reshape(count, m).T)
