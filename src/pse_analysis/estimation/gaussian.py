"""The recursion that the unscented and the extended filter share.

Predict with an affine process, predict the measurements in whichever way (`Observe`), judge the
innovation, condition. What is composed: process × observation × noise × robustness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pse_analysis.estimation import robust
from pse_analysis.estimation.conditioning import Posterior, Predicted, Prior
from pse_analysis.estimation.estimator import Estimator, Info, Snapshot, Voltages
from pse_analysis.estimation.holt import Process
from pse_analysis.estimation.noise import Learnt, Noise
from pse_analysis.estimation.robust import Judge, Protection, Suspicion
from pse_analysis.estimation.square_root import carried
from pse_analysis.estimation.start import begin
from pse_analysis.estimation.wls import WeightedLeastSquares, WlsSolution
from pse_analysis.grid.network import Network
from pse_analysis.measurement import MeasurementModel, SensorLayout, wrap
from pse_analysis.vocabulary import Status

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


Observe = Callable[[Prior, Snapshot, IntArray, float, FloatArray], Predicted]
"""(prior, snapshot, rows, tuned, s) -> prediction of the rows, linearised at s where it matters."""


class Observation(NamedTuple):
    """How the measurements are predicted.

    Attributes
    ----------
    predict : Observe
    tuned : float
        Memory at the start.
    passes : int
        How often the prediction is renewed at the estimate that it led to; 1: never.
    """

    predict: Observe
    tuned: float = 0.0
    passes: int = 1


@dataclass(frozen=True)
class Robustness:
    """How gross errors are met.

    Attributes
    ----------
    judge : Judge
    protection : Protection, optional
        Against latching; None to go without.
    """

    judge: Judge = robust.none
    protection: Protection | None = None


@dataclass(frozen=True, eq=False)
class GaussianState:
    """State of a filter between two instants.

    Attributes
    ----------
    s : (N,) ndarray
        Estimated entries of [θ; |V|], and their slopes if the process has any. [rad, p.u.]
    P : (N, N) ndarray
        Its covariance.
    x : (2N_bus,) ndarray
        [θ; |V|].
    process, noise : object
        Memories of these parts.
    tuned : float
        Memory of the observation.
    refusals : (m,) ndarray of int
        Consecutive refusals of each channel.
    chol_P : (N, N) ndarray, optional
        Root of P, where it is carried beside it.
    """

    s: FloatArray
    P: FloatArray
    x: FloatArray
    process: Any
    noise: Any
    tuned: float
    refusals: IntArray
    chol_P: FloatArray | None = None


class _Update(NamedTuple):
    found: Posterior
    innovation: FloatArray
    tuned: float
    iterations: int
    converged: bool


TOLERANCE = 1e-6
"""Largest move of a voltage in the last pass of an iterated filter. [rad, p.u.]"""


class GaussianFilter:
    """A filter for one sensor layout.

    Parameters
    ----------
    model : MeasurementModel
        Its columns are the voltages to be estimated.
    process : Process
    observation : Observation
    noise : Noise
    robustness : Robustness
    """

    def __init__(
        self,
        model: MeasurementModel,
        process: Process,
        observation: Observation,
        noise: Noise,
        robustness: Robustness | None = None,
    ) -> None:
        self.model = model
        self.process = process
        self.observation = observation
        self.noise = noise
        self.robustness = robustness or Robustness()

    def begin(self, x: FloatArray, P: FloatArray, time: np.datetime64) -> GaussianState:
        """State from an estimate of [θ; |V|] (2N,) with covariance P (n, n) of the columns."""
        s, covariance, memory = self.process.begin(
            x[self.model.columns], P, self.noise.voltages(x, time)
        )
        return GaussianState(
            s,
            covariance,
            x,
            memory,
            self.noise.begin(x, time),
            self.observation.tuned,
            np.zeros(self.model.shape[0], dtype=np.int64),
        )

    def step(self, state: GaussianState, snapshot: Snapshot) -> tuple[GaussianState | None, Info]:
        """Carry the state to a snapshot; None, and status ``diverged``, if S is lost."""
        m = self.model.shape[0]
        s, forecast, process = self.process.forecast(state.s, state.P, state.process)
        columns = self.model.columns
        ahead = state.x.copy()
        ahead[columns] = s[: len(columns)]
        drift, covariance, noise = self.noise.current(state.noise, ahead, snapshot.time)
        affine = s
        s = s + drift
        x = state.x.copy()
        x[columns] = s[: len(columns)]
        root = state.chol_P
        if root is not None:
            root = carried(_through(self.process.transition, root), covariance)
        prior = Prior(s, forecast + covariance, x, columns, root)
        used = snapshot.available & snapshot.fresh
        if not used.any():
            return replace(state, s=s, P=prior.P, x=x, process=process, chol_P=root), Info.nothing(
                m, Status.PREDICTED
            )
        rows = np.flatnonzero(used)
        try:
            update = self._update(prior, snapshot, rows, state.tuned, self.robustness.judge)
            refusals = np.zeros(m, dtype=np.int64)
            # What contradicts and was believed all the same was not understood either.
            refused = (update.found.inflation > 0) | (update.found.nis > robust.gate(len(rows))[0])
            refusals[rows] = np.where(refused, state.refusals[rows] + 1, 0)
            status, detail = Status.OK, ""
            protection = self.robustness.protection
            if protection is not None and protection.latched(refusals, used):
                cause = protection.cause(refusals[rows])
                alone, told = begin(self._alone, snapshot)
                if alone is None:
                    update, refusals, status, detail = self._widen(
                        prior, snapshot, rows, state.tuned, update, refusals, protection
                    )
                elif 2 * np.count_nonzero(told.findings[rows]) <= np.count_nonzero(refused):
                    return self._restarted(state, snapshot, rows, update, alone, told, cause)
                else:
                    # Wrong meters stay wrong whatever the forecast says; ask again after a while.
                    refusals[:] = 0
                    detail = "the snapshot alone refuses most of them as well"
                detail = f"{cause}: {detail}"
        except np.linalg.LinAlgError as error:
            return None, Info.nothing(
                m, Status.DIVERGED, f"{error}: the filter starts again from least squares"
            )
        if not update.converged:
            status = Status.NOT_CONVERGED
            detail = f"still moving after {update.iterations} passes; more noise would slow it less"
        found = update.found
        learnt = Learnt(found.s - affine, found.s - s, found.P, forecast)
        after = GaussianState(
            found.s,
            found.P,
            prior.filled(found.s),
            process,
            self.noise.learn(noise, learnt),
            update.tuned,
            refusals,
            found.chol_P,
        )
        full = np.full((2, m), np.nan)
        inflation = np.zeros(m)
        full[0, rows], full[1, rows] = update.innovation, np.sqrt(found.variance)
        inflation[rows] = found.inflation
        return after, Info(
            status,
            update.iterations,
            found.nis,
            len(rows),
            used,
            full[0],
            full[1],
            inflation,
            detail,
        )

    def _update(
        self, prior: Prior, snapshot: Snapshot, rows: IntArray, tuned: float, judge: Judge
    ) -> _Update:
        R = snapshot.sigma[rows] ** 2
        angular = self.model.angular[rows]
        at = prior.s
        converged = False
        verdict = None
        if judge is not robust.none:
            verdict = partial(_with_slopes, judge, lambda: self.model.jacobian(prior.x)[rows])
        for passes in range(1, self.observation.passes + 1):  # noqa: B007 (reported below)
            predicted = self.observation.predict(prior, snapshot, rows, tuned, at)
            eta = snapshot.z[rows] - predicted.mean
            eta[angular] = wrap(eta[angular])
            found = predicted.condition(prior, eta, R, verdict)
            moved = np.abs(found.s - at).max()
            at, tuned = found.s, predicted.tuned
            if moved < TOLERANCE:
                converged = True
                break
        return _Update(found, eta, tuned, passes, converged or self.observation.passes == 1)

    @cached_property
    def _alone(self) -> WeightedLeastSquares:
        return WeightedLeastSquares(self.model.network, self.model.layout)

    def _restarted(
        self,
        state: GaussianState,
        snapshot: Snapshot,
        rows: IntArray,
        update: _Update,
        alone: WlsSolution,
        told: Info,
        cause: str,
    ) -> tuple[GaussianState, Info]:
        """Start again from the snapshot alone; what was learnt about the noise is kept."""
        columns = self.model.columns
        again = self.begin(alone.x, alone.covariance()[np.ix_(columns, columns)], snapshot.time)
        left_out = told.findings.astype(bool)
        m = len(left_out)
        innovation, deviation = np.full(m, np.nan), np.full(m, np.nan)
        innovation[rows], deviation[rows] = update.innovation, np.sqrt(update.found.variance)
        refusals = self._refused_again(rows, m)
        kept = int(told.used.sum())
        info = Info(
            Status.RESTARTED,
            alone.iterations,
            alone.objective,
            max(kept - len(columns), 0),
            snapshot.available & snapshot.fresh,
            innovation,
            deviation,
            # As if each of them were off by no more than its noise.
            np.where(left_out, (alone.residual / snapshot.sigma) ** 2, 0.0),
            f"{cause}: the filter starts again from this snapshot alone",
        )
        return replace(again, noise=state.noise, tuned=update.tuned, refusals=refusals), info

    def _refused_again(self, rows: IntArray, m: int) -> IntArray:
        """Refusals after a way out: a judge of whole snapshots is not given many more to lose."""
        refusals = np.zeros(m, dtype=np.int64)
        protection = self.robustness.protection
        if protection is not None and self.robustness.judge is not robust.per_channel:
            refusals[rows] = protection.patience - 1
        return refusals

    def _widen(
        self,
        prior: Prior,
        snapshot: Snapshot,
        rows: IntArray,
        tuned: float,
        update: _Update,
        refusals: IntArray,
        protection: Protection,
    ) -> tuple[_Update, IntArray, Status, str]:
        """Widen the forecast where a snapshot alone is not enough, and judge by channel.

        Kept if it clears half of the refused channels.
        """
        P = prior.P.copy()
        voltages = np.arange(prior.n)
        P[voltages, voltages] += protection.widening(refusals[rows])
        widened = self._update(
            replace(prior, P=P, carried=None), snapshot, rows, tuned, robust.per_channel
        )
        if 2 * np.count_nonzero(widened.found.inflation) > np.count_nonzero(update.found.inflation):
            return update, refusals, Status.OK, "a wider forecast does not clear them"
        again = self._refused_again(rows, len(refusals))
        return widened, again, Status.RESTARTED, "the forecast was widened, which cleared most"


def _through(transition: FloatArray, root: FloatArray) -> FloatArray:
    """F L, with F = transition ⊗ I."""
    if transition.size == 1:
        return float(transition[0, 0]) * root
    blocks = root.reshape(len(transition), -1, root.shape[1])
    return np.asarray(np.einsum("ij,jnk->ink", transition, blocks).reshape(root.shape))


def _with_slopes(
    judge: Judge, slopes: Callable[[], sparse.csr_array], found: Suspicion
) -> FloatArray:
    return judge(replace(found, slopes=slopes))


def estimator(name: str, network: Network, layout: SensorLayout, made: GaussianFilter) -> Estimator:
    """Estimator that starts a filter from weighted least squares.

    Parameters
    ----------
    name : str
        Of the method.
    network : Network
    layout : SensorLayout
    made : GaussianFilter

    Returns
    -------
    Estimator
        It uses every sample once, with the σ that its age gave it.
    """
    wls = WeightedLeastSquares(network, layout)
    columns = made.model.columns
    inside = np.ix_(columns, columns)

    def init(snapshot: Snapshot) -> tuple[GaussianState | None, Info]:
        solution, info = begin(wls, snapshot)
        if solution is None:
            return None, info
        return made.begin(solution.x, solution.covariance()[inside], snapshot.time), info

    def read(state: GaussianState) -> Voltages:
        covariance = np.zeros((len(state.x), len(state.x)))
        covariance[inside] = state.P[: len(columns), : len(columns)]
        return Voltages(state.x, covariance)

    return Estimator(name, init, made.step, read)
