"""Where a filter of a grid starts: from a snapshot, and from what was usual where that is poor."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import Unobservable
from pse_analysis.estimation.core.interface import Info, Snapshot
from pse_analysis.estimation.static.robust_wls import begin
from pse_analysis.estimation.static.start_prior import StartPrior
from pse_analysis.estimation.static.wls import WeightedLeastSquares, WlsSolution
from pse_analysis.grid.network import Network
from pse_analysis.measurement import SensorLayout

MINOR = 0.1
"""Share of a variance of the prior up to which that of a snapshot alone makes the prior idle."""
MOST_LEFT_OUT = 0.25
"""Share of the measurements that may contradict a start from the prior."""


class Start:
    """Starts the filters of one grid and sensor layout.

    Parameters
    ----------
    network : Network
    layout : SensorLayout
    prior : StartPrior, optional
        What was usual before; without it a snapshot must tell the whole state.
    """

    def __init__(
        self, network: Network, layout: SensorLayout, prior: StartPrior | None = None
    ) -> None:
        self.network, self.layout, self.prior = network, layout, prior
        self._wls = WeightedLeastSquares(network, layout)

    def alone(self, snapshot: Snapshot) -> tuple[WlsSolution | None, Info]:
        """Starts from a snapshot alone; None, and why, where it has no estimate (see `begin`)."""
        return begin(self._wls, snapshot)

    def first(self, snapshot: Snapshot) -> tuple[WlsSolution | None, Info]:
        """Starts from a snapshot, and from the prior where that leaves states nearly open."""
        found, info = self.alone(snapshot)
        if self._beside is None or not snapshot.available.any():
            return found, info
        if found is not None and not self._vague(found):
            return found, info
        whole, told = begin(self._beside, self._with_prior(snapshot))
        m = len(self.layout)
        given = snapshot.available
        wrong = np.count_nonzero(given & ~told.used[:m])
        if whole is None or wrong > MOST_LEFT_OUT * np.count_nonzero(given):
            # What contradicts the usual as a whole is told by a later snapshot.
            return found, info
        assert told.reasons is not None
        return whole, replace(
            told,
            used=told.used[:m],
            innovation=told.innovation[:m],
            sigma_innovation=told.sigma_innovation[:m],
            inflation=told.inflation[:m],
            reasons=told.reasons[:m],
            detail="usual injections stand beside the measurements" if not wrong else told.detail,
        )

    @cached_property
    def _beside(self) -> WeightedLeastSquares | None:
        """Least squares with the prior's rows after those of the layout."""
        if self.prior is None:
            return None
        return WeightedLeastSquares(self.network, self.layout.joined(self.prior.layout))

    def _with_prior(self, snapshot: Snapshot) -> Snapshot:
        assert self.prior is not None
        usual, spread = self.prior.beside(self.layout, snapshot)
        zero, every = np.zeros(len(usual)), np.ones(len(usual), dtype=bool)
        return replace(
            snapshot,
            z=np.concatenate([snapshot.z, usual]),
            sigma=np.concatenate([snapshot.sigma, spread]),
            sigma_age=np.concatenate([snapshot.sigma_age, zero]),
            available=np.concatenate([snapshot.available, every]),
            fresh=np.concatenate([snapshot.fresh, every]),
            age_s=np.concatenate([snapshot.age_s, zero]),
        )

    def _vague(self, found: WlsSolution) -> bool:
        """Whether the prior would tell anything that matters beside a snapshot's own estimate."""
        usual = self._usual_variance
        if usual is None:
            return False
        variance, n = np.diagonal(found.covariance()), self.network.n_bus
        known = variance <= MINOR * usual
        # The angle that an island shares is no matter of loads.
        common = variance[:n][self.network.references]
        known[:n] |= variance[:n] <= common + MINOR * usual[:n]
        return not known.all()

    @cached_property
    def _usual_variance(self) -> FloatArray | None:
        """Variances of [θ; |V|] by the prior alone; None where it has no estimate. (2N,)"""
        assert self.prior is not None
        assert self._beside is not None
        rows = np.zeros(len(self.layout) + len(self.prior.z), dtype=bool)
        rows[len(self.layout) :] = True
        z, sigma = np.zeros(len(rows)), np.ones(len(rows))
        z[rows], sigma[rows] = self.prior.z, self.prior.sigma
        try:
            found = self._beside.solve(z, sigma, rows)
        except Unobservable:
            return None
        return np.asarray(np.diagonal(found.covariance())) if found.converged else None
