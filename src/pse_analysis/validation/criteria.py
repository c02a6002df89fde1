"""From rules and history to the numbers that a block is screened with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.validation import extrapolation, thresholds
from pse_analysis.validation.block import Criteria
from pse_analysis.validation.increments import Structure
from pse_analysis.validation.motion import Motion
from pse_analysis.validation.rules import Rule

FEWEST_EQUAL = 5
"""Least default number of equal values in a row that mean a stuck source."""

CHANCE_OF_RUN = 1e-6
"""Default probability that a healthy source repeats itself that often by chance."""

MOSTLY = 0.5
"""Share of repeats from which waiting for another value to confirm a step takes too long."""


def stuck_after(repeats: FloatArray) -> npt.NDArray[np.int64]:
    """Equal values in a row that chance explains with less than `CHANCE_OF_RUN`.

    Parameters
    ----------
    repeats : (n_channel,)
        Share of history samples that equal their predecessor.

    Returns
    -------
    (n_channel,) array of int
        At least `FEWEST_EQUAL`; 0 (not checked) where every sample repeats.
    """
    share = np.clip(np.asarray(repeats, dtype=float), 1e-12, 1.0)
    with np.errstate(divide="ignore"):
        run = np.ceil(np.log(CHANCE_OF_RUN) / np.log(share))
    return np.where(share < 1.0, np.maximum(run, FEWEST_EQUAL), 0).astype(np.int64)


def decide(
    rules: Sequence[Rule],
    structure: Structure | None,
    sigma: FloatArray,
    scan_k: FloatArray | None = None,
    turn: FloatArray | None = None,
) -> Criteria:
    """Thresholds of every channel by its rule's criterion.

    Parameters
    ----------
    rules : sequence of n_channel Rule
        Resolved ones: every field but limits, increment, stuck and late_s is set.
    structure : Structure or None
        Learnt from the history; None where there is none.
    sigma : (n_channel,)
        Standard deviation of the measurement error, for channels whose history never changes.
        [unit]
    scan_k : (n_channel,), optional
        The scanned coefficient, for rules that ask for it.
    turn : (n_channel,), optional
        Full turn of the channels that measure angles, inf for the rest. [unit]

    Raises
    ------
    ParameterError
        If a rule's prior and costs make rejecting every sample the cheapest.
    """
    n = len(rules)
    variance, learnt = _variance(structure, sigma, n)
    rho = extrapolation.closed_form(variance)
    given = _array(rules, "increment")
    wants_extrapolation = np.array([_has(r, "extrapolation") for r in rules], dtype=bool)
    wants_increment = np.array([_has(r, "increment") for r in rules], dtype=bool)

    # A stated threshold stands in for the learnt check, unless the rule names both.
    stated = ~np.isnan(given) & (wants_increment | wants_extrapolation)
    wants_extrapolation &= ~(stated & ~wants_increment)
    wants_increment |= stated

    k = np.zeros(n)
    gains = np.zeros(n, dtype=bool) if structure is None else extrapolation.gains(structure)
    for index, rule in enumerate(rules):
        if rule.k == "optimal":
            k[index] = rho[index] if gains[index] else 0.0
        elif rule.k == "scan":
            found = rho if scan_k is None else scan_k
            k[index] = found[index] if gains[index] else 0.0
        else:
            k[index] = float(rule.k or 0.0)
    k[~(wants_extrapolation & learnt)] = 0.0
    # With k = 0 the extrapolation check is the first-increment check, and is called by its name.
    wants_increment |= wants_extrapolation & (k == 0.0)
    wants_extrapolation &= k != 0.0

    amplitude = _array(rules, "amplitude")
    motion = Motion(variance, k, np.full(n, np.inf), np.full(n, np.inf), np.full(n, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        narrower = np.sqrt(variance[:, 1] / motion.one_step_variance)
    narrower = np.where(np.isfinite(narrower), narrower, 1.0)
    increment = np.where(wants_increment & learnt, _quantile(rules, amplitude), np.inf)
    sharper = np.where(wants_extrapolation & learnt, _quantile(rules, amplitude * narrower), np.inf)
    if stated.any():
        unlearnt = stated & ~learnt
        variance[unlearnt] = np.square(given[unlearnt])[:, None] * np.arange(variance.shape[1])
        increment = np.where(stated, given / np.sqrt(variance[:, 1]), increment)

    limits = np.array([_has(r, "limits") for r in rules], dtype=bool)
    repeats = np.zeros(n) if structure is None else structure.repeats
    stuck = stuck_after(repeats)
    own = _array(rules, "stuck")
    stuck = np.where(np.isnan(own), stuck, np.nan_to_num(own)).astype(np.int64)
    checks_stuck = np.array([_has(r, "stuck") for r in rules], dtype=bool)
    return Criteria(
        lower=np.where(limits, _array(rules, "lower"), np.nan),
        upper=np.where(limits, _array(rules, "upper"), np.nan),
        motion=Motion(
            structure=variance,
            k=k,
            increment=increment,
            extrapolation=sharper,
            confirm=np.array([r.confirm or 1 for r in rules], dtype=np.int64),
            turn=np.full(n, np.inf) if turn is None else turn,
            repeats=repeats > MOSTLY,
        ),
        stuck=np.where(checks_stuck, stuck, 0),
        stuck_at_zero=np.array([bool(r.stuck_at_zero) for r in rules], dtype=bool),
    )


def _variance(
    structure: Structure | None, sigma: FloatArray, n: int
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """v(n) and whether it is known; a history that never changes leaves the sensor's own noise."""
    if structure is None:
        return np.tile(np.arange(3.0), (n, 1)), np.zeros(n, dtype=bool)
    variance = structure.variance.copy()
    still = variance[:, 1] == 0.0
    variance[still, 1:] = 2.0 * np.square(sigma[still])[:, None]
    learnt = np.isfinite(variance[:, 1]) & (variance[:, 1] > 0.0)
    variance[~learnt] = np.arange(variance.shape[1], dtype=float)
    return variance, learnt


def _quantile(rules: Sequence[Rule], amplitude: FloatArray) -> FloatArray:
    """Quantile k = γ/σ of every channel."""
    q, q_max = _array(rules, "q"), _array(rules, "q_max")
    ratio = _array(rules, "cost_miss") / _array(rules, "cost_false_alarm")
    bayes = thresholds.bayes(q, ratio, amplitude)
    minimax = thresholds.minimax(ratio, amplitude, q_max=q_max)
    out = _array(rules, "quantile")
    for index, rule in enumerate(rules):
        if rule.criterion == "fixed":
            continue
        answer = bayes if rule.criterion == "bayes" else minimax
        if answer.verdict[index] == thresholds.Verdict.ALWAYS_REJECT:
            bound = float(thresholds.degenerate_odds(amplitude[index]))
            raise ParameterError(
                f"[validate.rules] {rule.channel}: with q = {answer.q[index]:g} and cost_miss/"
                f"cost_false_alarm = {ratio[index]:g} rejecting every sample is the cheapest "
                f"(q·r/(1−q) must stay below {bound:.3f} at A = {amplitude[index]:.3g}): "
                "lower q or cost_miss, or take criterion = 'minimax'"
            )
        out[index] = answer.k[index]
    return out


def _array(rules: Sequence[Rule], name: str) -> FloatArray:
    return np.array(
        [np.nan if getattr(r, name) is None else float(getattr(r, name)) for r in rules],
        dtype=float,
    )


def _has(rule: Rule, check: str) -> bool:
    return check in (rule.checks or ())
