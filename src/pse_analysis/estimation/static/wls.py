"""Weighted least squares on one snapshot: sparse Gauss-Newton in polar coordinates.

The rows are whitened (divided by σ) once per iteration, the gain is assembled on a pattern that is
known in advance, and one factorisation gives the step, and at the end the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.errors import Unobservable
from pse_analysis.grid.network import Network
from pse_analysis.measurement import (
    IA,
    IM,
    MeasurementModel,
    RectangularModel,
    SensorLayout,
)

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


COARSE = 1e-2
"""Largest step of a converged state whose rows are weighed by their residuals. [rad, p.u.]"""
ASSUMED = 1e-3
"""σ of the slack's angle where nothing ever told it. [rad]

It is taken for the reference then. A wide σ would be of no use to a filter that starts from it: its
powers are currents in the frame of the predicted voltage, which sees a turn of the whole grid.
"""


class Reference(NamedTuple):
    """What is known of the slack's angle beside the measurements. [rad]"""

    angle: float
    sigma: float


def state_columns(network: Network, layout: SensorLayout) -> npt.NDArray[np.int64]:
    """Columns of [θ; |V|] to be estimated.

    All of them where the layout measures an angle against an outside reference; otherwise all but
    the slack's angle, which is then the reference.
    """
    columns = np.arange(2 * network.n_bus)
    return columns if layout.has_angle else np.delete(columns, network.slack)


@dataclass(frozen=True, eq=False)
class WlsSolution:
    """A weighted least-squares estimate.

    Attributes
    ----------
    x : (2N,) ndarray
        [θ; |V|]. [rad; p.u.]
    residual : (m,) ndarray
        z - h(x); NaN where nothing was measured.
    objective : float
        Sum of the squared whitened residuals, χ² with m - n degrees of freedom.
    iterations : int
    converged : bool
    pinned : bool
        The measurements told no angle, so a `Reference` did.
    """

    x: FloatArray
    residual: FloatArray
    objective: float
    iterations: int
    converged: bool
    pinned: bool
    _gain: _Gain
    _columns: npt.NDArray[np.int64]

    def covariance(self) -> FloatArray:
        """Covariance of [θ; |V|], zero where a column is fixed. (2N, 2N)"""
        full = np.zeros((len(self.x), len(self.x)))
        full[np.ix_(self._columns, self._columns)] = self._gain.inverse()
        return full


