"""The recursion that the unscented and the extended filter share.

Predict with an affine process, predict the measurements in whichever way (`Observe`), judge the
innovation, condition. What is composed: process × observation × noise × robustness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.estimation.bad_data import robust
from pse_analysis.estimation.bad_data.robust import GrossErrorTest, Protection
from pse_analysis.estimation.core.interface import (
    Dynamics,
    Estimator,
    Info,
    Snapshot,
    Transition,
    Voltages,
)
from pse_analysis.estimation.filters.angle_reference import AngleReference, Frame, absolute
from pse_analysis.estimation.filters.conditioning import Prior
from pse_analysis.estimation.filters.protection import Recovery
from pse_analysis.estimation.filters.restart import ABSURD
from pse_analysis.estimation.filters.square_root import carried
from pse_analysis.estimation.filters.update import Observation, Update, update
from pse_analysis.estimation.process.dynamics import Process
from pse_analysis.estimation.process.sage_husa import Learnt, Noise
from pse_analysis.estimation.static.start import Start
from pse_analysis.estimation.static.wls import WlsSolution
from pse_analysis.measurement import VA, VM, MeasurementModel, wrap
from pse_analysis.vocabulary import Status


@dataclass(frozen=True)
class Robustness:
    """How gross errors are met.

    Attributes
    ----------
    judge : GrossErrorTest
    protection : Protection, optional
        Against latching; None to go without.
    absurd : float
        See `pse_analysis.estimation.filters.restart.gross_errors`.
    """

    judge: GrossErrorTest = robust.none
    protection: Protection | None = None
    absurd: float = ABSURD


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
    alpha : float
        Memory of the observation.
    refusals : (m,) ndarray of int
        Consecutive refusals of each channel.
    snapshot_rejections : int
        Consecutive snapshots that were refused as a whole.
    chol_P : (N, N) ndarray, optional
        Root of P, where it is carried beside it.
    frame : Frame, optional
        What its angles count from, where the reference of measured angles moves.
    """

    s: FloatArray
    P: FloatArray
    x: FloatArray
    process: Any
    noise: Any
    alpha: float
    refusals: IntArray
    snapshot_rejections: int = 0
    chol_P: FloatArray | None = None
    frame: Frame | None = None


