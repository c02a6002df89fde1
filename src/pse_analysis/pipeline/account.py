"""What a run met on its way, in a few lines: what was flagged, what did not work, what stands out.

Needs no truth, so it is what a study of real telemetry can go by.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd

from pse_analysis.vocabulary import SEVERITY, Flag, Status, usable

MOST = 5
"""Channels or kinds that are named."""
FAR = 3.0
"""Usual innovation of a channel, in units of its σ, from which on it stands out."""
NORMAL = 0.6745
"""Median of |x| of a normal law over its σ; single gross errors do not move it."""


def of_run(
    channels: Sequence[str],
    validated: pd.DataFrame,
    steps: pd.DataFrame,
    residuals: pd.DataFrame,
) -> list[str]:
    """Account of a run.

    Parameters
    ----------
    channels : sequence of str
        Names of all channels.
    validated, steps, residuals : DataFrame
        Tables of these names.

    Returns
    -------
    list of str
        One sentence each.
    """
    return [*_samples(channels, validated), *_steps(steps), *_far_channels(residuals)]


def _samples(channels: Sequence[str], validated: pd.DataFrame) -> Iterable[str]:
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
    judged = set(validated.loc[validated["threshold"].notna(), "channel"])
    blind = [name for name in channels if name not in judged]
    why = "no history to learn it from, or no rule asks for one"
    if blind == list(channels):
        yield f"only limits and stamps were checked, no threshold for changes ({why})"
    elif blind:
        yield f"only limits and stamps were checked ({why}) of {_named(blind)}"
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
