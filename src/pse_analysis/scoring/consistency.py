"""Whether a filter is as sure as it should be: NIS, NEES and the coverage of ±2σ."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from pse_analysis.scoring.errors import METRICS
from pse_analysis.vocabulary import Status

NOMINAL_COVERAGE = float(stats.norm.cdf(2.0) - stats.norm.cdf(-2.0))
"""Share of a normal variable inside ±2σ, 0.954."""


def bounds(dof: float, confidence: float = 0.99) -> tuple[float, float]:
    """Bounds of NIS/dof (or NEES/dof) for a filter's own model.

    Parameters
    ----------
    dof : float
        Degrees of freedom summed over steps (NIS) or trials (NEES).
    confidence : float
        Probability inside the two-sided bounds.

    Returns
    -------
    low, high : float
    """
    tail = 0.5 * (1.0 - confidence)
    low, high = stats.chi2.ppf([tail, 1.0 - tail], dof) / dof
    return float(low), float(high)


def of_steps(steps: pd.DataFrame, estimated: pd.DataFrame, *, by_hour: bool = True) -> pd.DataFrame:
    """Consistency and cost of every method and trial.

    Parameters
    ----------
    steps, estimated : DataFrame
        Tables of these names; from the second come the degrees of freedom of NEES, which are the
        states that have a σ.
    by_hour : bool
        Whether to add NIS by hour of day.

    Returns
    -------
    DataFrame
        Metrics ``nis_ratio`` (ΣNIS/Σm), ``nees_ratio`` (ΣNEES/Σn), ``steps_not_ok`` and
        ``seconds``. Both ratios are 1 where the filter knows how sure it may be.
    """
    judged = steps["nis"].notna() & (steps["dof"] > 0)
    table = steps.assign(
        nis=steps["nis"].where(judged),
        dof=steps["dof"].where(judged),
        not_ok=(steps["status"] != Status.OK).astype(float),
        element=_hour(steps["time_utc"]),
    )
    key = ["method", "trial"]
    free = estimated[estimated["sigma"] > 0].groupby([*key, "time_utc"], observed=True).size()
    table = table.merge(free.rename("n").reset_index(), on=[*key, "time_utc"], how="left")
    table["n"] = table["n"].where(table["nees"].notna())
    whole = table.groupby(key, sort=True)
    rows = [
        _long(whole["nis"].sum(min_count=1) / whole["dof"].sum(min_count=1), "nis_ratio", "1"),
        _long(whole["nees"].sum(min_count=1) / whole["n"].sum(min_count=1), "nees_ratio", "1"),
        _long(whole["not_ok"].sum(), "steps_not_ok", "1"),
        _long(whole["seconds"].sum(), "seconds", "s"),
    ]
    if by_hour:
        hourly = table.groupby([*key, "element"], sort=True)
        rows.append(
            _long(hourly["nis"].sum(min_count=1) / hourly["dof"].sum(min_count=1), "nis_ratio", "1")
        )
    return pd.concat(rows, ignore_index=True)


def coverage(paired: pd.DataFrame, *, by_hour: bool = True) -> pd.DataFrame:
    """Share of the truth inside ±2σ of the estimate; 0.954 where σ is right.

    Parameters
    ----------
    paired : DataFrame
        From `pse_analysis.scoring.errors.against_truth`.
    by_hour : bool
        Whether to add rows by hour of day.

    Returns
    -------
    DataFrame
        Metrics ``coverage_vm`` and ``coverage_va``, of a rotor ``coverage_angle`` and
        ``coverage_speed``. Exact zeros of σ (a reference angle that is fixed) do not count.
    """
    rows: list[pd.DataFrame] = []
    free = paired[paired["sigma"] > 0]
    table = free.assign(
        inside=(free["error"].abs() <= 2.0 * free["sigma"]).astype(float),
        element=_hour(free["time_utc"]),
    )
    for quantity, (name, _, _) in METRICS.items():
        part = table[table["quantity"] == quantity]
        if part.empty:
            continue
        keys = [["method", "trial"]] + ([["method", "trial", "element"]] if by_hour else [])
        rows.extend(
            _long(part.groupby(key, sort=True)["inside"].mean(), f"coverage_{name}", "1")
            for key in keys
        )
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


def _hour(times: pd.Series) -> npt.NDArray[np.object_]:
    """``hour/00`` … ``hour/23`` of UTC times."""
    names = np.array([f"hour/{hour:02d}" for hour in range(24)], dtype=object)
    return np.asarray(names[times.dt.tz_convert("UTC").dt.hour.to_numpy()])


def _long(values: pd.Series, metric: str, unit: str) -> pd.DataFrame:
    table = values.rename("value").astype(np.float64).reset_index()
    if "element" not in table:
        table["element"] = ""
    return table.assign(metric=metric, unit=unit)