class _Moved(NamedTuple):
    """F s + g, F P Fᵀ, what the parts of a filter remember, and the snapshot in the frame."""

    affine: FloatArray
    covariance: FloatArray
    process: Any
    noise: Any
    frame: Frame | None
    snapshot: Snapshot


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
    reference : AngleReference, optional
        How the reference of measured angles moves; it stands still if not given.
    """

    def __init__(
        self,
        model: MeasurementModel,
        process: Process,
        observation: Observation,
        noise: Noise,
        robustness: Robustness | None = None,
        reference: AngleReference | None = None,
    ) -> None:
        self.model = model
        self.process = process
        self.observation = observation
        self.noise = noise
        self.robustness = robustness or Robustness()
        self.reference = reference
        # Voltages come first: what is linear in the state needs no inverse to be judged.
        voltage = np.isin(model.layout.quantity, (VM, VA))
        self._order = np.concatenate([np.flatnonzero(voltage), np.flatnonzero(~voltage)])
        protection = self.robustness.protection
        self._recovery = None if protection is None else Recovery(model, protection)

    def begin(
        self, x: FloatArray, P: FloatArray, time: np.datetime64, *, measured: bool = True
    ) -> GaussianState:
        """State from an estimate of [θ; |V|] (2N,) with covariance P (n, n) of the columns.

        Whether its angles were ``measured`` tells what the reference of them is known to be.
        """
        s, covariance, memory = self.process.begin(
            x[self.model.columns], P, self.noise.voltages(x, time)
        )
        return GaussianState(
            s,
            covariance,
            x,
            memory,
            self.noise.begin(x, time),
            self.observation.alpha,
            np.zeros(self.model.shape[0], dtype=np.int64),
            frame=None if self.reference is None else self.reference.begin(measured=measured),
        )

    def step(self, state: GaussianState, snapshot: Snapshot) -> tuple[GaussianState | None, Info]:
        """Carry the state to a snapshot; None, and status ``diverged``, if S is lost."""
        m = self.model.shape[0]
        prior, moved = self._moved(state, snapshot)
        snapshot = moved.snapshot
        used = snapshot.available & snapshot.fresh
        if not used.any():
            ahead = replace(
                state,
                s=prior.s,
                P=prior.P,
                x=prior.x,
                process=moved.process,
                noise=self.noise.wait(moved.noise),
                chol_P=prior.carried,
            )
            ahead = replace(ahead, frame=moved.frame)
            return ahead, Info.nothing(m, Status.PREDICTED)
        rows = self._order[used[self._order]]
        judge, status, detail = self.robustness.judge, Status.OK, ""
        if (
            self._recovery is not None
            and state.snapshot_rejections >= self._recovery.protection.patience - 1
        ):
            judge = robust.per_channel
            detail = "snapshots were refused as a whole before: each channel is judged by itself"
        try:
            done = update(
                self.model,
                self.observation,
                prior,
                snapshot,
                rows,
                state.alpha,
                judge,
                self.robustness.absurd,
            )
            refusals, snapshot_rejections = self._refused(state, done, rows, judge)
            if self._recovery is not None and self._recovery.protection.latched(refusals, used):
                restart, detail = self._recovery.find(prior, snapshot, rows, done, refusals[rows])
                if restart is not None:
                    again = self.begin(restart.x, restart.P, snapshot.time)
                    # What was learnt about the noise is kept.
                    again = replace(
                        again,
                        noise=state.noise,
                        alpha=done.alpha,
                        snapshot_rejections=snapshot_rejections,
                        frame=moved.frame,
                    )
                    return again, restart.report.info(Status.RESTARTED, snapshot, rows, detail)
                # Wrong meters stay wrong whatever the forecast says; ask again after a while.
                refusals[:] = 0
        except np.linalg.LinAlgError as error:
            return None, Info.nothing(
                m, Status.DIVERGED, f"{error}: the filter starts again from least squares"
            )
        if not done.converged:
            status = Status.NOT_CONVERGED
            detail = f"still moving after {done.iterations} passes; more noise would slow it less"
        found = done.found
        learnt = Learnt(found.s - moved.affine, found.s - prior.s, found.P, moved.covariance)
        after = GaussianState(
            found.s,
            found.P,
            prior.filled(found.s),
            moved.process,
            self.noise.learn(moved.noise, learnt),
            done.alpha,
            refusals,
            snapshot_rejections,
            found.chol_P,
            moved.frame,
        )
        return after, done.report.info(status, snapshot, rows, detail)

    def _moved(self, state: GaussianState, snapshot: Snapshot) -> tuple[Prior, _Moved]:
        """The state at the instant of a snapshot before its measurements."""
        s, forecast, process = self.process.forecast(state.s, state.P, state.process)
        columns = self.model.columns
        ahead = state.x.copy()
        ahead[columns] = s[: len(columns)]
        drift, covariance, noise = self.noise.current(state.noise, ahead, snapshot.time)
        affine, s = s, s + drift
        x = state.x.copy()
        x[columns] = s[: len(columns)]
        frame = state.frame
        if self.reference is not None and frame is not None:
            snapshot, frame, covariance = self._followed(
                self.reference, frame, snapshot, x, forecast, covariance
            )
        root = state.chol_P
        if root is not None:
            root = carried(_through(self.process.transition, root), covariance)
        moved = _Moved(affine, forecast, process, noise, frame, snapshot)
        return Prior(s, forecast + covariance, x, columns, root), moved

    def _followed(
        self,
        reference: AngleReference,
        frame: Frame,
        snapshot: Snapshot,
        x: FloatArray,
        forecast: FloatArray,
        noise: FloatArray,
    ) -> tuple[Snapshot, Frame, FloatArray]:
        """The snapshot in the filter's frame, that frame, and Q with what it may have moved."""
        n = self.model.network.n_bus

        def covariance(bus: IntArray) -> FloatArray:
            # Where angles are measured all of them are estimated, and they come first.
            inside = np.ix_(bus, bus)
            return np.asarray(forecast[inside] + noise[inside])

        found = reference.follow(frame, snapshot, x[:n], covariance)
        noise = noise.copy()
        noise[:n, :n] += found.variance
        return found.snapshot, found.frame, noise

    def predict(self, state: GaussianState, snapshot: Snapshot) -> Transition:
        """How the state moves to the instant of a snapshot, before that is read."""
        prior, _ = self._moved(state, snapshot)
        return Transition(prior.s, prior.P, _through(self.process.transition, state.P).T)

    def difference(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """s₁ - s₂, angles taken by their shorter way."""
        out = one - other
        angles = np.flatnonzero(self.model.columns < self.model.network.n_bus)
        out[angles] = wrap(out[angles])
        return np.asarray(out)

    def estimate(self, state: GaussianState, s: FloatArray, P: FloatArray) -> Voltages:
        """[θ; |V|] of a mean and covariance of this filter's state."""
        columns = self.model.columns
        x = state.x.copy()
        x[columns] = s[: len(columns)]
        covariance = np.zeros((len(x), len(x)))
        covariance[np.ix_(columns, columns)] = P[: len(columns), : len(columns)]
        return absolute(x, covariance, state.frame)

    def _refused(
        self, state: GaussianState, done: Update, rows: IntArray, judge: GrossErrorTest
    ) -> tuple[IntArray, int]:
        """How often in a row each channel, and snapshots as a whole, were refused."""
        found = done.found
        open_gate = found.nis > robust.gate(len(rows))[0]
        if judge is robust.trace:
            refused = done.innovation**2 > robust.GATE_SQ * found.variance
        else:
            # What contradicts and was believed all the same was not understood either.
            refused = (found.inflation > 0) | open_gate
        # A meter that did not report stays as often refused as it was.
        refusals = state.refusals.copy()
        refusals[rows] = np.where(refused, state.refusals[rows] + 1, 0)
        snapshot_rejections = self.robustness.judge is robust.trace and (
            open_gate or found.inflation.any()
        )
        return refusals, state.snapshot_rejections + 1 if snapshot_rejections else 0


def _through(transition: FloatArray, root: FloatArray) -> FloatArray:
    """F L, with F = transition ⊗ I."""
    if transition.size == 1:
        return float(transition[0, 0]) * root
    blocks = root.reshape(len(transition), -1, root.shape[1])
    return np.asarray(np.einsum("ij,jnk->ink", transition, blocks).reshape(root.shape))


def estimator(name: str, made: GaussianFilter, start: Start) -> Estimator:
    """Estimator that starts a filter and steps it on.

    Parameters
    ----------
    name : str
        Of the method.
    made : GaussianFilter
    start : Start

    Returns
    -------
    Estimator
        It uses every sample once, with the σ that its age gave it.
    """
    inside = np.ix_(made.model.columns, made.model.columns)

    def begun(
        found: tuple[WlsSolution | None, Info], time: np.datetime64
    ) -> tuple[GaussianState | None, Info]:
        solution, info = found
        if solution is None:
            return None, info
        P = solution.covariance()[inside]
        return made.begin(solution.x, P, time, measured=not solution.pinned), info

    def read(state: GaussianState) -> Voltages:
        return made.estimate(state, state.s, state.P)

    def with_covariance(state: GaussianState, P: FloatArray) -> GaussianState:
        return replace(state, P=P, chol_P=None)

    dynamics = Dynamics(
        lambda state: (state.s, state.P), made.predict, made.estimate, made.difference
    )
    return Estimator(
        name,
        lambda snapshot: begun(start.first(snapshot), snapshot.time),
        made.step,
        read,
        with_covariance,
        dynamics,
        lambda snapshot: begun(start.alone(snapshot), snapshot.time),
    )
