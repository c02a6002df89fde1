"""Tables of the raw folder one at a time: who needs the grid need not read the telemetry."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.machine import Machine
from pse_analysis.telemetry import read_model, read_raw_table, read_telemetry


def read_network(raw: Path) -> Network:
    """The grid of a raw folder.

    Raises
    ------
    TableError
        If one of its files is missing or not whole, or the case is about a machine.
    """
    model = read_model(raw)
    if isinstance(model, Machine):
        raise TableError(f"{raw} holds {model.element}, not a grid: use read_model")
    return model


def read_machine(raw: Path) -> Machine:
    """The machine of a raw folder.

    Raises
    ------
    TableError
        If its file is missing or not whole, or the case is about a grid.
    """
    model = read_model(raw)
    if not isinstance(model, Machine):
        raise TableError(f"{raw} holds the grid {model.name}, not a machine: use read_network")
    return model


def find_raw_table(raw: Path, table: str) -> pd.DataFrame | None:
    """Return a table of a raw folder; None where one that only simulations know is not there."""
    if table == "telemetry":
        return read_telemetry(raw)
    if table != "channels" and not (raw / f"{table}.parquet").is_file():
        return None
    return read_raw_table(raw, table)
