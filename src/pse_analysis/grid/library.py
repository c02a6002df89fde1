"""Test grids that come with the package, each a folder of three small tables."""

from __future__ import annotations

import difflib
from importlib import resources

import pandas as pd

from pse_analysis.errors import GridError
from pse_analysis.grid.network import Network

GRIDS = ("ieee14", "ieee30", "ieee33", "ieee57", "ieee118", "ieee300")
"""Names that `load` knows; where each comes from stands in ``tables/SOURCE.md``."""


def load(name: str) -> Network:
    """Load a grid of the library.

    Parameters
    ----------
    name : str
        ``ieee14``, ``ieee30`` (the IEEE one), ``ieee33`` (Baran and Wu, tie lines open),
        ``ieee57``, ``ieee118`` or ``ieee300``.

    Raises
    ------
    GridError
        If there is no such grid.
    """
    if name not in GRIDS:
        close = difflib.get_close_matches(name, GRIDS, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise GridError(
            f"no grid {name!r} in the library: {hint}expected any of {', '.join(GRIDS)}"
        )
    folder = resources.files("pse_analysis.grid") / "tables" / name
    tables = {}
    for table in ("network", "buses", "branches"):
        with resources.as_file(folder / f"{table}.csv") as path:
            tables[table] = pd.read_csv(path)
    return Network.from_tables(**tables)
