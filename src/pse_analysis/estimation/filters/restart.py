"""What any filter of a grid does when its forecast and a snapshot exclude each other.

A filter cannot tell by itself that it is lost: its covariance shrinks whatever it is told. Two
things show from outside. A voltage that no grid has, such as a mirrored or a vanished one, is no
estimate; and a snapshot that is off by thousands of σ as a whole is no noise. Then the snapshot is
asked alone, and if it has no answer either, the forecast stands until one has.

A snapshot that contradicts the forecast less than that is taken in, for a filter that names no
wrong meter can do nothing else. But it makes the estimate no surer, and all that it has changed,
x̂ - x̂⁻, may be the error of a meter: P⁻ + (x̂ - x̂⁻)(x̂ - x̂⁻)ᵀ stands in the place of P, and the
status says so. So σ holds whoever was wrong, and what later snapshots say about that direction is
believed. Without that a filter whose process hardly moves in some direction keeps a wrong value
there for hours, with the σ of what it had known before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.interface import FAILURES, Estimate, Estimator, Info, Snapshot
from pse_analysis.measurement import VM, SensorLayout
from pse_analysis.parameters import Unbounded
from pse_analysis.vocabulary import Status

FAR = 30.0
"""Deviation, in units of its σ, from which a measurement is off by more than noise and load."""
MOST = 0.25
"""Share of the measurements of a snapshot up to which they are wrong rather than the forecast."""
NAMED = 0.1
"""Share of the measurements that a filter may have named while the others contradict its forecast.

Beyond it, it has not found what is wrong.
"""
ABSURD = 1e6
"""ηᵀS⁻¹η per measurement from which those that are far off are left out whatever filter it is."""
LOOSE = 0.1
"""σ of a voltage from which a forecast tells less than a snapshot does. [p.u., rad]"""
JUMP = 0.3
"""Distance over which no power is linear in the voltages. [p.u., rad]

A filter that corrects more than that in one step takes what its expansion leaves out for certain.
"""
WIDER = 3.0
"""Factor on all σ of a forecast that too many snapshots have contradicted."""
CERTAIN = 1.0 - 1e-6
"""Share of good snapshots that contradict the forecast less than a doubtful one."""
PASSES = 0.99
"""Share of good snapshots that end the suspicion which a doubtful one has raised."""
AGREE = 0.1
"""Distance up to which a meter confirms a voltage that is out of its bounds. [p.u.]

