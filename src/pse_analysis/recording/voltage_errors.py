"""Errors of |V| by method, instant and bus, as the grid shows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.drawing import method_colours
from pse_analysis.grid.network import Network
from pse_analysis.recording import grid_graph, marks
from pse_analysis.recording.take import Take

UNIT = "10⁻³ p.u."


@dataclass(frozen=True, eq=False)
class VoltageErrors:
    """|error| of |V|, or its own σ where the truth is not known.

    Attributes
    ----------
    network : Network
    by_method : mapping of str to (n_instant, n_bus) DataFrame
        [p.u.]
    largest : float
        End of the colour scale, the same for all methods. [p.u.]
    what : str
        Which of the two it is.
    """

    network: Network
    by_method: Mapping[str, pd.DataFrame]
    largest: float
    what: str

    @classmethod
    def of(cls, vm: pd.DataFrame, true: pd.DataFrame | None, network: Network) -> VoltageErrors:
        """From estimated and true |V|, see `voltages`."""
        buses = [f"bus/{name}" for name in network.buses.name]
        known = None
        if true is not None:
            known = true.pivot_table(index="time_utc", columns="element", values="value")
        shades = {}
        for name in method_colours(vm.method.unique()):
            values = vm[vm.method == name].pivot_table(
                index="time_utc",
                columns="element",
                values="sigma" if known is None else "value",
                dropna=False,
            )
            values = values.reindex(columns=buses)
            if known is not None:
                values = (values - known.reindex(index=values.index, columns=buses)).abs()
            shades[name] = values
        largest = grid_graph.scale_end(pd.concat(shades.values())) if shades else 1.0
        return cls(network, shades, largest, "σ of |V|" if true is None else "error of |V|")

    def views(self, origin: str, more: str = "") -> list[rrb.View]:
        """A view of the grid per method."""
        return [
            grid_graph.view(
                marks.named_path(origin, name), f"{name}: {self.what}{more}", self.network
            )
            for name in self.by_method
        ]

    def draw(self, stream: rr.RecordingStream, origin: str) -> None:
        """Colour the grid of every method."""
        for name, values in self.by_method.items():
            grid_graph.draw(
                stream,
                marks.named_path(origin, name),
                self.network,
                values,
                largest=self.largest,
                scale=1e3,
                unit=UNIT,
            )

    def legend(self) -> str:
        """How to read the colours."""
        end = 1e3 * self.largest
        return (
            f"The colours are those of the time cursor: violet is 0, yellow {end:g} × {UNIT} or "
            f"more, grey not known; the discs below the grid show the scale in steps of "
            f"{end / 5:g}. Point at a bus for its name. Drag the cursor, or press play, to watch "
            "the day."
        )


def voltages(table: pd.DataFrame, take: Take) -> pd.DataFrame:
    """|V| of a table of estimates or of the truth, in order of time."""
    return take.of(table)[lambda rows: rows.quantity == "vm_pu"].sort_values("time_utc")
