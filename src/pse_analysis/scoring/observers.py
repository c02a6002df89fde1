"""Observers of a machine against theory: stationary error beside its prediction, and settling."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.estimation import Method, Observer
from pse_analysis.estimation.machine import continuous_gain, rms
from pse_analysis.machine import STATES, Densities, Machine

NAMES = dict(zip(STATES, ("angle", "speed"), strict=True))
UNITS = dict(zip(STATES, ("rad", "rad/s"), strict=True))
GAIN_UNITS = dict(zip(STATES, ("1/s", "1/s²"), strict=True))


@dataclass(frozen=True)
class SettlingParams:
    """When an observer counts as settled.

    Attributes
    ----------
    after_s : float
        Instants from here on are the stationary part, whose RMS is compared with theory. [s]
    window_s, share : float
        It is settled at the first instant from which, over this time, this share of the errors
        lies inside ±2σ of theory; 0.954 of a stationary one do. [s, 1]
    """

    after_s: float = 0.0
    window_s: float = 2.0
    share: float = 0.9


@dataclass(frozen=True, eq=False)
class Expected:
    """What theory says of one observer.

    Attributes
    ----------
    gain : (2,) ndarray
        Continuous L. [1/s, 1/s²]
    rms : (2,) ndarray
        Stationary RMS of θ and ω at the telemetry's step. [rad, rad/s]
    """

    gain: FloatArray
    rms: FloatArray


def expect(
    machine: Machine, methods: Iterable[Method], densities: Densities, step_s: float
) -> dict[str, Expected]:
    """Theory of every observer under the true densities, by method."""
    return {
        m.name: Expected(
            continuous_gain(machine, m.observer.tuning).ravel(),
            rms(machine, m.observer.tuning, densities, step_s),
        )
        for m in methods
        if isinstance(m, Observer)
    }


def of_observers(
    paired: pd.DataFrame, expected: Mapping[str, Expected], params: SettlingParams | None = None
) -> pd.DataFrame:
    """Scores that only a machine has.

    Parameters
    ----------
    paired : DataFrame
        From `pse_analysis.scoring.errors.against_truth`.
    expected : mapping of str to Expected
        By method.
    params : SettlingParams, optional

    Returns
    -------
    DataFrame
        For ``angle`` and ``speed``: ``…_rms`` of the stationary part, ``…_rms_theory``,
        ``…_settling`` (NaN if it does not settle) and ``…_gain``, the entry of L.
    """
    params = params or SettlingParams()
    begin = paired["time_utc"].min()
    rows: list[tuple[str, int, str, float, str]] = []
    groups = paired.sort_values("time_utc").groupby(["method", "trial", "quantity"], sort=True)
    for (method, trial, quantity), part in groups:
        if method not in expected or quantity not in STATES:
            continue
        state = STATES.index(quantity)
        name, unit = NAMES[quantity], UNITS[quantity]
        since = (part["time_utc"] - begin).dt.total_seconds().to_numpy()
        error = part["error"].to_numpy()
        late = error[since >= params.after_s]
        sigma = float(expected[method].rms[state])
        found = {
            f"{name}_rms": (float(np.sqrt(np.mean(late**2))) if len(late) else np.nan, unit),
            f"{name}_rms_theory": (sigma, unit),
            f"{name}_settling": (settling_time(since, error, sigma, params), "s"),
            f"{name}_gain": (float(expected[method].gain[state]), GAIN_UNITS[quantity]),
        }
        rows += [(method, trial, metric, value, u) for metric, (value, u) in found.items()]
    table = pd.DataFrame(rows, columns=["method", "trial", "metric", "value", "unit"])
    return table.assign(element="")


def settling_time(
    since_s: FloatArray, error: FloatArray, sigma: float, params: SettlingParams | None = None
) -> float:
    """First time from which errors stay inside ±2σ as often as a stationary one's would.

    Parameters
    ----------
    since_s : (n,) ndarray
        Ascending. [s]
    error : (n,) ndarray
    sigma : float
        Of the stationary error.
    params : SettlingParams, optional

    Returns
    -------
    float
        NaN if there is none. [s]
    """
    params = params or SettlingParams()
    inside = np.concatenate([[0], np.cumsum(np.abs(error) <= 2.0 * sigma)])
    end = np.searchsorted(since_s, since_s + params.window_s, side="left")
    share = (inside[end] - inside[:-1]) / (end - np.arange(len(error)))
    whole = since_s + params.window_s <= since_s[-1] + 1e-9
    first = np.flatnonzero(whole & (share >= params.share))
    return float(since_s[first[0]]) if len(first) else float("nan")
