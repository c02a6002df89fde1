"""Estimators: from aligned telemetry to states with their covariance."""

from pse_analysis.estimation.core.interface import Estimate, Estimator, Info, Snapshot
from pse_analysis.estimation.core.run import Estimated
from pse_analysis.estimation.core.snapshots import Record, record
from pse_analysis.estimation.kinds import (
    ExtendedFilter,
    KalmanFilter,
    LeastSquares,
    Observer,
    UnscentedFilter,
)
from pse_analysis.estimation.methods import EstimateParams, GridMethod, Method, Setting
from pse_analysis.estimation.stage import estimate, true_states

__all__ = [
    "Estimate",
    "EstimateParams",
    "Estimated",
    "Estimator",
    "ExtendedFilter",
    "GridMethod",
    "Info",
    "KalmanFilter",
    "LeastSquares",
    "Method",
    "Observer",
    "Record",
    "Setting",
    "Snapshot",
    "UnscentedFilter",
    "estimate",
    "record",
    "true_states",
]
