"""Try the checks on loads whose gross errors are known: realised rates, risk and ROC.

The paper's plant load is not published. `generated_load` draws one with the increments its results
imply (ρ₁ = 0.5, so k_opt = 0.5 and a gain of 25 %); any other load can take its place.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.signal import lfilter

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.validation.block import RULED_OUT, Criteria, screen
from pse_analysis.validation.increments import Structure
from pse_analysis.validation.motion import Motion

CHECKS = ("limits", "increment", "extrapolation", "combination")


class Faulty(NamedTuple):
    """A load with gross errors and what is true of it; arrays of one shape.

    Attributes
    ----------
    value : ndarray
        With the errors. [unit]
    bad : ndarray of bool
        Where they are.
    size : ndarray
        Their size, 0 elsewhere. [unit]
    """

    value: FloatArray
    bad: BoolArray
    size: FloatArray


class Rates(NamedTuple):
    """Realised error rates of a check with their standard errors.

    Attributes
    ----------
    false_alarm, miss : float
        Shares of flagged good and of unflagged bad samples; NaN where there are none.
    false_alarm_error, miss_error : float
        Their binomial standard errors.
    """

    false_alarm: float
    miss: float
    false_alarm_error: float
    miss_error: float


def generated_load(
    n: int,
    rng: np.random.Generator,
    *,
    rho: float = 0.5,
    sigma: float = 1.0,
    level: float = 0.0,
    n_channel: int = 1,
) -> FloatArray:
    """Loads whose increments are AR(1), (n, n_channel). [unit]

    Parameters
    ----------
    n : int
        Samples.
    rng : Generator
    rho : float
        ρ₁ of the increments.
    sigma : float
        Their standard deviation. [unit]
    level : float
        Value before the first sample. [unit]
    n_channel : int
    """
    drawn = rng.standard_normal((n, n_channel))
    # The first increment is drawn from the stationary law, so no run-up has to be thrown away.
    drawn[1:] *= np.sqrt(1.0 - rho**2)
    change = lfilter([1.0], [1.0, -rho], drawn, axis=0)
    return np.asarray(level + sigma * np.cumsum(change, axis=0))


def with_errors(
    value: FloatArray, rng: np.random.Generator, *, share: float, largest: float
) -> Faulty:
    """The load with a share of its samples off by U(−largest, largest)."""
    x = np.asarray(value, dtype=float)
    bad = rng.random(x.shape) < share
    size = np.where(bad, rng.uniform(-largest, largest, x.shape), 0.0)
    return Faulty(x + size, bad, size)


def criteria(
    check: str,
    quantile: float,
    structure: Structure,
    *,
    lower: float | FloatArray = np.nan,
    upper: float | FloatArray = np.nan,
    confirm: int = 2,
) -> Criteria:
    """One check alone, or all of them, at k = γ/σ.

    Parameters
    ----------
    check : str
        Any of `CHECKS`; ``combination`` is limits, increment and extrapolation together.
    quantile : float
        Threshold over the σ of the check's own statistic; inf makes neither of the two.
    structure : Structure
        Learnt from the load's history.
    lower, upper : float or (n_channel,)
        Limits, of the checks that include them. [unit]
    confirm : int
        Samples that must agree with a flagged one before a step is accepted.
    """
    n = len(structure.variance)
    if check not in CHECKS:
        raise ValueError(f"unknown check {check!r}: expected any of {', '.join(CHECKS)}")
    off, on = np.full(n, np.inf), np.full(n, float(quantile))
    plain = check in ("increment", "combination")
    sharp = check in ("extrapolation", "combination")
    bounded = check in ("limits", "combination")
    motion = Motion(
        structure=structure.variance,
        k=structure.autocorrelation[:, 0] if sharp else np.zeros(n),
        increment=on if plain else off,
        extrapolation=on if sharp else off,
        confirm=np.full(n, confirm),
    )
    return Criteria(
        lower=np.broadcast_to(np.asarray(lower if bounded else np.nan, dtype=float), (n,)),
        upper=np.broadcast_to(np.asarray(upper if bounded else np.nan, dtype=float), (n,)),
        motion=motion,
        stuck=np.zeros(n, dtype=np.int64),
        stuck_at_zero=np.zeros(n, dtype=bool),
    )


def flagged(value: FloatArray, checked: Criteria) -> BoolArray:
    """Samples that the checks rule out, as they would be online."""
    found = screen(value, np.arange(len(value)), checked, detail=False)
    return np.asarray((found.reasons & RULED_OUT) != 0)


def flagged_given_references(value: FloatArray, checked: Criteria) -> BoolArray:
    """Flags of the third row where the first two are taken as references whatever they are.

    The closed forms hold given good reference samples: each channel is then one draw.

    Parameters
    ----------
    value : (3, n_channel)
        Two good samples and the one to be judged. [unit]
    checked : Criteria
        Without limits.
    """
    open_then_closed = np.array([[1e9], [1e9], [1.0]])
    found = screen(value, np.arange(3), checked, scale=open_then_closed, detail=False)
    return np.asarray((found.reasons[2] & RULED_OUT) != 0)


def rates(flags: BoolArray, bad: BoolArray) -> Rates:
    """Realised false-alarm and miss rates."""
    shares, errors = [], []
    for hits in (flags[~bad], ~flags[bad]):
        share = float(hits.mean()) if hits.size else np.nan
        shares.append(share)
        errors.append(float(np.sqrt(share * (1.0 - share) / hits.size)) if hits.size else np.nan)
    return Rates(shares[0], shares[1], errors[0], errors[1])


def cost(flags: BoolArray, bad: BoolArray, cost_ratio: float = 1.0) -> FloatArray:
    """Cost of each decision, in units of a false alarm; its mean is the realised risk (8)."""
    return np.where(bad, cost_ratio * ~flags, 1.0 * flags)


def roc(
    faulty: Faulty,
    structure: Structure,
    quantiles: npt.ArrayLike,
    *,
    limits: Mapping[float, tuple[float, float]] | None = None,
) -> pd.DataFrame:
    """Detection against false alarms for each check over a range of thresholds.

    Parameters
    ----------
    faulty : Faulty
        Of shape (n, n_channel).
    structure : Structure
        Learnt from the load's history.
    quantiles : array_like
        k = γ/σ to try.
    limits : mapping, optional
        Lower and upper limit to try by a label of their own, for the limit check; the widest pair
        also joins the combination.

    Returns
    -------
    DataFrame
        Columns ``check``, ``quantile`` (the limits' label for limits), ``false_alarm``,
        ``detection``.
    """
    ranges = {} if limits is None else dict(limits)
    rows = []
    for label, (low, high) in ranges.items():
        found = flagged(faulty.value, criteria("limits", np.inf, structure, lower=low, upper=high))
        rows.append(("limits", float(label), rates(found, faulty.bad)))
    widest = max(ranges.values(), key=lambda pair: pair[1] - pair[0], default=(np.nan, np.nan))
    for check in CHECKS[1:]:
        for quantile in np.asarray(quantiles, dtype=float):
            checked = criteria(check, quantile, structure, lower=widest[0], upper=widest[1])
            rows.append((check, float(quantile), rates(flagged(faulty.value, checked), faulty.bad)))
    return pd.DataFrame(
        [(check, label, found.false_alarm, 1.0 - found.miss) for check, label, found in rows],
        columns=["check", "quantile", "false_alarm", "detection"],
    )
