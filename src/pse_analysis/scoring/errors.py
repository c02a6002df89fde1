"""Errors of the estimated states against the simulated truth."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.vocabulary import Quantity

KEY = ["trial", "time_utc", "element", "quantity"]
METRICS = {
    Quantity.VM_PU: ("vm", "pu", 1.0),
    Quantity.VA_DEGREE: ("va", "rad", np.pi / 180.0),
    Quantity.ROTOR_ANGLE_RAD: ("angle", "rad", 1.0),
    Quantity.ROTOR_SPEED_RAD_S: ("speed", "rad/s", 1.0),
}
"""Short name, unit and factor from the table's unit of each estimated quantity."""


def against_truth(estimated: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """Estimates with the truth and the error beside them.

    Parameters
    ----------
    estimated, truth : DataFrame
        Tables of these names.

    Returns
    -------
    DataFrame
        ``estimated`` with ``true`` and ``error`` (estimate minus truth, angles folded into
        ±180°), in the quantity's unit; estimates that are missing or have no truth are dropped.

    Raises
    ------
    TableError
        If no estimate has a truth, which means that instants or names do not match.
    """
    known = truth.rename(columns={"value": "true"})
    paired = estimated.merge(known, on=KEY, how="inner", validate="many_to_one")
    if paired.empty and len(estimated):
        raise TableError(
            "truth: no row matches an estimate by trial, time_utc, element and quantity: expected "
            f"times like {estimated['time_utc'].iloc[0]}, received "
            f"{truth['time_utc'].iloc[0] if len(truth) else 'none'}"
        )
    paired = paired[paired["value"].notna()].reset_index(drop=True)
    error = paired["value"].to_numpy() - paired["true"].to_numpy()
    angle = (paired["quantity"] == Quantity.VA_DEGREE).to_numpy()
    paired["error"] = np.where(angle, (error + 180.0) % 360.0 - 180.0, error)
    return paired


def of_states(paired: pd.DataFrame, *, by_element: bool = True) -> pd.DataFrame:
    """Mean and largest |error| over elements and instants.

    Parameters
    ----------
    paired : DataFrame
        From `against_truth`.
    by_element : bool
        Whether to add a row per element.

    Returns
    -------
    DataFrame
        Metrics ``vm_error_mean``, ``vm_error_max`` [p.u.], ``va_error_mean``, ``va_error_max``
        [rad] (eq. (30) of [qi2025]), and ``vm_rmse``, ``va_rmse`` (eq. (35) of [qu2018]); the same
        with ``angle`` [rad] and ``speed`` [rad/s] for a machine's rotor.
    """
    rows = []
    for quantity, (name, unit, factor) in METRICS.items():
        part = paired[paired["quantity"] == quantity]
        if part.empty:
            continue
        size = part.assign(error=part["error"].abs() * factor, square=(part["error"] * factor) ** 2)
        keys = [["method", "trial"]] + ([["method", "trial", "element"]] if by_element else [])
        for key in keys:
            grouped = size.groupby(key, sort=True, observed=True)
            values = pd.DataFrame(
                {
                    f"{name}_error_mean": grouped["error"].mean(),
                    f"{name}_error_max": grouped["error"].max(),
                    f"{name}_rmse": np.sqrt(grouped["square"].mean()),
                }
            ).reset_index()
            if "element" not in values:
                values["element"] = ""
            long = values.melt(["method", "trial", "element"], var_name="metric")
            rows.append(long.assign(unit=unit))
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()
