"""Alignment: validated telemetry of all sources onto the instants of estimation."""

from __future__ import annotations

from pse_analysis.alignment.fusion import AlignParams, align

__all__ = ["AlignParams", "align"]
