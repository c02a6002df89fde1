"""Buses and branches from the tables that describe a grid."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pandas as pd

from pse_analysis.errors import GridError
from pse_analysis.grid.elements import OPTIONAL, Branches, Buses, branch_names, check_spelling
from pse_analysis.vocabulary import as_number, plain_columns, shown, unwritable


def read_tables(
    network: pd.DataFrame, buses: pd.DataFrame, branches: pd.DataFrame
) -> tuple[str, float, Buses, Branches]:
    """Name, base power, buses and branches of `pse_analysis.grid.Network.from_tables`.

    Raises
    ------
    GridError
        On a missing, repeated or misspelt column, a value that is no number, a name that is empty
        or repeats, or a branch that ends at an unknown bus.
    """
    own = {
        "network": ["name", "base_mva"],
        "buses": [f.name for f in dataclasses.fields(Buses)],
        "branches": [f.name for f in dataclasses.fields(Branches)],
    }
    network, buses, branches = (
        plain_columns(f"grid table {table!r}", frame, own[table], error=GridError)
        for table, frame in (("network", network), ("buses", buses), ("branches", branches))
    )
    for table, frame in (("buses", buses), ("branches", branches)):
        check_spelling(table, frame.columns, [name for name in own[table] if name != "name"])
    buses, branches = (
        frame.assign(
            **{k: v for k, v in OPTIONAL.items() if k in own[table] and k not in frame.columns}
        )
        for table, frame in (("buses", buses), ("branches", branches))
    )
    if "name" not in branches and {"from_bus", "to_bus"} <= set(branches.columns):
        branches = branches.assign(name=branch_names(branches))
    for table, frame in (("network", network), ("buses", buses), ("branches", branches)):
        missing = [n for n in own[table] if n not in frame.columns]
        if missing:
            raise GridError(
                f"grid table {table!r}: column {missing[0]!r} is missing; expected "
                f"{', '.join(own[table])}; received {', '.join(map(str, frame.columns))}"
            )
    if len(network) != 1:
        raise GridError(f"grid table 'network': expected one row, received {len(network)}")
    names = _names("buses", "bus", buses)
    position = {n: i for i, n in enumerate(names)}
    ends: dict[str, Any] = {}
    for end in ("from_bus", "to_bus"):
        labels = branches[end].astype(str)
        unknown = [b for b in labels if b not in position]
        if unknown:
            raise GridError(
                f"grid table 'branches': {end} {unknown[0]!r} is no bus; expected a name of "
                f"grid table 'buses', as {', '.join(names[:6])}"
            )
        ends[end] = np.array([position[b] for b in labels], dtype=np.int64)
    given = network["base_mva"].iloc[0]
    try:
        base_mva = as_number(given)
    except (TypeError, ValueError, OverflowError) as error:
        raise GridError(
            f"grid table 'network': base_mva must be a number, received {shown(given)}"
        ) from error
    bus_columns = {name: buses[name].to_numpy() for name in own["buses"] if name != "name"}
    branch_columns = {
        name: branches[name].to_numpy()
        for name in own["branches"]
        if name not in ("name", "from_bus", "to_bus")
    }
    return (
        str(network["name"].iloc[0]),
        base_mva,
        Buses(name=names, **bus_columns),
        Branches(name=_names("branches", "branch", branches), **ends, **branch_columns),
    )


def _names(table: str, element: str, frame: pd.DataFrame) -> tuple[str, ...]:
    """Names as texts, each of them there, once, and fit to be written."""
    given = frame["name"]
    if given.isna().any():
        raise GridError(
            f"grid table {table!r}: name is empty in row {int(np.argmax(given.isna()))}: "
            f"name that {element}, or leave it out"
        )
    names = tuple(given.astype(str))
    if len(set(names)) != len(names):
        repeated = given.astype(str)[given.astype(str).duplicated().to_numpy()].iloc[0]
        raise GridError(
            f"grid table {table!r}: name {repeated!r} repeats: give each {element} its own"
        )
    damaged = unwritable(names)
    if damaged or "" in names:
        raise GridError(
            f"grid table {table!r}: {(damaged or [''])[0]!r} is no name: expected a text of "
            "printable characters"
        )
    return names
