"""The methods of grids and machines that this package has, and what a case file may say of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import ClassVar, Literal

from pse_analysis.errors import ParameterError
from pse_analysis.estimation import machine, variants
from pse_analysis.estimation.bad_data.innovation_test import InnovationTest, Refuse, refuse
from pse_analysis.estimation.core.interface import Estimator
from pse_analysis.estimation.core.run import ConsistencyParams
from pse_analysis.estimation.filters import composition, intervals, restart
from pse_analysis.estimation.filters.angle_reference import AngleReference
from pse_analysis.estimation.filters.composition import Composition
from pse_analysis.estimation.filters.kalman import kalman_filter
from pse_analysis.estimation.filters.restart import RestartParams
from pse_analysis.estimation.methods import KINDS, GridMethod, Method, Setting, named, spelt
from pse_analysis.estimation.process import covariance_matching, learn_from_history, load_noise
from pse_analysis.estimation.process.covariance_matching import CovarianceMatching
from pse_analysis.estimation.process.load_noise import ProcessNoise
from pse_analysis.estimation.process.sage_husa import VoltageNoise, of_grid
from pse_analysis.estimation.static.start_prior import start_prior
from pse_analysis.estimation.static.tracking import WlsParams, tracking_wls
from pse_analysis.estimation.static.wls import state_columns
from pse_analysis.machine import Machine
from pse_analysis.measurement import SensorLayout
from pse_analysis.measurement.rectangular import Linearisation

VARIANCE = 1e-6
"""q of ``scalar`` noise where a method does not say it. [p.u.², rad²]"""
MOST_AHEAD = 1000
"""Most steps that a forecast may reach."""


@dataclass(frozen=True)
class HistoryParams:
    """How the movement of loads is learnt from telemetry before the study.

    Attributes
    ----------
    slot_s : float
        Slots of the day, each of which has its own σ. [s]
    bandwidth_s : float
        How far (Gaussian) each slot looks at its neighbours. [s]
    """

    slot_s: float = 900.0
    bandwidth_s: float = 5400.0

    def __post_init__(self) -> None:
        if not (60.0 <= self.slot_s <= 86_400.0 and 60.0 <= self.bandwidth_s <= 1e7):
            raise ParameterError(
                "history: expected slot_s in 60 … 86400 and bandwidth_s ≥ 60, received "
                f"{self.slot_s} and {self.bandwidth_s}"
            )


@named("wls")
@dataclass(frozen=True, kw_only=True)
class LeastSquares(GridMethod):
    """Weighted least squares on every snapshot; see `pse_analysis.estimation.static.tracking`.

    Attributes
    ----------
    confidence, tolerance, max_iterations
        As for `pse_analysis.estimation.static.tracking.WlsParams`.
    """

    confidence: float = WlsParams.confidence
    tolerance: float = WlsParams.tolerance
    max_iterations: int = WlsParams.max_iterations

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.numbers

    @property
    def numbers(self) -> WlsParams:
        """Numbers of the estimator."""
        return WlsParams(self.confidence, self.tolerance, self.max_iterations)

    def without_effect(self) -> Iterator[tuple[str, str]]:
        yield from super().without_effect()
        if self.screening == "innovation":
            yield 'screening = "innovation"', 'take filter = "kalman", "ukf" or "ekf"'

    def unscreened(self, setting: Setting) -> Estimator:
        return tracking_wls(self.name, setting.network, setting.layout, self.numbers)


@dataclass(frozen=True, kw_only=True)
class GridFilter(GridMethod):
    """What the filters of a grid have in common.

    Attributes
    ----------
    noise : {"load", "scalar", "innovation"}
        Process noise: loads as history moved them, q I, or, in a ``kalman`` filter, loads and
        source as its own innovations tell
        (`pse_analysis.estimation.process.covariance_matching`).
    variance : float, optional
        q of ``scalar`` noise, per step; `VARIANCE` by default. [p.u.², rad²]
    source_sigma : float, optional
        σ of the source voltage's change per step for ``load`` noise; learnt from history if not
        given. [p.u.]
    history : HistoryParams, optional
        How ``load`` noise is learnt.
    angle_reference : {"moving", "fixed"}
        Whether measured angles may count from something that moves against the grid, as a clock
        does (`pse_analysis.estimation.filters.angle_reference`).
    compose : Composition
        What the filter is made of; each kind has some of the parts.
    restart : RestartParams
        When the filter starts again.
    consistency : ConsistencyParams
        When its status becomes ``inconsistent``.
    innovation_test : InnovationTest, optional
        Numbers of ``screening = "innovation"``; as for the noise by default.
    smooth : bool
        Whether every instant is also estimated from all of them, the later ones included; stands
        in the tables as the method ``NAME_smoothed``.
    ahead : tuple of int
        Steps ahead of which forecasts are made; these stand as ``NAME_ahead_N``.
    """

    parts: ClassVar[tuple[str, ...]] = ()
    """Parts of ``compose`` that the filter has."""

    noise: Literal["load", "scalar", "innovation"] = "load"
    variance: float | None = None
    source_sigma: float | None = None
    history: HistoryParams | None = None
    angle_reference: Literal["moving", "fixed"] = "moving"
    compose: Composition = field(default_factory=Composition)
    restart: RestartParams = field(default_factory=RestartParams)
    consistency: ConsistencyParams = field(default_factory=ConsistencyParams)
    innovation_test: InnovationTest | None = None
    smooth: bool = False
    ahead: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        variance = VARIANCE if self.variance is None else self.variance
        sigma = 0.0 if self.source_sigma is None else self.source_sigma
        if not (0 < variance < math.inf and 0 <= sigma < math.inf):
            raise ParameterError(
                f"[estimate.methods] {self.name!r}: expected variance > 0 and source_sigma ≥ 0, "
                f"both finite, received {self.variance} and {self.source_sigma}"
            )
        if not all(1 <= steps <= MOST_AHEAD for steps in self.ahead) or (
            len(set(self.ahead)) < len(self.ahead)
        ):
            raise ParameterError(
                f"[estimate.methods] {self.name!r}: expected ahead to list different numbers of "
                f"steps in 1 … {MOST_AHEAD}, received {list(self.ahead)}"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which it stands in tables."""
        return (
            self.name,
            *((variants.smoothed_name(self.name),) if self.smooth else ()),
            *(variants.ahead_name(self.name, steps) for steps in self.ahead),
        )

    def without_effect(self) -> Iterator[tuple[str, str]]:
        yield from super().without_effect()
        if self.variance is not None and self.noise != "scalar":
            yield "variance", 'take noise = "scalar"'
        for key in ("source_sigma", "history"):
            if getattr(self, key) is not None and self.noise != "load":
                yield key, 'take noise = "load"'
        if self.innovation_test is not None and self.screening != "innovation":
            yield "innovation_test", 'take screening = "innovation"'
        plain = Composition()
        for part in fields(Composition):
            if part.name not in self.parts and (
                getattr(self.compose, part.name) != getattr(plain, part.name)
            ):
                owners = [
                    name
                    for name, other in KINDS.items()
                    if issubclass(other, GridFilter) and part.name in other.parts
                ]
                yield f"compose.{part.name}", f"take filter = {spelt(owners)}"

    def unscreened(self, setting: Setting) -> Estimator:
        return restart.guarded(self.unguarded(setting), setting.layout, self.restart)

    def reference(self, layout: SensorLayout) -> AngleReference | None:
        """How the reference of measured angles moves; None where it stands still, or none is."""
        moving = self.angle_reference == "moving" and layout.has_angle
        return AngleReference(layout) if moving else None

    def unguarded(self, setting: Setting) -> Estimator:
        """The filter without its restarts."""
        raise NotImplementedError(f"{type(self).__name__} has no estimator")

    def refuse(self) -> Refuse | None:
        """The innovation test, if one is asked for."""
        if self.screening != "innovation":
            return None
        # One variance for all voltages is chosen above whatever they do; loads surprise what is
        # learnt.
        usual = InnovationTest(forecast_inflation=1.0) if self.noise == "scalar" else None
        return refuse(self.innovation_test or usual)

    def known_noise(self, setting: Setting) -> ProcessNoise:
        """Process noise of [e; f], learnt or given."""
        network = setting.network
        if self.noise == "scalar":
            return load_noise.scalar_noise(
                network, VARIANCE if self.variance is None else self.variance
            )
        learning = self.history or HistoryParams()
        learnt = learn_from_history.learn_load(
            setting.history,
            setting.layout,
            network,
            setting.study.step_s,
            slot_s=learning.slot_s,
            bandwidth_s=learning.bandwidth_s,
            source=self.source_sigma,
        )
        return load_noise.load_noise(network, learnt)


