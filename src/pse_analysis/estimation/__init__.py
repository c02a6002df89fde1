"""Estimators: from aligned telemetry to states with their covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.errors import GridError, NotConverged, ParameterError, TableError, Unobservable
from pse_analysis.estimation import (
    composition,
    load_learning,
    machine,
    matching,
    process,
    refusal,
    restart,
    screening,
)
from pse_analysis.estimation.composition import Composition
from pse_analysis.estimation.driver import Estimated, States, run
from pse_analysis.estimation.estimator import Estimator, Info
from pse_analysis.estimation.kalman import kalman_filter
from pse_analysis.estimation.noise import of_grid
from pse_analysis.estimation.records import Record, record
from pse_analysis.estimation.restart import RestartParams
from pse_analysis.estimation.tracking import tracking_wls
from pse_analysis.estimation.wls import state_columns
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.measurement import BUS, Model, P, Q, SensorLayout
from pse_analysis.measurement.rectangular import Linearisation
from pse_analysis.parameters import Study
from pse_analysis.validation.adaptive import AdaptiveParams
from pse_analysis.vocabulary import Status, check

FloatArray = npt.NDArray[np.float64]

__all__ = [
    "EstimateParams",
    "Estimated",
    "Estimator",
    "Method",
    "Record",
    "build",
    "estimate",
    "record",
]


@dataclass(frozen=True)
class Method:
    """One estimator of a case file.

    Attributes
    ----------
    name : str
        Spelling in tables and figures.
    filter : {"wls", "kalman", "ukf", "ekf", "observer"}
        ``observer`` is a machine's, the others are a grid's. ``kalman`` has rectangular
        coordinates, ``ukf`` and ``ekf`` are polar.
    noise : {"load", "scalar", "innovation"}
        Process noise of a filter: loads as history moved them, q I, or, in a ``kalman`` filter,
        loads and source as its own innovations tell (`pse_analysis.estimation.matching`).
    variance : float
        q of ``scalar`` noise, per step. [p.u.², rad²]
    source_sigma : float, optional
        σ of the source voltage's change per step for ``load`` noise; learnt from history if not
        given. [p.u.]
    compose : Composition
        What a ``ukf`` or ``ekf`` is made of; of a ``kalman`` filter, the process only.
    observer : ObserverParams, optional
        What an ``observer`` is designed from.
    reading : {"interval", "instant"}
        Whether a ``kalman`` filter reads a sample over the interval that it covers, once, or as a
        value of the present instant, as often as it stands there.
    linearisation : {"derivative", "transform"}
        Whether a ``kalman`` filter follows the whole derivative of a power, or reads it as a
        current that is fixed in the frame of the predicted voltage, as [qi2025] does. The latter
        claims to know the angle that all buses share, which powers do not tell.
    screening : {"none", "literal", "absolute", "scaled", "innovation"}
        How gross errors are met: by an adaptive threshold before any filter, or, in a ``kalman``
        filter, by its own innovation.
    restart : RestartParams
        When a filter starts again.
    variant : str
        The aligned variant it reads.
    """

    name: str
    filter: Literal["wls", "kalman", "ukf", "ekf", "observer"]
    noise: Literal["load", "scalar", "innovation"] = "load"
    variance: float = 1e-6
    source_sigma: float | None = None
    compose: Composition = field(default_factory=Composition)
    observer: machine.ObserverParams | None = None
    reading: Literal["interval", "instant"] = "interval"
    linearisation: Linearisation = "derivative"
    screening: Literal["none", "literal", "absolute", "scaled", "innovation"] = "none"
    restart: RestartParams = field(default_factory=RestartParams)
    variant: str = "last"

    def __post_init__(self) -> None:
        if self.filter != "kalman" and (
            self.reading == "instant" or "innovation" in (self.screening, self.noise)
        ):
            raise ParameterError(
                f'[estimate.methods] {self.name!r}: reading = "instant" and screening or noise = '
                f'"innovation" are for filter = "kalman", not for {self.filter!r}: drop them'
            )
        if not self.name.strip():
            raise ParameterError("[estimate.methods] name is empty: give each method its own")
        sigma = 0.0 if self.source_sigma is None else self.source_sigma
        if not (0 < self.variance < math.inf and 0 <= sigma < math.inf):
            raise ParameterError(
                f"[estimate.methods] {self.name!r}: expected variance > 0 and source_sigma ≥ 0, "
                f"both finite, received {self.variance} and {self.source_sigma}"
            )
        self._check_composition()
        if (self.filter == "observer") != (self.observer is not None):
            raise ParameterError(
                f'[estimate.methods] {self.name!r}: filter = "observer" and a table observer = '
                "{ q = […], r = … } or { poles = […] } belong together"
            )

    def _check_composition(self) -> None:
        """Refuse parts that the filter would not use."""
        plain = Composition()
        if self.filter == "kalman":
            plain = replace(plain, process=self.compose.process, holt=self.compose.holt)
        if self.filter not in ("ukf", "ekf") and self.compose != plain:
            raise ParameterError(
                f"[estimate.methods] {self.name!r}: compose = {{ … }} is for ukf and ekf, and of "
                f"it process and holt alone for kalman; the filter is {self.filter}: drop the rest"
            )
        others = {"ukf": ("passes",), "ekf": ("scaling", "form", "points")}.get(self.filter, ())
        for part in others:
            if getattr(self.compose, part) != getattr(plain, part):
                raise ParameterError(
                    f"[estimate.methods] {self.name!r}: compose.{part} has no effect on "
                    f"{self.filter}: drop it, or take {'ekf' if part == 'passes' else 'ukf'}"
                )


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

    Raises
    ------
    ParameterError
        If the method is one of a machine.
    """
    estimator = _build_plain(method, network, layout, study, history)
    if method.filter != "wls":
        estimator = restart.guarded(estimator, layout, method.restart)
    if method.screening == "none" or method.screening == "innovation":
        return estimator
    return screening.screened(
        estimator, layout, AdaptiveParams(threshold=method.screening), history
    )