class _Gain:
    """JᵀR⁻¹J, assembled on a known pattern in an order of little fill-in, and factorised."""

    def __init__(self, model: MeasurementModel) -> None:
        _, n = model.shape
        self._n = n
        count = np.diff(model.indptr)
        # All pairs of entries that share a row: each adds one product to the gain.
        self._left = np.repeat(np.arange(len(model.indices)), count[model.row_of_entry])
        first = model.indptr[model.row_of_entry]
        span = count[model.row_of_entry]
        offset = np.arange(span.sum()) - np.repeat(np.cumsum(span) - span, span)
        self._right = np.repeat(first, span) + offset
        self._order = np.arange(n)
        self._lay_out(model.indices.astype(np.int64))
        # The order depends on the pattern alone, so it is found once.
        pattern = np.where(self._indices == self._column, float(n), -0.5 / n)
        self._matrix.data = pattern
        self._order = np.argsort(self._superlu("MMD_AT_PLUS_A").perm_c)
        self._place_of = np.empty(n, dtype=np.int64)
        self._place_of[self._order] = np.arange(n)
        self._lay_out(self._place_of[model.indices])
        self.factor: sparse_linalg.SuperLU | None = None

    def _lay_out(self, column_of_entry: npt.NDArray[np.int64]) -> None:
        """Pattern of the gain, with every entry's row and column, and where each product goes."""
        n = self._n
        code = column_of_entry[self._right] * n + column_of_entry[self._left]
        places, self._place = np.unique(code, return_inverse=True)
        # States in no measurement keep a place on the diagonal, to be found there.
        own = np.arange(n) * (n + 1)
        every = np.union1d(places, own)
        self._place = np.searchsorted(every, places)[self._place]
        self._own = np.searchsorted(every, own)
        self._column, self._indices = every // n, (every % n).astype(np.int32)
        indptr = np.searchsorted(self._column, np.arange(n + 1)).astype(np.int32)
        self._matrix = sparse.csc_array((np.zeros(len(every)), self._indices, indptr), shape=(n, n))

    def _superlu(self, order: str) -> sparse_linalg.SuperLU:
        return sparse_linalg.splu(
            self._matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def factorise(self, whitened: FloatArray, pin: tuple[int, float] | None = None) -> None:
        """Factorise the gain of whitened Jacobian entries, and of what is known of one column.

        Raises
        ------
        Unobservable
            If the gain is numerically singular.
        """
        data = np.bincount(
            self._place,
            weights=whitened[self._left] * whitened[self._right],
            minlength=len(self._indices),
        )
        if pin is not None:
            column, weight = pin
            data[self._own[self._place_of[column]]] += weight
        diagonal = data[self._own]
        if not (diagonal > 0).all():
            raise Unobservable("a state is in no measurement")
        # Scaled to a unit diagonal, a pivot is the share of a state that the others leave open.
        self._scale = 1.0 / np.sqrt(diagonal)
        self._matrix.data = data * self._scale[self._indices] * self._scale[self._column]
        try:
            self.factor = self._superlu("NATURAL")
        except RuntimeError as error:
            raise Unobservable("the gain is exactly singular") from error
        if np.abs(self.factor.U.diagonal()).min() < 1e-13:
            raise Unobservable("the gain is singular to working precision")

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution for one or many right-hand sides, in the order of the model's columns."""
        assert self.factor is not None
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        solution = np.empty_like(right)
        solution[self._order] = scale * self.factor.solve(scale * right[self._order])
        return solution

    def inverse(self) -> FloatArray:
        """Covariance of the model's columns. (n, n)"""
        inverse = self.solve(np.eye(self._n))
        return 0.5 * (inverse + inverse.T)


class WeightedLeastSquares:
    """Static state estimation for one sensor layout.

    Parameters
    ----------
    network : Network
    layout : SensorLayout
    tolerance : float
        Largest step of a converged state. [rad, p.u.]
    max_iterations : int
    """

    def __init__(
        self,
        network: Network,
        layout: SensorLayout,
        *,
        tolerance: float = 1e-8,
        max_iterations: int = 25,
    ) -> None:
        self.network = network
        self.model = MeasurementModel(network, layout, state_columns(network, layout))
        self.tolerance = tolerance
        self.max_iterations = max_iterations
        self._gain = _Gain(self.model)
        # A current phasor has no tangent where the current vanishes, as it does at a flat start.
        self._current = np.isin(layout.quantity, (IM, IA))

    def flat_start(self) -> FloatArray:
        """[θ; |V|] with rated voltage and no angle but that of phase shifters. (2N,)"""
        return np.concatenate([self.network.resting_angle_rad, np.ones(self.network.n_bus)])

    def solve(
        self,
        z: FloatArray,
        sigma: FloatArray,
        available: BoolArray | None = None,
        *,
        start: FloatArray | None = None,
        huber: float | None = None,
        reference: Reference | None = None,
    ) -> WlsSolution:
        """Estimate the state.

        Parameters
        ----------
        z, sigma : (m,) ndarray
            Measurements and their σ; only available rows are read. [p.u., rad]
        available : (m,) ndarray of bool, optional
            Rows that carry a value; all of them by default.
        start : (2N,) ndarray, optional
            [θ; |V|] to start from; flat by default, or, where currents are measured, the solution
            of the linear form of the measurements.
        huber : float, optional
            Residual, in units of σ, beyond which the cost of a row grows with the residual instead
            of its square, so that no row pulls harder; to `COARSE`, and with the covariance of the
            weights at the end.
        reference : Reference, optional
            What stands for the angle reference if the layout has one and no angle is available; by
            default the slack's angle of the start.

        Returns
        -------
        WlsSolution
            ``converged`` is False if the iteration limit was reached or the state ran away.

        Raises
        ------
        Unobservable
            With the buses that the available measurements do not reach, and what would help.
        """
        m = self.model.shape[0]
        rows = np.ones(m, dtype=bool) if available is None else np.asarray(available, dtype=bool)
        weight = np.zeros(m)
        weight[rows] = 1.0 / sigma[rows]
        observed = np.where(rows, z, 0.0)
        x: FloatArray = self.flat_start() if start is None else start.copy()
        if start is None and (self._current & rows).any():
            x = self._linear_start(observed, sigma, rows)
        layout, slack = self.model.layout, self.network.slack
        silent = layout.has_angle and not (rows & layout.angular).any()
        if silent:
            reference = reference or Reference(x[slack], ASSUMED)
            x[: self.network.n_bus] += reference.angle - x[slack]
        else:
            reference = None
        try:
            x, iterations, converged = self._iterate(x, observed, weight, huber, reference)
        except Unobservable as error:
            raise Unobservable(self._explain(x, weight, str(error))) from error
        residual = self.model.residual(observed, x)
        return WlsSolution(
            x=x,
            residual=np.where(rows, residual, np.nan),
            objective=float(np.sum((weight * residual) ** 2)),
            iterations=iterations,
            converged=converged,
            pinned=silent,
            _gain=self._gain,
            _columns=self.model.columns,
        )

    def _linear_start(self, z: FloatArray, sigma: FloatArray, rows: BoolArray) -> FloatArray:
        """[θ; |V|] by linear least squares from rated voltage, which parts without data keep.

        A current has no tangent in polar coordinates where it vanishes, as it does at rated
        voltage; in rectangular ones its phasor is linear. Half a phasor is left out.
        """
        n = self.network.n_bus
        linear = RectangularModel(self.network, self.model.layout)
        resting = np.exp(1j * self.network.resting_angle_rad)
        H, target, spread = linear.rows(z, sigma, rows, resting)
        read = rows & (~self._current | linear.paired(rows))
        weight = np.where(read, 1.0 / np.where(read, spread, 1.0), 0.0)
        whitened = sparse.csr_array(sparse.diags_array(weight) @ H)
        rated = np.concatenate([resting.real, resting.imag])
        # A prior of σ = 1 p.u. makes the gain regular and moves what is measured next to nothing.
        gain = sparse.csc_array(whitened.T @ whitened + sparse.eye_array(2 * n))
        x = rated + sparse_linalg.splu(gain).solve(
            whitened.T @ (weight * np.where(read, target, 0.0) - whitened @ rated)
        )
        voltage = x[:n] + 1j * x[n:]
        if not (self.model.layout.angular & rows).any():
            voltage = voltage * np.exp(-1j * np.angle(voltage[self.network.slack]))
        if (np.abs(voltage) < 0.1).any():
            return self.flat_start()
        return np.concatenate([np.angle(voltage), np.abs(voltage)])

    def _iterate(
        self,
        x: FloatArray,
        z: FloatArray,
        weight: FloatArray,
        huber: float | None,
        reference: Reference | None,
    ) -> tuple[FloatArray, int, bool]:
        model, slack = self.model, self.network.slack
        # The measurements leave the slack's angle where it is: to pin it takes no pull.
        pin = None if reference is None else (slack, reference.sigma**-2)
        tolerance = self.tolerance if huber is None else COARSE
        counted = weight
        for iteration in range(1, self.max_iterations + 1):
            residual = model.residual(z, x)
            if huber is not None:
                far = np.maximum(np.abs(weight * residual) / huber, 1.0)
                counted = weight / np.sqrt(far)
            whitened = model.jacobian_data(x) * counted[model.row_of_entry]
            self._gain.factorise(whitened, pin)
            gradient = np.bincount(
                model.indices,
                weights=whitened * (counted * residual)[model.row_of_entry],
                minlength=model.shape[1],
            )
            step = self._gain.solve(gradient.astype(float, copy=False))
            x = x.copy()
            x[model.columns] += step
            largest = np.abs(step).max(initial=0.0)
            if largest < tolerance:
                return x, iteration, True
            if not np.isfinite(largest) or (x[self.network.n_bus :] <= 0).any():
                return x, iteration, False
        return x, self.max_iterations, False

    def _explain(self, x: FloatArray, weight: FloatArray, cause: str) -> str:
        """Which buses the measurements leave open, from the null space of the whitened Jacobian."""
        model, n = self.model, self.network.n_bus
        dense = model.jacobian(x).toarray() * weight[:, None]
        if model.layout.has_angle and not (model.layout.angular & (weight > 0)).any():
            dense = np.vstack([dense, np.eye(1, dense.shape[1], self.network.slack)])
        norm = np.linalg.norm(dense, axis=0)
        _, singular, vectors = np.linalg.svd(
            dense / np.where(norm > 0, norm, 1.0), full_matrices=True
        )
        rank = int((singular > 1e-10 * singular.max(initial=1e-300)).sum())
        null = vectors[rank:]
        touched = model.columns[np.flatnonzero(np.abs(null).max(axis=0, initial=0.0) > 1e-6)]
        angle = [self.network.buses.name[c] for c in touched if c < n]
        size = [self.network.buses.name[c - n] for c in touched if c >= n]
        parts = [
            f"{kind} of buses {', '.join(names[:8])}{', …' if len(names) > 8 else ''}"
            for kind, names in (("the angles", angle), ("the magnitudes", size))
            if names
        ]
        return (
            f"{self.network.name} is not observable ({cause}): "
            f"{int((weight > 0).sum())} measurements leave {model.shape[1] - rank} of "
            f"{model.shape[1]} states open, among them {' and '.join(parts) or 'no single bus'}: "
            "add a P and Q injection, a flow on a branch that ends there, or a voltage phasor"
        )