@named("kalman")
@dataclass(frozen=True, kw_only=True)
class KalmanFilter(GridFilter):
    """Kalman filter in rectangular coordinates; see `pse_analysis.estimation.filters.kalman`.

    Attributes
    ----------
    reading : {"interval", "instant"}
        Whether a sample is read over the interval that it covers, once, or as a value of the
        present instant, as often as it stands there.
    linearisation : {"derivative", "transform"}
        Whether the filter follows the whole derivative of a power, or reads it as a current that is
        fixed in the frame of the predicted voltage, as [qi2025] does. The latter claims to know the
        angle that all buses share, which powers do not tell.
    window : float, optional
        Steps after which the weight of an innovation has faded to 1/e, for ``noise =
        "innovation"``; 18 by default.
    """

    parts: ClassVar[tuple[str, ...]] = ("process", "holt")

    reading: Literal["interval", "instant"] = "interval"
    linearisation: Linearisation = "derivative"
    window: float | None = None

    def without_effect(self) -> Iterator[tuple[str, str]]:
        yield from super().without_effect()
        if self.window is not None and self.noise != "innovation":
            yield "window", 'take noise = "innovation"'

    def unguarded(self, setting: Setting) -> Estimator:
        network, layout, history = setting.network, setting.layout, setting.history
        noise: ProcessNoise | CovarianceMatching
        if self.noise == "innovation":
            usual = covariance_matching.usual_injections(history, layout, network)
            window = covariance_matching.WINDOW if self.window is None else self.window
            noise = covariance_matching.of_loads(network, usual, window)
        else:
            noise = self.known_noise(setting)
        return kalman_filter(
            self.name,
            network,
            layout,
            noise,
            step_s=setting.study.step_s,
            reach_s=intervals.usual_reach(history, layout, setting.study.step_s),
            instant=self.reading == "instant",
            smooth=self.smooth,
            refuse=self.refuse(),
            process=composition.process_of(self.compose),
            linearisation=self.linearisation,
            reference=self.reference(layout),
            prior=start_prior(network, layout, history),
        )


