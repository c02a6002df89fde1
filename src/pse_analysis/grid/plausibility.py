"""Whether the numbers of a grid can be what their unit says."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from pse_analysis.errors import GridError
from pse_analysis.grid.elements import Branches, Buses, BusKind

VN_KV = (1e-3, 1500.0)
"""Rated voltages, from a laboratory's to above the highest in operation, 1150 kV. [kV]"""
LARGEST = 1e12
"""Magnitude that nothing in a grid exceeds, in any unit."""
LEAST_IMPEDANCE_PU = 1e-12
"""Series impedance below which two buses are one. [p.u.]"""
TAP = (1e-2, 1e2)
"""Ratios of transformers, whose rated ratio is taken out."""
SETTING_PU = (0.1, 3.0)
"""Voltages that a generator may be told to hold. [p.u.]"""

_UNLIMITED = ("q_min_mvar", "q_max_mvar")


def check_plausible(name: str, buses: Buses, branches: Branches) -> None:
    """Refuse values that are not finite or that no grid has in the unit of their column.

    Parameters
    ----------
    name
        Of the grid, for messages.
    buses, branches
        Its tables.

    Raises
    ------
    GridError
        With the element, the value, what was expected and what to do.
    """
    short = (
        branches.in_service
        & (np.abs(branches.r_pu) < LEAST_IMPEDANCE_PU)
        & (np.abs(branches.x_pu) < LEAST_IMPEDANCE_PU)
    )
    if short.any():
        culprit = branches.name[int(np.argmax(short))]
        raise GridError(f"{name}: branch {culprit!r} has zero impedance: merge its buses instead")
    for table, columns in (("buses", buses), ("branches", branches)):
        for field in dataclasses.fields(columns):
            if field.name == "name":
                continue
            values = np.asarray(getattr(columns, field.name), dtype=float)
            if field.name in _UNLIMITED:
                wanted = f"a number: {'-' * (field.name == 'q_min_mvar')}inf where none is known"
                _require(name, columns, field.name, ~np.isnan(values), wanted)
            elif not np.isfinite(values).all():
                at = int(np.argmin(np.isfinite(values)))
                raise GridError(
                    f"{name}: {table}.{field.name} must be finite, {columns.name[at]!r} has "
                    f"{values[at]}"
                )
            size = np.where(np.isinf(values), 0.0, np.abs(values))
            _require(name, columns, field.name, size <= LARGEST, f"at most {LARGEST:g} in size")
    _require(name, buses, "vn_kv", buses.vn_kv > 0, "positive")
    _require(
        name,
        buses,
        "vn_kv",
        (buses.vn_kv >= VN_KV[0]) & (buses.vn_kv <= VN_KV[1]),
        f"{VN_KV[0]:g} … {VN_KV[1]:g} kV: if it is in V, divide it by 1000",
    )
    controlled = buses.kind != BusKind.PQ
    _require(
        name,
        buses,
        "vm_set_pu",
        ~controlled | ((buses.vm_set_pu >= SETTING_PU[0]) & (buses.vm_set_pu <= SETTING_PU[1])),
        f"{SETTING_PU[0]:g} … {SETTING_PU[1]:g} p.u.: if it is in kV, divide it by vn_kv",
    )
    _require(name, branches, "tap", branches.tap > 0, "positive: 1 where there is no transformer")
    _require(
        name,
        branches,
        "tap",
        (branches.tap >= TAP[0]) & (branches.tap <= TAP[1]),
        f"{TAP[0]:g} … {TAP[1]:g}: it is the ratio over the rated ratio, 1 without a transformer",
    )
    _require(
        name,
        branches,
        "shift_rad",
        np.abs(branches.shift_rad) <= 2.0 * np.pi,
        "at most a full turn, 2π rad: if it is in degree, multiply it by π/180",
    )


def _require(
    name: str,
    columns: Buses | Branches,
    field: str,
    good: npt.NDArray[np.bool_],
    wanted: str,
) -> None:
    if good.all():
        return
    at = int(np.argmin(good))
    element = "branch" if isinstance(columns, Branches) else "bus"
    raise GridError(
        f"{name}: {field} of {element} {columns.name[at]!r} must be {wanted}; received "
        f"{getattr(columns, field)[at]}"
    )
