"""Weighted least squares on one snapshot after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import ParameterError, Unobservable
from pse_analysis.estimation.core.interface import Estimator, Info, Snapshot, Voltages
from pse_analysis.estimation.static.chi_square import Residuals, contradiction
from pse_analysis.estimation.static.observability import named
from pse_analysis.estimation.static.plausibility import implausible
from pse_analysis.estimation.static.wls import Reference, WeightedLeastSquares, WlsSolution
from pse_analysis.grid.network import Network
from pse_analysis.measurement import SensorLayout
from pse_analysis.vocabulary import Status

NO_ANGLE = "no angle is measured: angles are against the slack's, which stays where it was last"
NO_REDUNDANCY = "no redundancy: nothing would tell a wrong measurement"


@dataclass(frozen=True)
class WlsParams:
    """Numbers of weighted least squares.

    Attributes
    ----------
    confidence : float
        Least share of the snapshots without gross errors that pass the χ² test and the test of the
        largest normalised residual.
    tolerance : float
        Largest step of a converged state. [rad, p.u.]
    max_iterations : int
        From each start.
    """

    confidence: float = 0.99
    tolerance: float = 1e-8
    max_iterations: int = 50

    def __post_init__(self) -> None:
        if not 0.5 <= self.confidence < 1.0:
            raise ParameterError(
                "least squares: confidence is the share of good snapshots that pass the tests: "
                f"expected 0.5 or more and less than 1, received {self.confidence}"
            )
        if not (0.0 < self.tolerance <= 1e-2 and self.max_iterations >= 1):
            raise ParameterError(
                "least squares: expected 0 < tolerance ≤ 0.01 and max_iterations ≥ 1, received "
                f"{self.tolerance} and {self.max_iterations}"
            )


@dataclass(frozen=True, eq=False)
class _WlsState:
    """An estimate, with what it starts the next one from."""

    x: FloatArray
    covariance: FloatArray
    open: BoolArray
    plausible: bool


def tracking_wls(
    name: str, network: Network, layout: SensorLayout, params: WlsParams | None = None
) -> Estimator:
    """Weighted least squares on every snapshot, started from the last estimate.

    Parameters
    ----------
    name : str
    network : Network
    layout : SensorLayout
    params : WlsParams, optional

    Returns
    -------
    Estimator
        Held samples take part, with the σ that age gave them; the previous estimate is no prior,
        but for reference angles while no angle is measured. Its status is that of the χ² test, and
        states that the measurements leave open are NaN.
    """
    params = params or WlsParams()
    wls = WeightedLeastSquares(
        network, layout, tolerance=params.tolerance, max_iterations=params.max_iterations
    )

    def solve(last: _WlsState | None, snapshot: Snapshot) -> tuple[_WlsState | None, Info]:
        m, given = len(layout), (snapshot.z, snapshot.sigma, snapshot.available)
        start, reference = None, None
        if last is not None:
            spread = np.sqrt(np.diagonal(last.covariance)[: network.n_bus])
            reference = Reference(last.x[: network.n_bus], np.nan_to_num(spread))
            start = last.x if last.plausible else None
        try:
            solution = wls.solve(*given, start=start, reference=reference, partial=True)
            if not solution.converged and start is not None:
                solution = wls.solve(*given, reference=reference, partial=True)
        except Unobservable as error:
            return None, Info.nothing(m, Status.UNOBSERVABLE, str(error))
        if not solution.converged:
            return None, Info.nothing(
                m, Status.NOT_CONVERGED, f"no convergence in {solution.iterations} iterations"
            )
        covariance = solution.covariance()
        strange = implausible(network, solution.x, solution.open)
        state = _WlsState(solution.x, covariance, solution.open, not strange)
        return state, _info_of(network, layout, params, solution, snapshot, strange, last)

    def init(snapshot: Snapshot) -> tuple[_WlsState | None, Info]:
        return solve(None, snapshot)

    def step(state: _WlsState, snapshot: Snapshot) -> tuple[_WlsState | None, Info]:
        return solve(state, snapshot)

    def read(state: _WlsState) -> Voltages:
        return Voltages(np.where(state.open, np.nan, state.x), state.covariance, state.open)

    return Estimator(name, init, step, read)


def _info_of(
    network: Network,
    layout: SensorLayout,
    params: WlsParams,
    solution: WlsSolution,
    snapshot: Snapshot,
    strange: str,
    last: _WlsState | None,
) -> Info:
    """Returns what an estimate says of itself: status, residuals, and what is wrong with it."""
    residuals = Residuals.of(
        solution.objective, solution.dof, solution.residual, snapshot.sigma, solution.explained()
    )
    used = np.isfinite(solution.residual)
    details, status = [], Status.OK
    if solution.open.any():
        status = Status.PARTLY_OBSERVABLE
        same = last is not None and np.array_equal(last.open, solution.open)
        details.append(
            f"{int(solution.open.sum())} states stay open"
            if same
            else f"open: {named(network.buses.name, np.flatnonzero(solution.open))}"
        )
    wrong = contradiction(residuals, layout.channel, params.confidence)
    if strange or wrong:
        status = Status.INCONSISTENT
        details += [part for part in (strange, wrong) if part]
    if solution.pinned:
        details.append(NO_ANGLE)
    if solution.dof == 0:
        details.append(NO_REDUNDANCY)
    return Info(
        status,
        solution.iterations,
        solution.objective,
        solution.dof,
        used,
        solution.residual,
        np.where(used, residuals.deviation, np.nan),
        np.zeros(len(layout)),
        "; ".join(details),
        tested=True,
    )