@dataclass(frozen=True, kw_only=True)
class PolarFilter(GridFilter):
    """A filter in polar coordinates, made of the parts in ``compose``."""

    def without_effect(self) -> Iterator[tuple[str, str]]:
        yield from super().without_effect()
        if self.noise == "innovation":
            yield 'noise = "innovation"', 'take filter = "kalman"'
        if self.screening == "innovation" and self.compose.robustness != "none":
            yield 'screening = "innovation"', 'take compose.robustness = "none": both judge it'

    def unguarded(self, setting: Setting) -> Estimator:
        network, layout = setting.network, setting.layout
        noise: VoltageNoise
        if self.noise == "scalar":
            noise = composition.scalar(
                network, layout, VARIANCE if self.variance is None else self.variance
            )
        else:
            noise = of_grid(network, self.known_noise(setting), state_columns(network, layout))
        observation: Literal["ukf", "ekf"] = "ukf" if "points" in self.parts else "ekf"
        return composition.build(
            self.name,
            observation,
            self.compose,
            network,
            layout,
            noise,
            self.refuse(),
            self.reference(layout),
            start_prior(network, layout, setting.history),
        )


_COMMON = tuple(
    part.name
    for part in fields(Composition)
    if part.name not in ("scaling", "form", "points", "passes")
)


@named("ukf")
@dataclass(frozen=True, kw_only=True)
class UnscentedFilter(PolarFilter):
    """Unscented Kalman filter; see `pse_analysis.estimation.filters.unscented`."""

    parts: ClassVar[tuple[str, ...]] = (*_COMMON, "scaling", "form", "points")


@named("ekf")
@dataclass(frozen=True, kw_only=True)
class ExtendedFilter(PolarFilter):
    """Extended Kalman filter; see `pse_analysis.estimation.filters.linearised`."""

    parts: ClassVar[tuple[str, ...]] = (*_COMMON, "passes")


@named("observer")
@dataclass(frozen=True, kw_only=True)
class Observer(Method):
    """Observer of a machine; see `pse_analysis.estimation.machine`.

    Attributes
    ----------
    observer : ObserverParams
        What it is designed from.
    """

    about: ClassVar[str] = "machine"

    observer: machine.ObserverParams

    def estimator(self, setting: Setting) -> Estimator:
        if not isinstance(setting.model, Machine):
            raise ParameterError(
                f"method {self.name!r} observes a machine, but the case has a grid: use wls, "
                "kalman, ukf or ekf"
            )
        return machine.from_params(self.name, setting.model, self.observer, setting.study.step_s)