def _build_plain(
    method: Method, network: Network, layout: SensorLayout, study: Study, history: Record
) -> Estimator:
    if method.filter == "observer":
        raise ParameterError(
            f"method {method.name!r} observes a machine, but the case has a grid: use wls, kalman, "
            "ukf or ekf"
        )
    if method.filter == "wls":
        return tracking_wls(method.name, network, layout)
    if method.noise == "innovation":
        noise: process.ProcessNoise | matching.Matching = matching.of_loads(
            network, _usual_injections(history, layout, network)
        )
    else:
        noise = known = _known_noise(method, network, layout, study, history)
    if method.filter in ("ukf", "ekf"):
        polar = (
            composition.scalar(network, layout, method.variance)
            if method.noise == "scalar"
            else of_grid(network, known, state_columns(network, layout))
        )
        return composition.build(method.name, method.filter, method.compose, network, layout, polar)
    return kalman_filter(
        method.name,
        network,
        layout,
        noise,
        step_s=study.step_s,
        reach_s=_reach(history, layout, study.step_s),
        instant=method.reading == "instant",
        refuse=_refuse(method) if method.screening == "innovation" else None,
        process=composition.process_of(method.compose),
        linearisation=method.linearisation,
    )


def _refuse(method: Method) -> refusal.Refuse:
    params = refusal.InnovationParams()
    # One variance for all voltages is chosen above whatever they do; loads surprise what is learnt.
    return refusal.refuse(replace(params, doubt=1.0) if method.noise == "scalar" else params)


def _known_noise(
    method: Method, network: Network, layout: SensorLayout, study: Study, history: Record
) -> process.ProcessNoise:
    if method.noise == "scalar":
        return process.scalar_noise(network, method.variance)
    learnt = load_learning.learn_load(
        history, layout, network, study.step_s, source=method.source_sigma
    )
    return process.load_noise(network, learnt)


def _usual_injections(history: Record, layout: SensorLayout, network: Network) -> FloatArray:
    """Mean of the metered [P; Q] of every bus before the study, NaN where none is. (2N,) [p.u.]"""
    out = np.full(2 * network.n_bus, np.nan)
    read = history.available & history.fresh
    for q, offset in ((P, 0), (Q, network.n_bus)):
        for row in np.flatnonzero((layout.quantity == q) & (layout.side == BUS)):
            if read[:, row].any():
                out[offset + layout.position[row]] = history.z[read[:, row], row].mean()
    return out


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
    model: Model,
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
    model : Network or Machine
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
    layout = SensorLayout.from_channels(channels, model)
    start, end = (
        pd.Timestamp(t).tz_convert("UTC").tz_localize(None).to_datetime64().astype("datetime64[us]")
        for t in (study.start, study.end)
    )
    step = np.timedelta64(round(study.step_s * 1e6), "us")
    whole = record(rows, layout, np.arange(start, end, step))
    studied = whole.between(start, None)
    if isinstance(model, Machine):
        estimator = _build_observer(method, model, study)
        snapshots, layout = machine.snapshots(studied, layout, model)
    else:
        try:
            estimator = build(method, model, layout, study, whole.between(None, start))
        except (GridError, NotConverged, Unobservable) as error:
            estimator = _without_estimates(method.name, layout, str(error))
        snapshots = studied.snapshots()
    reference = None if truth is None else true_states(truth, model, studied.time, trial)
    result = run(estimator, snapshots, model, layout, trial=trial, truth=reference)
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


def _build_observer(method: Method, model: Machine, study: Study) -> Estimator:
    if method.observer is None:
        raise ParameterError(
            f"method {method.name!r} is {method.filter!r}, a grid's, but the case is about "
            f'{model.element}: use filter = "observer"'
        )
    return machine.from_params(method.name, model, method.observer, study.step_s)


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
    stamps = rows["time_utc"].dt.tz_convert("UTC").dt.tz_localize(None).to_numpy()
    row = pd.Index(times.astype("datetime64[us]")).get_indexer(stamps.astype("datetime64[us]"))
    out = np.full((len(times), len(states)), np.nan)
    keep = (row >= 0) & (column >= 0)
    out[row[keep], column[keep]] = rows["value"].to_numpy()[keep]
    return np.asarray(out / states.factor)
