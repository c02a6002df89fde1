"""Bad data before and inside a filter: an adaptive threshold per channel, or the filter's own view.

``adaptive`` compares every channel with its own past (`pse_analysis.validation.adaptive`) before
any estimator sees it, and so it takes a true jump of the load for an error. ``refuse`` is asked by
a Kalman filter about its innovation: it knows how the load may move, and what the other channels
say about the same movement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import linalg

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.estimator import Estimate, Estimator, Info, Record, Snapshot
from pse_analysis.measurement import IA, VA, SensorLayout
from pse_analysis.validation import adaptive
from pse_analysis.validation.adaptive import AdaptiveParams, AdaptiveState
from pse_analysis.vocabulary import Reason

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

Refuse = Callable[[FloatArray, FloatArray], BoolArray]
"""(innovation (m,), lower Cholesky factor of its covariance (m, m)) -> rows not to be used (m,).

The filter has the factor already; above the diagonal it is zero.
"""


@dataclass(frozen=True)
class InnovationParams:
    """When a filter refuses a channel.

    Attributes
    ----------
    factor : float
        c: refused if the innovation lies more than c of its own σ, given all other channels, away
        from what these and the forecast predict. Loads are heavy-tailed: where single customers
        switch, a good channel that alone sees a step lies 4 to 6 σ off, and to refuse it costs more
        than the few errors of that size do.
    alone : float
        Nor is a channel refused that lies less than so many of its own σ away from the forecast
        alone: what only the others speak against rests on correlations that are learnt, of loads
        and of values that are held, and these are not as certain as S has them.
    largest_share : float
        Share of the channels of a snapshot that may be refused: if more seem wrong, the forecast
        is.
    """

    factor: float = 6.0
    alone: float = 2.5
    largest_share: float = 0.25

    def __post_init__(self) -> None:
        if not (self.factor > 0 and self.alone >= 0 and 0 < self.largest_share < 1):
            raise ParameterError(
                "screening: expected factor > 0, alone ≥ 0 and 0 < largest_share < 1, received "
                f"{self.factor}, {self.alone} and {self.largest_share}"
            )


def refuse(params: InnovationParams | None = None) -> Refuse:
    """Refuse the channel that disagrees most with the others and the forecast, and so on.

    Parameters
    ----------
    params : InnovationParams, optional

    Returns
    -------
    Refuse

    Notes
    -----
    With M = S⁻¹ the innovation of channel i, given those of all others, has the mean
    η_i - (Mη)_i/M_ii and the variance 1/M_ii; so |(Mη)_i|/√M_ii is the largest normalised residual
    of a least-squares estimate that counts the forecast among its measurements. Taking a channel
    out changes M by one rank.
    """
    params = params or InnovationParams()

    def refused(innovation: FloatArray, chol_S: FloatArray) -> BoolArray:
        m = len(innovation)
        out = np.zeros(m, dtype=bool)
        own_variance = np.einsum("ij,ij->i", chol_S, chol_S)
        expected = innovation**2 <= params.alone**2 * own_variance
        if expected.all():
            return out
        inverse, _ = linalg.lapack.dtrtri(chol_S, lower=1)
        y = inverse.T @ (inverse @ innovation)
        # Most snapshots hold no error: the diagonal of M = L⁻ᵀL⁻¹ is enough to see that.
        odd = y * y > params.factor**2 * np.einsum("ij,ij->j", inverse, inverse)
        if not (odd & ~expected).any():
            return out
        M = inverse.T @ inverse
        for _ in range(int(params.largest_share * m)):
            variance = np.where(out | expected, np.inf, np.diagonal(M))
            suspicion = np.abs(y) / np.sqrt(variance)
            worst = int(suspicion.argmax())
            if suspicion[worst] <= params.factor:
                return out
            out[worst] = True
            column, own = M[:, worst].copy(), M[worst, worst]
            y = y - column * (y[worst] / own)
            M = M - np.outer(column, column / own)
        return out

    return refused


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
        own = np.sqrt(np.maximum(snapshot.sigma**2 - snapshot.sigma_age**2, 0.0))
        past, decision = adaptive.step(state.past, snapshot.z, own, new, params, turn, kind)
        replaced = decision.flagged | (state.replaced & ~new)
        if not (replaced.any() or decision.released.any()):
            return state._replace(past=past, replaced=replaced), snapshot, None
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

    return Estimator(estimator.name, init, step, read)