A meter that reads less confirms nothing: a dead one says the same.
"""
NEITHER = "nothing of the snapshot is believed, nor does it tell a state by itself"


class Contradiction(np.linalg.LinAlgError):
    """A forecast and a snapshot exclude each other."""


@dataclass(frozen=True)
class RestartParams:
    """When a filter of a grid starts again.

    Attributes
    ----------
    lowest, highest : float
        Bounds of |V|. An estimate beyond them that no meter confirms is none. [p.u.]
    patience : int
        Snapshots in a row that may contradict the forecast before it is believed no longer.
    doubt : float
        ηᵀS⁻¹η per measurement from which a snapshot that was taken in contradicts the forecast, so
        that what it changed is doubtful; inf for filters that are to believe whatever they take in.
    lone : float
        The same for a single measurement: its innovation or its residual, in units of their σ.
    """

    lowest: float = 0.3
    highest: float = 2.0
    patience: int = 3
    doubt: Unbounded = 2.0
    lone: Unbounded = 6.0

    def __post_init__(self) -> None:
        if not (0 < self.lowest < 1 < self.highest < np.inf) or self.patience < 1:
            raise ParameterError(
                "restart: expected 0 < lowest < 1 < highest and patience ≥ 1, received "
                f"{self.lowest}, {self.highest} and {self.patience}"
            )
        if not (self.doubt > 1.0 and self.lone > 1.0):
            raise ParameterError(
                f"restart: expected doubt > 1 and lone > 1, received {self.doubt} and {self.lone}"
            )

    def contradiction(self, info: Info) -> str:
        """How a snapshot that was taken in contradicts the forecast, in words; "" if it does not.

        The number of measurements is as uncertain a measure as it is small: the χ² bound that
        `CERTAIN` of good snapshots pass must be left as well.
        """
        if info.dof == 0 or not np.isfinite(info.nis):
            return ""
        ratio = info.nis / info.dof
        if ratio > self.doubt and info.nis > special.chdtri(info.dof, 1.0 - CERTAIN):
            return f"NIS is {ratio:.3g} per measurement"
        believed = info.used & (info.inflation == 0)
        off = np.abs(info.innovation[believed]) / info.sigma_innovation[believed]
        largest = float(np.nanmax(off, initial=0.0))
        if largest > self.lone:
            return f"a measurement is {largest:.3g} σ off its forecast"
        if info.misfit > self.lone:
            return f"a measurement is {info.misfit:.3g} σ off the estimate"
        return ""


def gross_errors(
    eta: FloatArray, variance: FloatArray, nis: float, absurd: float = ABSURD
) -> BoolArray:
    """Which measurements are wrong beyond any doubt, before anything is believed.

    Parameters
    ----------
    eta, variance : (m,) ndarray
        Innovation, and its S_ii.
    nis : float
        ηᵀS⁻¹η.
    absurd : float
        ηᵀS⁻¹η per measurement from which those that are far off are left out; whatever comes is
        believed where it is infinite.

    Returns
    -------
    (m,) ndarray of bool
        None, unless the snapshot as a whole is absurd.

    Raises
    ------
    Contradiction
        If many of them are far off: then it is the forecast that is wrong, or all of them.
    """
    m = len(eta)
    if nis <= FAR**2 or absurd == np.inf:
        # None can be off by more.
        return np.zeros(m, dtype=bool)
    far = eta**2 > FAR**2 * variance
    if not np.isfinite(nis) or np.count_nonzero(far) > MOST * m:
        raise Contradiction(
            f"the snapshot and the forecast exclude each other: {np.count_nonzero(far)} of {m} "
            f"measurements are off by more than {FAR:g} σ"
        )
    return np.asarray(far & (nis > absurd * m))


class Guarded(NamedTuple):
    """State of a filter that may start again.

    Attributes
    ----------
    inner : object
        State of the filter.
    skipped : int
        Snapshots in a row that were passed over.
    strange : int
        Snapshots in a row that were taken in although they contradict the forecast.
    loose : bool
        Instants without a measurement have left the state more uncertain than `LOOSE`.
    suspect : bool
        A snapshot was doubtful, and none has passed the χ² test of `PASSES` since.
    undoubted : Guarded, optional
        The same before the last snapshot was found doubtful, for who knows the later ones.
    """

    inner: Any
    skipped: int = 0
    strange: int = 0
    loose: bool = False
    suspect: bool = False
    undoubted: Guarded | None = None


class Guard:
    """A filter of a grid that never calls an impossible state an estimate.

    Parameters
    ----------
    estimator : Estimator
    layout : SensorLayout
    params : RestartParams
    """

    def __init__(self, estimator: Estimator, layout: SensorLayout, params: RestartParams) -> None:
        self.inner, self.layout, self.params = estimator, layout, params
        self._meters = np.flatnonzero(layout.quantity == VM)

    def init(self, snapshot: Snapshot) -> tuple[Guarded | None, Info]:
        """Start from a snapshot; None if what it says is impossible."""
        return self._started(self.inner.init, snapshot)

    def _alone(self, snapshot: Snapshot) -> tuple[Guarded | None, Info]:
        """Start again, from a snapshot and nothing else."""
        return self._started(self.inner.again or self.inner.init, snapshot)

    def _started(self, start: Any, snapshot: Snapshot) -> tuple[Guarded | None, Info]:
        state, info = self._tried(start, snapshot)
        why = "" if state is None else self.impossible(state, snapshot)
        if why:
            return None, Info.nothing(len(self.layout), Status.NOT_CONVERGED, why)
        return (None if state is None else Guarded(state)), info

    def step(self, state: Guarded, snapshot: Snapshot) -> tuple[Guarded | None, Info]:
        """Carry the state on, start again, or keep to the forecast."""
        if state.loose and snapshot.available.any():
            begun = self._alone(snapshot)
            if begun[1].status is not Status.UNOBSERVABLE:
                why = f"the forecast knows voltages to no better than {LOOSE:g} p.u."
                return self._again(state, snapshot, why, begun)
        after, info = self._tried(self.inner.step, state.inner, snapshot)
        why = info.detail if after is None else self.impossible(after, snapshot)
        if why:
            return self._again(state, snapshot, why)
        doubt, moved = self.params.contradiction(info), 0.0
        absurd = info.nis > FAR**2 * max(info.dof, 1)
        strange = state.strange + 1 if doubt or absurd else 0
        undoubted = Guarded(after) if doubt else None
        if doubt:
            after, moved = self._doubted(state.inner, after, snapshot)
            info = _contradicted(info, doubt)
        named = int(np.count_nonzero(info.judged & ((info.inflation > 0) | ~info.used)))
        if doubt and named > NAMED * info.judged.sum():
            why = f"{doubt} although {named} measurements are not believed"
            return self._again(state, snapshot, why)
        if moved > JUMP:
            why = f"{doubt}, and the snapshot would move a voltage by {moved:.2g} p.u."
            return self._again(state, snapshot, why)
        passes = info.nis <= special.chdtri(max(info.dof, 1), 1.0 - PASSES)
        suspect = bool(doubt) or (state.suspect and not passes)
        if suspect and not doubt and info.dof > 0:
            info = _contradicted(info, f"NIS is {info.nis / info.dof:.3g} per measurement")
        loose = info.dof == 0 and self._loose(after)
        kept = Guarded(after, 0, strange, loose, suspect, undoubted), info
        if strange < self.params.patience:
            return kept
        why = f"{strange} snapshots in a row contradicted the forecast"
        return self._again(state, snapshot, why, kept=None if absurd else kept)

    def _again(
        self,
        state: Guarded,
        snapshot: Snapshot,
        why: str,
        begun: tuple[Guarded | None, Info] | None = None,
        kept: tuple[Guarded, Info] | None = None,
    ) -> tuple[Guarded | None, Info]:
        """Start from the snapshot alone, or else keep what there is, or else the forecast."""
        first, told = begun or self._alone(snapshot)
        if first is not None:
            detail = f"{why}: the filter starts again from this snapshot alone"
            if told.detail:
                detail += f", {told.detail}"
            return first, replace(told, status=Status.RESTARTED, detail=detail)
        if kept is not None:
            return kept
        return self._forecast(state, snapshot, f"{why}: {NEITHER} ({told.detail})")

    def _forecast(
        self, state: Guarded, snapshot: Snapshot, why: str
    ) -> tuple[Guarded | None, Info]:
        """Keep to the forecast, and doubt it the longer the more."""
        ahead, _ = self._tried(self.inner.step, state.inner, snapshot.silent())
        if ahead is None or self.impossible(ahead, snapshot.silent()):
            return None, Info.nothing(len(self.layout), Status.DIVERGED, why)
        skipped = state.skipped + 1
        change, dynamics = self.inner.with_covariance, self.inner.dynamics
        if skipped > self.params.patience and change is not None and dynamics is not None:
            ahead = change(ahead, WIDER**2 * dynamics.belief(ahead)[1])
        kept = Guarded(ahead, skipped, loose=self._loose(ahead), suspect=state.suspect)
        return kept, Info.nothing(len(self.layout), Status.PREDICTED, why)

    def _doubted(self, before: Any, after: Any, snapshot: Snapshot) -> tuple[Any, float]:
        """A state that a doubtful snapshot has made no surer, and how far that has moved it."""
        change, dynamics = self.inner.with_covariance, self.inner.dynamics
        if change is None or dynamics is None:
            return after, 0.0
        forecast = dynamics.predict(before, snapshot)
        moved = dynamics.difference(dynamics.belief(after)[0], forecast.mean)
        after = change(after, forecast.covariance + np.outer(moved, moved))
        return after, float(np.abs(moved).max(initial=0.0))

    def _loose(self, state: Any) -> bool:
        """Whether a state knows less than a snapshot would tell."""
        estimate = self.inner.read(state)
        if estimate is None:
            return False
        return bool(np.diagonal(estimate.covariance).max(initial=0.0) > LOOSE**2)

    def read(self, state: Guarded) -> Estimate | None:
        """Estimate of the filter."""
        return self.inner.read(state.inner)

    def impossible(self, state: Any, snapshot: Snapshot) -> str:
        """Why a state is none, in words; "" if it may be one."""
        estimate = self.inner.read(state)
        if estimate is None:
            return ""
        variance = np.diagonal(estimate.covariance)
        if not (np.isfinite(estimate.x).all() and np.isfinite(variance).all()):
            return "the state is not finite"
        if (variance < 0).any():
            return "a variance is negative"
        size = estimate.x[len(estimate.x) // 2 :]
        odd = (size < self.params.lowest) | (size > self.params.highest)
        if not odd.any():
            return ""
        rows = self._meters[(snapshot.available & snapshot.fresh)[self._meters]]
        bus = self.layout.position[rows]
        agreed = np.zeros(len(size), dtype=bool)
        read = snapshot.z[rows]
        agreed[bus[(np.abs(read - size[bus]) <= AGREE) & (read > AGREE)]] = True
        if not (odd & ~agreed).any():
            return ""
        worst = int(np.where(odd & ~agreed, np.abs(size - 1.0), -1.0).argmax())
        return (
            f"|V| = {size[worst]:.3g} p.u. at bus number {worst} lies outside "
            f"{self.params.lowest:g} … {self.params.highest:g} p.u., and no meter confirms it"
        )

    def _tried(self, function: Any, *given: Any) -> tuple[Any, Info]:
        """A step or a start; None if the numbers do not allow it."""
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                state, info = function(*given)
        except FAILURES as error:
            return None, Info.nothing(
                len(self.layout), Status.DIVERGED, f"{type(error).__name__}: {error}"
            )
        return state, info


def _contradicted(info: Info, doubt: str) -> Info:
    """Info of a step whose snapshot contradicts the forecast."""
    if info.status is not Status.OK:
        return info
    detail = f"{doubt}: what the snapshot changed is doubtful"
    if info.detail:
        detail += f"; {info.detail}"
    return replace(info, status=Status.INCONSISTENT, detail=detail)


def guarded(
    estimator: Estimator, layout: SensorLayout, params: RestartParams | None = None
) -> Estimator:
    """Filter of a grid that starts again when it is lost.

    Parameters
    ----------
    estimator : Estimator
    layout : SensorLayout
    params : RestartParams, optional

    Returns
    -------
    Estimator
        Its status is ``restarted`` where it started again, and ``predicted`` where neither the
        forecast nor the snapshot alone could be reconciled.
    """
    made = Guard(estimator, layout, params or RestartParams())
    dynamics = estimator.dynamics
    return Estimator(
        estimator.name,
        made.init,
        made.step,
        made.read,
        dynamics=None
        if dynamics is None
        else dynamics.inside(lambda state: state.inner)._replace(
            undoubted=lambda state: state.undoubted
        ),
    )
