"""How a snapshot is taken in: predict it, judge the innovation, condition, maybe again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.estimation.bad_data.identification import Deletion, of_snapshot
from pse_analysis.estimation.bad_data.robust import FORGETTING, GrossErrorTest, InnovationStats
from pse_analysis.estimation.core.interface import Info, Snapshot
from pse_analysis.estimation.filters.conditioning import Posterior, Predicted, Prior, misfit
from pse_analysis.estimation.filters.restart import ABSURD, gross_errors
from pse_analysis.measurement import MeasurementModel, wrap
from pse_analysis.vocabulary import Status

Observe = Callable[[Prior, Snapshot, IntArray, float, FloatArray], Predicted]
"""(prior, snapshot, rows, alpha, s) -> prediction of the rows, linearised at s where it matters."""

Remainder = Callable[[Prior, IntArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""(prior, rows, s of the expansion, s that it led to, σ of the rows) -> what was left out (r,)."""

TOLERANCE = 1e-6
"""Largest move of a voltage in the last pass of an iterated filter. [rad, p.u.]"""


class Observation(NamedTuple):
    """How the measurements are predicted.

    Attributes
    ----------
    predict : Observe
    alpha : float
        Memory at the start.
    passes : int
        How often the prediction is renewed at the estimate that it led to; 1: never.
    remainder : Remainder, optional
        What an expansion leaves out; None where nothing is expanded.
    """

    predict: Observe
    alpha: float = 0.0
    passes: int = 1
    remainder: Remainder | None = None


class UpdateReport(NamedTuple):
    """Report of how a snapshot was taken in.

    Attributes
    ----------
    iterations : int
    nis : float
        ηᵀS⁻¹η, or the objective of least squares.
    dof : int
        Its degrees of freedom.
    innovation, variance, inflation : (r,) ndarray
        Of the rows that report.
    misfit : float
        As in `Info`.
    """

    iterations: int
    nis: float
    dof: int
    innovation: FloatArray
    variance: FloatArray
    inflation: FloatArray
    misfit: float = np.nan

    def info(self, status: Status, snapshot: Snapshot, rows: IntArray, detail: str) -> Info:
        """The same for all rows of the layout."""
        m = len(snapshot.z)
        innovation, deviation, inflation = np.full(m, np.nan), np.full(m, np.nan), np.zeros(m)
        innovation[rows], deviation[rows] = self.innovation, np.sqrt(self.variance)
        inflation[rows] = self.inflation
        used = snapshot.available & snapshot.fresh
        return Info(
            status,
            self.iterations,
            self.nis,
            self.dof,
            used,
            innovation,
            deviation,
            inflation,
            detail,
            misfit=self.misfit,
        )


class Update(NamedTuple):
    """What a snapshot changed.

    Attributes
    ----------
    found : Posterior
    innovation : (r,) ndarray
        η of the last pass. [p.u., rad]
    alpha : float
        Memory of the observation.
    iterations : int
    converged : bool
    misfit : float
        As in `Info`.
    """

    found: Posterior
    innovation: FloatArray
    alpha: float
    iterations: int
    converged: bool
    misfit: float

    @property
    def report(self) -> UpdateReport:
        """The report of the update."""
        found, dof = self.found, len(self.innovation)
        return UpdateReport(
            self.iterations,
            found.nis,
            dof,
            self.innovation,
            found.variance,
            found.inflation,
            self.misfit,
        )


def update(
    model: MeasurementModel,
    observation: Observation,
    prior: Prior,
    snapshot: Snapshot,
    rows: IntArray,
    alpha: float,
    judge: GrossErrorTest,
    absurd: float = ABSURD,
) -> Update:
    """Condition a prior on some rows of a snapshot.

    Parameters
    ----------
    model : MeasurementModel
    observation : Observation
    prior : Prior
    snapshot : Snapshot
    rows : (r,) ndarray of int
        In any order; what is linear in the state is judged faster where it comes first.
    alpha : float
        Memory of the observation.
    judge : GrossErrorTest
    absurd : float
        See `gross_errors`.

    Returns
    -------
    Update

    Raises
    ------
    numpy.linalg.LinAlgError
        If the innovation's covariance is lost.
    """
    R = snapshot.sigma[rows] ** 2
    angular = model.angular[rows]
    at = prior.s
    converged = observation.passes == 1
    verdict = _Verdict(judge, absurd, partial(of_snapshot, model, prior.x, rows))
    for passes in range(1, observation.passes + 1):  # noqa: B007 (reported below)
        predicted = observation.predict(prior, snapshot, rows, alpha, at)
        eta = snapshot.z[rows] - predicted.mean
        eta[angular] = wrap(eta[angular])
        found = predicted.condition(prior, eta, R, verdict)
        last, at, alpha = at, found.s, predicted.alpha
        if np.abs(at - last).max() < TOLERANCE:
            converged = True
            break
    if observation.remainder is not None:
        # What the expansion leaves out is no noise, but the measurement is no surer than that.
        left = observation.remainder(prior, rows, last, at, snapshot.sigma[rows])
        if left.any():
            found = predicted.condition(prior, eta, R + left**2, verdict)
    return Update(found, eta, alpha, passes, converged, verdict.misfit)


class _Verdict:
    """A judgement that may ask the snapshot alone, of what is not wrong beyond any doubt.

    Parameters
    ----------
    judge : GrossErrorTest
    absurd : float
    alone : (innovation, noise, rows) -> Deletion

    Attributes
    ----------
    misfit : float
        Of the last judgement; NaN where it named any measurement.
    """

    def __init__(
        self, judge: GrossErrorTest, absurd: float, alone: Callable[..., Deletion]
    ) -> None:
        self._judge, self._absurd, self._alone = judge, absurd, alone
        self.misfit = np.nan

    def __call__(self, found: InnovationStats) -> FloatArray:
        """Inflation φ of the noise. (r,)"""
        phi = self._inflation(found)
        self.misfit = np.nan
        if not phi.any():
            self.misfit = misfit(found.root.chol, found.white, np.sqrt(found.noise))
        return phi

    def _inflation(self, found: InnovationStats) -> FloatArray:
        gross = gross_errors(found.innovation, found.variance, found.nis, self._absurd)
        if gross.any():
            return np.where(gross, FORGETTING * found.innovation**2 / found.noise, 0.0)
        alone = partial(self._alone, found.innovation, found.noise)
        return self._judge(replace(found, alone=alone))
