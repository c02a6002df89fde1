"""Figures of the checks: thresholds, extrapolation and what both are worth."""

from __future__ import annotations

from pse_analysis.figures.validation.checks import margins, realised_rates, roc_curves, scheme
from pse_analysis.figures.validation.extrapolation import (
    extrapolated,
    gain_against_autocorrelation,
    share_against_threshold,
    variance_against_k,
)
from pse_analysis.figures.validation.thresholds import densities, risk_curves

__all__ = [
    "densities",
    "extrapolated",
    "gain_against_autocorrelation",
    "margins",
    "realised_rates",
    "risk_curves",
    "roc_curves",
    "scheme",
    "share_against_threshold",
    "variance_against_k",
]
