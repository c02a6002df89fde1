"""Validation of measurements: which samples of the telemetry can be trusted, and why not."""

from pse_analysis.validation import checks, extrapolation, increments, qartod, thresholds
from pse_analysis.validation.default_limits import DefaultLimits
from pse_analysis.validation.periods import wrong_periods
from pse_analysis.validation.rules import Rule, ValidateParams
from pse_analysis.validation.series import check_series
from pse_analysis.validation.stage import validate

__all__ = [
    "DefaultLimits",
    "Rule",
    "ValidateParams",
    "check_series",
    "checks",
    "extrapolation",
    "increments",
    "qartod",
    "thresholds",
    "validate",
    "wrong_periods",
]
