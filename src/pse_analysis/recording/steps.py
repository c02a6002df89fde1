"""What recordings of estimates share, of a grid or of a machine: samples, and how steps ended."""

from __future__ import annotations

import pandas as pd
import rerun as rr

from pse_analysis.drawing import GREEN, GREY, ORANGE, SOURCES, VERMILION
from pse_analysis.recording import marks

_STATUS = {"ok": GREEN, "predicted": GREY, "restarted": ORANGE, "partly_observable": ORANGE}


def draw_statuses(stream: rr.RecordingStream, steps: pd.DataFrame) -> None:
    """A lane per method below ``status``: how each of its steps ended."""
    for name, one in steps.groupby("method", sort=False):
        colours = {s: _STATUS.get(s, VERMILION) for s in one.status.unique()}
        times = pd.DatetimeIndex(one.time_utc)
        marks.lane(
            stream, marks.named_path("status", str(name)), times, one.status.tolist(), colours
        )


def draw_measured(
    stream: rr.RecordingStream, entity: str, samples: pd.DataFrame, size: float
) -> None:
    """Dots of measured values, an entity per source."""
    for source, part in samples.groupby("source", sort=False):
        dots = marks.named(f"measured, {source}", part.time_utc, part.value_pu)
        colour = SOURCES.get(str(source), GREY)
        marks.dots(stream, f"{entity}/{source}", dots, [colour], size)
