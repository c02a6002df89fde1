"""Estimators: from aligned telemetry to voltages with their covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.estimation import process
from pse_analysis.estimation.estimator import Estimated, Estimator, Record, record, run
from pse_analysis.estimation.kalman import kalman_filter
from pse_analysis.estimation.wls import tracking_wls
from pse_analysis.grid.network import Network
from pse_analysis.measurement import SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.vocabulary import check

__all__ = ["EstimateParams", "Estimated", "Estimator", "Method", "Record", "build", "estimate"]


@dataclass(frozen=True)
class Method:
    """One estimator of a case file.

    Attributes
    ----------
    name : str
        Spelling in tables and figures.
    filter : {"wls", "kalman"}
    noise : {"load", "scalar"}
        Process noise of a filter.
    variance : float
        q of ``scalar`` noise, per step. [p.u.²]
    source_sigma : float, optional
        σ of the source voltage's change per step for ``load`` noise; learnt from history if not
        given. [p.u.]
    variant : str
        The aligned variant it reads.
    """

    name: str
    filter: Literal["wls", "kalman"]
    noise: Literal["load", "scalar"] = "load"
    variance: float = 1e-6
    source_sigma: float | None = None
    variant: str = "last"


@dataclass(frozen=True)
class EstimateParams:
    """The methods of a case, compared on the same telemetry."""

    methods: tuple[Method, ...]


def build(
    method: Method, network: Network, layout: SensorLayout, study: Study, history: Record
) -> Estimator:
    """Build a method's estimator, learning from history what it needs.

    Parameters
    ----------
    method : Method
    network : Network
    layout : SensorLayout
    study : Study
    history : Record
        Aligned telemetry before the study.
    """
    if method.filter == "wls":
        return tracking_wls(method.name, network, layout)
    noise = (
        process.scalar_noise(network, method.variance)
        if method.noise == "scalar"
        else process.load_noise(
            network,
            process.learn_load(history, layout, network, study.step_s, source=method.source_sigma),
        )
    )
    return kalman_filter(
        method.name,
        network,
        layout,
        noise,
        step_s=study.step_s,
        reach_s=_reach(history, layout, study.step_s),
    )


def _reach(history: Record, layout: SensorLayout, step_s: float) -> float:
    """How far fresh samples usually reach back; the few that come later are not worth the states.

    Without history a sample is expected within one step of its end.
    """
    span = history.age_s + layout.window_s
    usual = [
        np.quantile(span[history.fresh[:, row], row], 0.95)
        for row in np.flatnonzero(history.fresh.any(axis=0))
    ]
    expected = float(np.max(layout.window_s, initial=0.0)) + step_s
    return float(max(usual)) if usual else expected


def estimate(
    aligned: pd.DataFrame,
    channels: pd.DataFrame,
    network: Network,
    study: Study,
    method: Method,
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
    network : Network
    study : Study
        Instants to estimate; earlier rows are history.
    method : Method
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
    rows = aligned[(aligned["trial"] == trial) & (aligned["variant"] == method.variant)]
    if rows.empty:
        raise TableError(
            f"method {method.name!r} reads variant {method.variant!r} of trial {trial}, which the "
            f"aligned table does not have: it has variants {sorted(set(aligned['variant']))} and "
            f"trials {sorted(set(aligned['trial']))}"
        )
    layout = SensorLayout.from_channels(channels, network)
    whole = record(rows, layout)
    start = pd.Timestamp(study.start).tz_convert("UTC").tz_localize(None).to_datetime64()
    estimator = build(method, network, layout, study, whole.between(None, start))
    studied = whole.between(start, None)
    reference = None if truth is None else true_states(truth, network, studied.time, trial)
    result = run(estimator, studied.snapshots(), network, layout, trial=trial, truth=reference)
    return Estimated(
        check("estimated", result.estimated),
        check("residuals", result.residuals),
        check("steps", result.steps),
    )


def true_states(truth: pd.DataFrame, network: Network, times: np.ndarray, trial: int) -> np.ndarray:
    """True [θ; |V|] at given instants from the truth table, NaN where it says nothing.

    Parameters
    ----------
    truth : DataFrame
    network : Network
    times : (T,) ndarray of datetime64
    trial : int

    Returns
    -------
    (T, 2N) ndarray
        [rad, p.u.]
    """
    rows = truth[(truth["trial"] == trial) & truth["quantity"].isin(["va_degree", "vm_pu"])]
    n = network.n_bus
    element = pd.Index([f"bus/{name}" for name in network.buses.name])
    column = element.get_indexer(rows["element"])
    column = np.where(rows["quantity"] == "vm_pu", column + n, column)
    stamps = rows["time_utc"].dt.tz_convert("UTC").dt.tz_localize(None).to_numpy()
    row = pd.Index(times.astype("datetime64[us]")).get_indexer(stamps.astype("datetime64[us]"))
    out = np.full((len(times), 2 * n), np.nan)
    keep = (row >= 0) & (column >= 0)
    out[row[keep], column[keep]] = rows["value"].to_numpy()[keep]
    out[:, :n] = np.deg2rad(out[:, :n])
    return out
