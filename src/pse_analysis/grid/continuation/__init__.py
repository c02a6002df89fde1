"""Continuation power flow: the states of a grid along a loading direction, up to its limit."""

from __future__ import annotations

from pse_analysis.grid.continuation.curve import Curve, EndKind
from pse_analysis.grid.continuation.equations import LoadedGrid
from pse_analysis.grid.continuation.loading import Loading
from pse_analysis.grid.continuation.params import ContinuationParams
from pse_analysis.grid.continuation.tracing import continuation, trace

__all__ = [
    "ContinuationParams",
    "Curve",
    "EndKind",
    "LoadedGrid",
    "Loading",
    "continuation",
    "trace",
]
