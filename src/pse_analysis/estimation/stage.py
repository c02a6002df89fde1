"""From aligned telemetry to the tables of an estimate: one method on one trial."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pse_analysis.arrays import utc_microseconds
from pse_analysis.errors import GridError, NotConverged, TableError, Unobservable
from pse_analysis.estimation import machine, variants
from pse_analysis.estimation.core.interface import Estimator, Info
from pse_analysis.estimation.core.run import Estimated, States, run
from pse_analysis.estimation.core.snapshots import record
from pse_analysis.estimation.kinds import GridFilter
from pse_analysis.estimation.methods import Factory, Method, Setting
from pse_analysis.machine import Machine
from pse_analysis.measurement import Model, SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.vocabulary import Status, check


def estimate(
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    model: Model,
    study: Study,
    method: Method | Factory,
    *,
    trial: int = 0,
    truth: pd.DataFrame | None = None,
) -> Estimated:
    """Run one method over one trial.

    Parameters
    ----------
    aligned : DataFrame
        Table ``aligned``; rows of other trials and variants are passed over.
    channels : DataFrame
        Table ``channels``.
    model : Network or Machine
    study : Study
        Instants to estimate; earlier rows are history.
    method : Method or callable
        A method, or a function that makes an estimator of one's own from a `Setting`; the latter
        reads the variant ``last``.
    trial : int
    truth : DataFrame, optional
        Table ``truth``, for NEES.

    Returns
    -------
    Estimated

    Raises
    ------
    TableError
        If the aligned table has no row of this trial and variant.
    """
    factory: Factory
    if isinstance(method, Method):
        name, variant, factory = method.name, method.variant, method.estimator
    else:
        name, variant, factory = _name(method), "last", method
    rows = aligned[(aligned["trial"] == trial) & (aligned["variant"] == variant)]
    if rows.empty:
        raise TableError(
            f"method {name!r} reads variant {variant!r} of trial {trial}, which the "
            f"aligned table does not have: it has variants {sorted(set(aligned['variant']))} and "
            f"trials {sorted(set(aligned['trial']))}"
        )
    layout = SensorLayout.from_channels(channels, model)
    start, end = utc_microseconds(pd.DatetimeIndex([study.start, study.end]))
    step = np.timedelta64(round(study.step_s * 1e6), "us")
    whole = record(rows, layout, np.arange(start, end, step))
    studied = whole.between(start, None)
    setting = Setting(model, layout, study, whole.between(None, start))
    try:
        estimator = factory(setting)
    except (GridError, NotConverged, Unobservable) as error:
        estimator = _without_estimates(name, layout, str(error))
    reference = None if truth is None else true_states(truth, model, studied.time, trial)
    if isinstance(model, Machine):
        snapshots, layout = machine.snapshots(studied, layout, model)
        result = run(estimator, snapshots, model, layout, trial=trial, truth=reference)
    else:
        own = method if isinstance(method, GridFilter) else None
        result = variants.run(
            estimator,
            list(studied.snapshots()),
            model,
            layout,
            smooth=own is not None and own.smooth,
            ahead=() if own is None else own.ahead,
            consistency=None if own is None else own.consistency,
            trial=trial,
            truth=reference,
        )
    return Estimated(
        check("estimated", result.estimated),
        check("residuals", result.residuals),
        check("steps", result.steps),
    )


def _without_estimates(name: str, layout: SensorLayout, why: str) -> Estimator:
    """A method that the history gives nothing to start from: it says so, and the others go on."""
    info = Info.nothing(len(layout), Status.NOT_CONVERGED, f"nothing learnt from history: {why}")
    return Estimator(
        name, lambda _snapshot: (None, info), lambda _state, _snapshot: (None, info), lambda _: None
    )


def _name(factory: Factory) -> str:
    """Name of a function that makes an estimator, where one has to be told."""
    return getattr(factory, "__name__", type(factory).__name__)


def true_states(truth: pd.DataFrame, model: Model, times: np.ndarray, trial: int) -> np.ndarray:
    """True states at given instants from the truth table, NaN where it says nothing.

    Parameters
    ----------
    truth : DataFrame
    model : Network or Machine
    times : (T,) ndarray of datetime64
    trial : int

    Returns
    -------
    (T, n) ndarray
        [θ; |V|] of a grid [rad, p.u.], [θ; ω] of a machine [rad, rad/s].
    """
    states = States.of(model)
    rows = truth[truth["trial"] == trial]
    names = pd.MultiIndex.from_arrays([states.element, states.quantity])
    column = names.get_indexer(pd.MultiIndex.from_frame(rows[["element", "quantity"]]))
    stamps = utc_microseconds(rows["time_utc"])
    row = pd.Index(times.astype("datetime64[us]")).get_indexer(stamps)
    out = np.full((len(times), len(states)), np.nan)
    keep = (row >= 0) & (column >= 0)
    out[row[keep], column[keep]] = rows["value"].to_numpy()[keep]
    return np.asarray(out / states.factor)
