"""The result of a study of a section, as tables and as the one number that counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.grid.continuation.base import BaseState
from pse_analysis.grid.network import Network
from pse_analysis.scoring.transfer_limit.outages import Reached
from pse_analysis.scoring.transfer_limit.sections import Section, SectionPower


@dataclass(frozen=True, eq=False)
class TransferLimit:
    """The maximum allowed power flow of a section, and what it rests on.

    Attributes
    ----------
    section : str
    mapf_mw : float
        The lowest value of all criteria, outages and loading vectors; NaN where one of them could
        not be determined. [MW]
    sigma_mw : float
        Its standard error from the covariance of the base state, by the delta method; NaN without
        one. [MW]
    criterion, contingency, loading, element : str
        Which of them binds, and what meets it first; the contingency is "" without outage.
    base_mw : float
        Power in the base state. [MW]
    irregular_mw : float
        Irregular oscillations ΔP. [MW]
    table : DataFrame
        One row per loading vector, contingency and criterion: ``state`` (found, not_reached,
        unresolved), ``power_mw`` before and ``value_mw`` after margins, ``sigma_mw``,
        ``loading_factor`` λ, ``element``, ``binding``, ``detail``.
    curves : DataFrame
        Nose curves, one row per point.
    gradient : (2N,) ndarray
        Derivative of the limit by the base state [θ; |V|]; zeros without a covariance.
        [MW/rad, MW/p.u.]
    findings : tuple of str
        What a reader should know of, in sentences.
    """

    section: str
    mapf_mw: float
    sigma_mw: float
    criterion: str
    contingency: str
    loading: str
    element: str
    base_mw: float
    irregular_mw: float
    table: pd.DataFrame
    curves: pd.DataFrame
    gradient: FloatArray
    findings: tuple[str, ...]


Row = tuple[str, str, Reached]
"""Loading vector, contingency, and what was found."""


def result(
    network: Network,
    section: Section,
    base: BaseState,
    irregular_mw: float,
    rows: Sequence[Row],
    curves: pd.DataFrame,
    covariance: FloatArray | None,
) -> TransferLimit:
    """Returns the lowest of all criteria, and the tables that show the others."""
    table = pd.DataFrame(
        {
            "loading": loading,
            "contingency": contingency,
            "criterion": str(reached.criterion),
            "state": reached.state,
            "value_mw": reached.power_mw - irregular_mw,
            "sigma_mw": _sigma(reached.power_gradient, covariance),
            "power_mw": reached.power_mw,
            "loading_factor": reached.loading,
            "element": reached.element,
            "detail": reached.detail,
        }
        for loading, contingency, reached in rows
    )
    value = table["value_mw"].where(table["state"] == "found")
    determined = not (table["state"] == "unresolved").any()
    table.insert(3, "binding", (table.index == value.idxmin()) & determined)
    binding = table[table["binding"]].to_dict("records")
    chosen: Mapping[str, Any] = binding[0] if binding else {}
    gradient = rows[int(value.idxmin())][2].power_gradient if determined else None
    return TransferLimit(
        section=section.name,
        mapf_mw=float(chosen.get("value_mw", np.nan)),
        sigma_mw=float(chosen.get("sigma_mw", np.nan)),
        **{
            key: str(chosen.get(key, ""))
            for key in ("criterion", "contingency", "loading", "element")
        },
        base_mw=float(SectionPower(network, section).power_mw(base.x)),
        irregular_mw=irregular_mw,
        table=table.sort_values("value_mw", kind="stable", ignore_index=True),
        curves=curves,
        gradient=np.zeros(2 * network.n_bus) if gradient is None else gradient,
        findings=_findings(network, base, table),
    )


def _sigma(gradient: FloatArray | None, covariance: FloatArray | None) -> float:
    """Standard error of a quantity, by the delta method; NaN where it is not asked for."""
    if gradient is None or covariance is None:
        return np.nan
    return float(np.sqrt(max(float(gradient @ covariance @ gradient), 0.0)))


def _findings(network: Network, base: BaseState, table: pd.DataFrame) -> tuple[str, ...]:
    out = [
        f"no limit is given, because {row.criterion}{_after(row)} along {row.loading}"
        f"{f' ({row.element})' if row.element else ''} is undetermined: {row.detail}"
        for row in table[table["state"] == "unresolved"].itertuples()
    ]
    found = table[table["state"] == "found"]
    if out and len(found):
        least = found.loc[[found["value_mw"].idxmin()]]
        out += [
            f"the lowest of what could be determined is {row.value_mw:.4g} MW, of "
            f"{row.criterion}{_after(row)} along {row.loading}"
            for row in least.itertuples()
        ]
    beyond = np.flatnonzero(base.upper_is_base | base.lower_is_base)
    if len(beyond):
        names = ", ".join(network.buses.name[bus] for bus in beyond[:5])
        out.append(
            f"in the base state {len(beyond)} generators lie beyond their reactive limits and are "
            f"held at what they give: buses {names}{', …' if len(beyond) > 5 else ''}"
        )
    return tuple(out)


def _after(row: Any) -> str:
    return f" after {row.contingency}" if row.contingency else ""
