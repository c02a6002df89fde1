"""Figures and tables of a study, for notebooks and papers.

Every function reads tables; drawings are a `Paper`, a matplotlib figure as wide as one or both
columns of a journal page that also shows itself in a notebook. Nothing here touches matplotlib's
global state.
"""

from __future__ import annotations

from pse_analysis.figures import machine
from pse_analysis.figures.alignment import errors_at_instant, screened, warped
from pse_analysis.figures.filters import curves
from pse_analysis.figures.one_line import grid
from pse_analysis.figures.paper import DOUBLE, SINGLE, Paper
from pse_analysis.figures.scores import (
    consistency,
    coverage_by_hour,
    detection_table,
    errors_by_bus,
    score_table,
)
from pse_analysis.figures.signals import flags, voltage

__all__ = [
    "DOUBLE",
    "SINGLE",
    "Paper",
    "consistency",
    "coverage_by_hour",
    "curves",
    "detection_table",
    "errors_at_instant",
    "errors_by_bus",
    "flags",
    "grid",
    "machine",
    "score_table",
    "screened",
    "voltage",
    "warped",
]
