"""One seed to the raw case of a machine: ΔM and a noisy rotor angle, with their truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.machine import INPUT, STATES, Densities, Machine
from pse_analysis.parameters import Study, Unbounded
from pse_analysis.simulation import faults
from pse_analysis.simulation.case import sample_tables, utc
from pse_analysis.simulation.machine import GovernorParams, LoadStepParams, disturb, load_step
from pse_analysis.simulation.scenario import SECOND, microseconds
from pse_analysis.simulation.sensors import Samples
from pse_analysis.simulation.settings import LONGEST_S, SHORTEST_S, FaultParams, require_few
from pse_analysis.telemetry import RawCase
from pse_analysis.vocabulary import Aggregation, SigmaKind, Source


@dataclass(frozen=True)
class MachineSimulateParams:
    """Everything that a simulated machine's case is made of; one seed gives the same bytes again.

    Attributes
    ----------
    seed : int
        Of all randomness; a trial does not depend on how many there are.
    densities : Densities
        True ones of the disturbances and of the measured angle's noise.
    trials : int
    period_s : float
        Sampling period of both channels, and the time for which the angle's noise is held: σ of a
        sample is √(density/period). [s]
    every : int
        Disturbances are held for period_s/every.
    start, start_sigma : (2,) tuple of float
        Mean and spread over trials of θ and ω at the begin. [rad, rad/s]
    delta_m_sigma : float
        σ of the noise of ΔM. [p.u.]
    angle_limits, delta_m_limits : (2,) tuple of float
        Credible range of the channels. [rad, p.u.]
    load : LoadStepParams
        Its step is counted from the study's start.
    governor : GovernorParams
    faults : tuple of FaultParams
    """

    seed: int
    densities: Densities
    trials: int = 1
    period_s: float = 0.01
    every: int = 5
    start: tuple[float, float] = (0.0, 0.0)
    start_sigma: tuple[float, float] = (0.0, 0.0)
    delta_m_sigma: float = 1e-4
    angle_limits: tuple[Unbounded, Unbounded] = (-1000.0, 1000.0)
    delta_m_limits: tuple[Unbounded, Unbounded] = (-1.0, 1.0)
    load: LoadStepParams = field(default_factory=LoadStepParams)
    governor: GovernorParams = field(default_factory=GovernorParams)
    faults: tuple[FaultParams, ...] = ()

    def __post_init__(self) -> None:
        for name, low, high in (("seed", 0.0, math.inf), ("trials", 1.0, 1e6), ("every", 1.0, 1e4)):
            if not low <= getattr(self, name) <= high:
                raise ParameterError(
                    f"[simulate] {name} must be ≥ {low:g}, at most {high:g}, received "
                    f"{getattr(self, name)}"
                )
        for name, low, high in (("period_s", SHORTEST_S, LONGEST_S), ("delta_m_sigma", 1e-12, 1e6)):
            if not low <= getattr(self, name) <= high:
                raise ParameterError(
                    f"[simulate] {name} must be above 0, {low:g} … {high:g}, received "
                    f"{getattr(self, name)}"
                )
        for name in ("start", "start_sigma"):
            if not all(math.isfinite(v) for v in getattr(self, name)) or (
                name == "start_sigma" and min(self.start_sigma) < 0
            ):
                raise ParameterError(
                    f"[simulate] {name} must hold two finite numbers"
                    f"{' ≥ 0' if name == 'start_sigma' else ''}, received {getattr(self, name)}"
                )
        density = self.densities
        if not (
            min(density.theta, density.omega) >= 0 < density.angle
            and max(density.theta, density.omega, density.angle) <= 1e12
        ):
            raise ParameterError(
                "[simulate] densities: expected theta ≥ 0, omega ≥ 0 and angle > 0, received "
                f"{self.densities}"
            )


def simulate_machine(machine: Machine, study: Study, params: MachineSimulateParams) -> RawCase:
    """Simulate the telemetry of a machine on load.

    Parameters
    ----------
    machine : Machine
    study : Study
        Telemetry begins ``history_s`` before its start and ends with it.
    params : MachineSimulateParams

    Returns
    -------
    RawCase
        Truth (θ and ω) at the study's instants; telemetry, sample_truth and faults from the start
        of the history on.

    Raises
    ------
    ParameterError
        If the study's step is not a multiple of the sampling period.
    """
    period = round(params.period_s * SECOND)
    step = round(study.step_s * SECOND)
    if step % period or round(study.history_s * SECOND) % period:
        raise ParameterError(
            f"[simulate] period_s = {params.period_s} must divide the study's step_s = "
            f"{study.step_s} and history_s = {study.history_s}: choose e.g. period_s = step_s"
        )
    span = (study.end - study.history_start).total_seconds()
    require_few(2 * params.trials * params.every * span / params.period_s, "values of noise")
    origin, end = microseconds(study.start), microseconds(study.end)
    time = np.arange(microseconds(study.history_start), end, period, dtype=np.int64)
    seconds = (time - origin) / SECOND
    channels = _channels(machine, params)
    studied = np.flatnonzero((time >= origin) & ((time - origin) % step == 0))
    parts: list[tuple[pd.DataFrame, ...]] = []
    for trial, seed in enumerate(np.random.SeedSequence(params.seed).spawn(params.trials)):
        draw_seed, fault_seed = seed.spawn(2)
        rng = np.random.default_rng(draw_seed)
        drawn = rng.normal(params.start, params.start_sigma)
        begin = (float(drawn[0]), float(drawn[1]))
        motion = load_step(machine, params.load, params.governor, seconds, begin)
        response = disturb(
            machine, params.densities, params.period_s, len(time) - 1, 1, rng, every=params.every
        )
        x = motion.x + response.x[:, :, 0]
        truths = np.stack([x[:, 0], motion.delta_m])
        noise = np.stack(
            [response.noise[:, 0], params.delta_m_sigma * rng.standard_normal(len(time))]
        )
        samples = faults.inject(
            _samples(time, truths, noise, channels["sigma"].to_numpy(dtype=float)),
            channels,
            params.faults,
            fault_seed,
        )
        parts.append(
            (
                _truth_table(machine, time[studied], x[studied], trial),
                *sample_tables(samples, channels, np.zeros(len(channels), dtype=bool), trial),
            )
        )
    truth, telemetry, sample_truth, injected = (
        pd.concat(part, ignore_index=True) for part in zip(*parts, strict=True)
    )
    return RawCase(machine, channels, telemetry, truth, sample_truth, injected)


def _channels(machine: Machine, params: MachineSimulateParams) -> pd.DataFrame:
    quantities = [STATES[0], INPUT]
    limits = [params.angle_limits, params.delta_m_limits]
    n = len(quantities)
    return pd.DataFrame(
        {
            "channel": [f"{Source.PMU}:{machine.element}:{q}" for q in quantities],
            "source": str(Source.PMU),
            "quantity": quantities,
            "element": machine.element,
            "side": "",
            "unit": ["rad", "pu"],
            "sigma": [
                float(np.sqrt(params.densities.angle / params.period_s)),
                params.delta_m_sigma,
            ],
            "sigma_kind": str(SigmaKind.ABSOLUTE),
            "lower": [low for low, _ in limits],
            "upper": [high for _, high in limits],
            "period_s": float(params.period_s),
            "sign": np.ones(n, dtype=np.int8),
            "aggregation": str(Aggregation.INSTANT),
        }
    )


def _samples(
    time: npt.NDArray[np.int64], truths: FloatArray, noise: FloatArray, sigma: FloatArray
) -> Samples:
    m, n = truths.shape
    return Samples(
        channel=np.repeat(np.arange(m), n),
        sampled=np.tile(time, m),
        arrival=np.tile(time, m),
        value=(truths + noise).ravel(),
        truth=truths.ravel(),
        sigma=np.repeat(sigma, n),
        kind=np.zeros(m * n, dtype=np.int8),
        size=np.zeros(m * n),
        taken=np.zeros(m * n, dtype=bool),
    )


def _truth_table(
    machine: Machine, time: npt.NDArray[np.int64], x: FloatArray, trial: int
) -> pd.DataFrame:
    n = len(STATES)
    return pd.DataFrame(
        {
            "trial": np.full(x.size, trial, dtype=np.int32),
            "time_utc": utc(np.repeat(time, n)),
            "element": machine.element,
            "quantity": np.tile(np.array(STATES, dtype=object), len(time)),
            "value": x.ravel(),
        }
    )
