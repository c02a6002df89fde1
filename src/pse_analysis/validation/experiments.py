"""What the papers' claims come to on loads whose gross errors are known: tables for a notebook."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.validation import extrapolation, thresholds, trials
from pse_analysis.validation.block import Criteria
from pse_analysis.validation.increments import N_LAG, Structure, learn
from pse_analysis.validation.motion import gap_variance

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

MOVING = ("increment", "extrapolation")
"""The two checks whose rates the closed forms predict."""

FACTORS = (0.5, 0.75, 1.25, 1.5)
"""Of the Bayes threshold, whose risk is compared with its own."""

_BISECTIONS = 14


def known_structure(n_channel: int, rho: float = 0.5, sigma: float = 1.0) -> Structure:
    """Structure of loads whose increments are AR(1), as if learnt without error."""
    variance = np.tile(
        gap_variance(sigma**2, rho ** np.arange(1, N_LAG + 1), N_LAG), (n_channel, 1)
    )
    return Structure(variance, np.full(n_channel, 10_000), np.zeros(n_channel))


def gain_by_autocorrelation(
    rhos: Iterable[float], rng: np.random.Generator, *, n: int = 5_000, n_channel: int = 20
) -> pd.DataFrame:
    """Gain in resolution ΔPC (16) on generated loads, beside 100·ρ₁². [%]

    Returns
    -------
    DataFrame
        Columns ``rho``, ``theory``, ``simulated`` and its standard error ``error``.
    """
    rows = []
    for rho in rhos:
        x = trials.generated_load(n, rng, rho=rho, n_channel=n_channel)
        k = extrapolation.closed_form(learn(x, np.arange(n)[:, None], robust=False).variance)
        naive, optimal = (
            np.nanmean(np.square(extrapolation.errors(x, u)), axis=0) for u in (0.0, k)
        )
        gain = extrapolation.gain_percent(naive, optimal)
        rows.append((rho, 100.0 * rho**2, gain.mean(), gain.std(ddof=1) / np.sqrt(n_channel)))
    return pd.DataFrame(rows, columns=["rho", "theory", "simulated", "error"])


def realised_rates(
    priors: Sequence[float],
    rng: np.random.Generator,
    *,
    cost_ratio: float = 1.0,
    amplitude: float = thresholds.DEFAULT_AMPLITUDE,
    rho: float = 0.5,
    n_draw: int = 200_000,
    shape: tuple[int, int] = (5_000, 40),
) -> pd.DataFrame:
    """False alarms and misses at Bayes thresholds, predicted and realised.

    Parameters
    ----------
    priors : sequence of float
        q, which is also the share of gross errors that are put in.
    rng : Generator
    cost_ratio : float
        Cost of a miss over that of a false alarm.
    amplitude : float
        A, largest gross error over σ of the increment.
    rho : float
        ρ₁ of the load's increments.
    n_draw : int
        Samples judged after good references (conditional rates).
    shape : (int, int)
        Samples and channels of the loads that are screened as they come (unconditional rates).

    Returns
    -------
    DataFrame
        A row per ``check``, ``q`` and ``rate`` (false_alarm, miss): ``quantile``, ``predicted``,
        ``conditional``, ``unconditional`` and the standard errors ``conditional_error`` (of the
        predicted rate, with the number of draws) and ``unconditional_error``.
    """
    rows = []
    for q in priors:
        start = trials.generated_load(3, rng, rho=rho, n_channel=n_draw)
        hit = trials.with_errors(start[2:], rng, share=q, largest=amplitude)
        start[2:] = hit.value
        record = trials.generated_load(shape[0], rng, rho=rho, n_channel=shape[1])
        faulty = trials.with_errors(record, rng, share=q, largest=amplitude)
        for check in MOVING:
            answer = thresholds.bayes(q, cost_ratio, amplitude / _spread(check, rho))
            quantile = float(answer.k)
            own = trials.criteria(check, quantile, known_structure(n_draw, rho))
            given = trials.rates(trials.flagged_given_references(start, own), hit.bad[0])
            wide = trials.criteria(check, quantile, known_structure(shape[1], rho))
            free = trials.rates(trials.flagged(faulty.value, wide), faulty.bad)
            for rate, judged in (("false_alarm", ~hit.bad), ("miss", hit.bad)):
                predicted = float(getattr(answer, rate))
                error = np.sqrt(predicted * (1.0 - predicted) / judged.sum())
                realised = [getattr(given, rate), error]
                realised += [getattr(free, rate), getattr(free, f"{rate}_error")]
                rows.append((check, q, rate, quantile, predicted, *realised))
    columns = ["check", "q", "rate", "quantile", "predicted", "conditional", "conditional_error"]
    return pd.DataFrame(rows, columns=[*columns, "unconditional", "unconditional_error"])


def risk_around_optimum(
    q: float,
    rng: np.random.Generator,
    *,
    cost_ratio: float = 1.0,
    amplitude: float = thresholds.DEFAULT_AMPLITUDE,
    rho: float = 0.5,
    n_draw: int = 200_000,
    factors: Sequence[float] = FACTORS,
) -> pd.DataFrame:
    """Realised risk at multiples of the Bayes threshold, less its own, given good references.

    Returns
    -------
    DataFrame
        Columns ``check``, ``factor``, ``risk``, ``excess`` over the risk at the Bayes threshold and
        the paired standard error ``error`` of the excess; costs count in false alarms.
    """
    x = trials.generated_load(3, rng, rho=rho, n_channel=n_draw)
    hit = trials.with_errors(x[2:], rng, share=q, largest=amplitude)
    x[2:] = hit.value
    structure = known_structure(n_draw, rho)
    rows = []
    for check in MOVING:
        best = float(thresholds.bayes(q, cost_ratio, amplitude / _spread(check, rho)).k)
        costs = {}
        for factor in (1.0, *factors):
            own = trials.criteria(check, factor * best, structure)
            flags = trials.flagged_given_references(x, own)
            costs[factor] = trials.cost(flags, hit.bad[0], cost_ratio)
        for factor in factors:
            excess = costs[factor] - costs[1.0]
            error = excess.std() / np.sqrt(n_draw)
            rows.append((check, factor, costs[factor].mean(), excess.mean(), error))
    return pd.DataFrame(rows, columns=["check", "factor", "risk", "excess", "error"])


def margins(
    curves: pd.DataFrame,
    rng: np.random.Generator,
    *,
    n_history: int,
    amplitude: float = thresholds.DEFAULT_AMPLITUDE,
    share: float = 0.02,
    false_alarm: float = 0.02,
    repeats: int = 100,
) -> pd.DataFrame:
    """What extrapolation finds more than first increments do, at equal false alarms, per curve.

    Parameters
    ----------
    curves : (n, n_curve) DataFrame
        Loads without errors, evenly sampled. [unit]
    rng : Generator
    n_history : int
        First samples, from which σ and k = ρ̂₁ are learnt; errors are put into the rest.
    amplitude : float
        A, largest gross error over σ of the increment.
    share : float
        Of samples with an error.
    false_alarm : float
        Rate at which both checks are held; the first-increment check gets the larger of two that
        enclose it.
    repeats : int
        Draws of the errors.

    Returns
    -------
    DataFrame
        Index: curves. ``rho`` (ρ̂₁), ``evidence`` (standard errors by which the history shows a
        gain), ``claimed`` (whether the validate stage would extrapolate), ``increment`` and
        ``extrapolation`` (shares of errors found), ``margin`` and its standard error ``error``
        (over the samples of the curve, repeats brought together).
    """
    history = curves.iloc[:n_history].to_numpy(dtype=float)
    learnt = learn(history, np.arange(n_history, dtype=float)[:, None])
    claimed = extrapolation.gains(learnt)
    rows = []
    for i, name in enumerate(curves.columns):
        own = Structure(
            np.tile(learnt.variance[i], (repeats, 1)),
            np.full(repeats, learnt.count[i]),
            np.zeros(repeats),
        )
        x = np.tile(curves[name].to_numpy(dtype=float)[n_history:, None], (1, repeats))
        faulty = trials.with_errors(x, rng, share=share, largest=amplitude * learnt.sigma[i])
        sharp = _at_rate(faulty, own, "extrapolation", false_alarm)
        plain = _at_rate(faulty, own, "increment", float(sharp[~faulty.bad].mean()))
        gain = np.where(faulty.bad, sharp.astype(float) - plain, np.nan)
        by_sample = np.nanmean(gain[faulty.bad.any(axis=1)], axis=1)
        rows.append(
            (
                name,
                learnt.autocorrelation[i, 0],
                learnt.evidence[i],
                claimed[i],
                plain[faulty.bad].mean(),
                sharp[faulty.bad].mean(),
                by_sample.mean(),
                by_sample.std(ddof=1) / np.sqrt(len(by_sample)),
            )
        )
    columns = ["rho", "evidence", "claimed", "increment", "extrapolation", "margin", "error"]
    return pd.DataFrame(rows, columns=["curve", *columns]).set_index("curve")


def _spread(check: str, rho: float) -> float:
    """σ of the check's statistic over σ of the increment."""
    return float(np.sqrt(1.0 - rho**2)) if check == "extrapolation" else 1.0


def _at_rate(faulty: trials.Faulty, structure: Structure, check: str, rate: float) -> Bools:
    """Flags at the largest threshold whose realised false-alarm rate is at least ``rate``."""

    def flags(quantile: float) -> Bools:
        own: Criteria = trials.criteria(check, quantile, structure)
        return trials.flagged(faulty.value, own)

    low, high = 0.2, 30.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        enough = flags(middle)[~faulty.bad].mean() >= rate
        low, high = (middle, high) if enough else (low, middle)
    return flags(low)
