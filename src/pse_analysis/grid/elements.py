"""Buses and branches of a grid as columns, with what a table may leave out."""

from __future__ import annotations

import dataclasses
import difflib
import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import GridError
from pse_analysis.vocabulary import as_number, shown

Columns = TypeVar("Columns", "Buses", "Branches")


class BusKind(enum.IntEnum):
    """What power flow holds at a bus: P and Q, P and |V|, or |V| and θ."""

    PQ = 1
    PV = 2
    SLACK = 3


@dataclass(frozen=True, eq=False)
class Buses:
    """Columns of the bus table, each of length n_bus and read-only.

    Attributes
    ----------
    name
        Names as the literature numbers them.
    kind
        Values of `BusKind`.
    vn_kv
        Rated line-to-line voltage. [kV]
    p_load_mw, q_load_mvar
        Nominal load. [MW, Mvar]
    p_gen_mw
        Nominal generation. [MW]
    vm_set_pu
        Voltage set-point of PV and slack buses. [p.u.]
    q_min_mvar, q_max_mvar
        Reactive limits of the generation; ±inf where none are known. [Mvar]
    g_shunt_pu, b_shunt_pu
        Shunt admittance. [p.u.]
    """

    name: tuple[str, ...]
    kind: npt.NDArray[np.int8]
    vn_kv: FloatArray
    p_load_mw: FloatArray
    q_load_mvar: FloatArray
    p_gen_mw: FloatArray
    vm_set_pu: FloatArray
    q_min_mvar: FloatArray
    q_max_mvar: FloatArray
    g_shunt_pu: FloatArray
    b_shunt_pu: FloatArray


@dataclass(frozen=True, eq=False)
class Branches:
    """Columns of the branch table, each of length n_branch and read-only.

    Attributes
    ----------
    name
        ``from-to``; a parallel circuit carries ``#2``, ``#3``, …
    from_bus, to_bus
        Positions of the end buses.
    r_pu, x_pu, g_pu, b_pu
        Series impedance and total charging admittance. [p.u.]
    tap
        Ratio at the from end; 1 where there is no transformer.
    shift_rad
        Phase shift at the from end. [rad]
    in_service
        Whether the branch is closed at both ends.
    """

    name: tuple[str, ...]
    from_bus: IntArray
    to_bus: IntArray
    r_pu: FloatArray
    x_pu: FloatArray
    g_pu: FloatArray
    b_pu: FloatArray
    tap: FloatArray
    shift_rad: FloatArray
    in_service: npt.NDArray[np.bool_]


_TYPES: Mapping[str, type[np.generic]] = MappingProxyType(
    {"from_bus": np.int64, "to_bus": np.int64, "in_service": np.bool_, "kind": np.int8}
)
_CODES: Mapping[str, tuple[tuple[int, ...], str]] = MappingProxyType(
    {"in_service": ((0, 1), "true or false"), "kind": ((1, 2, 3), "1, 2 or 3: PQ, PV or slack")}
)
_WORDS = MappingProxyType({"true": 1.0, "yes": 1.0, "false": 0.0, "no": 0.0})

OPTIONAL: Mapping[str, float | bool] = MappingProxyType(
    {
        "p_load_mw": 0.0,
        "q_load_mvar": 0.0,
        "p_gen_mw": 0.0,
        "vm_set_pu": 1.0,
        "q_min_mvar": -np.inf,
        "q_max_mvar": np.inf,
        "g_shunt_pu": 0.0,
        "b_shunt_pu": 0.0,
        "g_pu": 0.0,
        "b_pu": 0.0,
        "tap": 1.0,
        "shift_rad": 0.0,
        "in_service": True,
    }
)
"""Value of the columns of buses and branches that a table may leave out."""

ALIKE = 0.85
"""Similarity of names from which one is taken for the other misspelt."""


def branch_names(branches: pd.DataFrame) -> list[str]:
    """Names by their ends, with a number behind the second of parallel ones and on."""
    ends = branches["from_bus"].astype(str) + "-" + branches["to_bus"].astype(str)
    copy = ends.groupby(ends).cumcount() + 1
    return [end if k == 1 else f"{end}#{k}" for end, k in zip(ends, copy, strict=True)]


def freeze(columns: Columns) -> None:
    """Give every column its type, one length, and no way to be written to."""
    length = len(columns.name)
    for field in dataclasses.fields(columns):
        if field.name == "name":
            object.__setattr__(columns, "name", tuple(map(str, columns.name)))
            continue
        values = np.asarray(getattr(columns, field.name))
        if values.shape != (length,):
            raise GridError(
                f"{type(columns).__name__}.{field.name}: expected {length} values, one per name, "
                f"received shape {values.shape}"
            )
        array = _numbers(columns, field.name, values).astype(_TYPES.get(field.name, np.float64))
        array.flags.writeable = False
        object.__setattr__(columns, field.name, array)


def _numbers(columns: Columns, field: str, values: npt.NDArray[Any]) -> FloatArray:
    """The values as numbers, also those that a table spells as text."""
    codes, wanted = _CODES.get(field, ((), "a number"))
    numbers = np.full(values.shape, np.nan)
    refused = np.zeros(values.shape, dtype=bool)
    if values.dtype.kind in "biuf":
        numbers[:] = values
    else:
        for at, value in enumerate(values):
            word = str(value).strip().lower()
            try:
                numbers[at] = _WORDS[word] if codes and word in _WORDS else as_number(value)
            except (TypeError, ValueError, OverflowError):
                refused[at] = True
    if field in ("from_bus", "to_bus"):
        wanted = "the position of a bus"
        refused |= ~(np.abs(numbers) < 2**53) | (numbers != np.rint(numbers))
    if codes:
        refused |= ~np.isin(numbers, codes)
    if refused.any():
        at = int(np.argmax(refused))
        element = "branch" if isinstance(columns, Branches) else "bus"
        comma = "," in str(values[at])
        raise GridError(
            f"{field} of {element} {columns.name[at]!r} must be {wanted}; received "
            f"{shown(values[at])}"
            + ("; read decimal commas with pandas.read_csv(decimal=',')" if comma else "")
        )
    return numbers


def check_spelling(table: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Refuse a column that looks like one that is known and not given.

    Raises
    ------
    GridError
        With both names; a column that resembles none is the user's own.
    """
    given, known = [str(name) for name in given], list(known)
    absent = [name for name in known if name not in given]
    # b_shunt_pu without g_shunt_pu is no misspelling of it.
    for column in (name for name in given if name not in known):
        word = column.strip().lower()
        for name in absent:
            first = name.split("_")[0]
            if (
                difflib.SequenceMatcher(None, word, name).ratio() >= ALIKE
                or (len(first) > 2 and word.split("_")[0] == first)
                or (len(word) > 2 and name.startswith(word))
            ):
                raise GridError(
                    f"grid table {table!r}: unknown column {column!r}: did you mean {name!r}? "
                    "Rename it (with that unit), or leave it out if it is something else"
                )
