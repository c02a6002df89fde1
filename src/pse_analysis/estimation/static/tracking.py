"""Weighted least squares on one snapshot after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pse_analysis.errors import Unobservable
from pse_analysis.estimation.core.interface import Estimator, Info, Snapshot, Voltages
from pse_analysis.estimation.static.wls import Reference, WeightedLeastSquares
from pse_analysis.grid.network import Network
from pse_analysis.measurement import SensorLayout
from pse_analysis.vocabulary import Status

FloatArray = npt.NDArray[np.float64]

NO_ANGLE = "no angle is measured: angles are against the slack's, which stays where it was last"


@dataclass(frozen=True, eq=False)
class _WlsState:
    x: FloatArray
    covariance: FloatArray


def tracking_wls(
    name: str,
    network: Network,
    layout: SensorLayout,
    *,
    tolerance: float = 1e-8,
    max_iterations: int = 25,
) -> Estimator:
    """Weighted least squares on every snapshot, started from the last estimate.

    Parameters
    ----------
    name : str
    network : Network
    layout : SensorLayout
    tolerance : float
        Largest step of a converged state. [rad, p.u.]
    max_iterations : int

    Returns
    -------
    Estimator
        Held samples take part, with the σ that age gave them; the previous estimate is no prior,
        but for the slack's angle while no angle is measured.
    """
    wls = WeightedLeastSquares(network, layout, tolerance=tolerance, max_iterations=max_iterations)
    model = wls.model

    def solve(last: _WlsState | None, snapshot: Snapshot) -> tuple[_WlsState | None, Info]:
        m, given = len(layout), (snapshot.z, snapshot.sigma, snapshot.available)
        start, reference = None, None
        if last is not None:
            start = last.x
            spread = np.sqrt(last.covariance[network.slack, network.slack])
            reference = Reference(start[network.slack], spread) if spread > 0 else None
        try:
            solution = wls.solve(*given, start=start, reference=reference)
            if not solution.converged and start is not None:
                solution = wls.solve(*given, reference=reference)
        except Unobservable as error:
            return None, Info.nothing(m, Status.UNOBSERVABLE, str(error))
        if not solution.converged:
            reached = f"in {solution.iterations} iterations"
            if solution.iterations < wls.max_iterations:
                reached = f"{reached}: the state ran away, some measurements are grossly wrong"
            return None, Info.nothing(m, Status.NOT_CONVERGED, f"no convergence {reached}")
        covariance = solution.covariance()
        J = model.jacobian(solution.x)
        columns = np.ix_(model.columns, model.columns)
        explained = np.asarray((J @ covariance[columns] * J.toarray()).sum(axis=1))
        used = snapshot.available
        left = np.maximum(snapshot.sigma**2 - explained, (1e-3 * snapshot.sigma) ** 2)
        info = Info(
            Status.OK,
            solution.iterations,
            solution.objective,
            max(int(used.sum()) + int(solution.pinned) - model.shape[1], 0),
            used,
            solution.residual,
            np.where(used, np.sqrt(left), np.nan),
            np.zeros(m),
            NO_ANGLE if solution.pinned else "",
        )
        return _WlsState(solution.x, covariance), info

    def init(snapshot: Snapshot) -> tuple[_WlsState | None, Info]:
        return solve(None, snapshot)

    def step(state: _WlsState, snapshot: Snapshot) -> tuple[_WlsState | None, Info]:
        return solve(state, snapshot)

    def read(state: _WlsState) -> Voltages:
        return Voltages(state.x, state.covariance)

    return Estimator(name, init, step, read)
