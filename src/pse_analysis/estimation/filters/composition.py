"""Unscented and extended filters from what a case file says: process × scaling × noise × gate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.bad_data import robust
from pse_analysis.estimation.bad_data.innovation_test import Refuse
from pse_analysis.estimation.bad_data.robust import Protection
from pse_analysis.estimation.core.interface import Estimator
from pse_analysis.estimation.filters import linearised, recursion, unscented
from pse_analysis.estimation.filters.angle_reference import AngleReference
from pse_analysis.estimation.filters.restart import ABSURD
from pse_analysis.estimation.filters.unscented import Form, Scaling
from pse_analysis.estimation.process import dynamics, sage_husa
from pse_analysis.estimation.process.dynamics import HoltParams
from pse_analysis.estimation.process.sage_husa import VoltageNoise
from pse_analysis.estimation.static.start import Start
from pse_analysis.estimation.static.start_prior import StartPrior
from pse_analysis.estimation.static.wls import state_columns
from pse_analysis.grid.network import Network
from pse_analysis.measurement import MeasurementModel, SensorLayout
from pse_analysis.parameters import Unbounded

MOST_PASSES = 100
"""Linearisations of one step; what has not converged by then never does."""
FORGETTING = 0.97
"""b of Sage and Husa where it is not said."""


@dataclass(frozen=True)
class Composition:
    """What an unscented or extended filter is made of; any combination works.

    Attributes
    ----------
    process : {"random_walk", "holt", "local_trend"}
    scaling : {"fixed", "moments", "likelihood"}
        How an unscented filter chooses α.
    form : {"covariance", "square_root"}
        What an unscented filter carries from step to step; see
        `pse_analysis.estimation.filters.unscented`.
    learning : {"none", "sage_husa"}
        Whether it learns its process noise on the way.
    robustness : {"none", "trace", "per_channel"}
        How gross errors are met.
    absurd : float
        ηᵀS⁻¹η per measurement from which whatever filter leaves out what is far off; inf to believe
        everything, as the filters of the papers do.
    protected : bool
        Whether a robust filter doubts its forecast after it has refused the same channels again
        and again.
    passes : int
        Most linearisations of an extended filter per step; above 1 it is the iterated one.
    holt, points, protection
        Numbers of these parts.
    forgetting : float
        b of Sage and Husa.
    """

    process: Literal["random_walk", "holt", "local_trend"] = "random_walk"
    scaling: Literal["fixed", "moments", "likelihood"] = "fixed"
    form: Form = "covariance"
    learning: Literal["none", "sage_husa"] = "none"
    robustness: Literal["none", "trace", "per_channel"] = "none"
    absurd: Unbounded = ABSURD
    protected: bool = True
    passes: int = 1
    forgetting: float = FORGETTING
    holt: HoltParams = field(default_factory=HoltParams)
    points: Scaling = field(default_factory=Scaling)
    protection: Protection = field(default_factory=Protection)

    def __post_init__(self) -> None:
        if not 1 <= self.passes <= MOST_PASSES:
            raise ParameterError(
                f"compose: expected passes in 1 … {MOST_PASSES}, received {self.passes}"
            )
        if not 0.0 < self.forgetting < 1.0:
            raise ParameterError(
                f"compose: expected 0 < forgetting < 1, received {self.forgetting}"
            )
        if not self.absurd >= 1.0:
            raise ParameterError(f"compose: expected absurd ≥ 1, received {self.absurd}")
        for key, needed in self._without_effect():
            raise ParameterError(f"compose.{key} has no effect here: drop it, or {needed}")

    def _without_effect(self) -> Iterator[tuple[str, str]]:
        """Numbers of parts that are not there, each with what it needs."""
        judged = self.robustness != "none"
        if self.process == "random_walk" and self.holt != HoltParams():
            yield "holt", 'take process = "holt" or "local_trend"'
        if self.process == "local_trend" and self.holt.as_printed:
            yield "holt.as_printed", 'take process = "holt"'
        if self.learning == "none" and self.forgetting != FORGETTING:
            yield "forgetting", 'take learning = "sage_husa"'
        if not judged and not self.protected:
            yield "protected", 'take robustness = "trace" or "per_channel"'
        if not (judged and self.protected) and self.protection != Protection():
            yield "protection", 'take a robustness other than "none" and protected = true'
        if self.scaling == "likelihood" and self.points.alpha != Scaling().alpha:
            yield "points.alpha", 'take scaling = "fixed" or "moments"'


def process_of(composition: Composition) -> dynamics.Process:
    """How the mean moves in a composition."""
    if composition.process == "random_walk":
        return dynamics.random_walk()
    return (dynamics.holt if composition.process == "holt" else dynamics.local_trend)(
        composition.holt
    )


def compose(
    kind: Literal["ukf", "ekf"],
    composition: Composition,
    network: Network,
    layout: SensorLayout,
    voltages: VoltageNoise,
    refuse: Refuse | None = None,
    reference: AngleReference | None = None,
) -> recursion.GaussianFilter:
    """The filter of a composition.

    Parameters
    ----------
    kind : {"ukf", "ekf"}
    composition : Composition
    network : Network
    layout : SensorLayout
    voltages : VoltageNoise
        Process noise of the estimated voltages, from which learning starts.
    refuse : Refuse, optional
        Innovation test that stands in the place of a robustness.
    reference : AngleReference, optional
        How the reference of measured angles moves; it stands still if not given.

    Returns
    -------
    GaussianFilter
    """
    model = MeasurementModel(network, layout, state_columns(network, layout))
    process = process_of(composition)
    made = (
        sage_husa.known(voltages, process)
        if composition.learning == "none"
        else sage_husa.sage_husa(voltages, process, composition.forgetting)
    )
    if kind == "ekf":
        observation = linearised.linearised(model, composition.passes)
    else:
        scaled = {
            "fixed": unscented.fixed,
            "moments": unscented.by_moments,
            "likelihood": unscented.by_likelihood,
        }[composition.scaling]
        observation = scaled(model, composition.points, composition.form)
    judge = (
        robust.GROSS_ERROR_TESTS[composition.robustness]
        if refuse is None
        else robust.left_out(refuse)
    )
    judges = composition.robustness != "none" and composition.protected
    return recursion.GaussianFilter(
        model,
        process,
        observation,
        made,
        recursion.Robustness(judge, composition.protection if judges else None, composition.absurd),
        reference,
    )


def build(
    name: str,
    kind: Literal["ukf", "ekf"],
    composition: Composition,
    network: Network,
    layout: SensorLayout,
    voltages: VoltageNoise,
    refuse: Refuse | None = None,
    reference: AngleReference | None = None,
    prior: StartPrior | None = None,
) -> Estimator:
    """Estimator of a composition, started from a snapshot and what was usual before it."""
    made = compose(kind, composition, network, layout, voltages, refuse, reference)
    return recursion.estimator(name, made, Start(network, layout, prior))


def scalar(network: Network, layout: SensorLayout, variance: float) -> VoltageNoise:
    """Q = q I on the voltages that a layout lets be estimated. [p.u.², rad²]"""
    return sage_husa.constant(np.full(len(state_columns(network, layout)), variance))
