"""Alignment: validated telemetry of all sources onto the instants of estimation."""

from __future__ import annotations

from pse_analysis.alignment import dtw, pseudo_measurements, stamps
from pse_analysis.alignment.fusion import AlignParams, Variant, align

__all__ = ["AlignParams", "Variant", "align", "dtw", "pseudo_measurements", "stamps"]
