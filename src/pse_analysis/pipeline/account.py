"""What a run met on its way, in a few lines: what was flagged, what did not work, what stands out.

Needs no truth, so it is what a study of real telemetry can go by.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pse_analysis.measurement import Model
from pse_analysis.parameters import Study
from pse_analysis.validation.default_limits import PhysicalLimits, physical_limits
from pse_analysis.validation.increments import FEWEST
from pse_analysis.validation.periods import sentences, wrong_periods
from pse_analysis.validation.rules import Rule, ValidateParams, resolve
from pse_analysis.vocabulary import SEVERITY, Flag, Reason, Status, usable

MOST = 5
"""Channels or kinds that are named."""
FAR = 3.0
"""Usual innovation of a channel, in units of its σ, from which on it stands out."""
NORMAL = 0.6745
"""Median of |x| of a normal law over its σ; single gross errors do not move it."""
ENOUGH = 30
"""Periods of history that hold increments enough for a threshold, with losses and bad samples."""
CHANGES = frozenset({"increment", "extrapolation"})
"""Checks of how much a value changes."""


@dataclass(frozen=True)
class Account:
    """What a run has to tell.

    Attributes
    ----------
    notices : tuple of str
        What a reader must know before the results, one sentence each.
    findings : tuple of str
        The rest.
    """

    notices: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


def of_run(
    channels: pd.DataFrame,
    validated: pd.DataFrame,
    steps: pd.DataFrame,
    residuals: pd.DataFrame,
    *,
    study: Study,
    params: ValidateParams,
    model: Model | None = None,
) -> Account:
    """Account of a run.

    Parameters
    ----------
    channels, validated, steps, residuals : DataFrame
        Tables of these names.
    study : Study
        Tells what is history.
    params : ValidateParams
        What the validate stage was asked to check.
    model : Network or Machine, optional
        What default limits follow from.

    Returns
    -------
    Account
    """
    rules = resolve(channels, params, model)
    default = physical_limits(channels, model, params.default_limits)
    wrong = wrong_periods(validated, channels)
    unjudged = _unjudged(validated, rules)
    return Account(
        notices=(
            *sentences(wrong, MOST),
            *_unlearnt(unjudged, channels, validated, study, set(wrong["channel"])),
        ),
        findings=(
            *_samples(rules, unjudged, validated),
            *_beyond_default(rules, default, validated),
            *_steps(steps),
            *_far_channels(residuals),
        ),
    )


def _unjudged(validated: pd.DataFrame, rules: Sequence[Rule]) -> list[Rule]:
    """Rules of the channels of which no change was compared with a threshold."""
    # At a limit and at a stuck value the column holds what that check compares with.
    other = (validated["reasons"] & int(Reason.LIMIT | Reason.STUCK)) != 0
    judged = set(validated.loc[validated["threshold"].notna() & ~other, "channel"])
    return [rule for rule in rules if rule.channel not in judged]


def _asks(rule: Rule) -> bool:
    """Whether a rule asks for changes to be checked."""
    return not CHANGES.isdisjoint(rule.checks or ())


def _unlearnt(
    unjudged: Sequence[Rule],
    channels: pd.DataFrame,
    validated: pd.DataFrame,
    study: Study,
    wrong: Set[str],
) -> Iterable[str]:
    """Which channels should have a learnt threshold and have none, why, and what to do."""
    there = set(validated["channel"])
    names = [r.channel for r in unjudged if _asks(r) and not r.increment and r.channel in there]
    if not names:
        return
    past = validated[(validated["time_utc"] < study.start) & usable(validated["flag"].to_numpy())]
    count = past.groupby(["trial", "channel"], observed=True).size()
    most = count.groupby(level="channel").max().reindex(names, fill_value=0)
    few, many = int(most.min()), int(most.max())
    period = channels.set_index("channel")["period_s"].reindex(names).max()
    why = "there is no history (history_s = 0)"
    if study.history_s:
        held = f"{few}" if few == many else f"{few} to {many}"
        why = (
            f"their history of {study.history_s:g} s holds {held} usable samples, and {FEWEST} "
            "increments over one period_s are needed"
        )
    text = (
        f"no threshold for changes was learnt for {len(names)} of {len(channels)} channels "
        f"({_named(names)}): {why}. A wrong value of theirs inside the limits enters the "
        f"estimates. Lengthen [study] history_s to {ENOUGH * period:g} or more, with telemetry to "
        "fill it, or state increment = … for them in [[validate.rules]]"
    )
    yield text + ("; mend period_s first where it is wrong" if wrong & set(names) else "")


def _beyond_default(
    rules: Sequence[Rule], default: PhysicalLimits, validated: pd.DataFrame
) -> Iterable[str]:
    """How many samples lie outside limits that nobody stated."""
    limit = validated.loc[(validated["reasons"] & int(Reason.LIMIT)) != 0]
    at = pd.Index([rule.channel for rule in rules]).get_indexer(pd.Index(limit["channel"]))
    # What a sample was compared with tells whether that limit was a default one.
    compared = limit["threshold"].to_numpy()
    of_default = (compared == default.lower[at]) | (compared == default.upper[at])
    count = limit[of_default].groupby(at[of_default])["value"].agg(["size", "first"])
    told = [
        f"{rules[k].channel} ({size:,}, e.g. {first:.4g}; {default.origin[k]})"
        for k, size, first in count.itertuples()
    ]
    if told:
        yield (
            f"samples outside the default limits, which no plant exceeds: {_named(told)}: look at "
            "the unit, or state lower and upper"
        )


def _samples(
    rules: Sequence[Rule], unjudged: Sequence[Rule], validated: pd.DataFrame
) -> Iterable[str]:
    channels = [rule.channel for rule in rules]
    flag, reasons = validated["flag"].to_numpy(), validated["reasons"].to_numpy()
    good = usable(flag)
    counts = {
        reason.name.lower().replace("_", " "): int(((reasons & reason) != 0).sum())
        for reason, severity in SEVERITY.items()
        if reason.name and severity != Flag.GOOD
    }
    kinds = sorted(((n, k) for k, n in counts.items() if n), reverse=True)
    flagged = int((flag != Flag.GOOD).sum())
    text = f"telemetry: {len(flag):,} samples of {len(channels)} channels, {flagged:,} flagged"
    if kinds:
        text += f", reasons: {', '.join(f'{kind} {n:,}' for n, kind in kinds)}"
    yield text
    blind = [rule.channel for rule in unjudged if not _asks(rule)]
    if blind == channels:
        yield "changes were not checked: no rule asks for it"
    elif blind:
        yield f"changes were not checked, because no rule asks for it, of {_named(blind)}"
    heard = set(validated["channel"].to_numpy()[good])
    silent = [name for name in channels if name not in heard]
    if silent:
        yield f"channels without a usable sample: {_named(silent)}"
    share = pd.Series(~good).groupby(validated["channel"].to_numpy()).mean()
    poor = share[(share > 0.5) & (share < 1.0)].sort_values(ascending=False)
    if len(poor):
        named = [f"{name} ({part:.0%})" for name, part in poor.items()]
        yield f"channels of which most samples are flagged: {_named(named)}"


def _steps(steps: pd.DataFrame) -> Iterable[str]:
    wrong = steps[~steps["status"].isin((Status.OK, Status.PREDICTED))]
    for method, own in wrong.groupby("method", sort=False):
        counts = own["status"].value_counts()
        text = f"{method}: {', '.join(f'{n} × {status}' for status, n in counts.items())}"
        told = own[own["detail"] != ""]
        if len(told):
            first = told.iloc[0]
            text += f"; first at {first['time_utc']:%Y-%m-%d %H:%M}: {first['detail']}"
        yield text


def _far_channels(residuals: pd.DataFrame) -> Iterable[str]:
    ratio = (residuals["innovation"] / residuals["sigma_innovation"]).where(residuals["used"])
    size = ratio.replace([np.inf, -np.inf], np.nan).abs() / NORMAL
    by_method = size.groupby([residuals["method"], residuals["channel"]], observed=True).median()
    # A method that goes astray drags all channels along; what is wrong stands out in all of them.
    least = by_method.groupby(level="channel", observed=True).min()
    far = least[least > FAR].sort_values(ascending=False)
    if len(far):
        named = [f"{name} ({size:.0f} σ)" for name, size in far.items()]
        yield (
            f"channels that no method can agree with: {_named(named)}: look at their units, signs "
            "and σ, or the grid's parameters there"
        )


def _named(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return ", ".join(names[:MOST]) + more
