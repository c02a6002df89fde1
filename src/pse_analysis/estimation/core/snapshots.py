"""Aligned telemetry as arrays, and as the snapshots that estimators step through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import BoolArray, FloatArray, utc_microseconds
from pse_analysis.errors import TableError
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.measurement import SensorLayout
from pse_analysis.vocabulary import Origin, usable


@dataclass(frozen=True, eq=False)
class Record:
    """Aligned telemetry of one trial as arrays: T instants by m rows of a layout."""

    time: npt.NDArray[np.datetime64]
    z: FloatArray
    sigma: FloatArray
    sigma_age: FloatArray
    available: BoolArray
    fresh: BoolArray
    age_s: FloatArray

    def snapshots(self) -> Iterator[Snapshot]:
        """One snapshot per instant."""
        for t in range(len(self.time)):
            yield Snapshot(
                self.time[t],
                self.z[t],
                self.sigma[t],
                self.sigma_age[t],
                self.available[t],
                self.fresh[t],
                self.age_s[t],
            )

    def between(self, start: np.datetime64 | None, end: np.datetime64 | None) -> Record:
        """The instants in [start, end)."""
        keep = np.ones(len(self.time), dtype=bool)
        if start is not None:
            keep &= self.time >= start
        if end is not None:
            keep &= self.time < end
        return Record(
            *(
                getattr(self, name)[keep]
                for name in ("time", "z", "sigma", "sigma_age", "available", "fresh", "age_s")
            )
        )


def record(
    aligned: pd.DataFrame,
    layout: SensorLayout,
    instants: npt.NDArray[np.datetime64] | None = None,
) -> Record:
    """Arrays from the aligned table of one trial and variant.

    Parameters
    ----------
    aligned : DataFrame
    layout : SensorLayout
    instants : (T,) ndarray of datetime64, optional
        Instants that are there even if no sample is; a filter has to pass through them.

    Raises
    ------
    TableError
        If a channel is not in the layout, or a row stands twice.
    """
    stamps = utc_microseconds(aligned["time_utc"])
    times = np.unique(stamps if instants is None else np.concatenate([stamps, instants]))
    row = np.searchsorted(times, stamps)
    column = pd.Index(layout.channel).get_indexer(aligned["channel"])
    if (column < 0).any():
        name = aligned["channel"].iloc[int(np.argmin(column))]
        raise TableError(
            f"aligned: channel {name!r} is not in the channels table: add it there, or align again"
        )
    if len(np.unique(row * len(layout) + column)) != len(row):
        raise TableError(
            "aligned: a channel stands twice at one instant: expected one trial and one variant"
        )
    shape = (len(times), len(layout))

    def scattered(values: npt.ArrayLike, start: float, kind: type = float) -> npt.NDArray[Any]:
        out: npt.NDArray[Any] = np.full(shape, start, dtype=kind)
        out[row, column] = values
        return out

    good = usable(aligned["flag"].to_numpy())
    return Record(
        time=times,
        z=scattered(aligned["value_pu"], 0.0),
        sigma=scattered(aligned["sigma_pu"], 1.0),
        sigma_age=scattered(aligned["sigma_age_pu"], 0.0),
        available=scattered(good, 0, bool),
        fresh=scattered(good & (aligned["origin"] != Origin.HELD).to_numpy(), 0, bool),
        age_s=scattered(aligned["age_s"], 0.0),
    )
