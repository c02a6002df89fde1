"""The ways out for a filter whose forecast is contradicted by the same channels again and again.

A forecast that is wrong is not worthless. First it is made as uncertain as the channels that
contradict it say, in the directions in which they contradict it, and as certain as before in all
others: where a snapshot has little redundancy of its own, the forecast still tells a wrong meter
from a right one. Only if that does not reconcile them the snapshot alone is asked.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.estimation.bad_data import robust
from pse_analysis.estimation.bad_data.identification import PRIOR_SIGMA_PU
from pse_analysis.estimation.bad_data.robust import GATE_SQ, Protection
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.conditioning import Prior
from pse_analysis.estimation.filters.linearised import linearised
from pse_analysis.estimation.filters.update import Update, UpdateReport, update
from pse_analysis.estimation.static.robust_wls import begin
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.measurement import MeasurementModel

PASSES = 3
"""Linearisations about what a widened forecast leads to."""


class Restart(NamedTuple):
    """An estimate to start again from.

    Attributes
    ----------
    x : (2N_bus,) ndarray
        [θ; |V|]. [rad, p.u.]
    P : (n, n) ndarray
        Covariance of its estimated entries.
    report : UpdateReport
    """

    x: FloatArray
    P: FloatArray
    report: UpdateReport


class Recovery:
    """The ways out for one sensor layout.

    Parameters
    ----------
    model : MeasurementModel
        Its columns are the voltages that are estimated.
    protection : Protection
    """

    def __init__(self, model: MeasurementModel, protection: Protection) -> None:
        self.model = model
        self.protection = protection
        self._observation = linearised(model, PASSES)

    @cached_property
    def _least_squares(self) -> WeightedLeastSquares:
        return WeightedLeastSquares(self.model.network, self.model.layout)

    def find(
        self,
        prior: Prior,
        snapshot: Snapshot,
        rows: IntArray,
        refused: Update,
        refusals: IntArray,
    ) -> tuple[Restart | None, str]:
        """Try the ways out in turn.

        Parameters
        ----------
        prior : Prior
            The forecast.
        snapshot : Snapshot
        rows : (r,) ndarray of int
            Channels that report.
        refused : Update
            What the filter made of them.
        refusals : (r,) ndarray of int
            How often in a row each of them was refused.

        Returns
        -------
        restart : Restart or None
            None where neither a wider forecast nor the snapshot alone clears half of the channels
            that are stuck: they are wrong for good.
        detail : str
            What was done, and why.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the widened forecast is not positive definite.
        """
        stuck = refusals >= self.protection.patience
        cause = self.protection.cause(refusals)
        wide = self.widened(prior, rows, refused, stuck)
        done = update(self.model, self._observation, wide, snapshot, rows, 0.0, robust.per_channel)
        found, n = done.found, prior.n
        if _reconciled(found.inflation > 0, stuck):
            restart = Restart(prior.filled(found.s), found.P[:n, :n], done.report)
            return restart, f"{cause}: the forecast was widened in their directions"
        alone, told = begin(self._least_squares, snapshot)
        if alone is None:
            return None, f"{cause}: a wider forecast does not clear them"
        left_out = told.findings[rows] > 0
        if not _reconciled(left_out, stuck):
            return None, f"{cause}: the snapshot alone refuses most of them as well"
        told_alone = UpdateReport(
            alone.iterations,
            alone.objective,
            max(int(told.used.sum()) - n, 0),
            refused.innovation,
            refused.found.variance,
            # As if each of them were off by no more than its noise.
            np.where(left_out, (alone.residual / snapshot.sigma)[rows] ** 2, 0.0),
        )
        covariance = alone.covariance()[np.ix_(prior.columns, prior.columns)]
        restart = Restart(alone.x, covariance, told_alone)
        return restart, f"{cause}: the filter starts again from this snapshot alone"

    def widened(self, prior: Prior, rows: IntArray, refused: Update, stuck: BoolArray) -> Prior:
        """A forecast that is as uncertain as the stuck channels say.

        Parameters
        ----------
        prior : Prior
        rows : (r,) ndarray of int
        refused : Update
        stuck : (r,) ndarray of bool

        Returns
        -------
        Prior

        Notes
        -----
        A channel with ∂h/∂x = hᵀ that is off by η would be so most likely by an error of the
        forecast along P h. P + Σ (P h)(P h)ᵀ η²/(hᵀP h)² expects each of them to be off by η at
        least, as long as no voltage is off by more than `PRIOR_SIGMA_PU`. Where ηᵀS⁻¹η is large and
        no         channel stands out, all of P is as much too small.
        """
        eta, found = refused.innovation, refused.found
        out = np.flatnonzero(stuck & (eta**2 > GATE_SQ * found.variance))
        H = self.model.jacobian(prior.x)[rows[out]]
        along = np.asarray(H @ prior.P[: prior.n])
        own = np.asarray(H.multiply(along[:, : prior.n]).sum(axis=1)).ravel()
        along *= np.divide(eta[out], own, out=np.zeros_like(own), where=own > 0)[:, None]
        # No voltage is off by more than its rating, whatever a broken meter reads.
        furthest = np.abs(along[:, : prior.n]).max(axis=1, initial=0.0)
        along /= np.maximum(furthest / PRIOR_SIGMA_PU, 1.0)[:, None]
        scale = max(1.0, found.nis / len(rows))
        return replace(prior, P=scale * prior.P + along.T @ along, carried=None)


def _reconciled(refused: BoolArray, stuck: BoolArray) -> bool:
    """Whether at most half of the stuck channels are still refused."""
    return bool(2 * np.count_nonzero(refused & stuck) <= np.count_nonzero(stuck))
