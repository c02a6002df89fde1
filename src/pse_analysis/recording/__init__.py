"""Recordings of a case for the Rerun viewer: one ``.rrd`` per stage, read from its tables."""

from __future__ import annotations

from pse_analysis.recording.alignment import aligned
from pse_analysis.recording.detection import detected
from pse_analysis.recording.estimates import estimated
from pse_analysis.recording.machine import machine_estimated, machine_scored
from pse_analysis.recording.scores import scored
from pse_analysis.recording.take import Take
from pse_analysis.recording.telemetry import validated

__all__ = [
    "Take",
    "aligned",
    "detected",
    "estimated",
    "machine_estimated",
    "machine_scored",
    "scored",
    "validated",
]
