"""How marks are looked at: the time that plots open on, their axes, and views side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.recording.marks import TIMELINE


@dataclass(frozen=True)
class Window:
    """The time that plots open on."""

    start: pd.Timestamp
    end: pd.Timestamp

    def axis(self) -> rrb.TimeAxis:
        """Time axis with a small margin, without which the labels at both ends are cut off."""
        margin = 0.04 * (self.end - self.start)
        bounds = [
            rr.TimeRangeBoundary.absolute(nanos=moment.as_unit("ns").value)
            for moment in (self.start - margin, self.end + margin)
        ]
        return rrb.TimeAxis(view_range=rr.TimeRange(start=bounds[0], end=bounds[1]))

    def plot(
        self,
        origin: str,
        name: str,
        values: npt.ArrayLike,
        *,
        zero: bool = False,
        legend: bool = True,
        contents: Sequence[str] | None = None,
    ) -> rrb.TimeSeriesView:
        """A plot whose vertical axis holds the given values.

        Parameters
        ----------
        origin : str
            Entity path that the plot shows.
        name : str
            Title, with the unit.
        values : array_like
            What must be visible.
        zero : bool
            Whether the axis starts at zero.
        legend : bool
            Whether to name the series.
        contents : sequence of str, optional
            Query of the entities to show; default: everything below the origin.
        """
        v = np.asarray(values, dtype=np.float64)
        v = v[np.isfinite(v)]
        low, high = (float(v.min()), float(v.max())) if v.size else (0.0, 1.0)
        low = 0.0 if zero else low
        margin = 0.06 * (high - low) or 0.05 * max(abs(high), 1e-3)
        return rrb.TimeSeriesView(
            origin=origin,
            contents=contents if contents is not None else "$origin/**",
            name=name,
            axis_x=self.axis(),
            axis_y=rrb.ScalarAxis(range=(low if zero else low - margin, high + margin)),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
        )

    def lanes(self, origin: str, name: str) -> rrb.StateTimelineView:
        """The lanes below an entity path."""
        return rrb.StateTimelineView(origin=origin, name=name, time_view=self.axis())


def page(origin: str, name: str) -> rrb.TextDocumentView:
    """A page of text, see `pse_analysis.recording.marks.page`."""
    return rrb.TextDocumentView(origin=origin, name=name)


def columns(
    *parts: rrb.Container | rrb.View, shares: Sequence[float] | None = None
) -> rrb.Blueprint:
    """What the viewer opens on: columns side by side, the panels at the sides folded away."""
    return rrb.Blueprint(
        rrb.Horizontal(*parts, column_shares=shares),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
    )
