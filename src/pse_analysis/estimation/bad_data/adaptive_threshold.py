"""Bad data before a filter: every channel is compared with its own past.

The adaptive threshold (`pse_analysis.validation.adaptive`) stands before any estimator, so it takes
a true jump of the load for an error; a filter's own view is in
`pse_analysis.estimation.bad_data.innovation_test`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.estimation.core.interface import Estimate, Estimator, Info, Snapshot
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.measurement import IA, VA, SensorLayout
from pse_analysis.validation import adaptive
from pse_analysis.validation.adaptive import AdaptiveParams, AdaptiveState
from pse_analysis.vocabulary import Reason


class ScreenedState(NamedTuple):
    """State of an estimator behind an adaptive threshold.

    Attributes
    ----------
    inner : object or None
        State of the estimator; None where it has none.
    past : AdaptiveState
    replaced : (m,) ndarray of bool
        Channels whose newest sample was replaced.
    value, sigma : (m,) ndarray
        What stands for these as long as they are held; of no meaning for the others.
    """

    inner: Any
    past: AdaptiveState
    replaced: BoolArray
    value: FloatArray
    sigma: FloatArray


def screened(
    estimator: Estimator, layout: SensorLayout, params: AdaptiveParams, history: Record
) -> Estimator:
    """Put an adaptive threshold before an estimator.

    Parameters
    ----------
    estimator : Estimator
        Any; it sees replaced values with a larger σ.
    layout : SensorLayout
    params : AdaptiveParams
    history : Record
        Telemetry before the first snapshot, on which windows and residuals are filled.

    Returns
    -------
    Estimator
        Its info says in ``reasons`` which samples were replaced (`Reason.INCREMENT`) and which were
        accepted after a run of flags (`Reason.STEP_ACCEPTED`).
    """
    m = len(layout)
    turn = np.where(np.isin(layout.quantity, (VA, IA)), 2.0 * np.pi, np.inf)
    kind = pd.factorize(pd.MultiIndex.from_arrays([layout.source, layout.quantity]))[0]

    def judged(
        state: ScreenedState, snapshot: Snapshot
    ) -> tuple[ScreenedState, Snapshot, npt.NDArray[np.int32] | None]:
        new = snapshot.available & snapshot.fresh
        past, decision = adaptive.step(
            state.past, snapshot.z, snapshot.sigma_own, new, params, turn, kind
        )
        held = state.replaced & ~new
        if not (held.any() or decision.flagged.any() or decision.released.any()):
            return state._replace(past=past, replaced=held), snapshot, None
        replaced = decision.flagged | held
        value = np.where(new, decision.value, state.value)
        sigma = np.where(new, decision.sigma, state.sigma)
        stands = snapshot.available & replaced
        seen = replace(
            snapshot,
            z=np.where(stands, value, snapshot.z),
            sigma=np.where(stands, np.hypot(sigma, snapshot.sigma_age), snapshot.sigma),
        )
        reasons = np.where(stands, int(Reason.INCREMENT), 0) | np.where(
            new & decision.released, int(Reason.STEP_ACCEPTED), 0
        )
        following = ScreenedState(state.inner, past, replaced, value, sigma)
        return following, seen, reasons.astype(np.int32)

    def primed() -> ScreenedState:
        state = ScreenedState(
            None,
            AdaptiveState.empty(m, params),
            np.zeros(m, dtype=bool),
            np.zeros(m),
            np.ones(m),
        )
        for snapshot in history.snapshots():
            state = judged(state, snapshot)[0]
        return state

    def step(state: ScreenedState, snapshot: Snapshot) -> tuple[ScreenedState, Info]:
        state, seen, reasons = judged(state, snapshot)
        if state.inner is None:
            inner, info = estimator.init(seen)
        else:
            inner, info = estimator.step(state.inner, seen)
        if reasons is None:
            return state._replace(inner=inner), info
        widened = (seen.sigma / snapshot.sigma) ** 2 - 1.0
        inflation = np.where(
            reasons & int(Reason.INCREMENT), np.maximum(info.inflation, widened), info.inflation
        )
        return state._replace(inner=inner), replace(
            info, inflation=inflation, reasons=reasons | info.findings
        )

    def init(snapshot: Snapshot) -> tuple[ScreenedState, Info]:
        return step(primed(), snapshot)

    def read(state: ScreenedState) -> Estimate | None:
        return None if state.inner is None else estimator.read(state.inner)

    dynamics = estimator.dynamics
    return Estimator(
        estimator.name,
        init,
        step,
        read,
        dynamics=None if dynamics is None else dynamics.inside(lambda state: state.inner),
    )
