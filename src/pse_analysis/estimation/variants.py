"""A filter that also looks back and ahead: smoothed estimates and forecasts beside its own.

Each stands in the tables as a method of its own: ``NAME_smoothed``, and ``NAME_ahead_N`` for
forecasts made N steps before the instant that they are about.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.estimation.core import run as driver
from pse_analysis.estimation.core.interface import Estimator, Info, Snapshot
from pse_analysis.estimation.core.run import ConsistencyParams, Estimated, Watch
from pse_analysis.estimation.filters.smoother import Ahead, Trail
from pse_analysis.measurement import Model, SensorLayout
from pse_analysis.vocabulary import Status


def smoothed_name(name: str) -> str:
    """Method by which the smoothed estimates of a filter stand in tables."""
    return f"{name}_smoothed"


def ahead_name(name: str, steps: int) -> str:
    """Method by which forecasts of a filter stand in tables."""
    return f"{name}_ahead_{steps}"


def run(
    estimator: Estimator,
    snapshots: Sequence[Snapshot],
    model: Model,
    layout: SensorLayout,
    *,
    smooth: bool = False,
    ahead: tuple[int, ...] = (),
    trial: int = 0,
    truth: FloatArray | None = None,
    consistency: ConsistencyParams | None = None,
) -> Estimated:
    """Run an estimator over snapshots, and tell what it makes of them later and before.

    Parameters
    ----------
    estimator : Estimator
    snapshots : sequence of Snapshot
    model : Network or Machine
    layout : SensorLayout
    smooth : bool
        Whether every instant is estimated again from all of them; there is no such estimate where
        the estimator does not say how its state moves.
    ahead : tuple of int
        Steps ahead of which there are to be forecasts.
    trial : int
    truth : (T, n) ndarray, optional
        As for `pse_analysis.estimation.core.run.run`.
    consistency : ConsistencyParams, optional

    Returns
    -------
    Estimated
        Of the estimator and of its variants.
    """
    trail, forecasts = Trail(estimator, snapshots), Ahead(estimator, snapshots, ahead)
    infos: list[Info] = []
    forecasting = [0.0]

    def forecast(k: int, state: object, info: Info) -> None:
        begun = time.perf_counter()
        forecasts.watch(k, state, info)
        forecasting[0] += time.perf_counter() - begun

    watch: list[Watch] = [lambda _k, _state, info: infos.append(info)]
    if smooth and estimator.dynamics is not None:
        watch.append(trail.watch)
    if ahead:
        watch.append(forecast)
    own = driver.run(
        estimator,
        iter(snapshots),
        model,
        layout,
        trial=trial,
        truth=truth,
        watch=watch,
        consistency=consistency,
    )
    made = [own]
    m, status = len(layout), [Status(one) for one in own.steps["status"]]
    known = [None] * len(snapshots) if truth is None else list(truth)
    if smooth:
        begun = time.perf_counter()
        back = trail.smoothed() if estimator.dynamics else [None] * len(snapshots)
        seconds = time.perf_counter() - begun
        made.append(
            driver.derived(
                smoothed_name(estimator.name),
                trial,
                [
                    (s.time, Info.nothing(m, status[k]), back[k], known[k])
                    for k, s in enumerate(snapshots)
                ],
                seconds,
                model,
                layout,
            )
        )
    for steps in ahead:
        found = forecasts.found.get(steps, {})
        made.append(
            driver.derived(
                ahead_name(estimator.name, steps),
                trial,
                [
                    (s.time, Info.nothing(m, status[k - steps]), found.get(k), known[k])
                    for k, s in enumerate(snapshots)
                    if k >= steps
                ],
                forecasting[0] / len(ahead),
                model,
                layout,
            )
        )
    if len(made) == 1:
        return own
    return Estimated(
        *(
            pd.concat([getattr(part, name) for part in made], ignore_index=True)
            for name in ("estimated", "residuals", "steps")
        )
    )
