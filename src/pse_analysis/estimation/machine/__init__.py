"""Observers of a synchronous machine: gains, what they are worth, and their run on telemetry."""

from pse_analysis.estimation.machine.gain import (
    Finding,
    Poles,
    Tuning,
    continuous_gain,
    discrete_gain,
    findings,
    gain_without_damping,
    require_solvable,
)
from pse_analysis.estimation.machine.observer import ObserverState, observe, observer
from pse_analysis.estimation.machine.stationary_error import (
    ModelError,
    Tuned,
    continuous_covariance,
    discrete_covariance,
    model_error,
    rms,
    tune,
)
from pse_analysis.estimation.machine.study import ObserverParams, from_params, snapshots
from pse_analysis.estimation.machine.trials import Simulated, simulated_rms

__all__ = [
    "Finding",
    "ModelError",
    "ObserverParams",
    "ObserverState",
    "Poles",
    "Simulated",
    "Tuned",
    "Tuning",
    "continuous_covariance",
    "continuous_gain",
    "discrete_covariance",
    "discrete_gain",
    "findings",
    "from_params",
    "gain_without_damping",
    "model_error",
    "observe",
    "observer",
    "require_solvable",
    "rms",
    "simulated_rms",
    "snapshots",
    "tune",
]
