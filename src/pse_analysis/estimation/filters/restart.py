"""What any filter of a grid does when its forecast and a snapshot exclude each other.

A filter cannot tell by itself that it is lost: its covariance shrinks whatever it is told. Two
things show from outside. A voltage that no grid has, such as a mirrored or a vanished one, is no
estimate; and a snapshot that is off by thousands of σ as a whole is no noise. Then the snapshot is
asked alone, and if it has no answer either, the forecast stands until one has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.interface import FAILURES, Estimate, Estimator, Info, Snapshot
from pse_analysis.measurement import VM, SensorLayout
from pse_analysis.vocabulary import Status

FAR = 30.0
"""Deviation, in units of its σ, from which a measurement is off by more than noise and load."""
MOST = 0.25
"""Share of the measurements of a snapshot up to which they are wrong rather than the forecast."""
ABSURD = 1e6
"""ηᵀS⁻¹η per measurement from which those that are far off are left out whatever filter it is."""
WIDER = 3.0
"""Factor on all σ of a forecast that too many snapshots have contradicted."""
AGREE = 0.1
"""Distance up to which a meter confirms a voltage that is out of its bounds. [p.u.]"""


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
    """

    lowest: float = 0.3
    highest: float = 2.0
    patience: int = 3

    def __post_init__(self) -> None:
        if not (0 < self.lowest < 1 < self.highest < np.inf) or self.patience < 1:
            raise ParameterError(
                "restart: expected 0 < lowest < 1 < highest and patience ≥ 1, received "
                f"{self.lowest}, {self.highest} and {self.patience}"
            )


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
    """

    inner: Any
    skipped: int = 0
    strange: int = 0


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

    def _started(self, start: Any, snapshot: Snapshot) -> tuple[Guarded | None, Info]:
        state, info = self._tried(start, snapshot)
        why = "" if state is None else self.impossible(state, snapshot)
        if why:
            return None, Info.nothing(len(self.layout), Status.NOT_CONVERGED, why)
        return (None if state is None else Guarded(state)), info

    def step(self, state: Guarded, snapshot: Snapshot) -> tuple[Guarded | None, Info]:
        """Carry the state on, start again, or keep to the forecast."""
        after, info = self._tried(self.inner.step, state.inner, snapshot)
        why = info.detail if after is None else self.impossible(after, snapshot)
        strange = state.strange + 1 if info.nis > FAR**2 * max(info.dof, 1) else 0
        if strange >= self.params.patience:
            why = why or f"{strange} snapshots in a row contradicted the forecast"
        if after is not None and not why:
            return Guarded(after, 0, strange), info
        begun, told = self._started(self.inner.again or self.inner.init, snapshot)
        if begun is not None:
            detail = f"{why}: the filter starts again from this snapshot alone"
            if told.detail:
                detail += f", {told.detail}"
            return begun, replace(told, status=Status.RESTARTED, detail=detail)
        ahead, _ = self._tried(self.inner.step, state.inner, snapshot.silent())
        if ahead is None or self.impossible(ahead, snapshot.silent()):
            return None, Info.nothing(len(self.layout), Status.DIVERGED, why)
        skipped = state.skipped + 1
        if skipped > self.params.patience and self.inner.widened is not None:
            ahead = self.inner.widened(ahead)
        return Guarded(ahead, skipped), Info.nothing(
            len(self.layout),
            Status.PREDICTED,
            f"{why}: nothing of the snapshot is believed, nor does it tell a state by itself "
            f"({told.detail})",
        )

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
        agreed[bus[np.abs(snapshot.z[rows] - size[bus]) <= AGREE]] = True
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
        dynamics=None if dynamics is None else dynamics.inside(lambda state: state.inner),
    )
