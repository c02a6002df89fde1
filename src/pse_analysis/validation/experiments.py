"""What the papers' claims come to on loads whose gross errors are known: tables for a notebook."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.validation import extrapolation, thresholds, trials
from pse_analysis.validation.block import Criteria
from pse_analysis.validation.increments import N_LAG, Structure, learn
from pse_analysis.validation.motion import gap_variance

MOVING = ("increment", "extrapolation")
"""The two checks whose rates the closed forms predict."""

FACTORS = (0.5, 0.75, 1.25, 1.5)
"""Of the Bayes threshold, whose risk is compared with its own."""

_BISECTIONS = 11


def known_structure(n_channel: int, rho: float = 0.5, sigma: float = 1.0) -> Structure:
    """Structure of loads whose increments are AR(1), as if learnt without error."""
    variance = np.tile(gap_variance(sigma, rho ** np.arange(1, N_LAG + 1), N_LAG), (n_channel, 1))
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


def predicted_roc(
    quantiles: npt.ArrayLike,
    *,
    amplitude: float = thresholds.DEFAULT_AMPLITUDE,
    rho: float = 0.5,
) -> pd.DataFrame:
    """Detection against false alarms by the closed forms, which hold given good references.

    Returns
    -------
    DataFrame
        Columns ``check``, ``quantile``, ``false_alarm``, ``detection``, as of `trials.roc`.
    """
    k = np.asarray(quantiles, dtype=float)
    parts = [
        pd.DataFrame(
            {
                "check": check,
                "quantile": k,
                "false_alarm": thresholds.false_alarm(k),
                "detection": 1.0 - thresholds.miss(k, amplitude / _spread(check, rho)),
            }
        )
        for check in MOVING
    ]
    return pd.concat(parts, ignore_index=True)


def margins(
    curves: pd.DataFrame,
    rng: np.random.Generator,
    *,
    n_history: int,
    amplitude: float = thresholds.DEFAULT_AMPLITUDE,
    false_alarm: float = 0.02,
    share: float = 0.01,
    repeats: int = 60,
    n_block: int = 24,
    n_bootstrap: int = 200,
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
    false_alarm : float
        Share of good samples beyond γ, for both checks.
    share, repeats : float, int
        Share of samples with an error, and draws of the errors, for the margin as samples come.
    n_block, n_bootstrap : int
        Samples drawn together, and draws, of the bootstrap that gives the standard error.

    Returns
    -------
    DataFrame
        Index: curves. ``rho`` (ρ̂₁), ``evidence`` (standard errors by which the history shows a
        gain), ``claimed`` (whether the validate stage would extrapolate). Given good references:
        ``increment`` and ``extrapolation`` (probability that an error is found), ``margin`` and its
        standard error ``error``. ``as_they_come`` is the margin where references may be bad.

    Notes
    -----
    Given good references nothing has to be drawn: an error n ~ U(−a, a) on an extrapolation error e
    is found with probability 1 − |[−γ−e, γ−e] ∩ [−a, a]|/2a, and γ is a quantile of |e|.
    """
    history = curves.iloc[:n_history].to_numpy(dtype=float)
    learnt = learn(history, np.arange(n_history, dtype=float)[:, None])
    claimed = extrapolation.gains(learnt)
    rows = []
    for i, name in enumerate(curves.columns):
        x = curves[name].to_numpy(dtype=float)[n_history - 2 :]
        rho, largest = learnt.autocorrelation[i, 0], amplitude * learnt.sigma[i]
        both = np.stack([extrapolation.errors(x, k)[2:] for k in (0.0, rho)])
        plain, sharp = _found(both, largest, false_alarm)
        drawn = [
            _found(_blocks(both, rng, n_block), largest, false_alarm) for _ in range(n_bootstrap)
        ]
        error = np.std([b - a for a, b in drawn], ddof=1)
        alone = Structure(
            np.tile(learnt.variance[i], (repeats, 1)),
            np.full(repeats, learnt.count[i]),
            np.zeros(repeats),
        )
        tiled = np.tile(x[2:, None], (1, repeats))
        faulty = trials.with_errors(tiled, rng, share=share, largest=largest)
        as_it_comes = _margin_as_they_come(faulty, alone, false_alarm)
        row = (name, rho, learnt.evidence[i], claimed[i])
        rows.append((*row, plain, sharp, sharp - plain, error, as_it_comes))
    columns = ["curve", "rho", "evidence", "claimed", "increment", "extrapolation", "margin"]
    table = pd.DataFrame(rows, columns=[*columns, "error", "as_they_come"])
    return table.set_index("curve")


def _found(errors: FloatArray, largest: float, false_alarm: float) -> FloatArray:
    """Mean probability that an error is found, a row per check, γ at equal false alarms."""
    gamma = np.quantile(np.abs(errors), 1.0 - false_alarm, axis=1, keepdims=True)
    low, high = np.maximum(-gamma - errors, -largest), np.minimum(gamma - errors, largest)
    return np.asarray((1.0 - np.maximum(high - low, 0.0) / (2.0 * largest)).mean(axis=1))


def _blocks(errors: FloatArray, rng: np.random.Generator, n_block: int) -> FloatArray:
    """As many samples again, drawn in blocks, so that the course of a day stays together."""
    n = errors.shape[1]
    begin = rng.integers(0, n - n_block + 1, -(-n // n_block))
    at = (begin[:, None] + np.arange(n_block)).ravel()[:n]
    return np.asarray(errors[:, at])


def _margin_as_they_come(faulty: trials.Faulty, structure: Structure, false_alarm: float) -> float:
    sharp = _at_rate(faulty, structure, "extrapolation", false_alarm)
    plain = _at_rate(faulty, structure, "increment", float(sharp[~faulty.bad].mean()))
    return float(sharp[faulty.bad].mean() - plain[faulty.bad].mean())


def _spread(check: str, rho: float) -> float:
    """σ of the check's statistic over σ of the increment."""
    return float(np.sqrt(1.0 - rho**2)) if check == "extrapolation" else 1.0


def _at_rate(faulty: trials.Faulty, structure: Structure, check: str, rate: float) -> BoolArray:
    """Flags at the largest threshold whose realised false-alarm rate is at least ``rate``."""

    def flags(quantile: float) -> BoolArray:
        own: Criteria = trials.criteria(check, quantile, structure)
        return trials.flagged(faulty.value, own)

    low, high = 0.2, 30.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        enough = flags(middle)[~faulty.bad].mean() >= rate
        low, high = (middle, high) if enough else (low, middle)
    return flags(low)
