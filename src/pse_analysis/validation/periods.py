"""Whether a channel's stated period is the one in which its samples come.

Gaps, late samples, thresholds over a period and the interval of a mean all count in ``period_s``.
Nothing is corrected here: what the stages use stays what the user states, because the spacing of
stamps is known only once the samples are there, flags must not depend on later samples, and no
stamp says over which time a mean was taken.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from pse_analysis.arrays import IntArray, utc_microseconds
from pse_analysis.vocabulary import Aggregation

FEWEST_SPACINGS = 20
"""Spacings below which nothing is said of a channel."""

NEAR = 1.25
"""Ratio up to which a spacing counts as the stated period."""

EXPECTED_SHARE = 0.2
"""Share of spacings near the stated period from which on it is right: the rest follows losses.

With independent losses the share is that of samples that arrive; with every third poll lost, 0.5.
"""

WINDOW = 1.5
"""Ratio of the largest to the smallest spacing that count as one, jitter included."""

REGULAR_SHARE = 0.5
"""Share of one spacing from which on a channel counts as periodic, so that its period is known."""

LOSSY_SHARE = 0.35
"""The same where the other spacings are multiples of it."""

SHORT_SHARE, BETWEEN_SHARE = 0.2, 0.05
"""Largest shares of spacings far below that one, and of those between a quarter and two thirds.

Telegrams delivered twice give spacings far below it. A source that reports on change, and at the
latest after a fixed time, gives any spacing below that time, and has no period to be judged.
"""

WRONG = 1.4
"""Ratio between spacing and stated period from which on the period is wrong."""

RUN = 4
"""Spacings in a row whose mean must be off as well.

Stamps that are cut to whole seconds show a period of 1.5 s as 1 s and 2 s, one of 0.5 s as 0 s and
1 s, but keep the mean.
"""

_RUN_OFF = 1.1
_WHOLE = 0.2
_SHARP, _BLUR = 1e-3, 0.05
_USUAL = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 10.0, 12.0, 15.0, 20.0, 24.0, 30.0)
_FAST = (0.01, 0.02, 0.04, 0.05, 0.1, 0.2, 0.5)


def wrong_periods(telemetry: pd.DataFrame, channels: pd.DataFrame) -> pd.DataFrame:
    """Returns the channels whose stated period is off by a factor from the spacing of their stamps.

    Parameters
    ----------
    telemetry : DataFrame
        Columns ``trial``, ``channel`` and ``time_utc`` of table ``telemetry`` or ``validated``.
    channels : DataFrame
        Of schema ``channels``.

    Returns
    -------
    DataFrame
        One row for each such channel, in the order of ``channels``: ``channel``, ``stated_s``,
        ``seen_s`` and whether it is a ``mean``. [s]

    Notes
    -----
    A spacing is the time from one stamp to the next one of the trial. A channel is named if one
    spacing (`WINDOW`) makes up half of them, hardly any is shorter, and it differs from the stated
    period by `WRONG`. Lost samples lengthen spacings: while a fifth of them is the stated period,
    that is right. A source of which every second poll is lost cannot be told from one of twice the
    period, and is named; with every third one lost it is not.
    """
    position = pd.Index(channels["channel"]).get_indexer(pd.Index(telemetry["channel"]))
    known = position >= 0
    trial, channel, time = (
        np.asarray(column[known], dtype=np.int64)
        for column in (
            telemetry["trial"].to_numpy(),
            position,
            utc_microseconds(telemetry["time_utc"]),
        )
    )
    stated = channels["period_s"].to_numpy(dtype=float)
    lane = trial * len(channels) + channel
    step, later = np.diff(lane), np.diff(time)
    if not np.all((step > 0) | ((step == 0) & (later >= 0))):
        order = np.lexsort((time, lane))
        lane, time, channel = lane[order], time[order], channel[order]
        step, later = np.diff(lane), np.diff(time)
    spacing, of = later[step == 0] / 1e6, channel[1:][step == 0]
    apart = spacing > 0.0
    near = np.abs(np.log(np.where(apart, spacing, 1.0) / stated[of])) <= np.log(NEAR)
    n = np.bincount(of[apart], minlength=len(channels))
    fits = np.bincount(of[near & apart], minlength=len(channels))
    doubtful = (n >= FEWEST_SPACINGS) & (fits < EXPECTED_SHARE * n)
    rows = np.flatnonzero(doubtful[channel])
    rows = rows[np.argsort(channel[rows], kind="stable")]
    found = []
    for own in np.split(rows, np.flatnonzero(np.diff(channel[rows])) + 1) if len(rows) else ():
        at = int(channel[own[0]])
        seen = _period(lane[own], time[own], float(stated[at]))
        if seen is not None:
            found.append((channels["channel"].iloc[at], float(stated[at]), seen))
    wrong = pd.DataFrame(found, columns=["channel", "stated_s", "seen_s"])
    mean = channels.loc[channels["aggregation"] == Aggregation.MEAN, "channel"]
    return wrong.assign(mean=wrong["channel"].isin(mean))


def sentences(wrong: pd.DataFrame, most: int = 5) -> Iterator[str]:
    """Yields a sentence for every group of channels that have one wrong period.

    Parameters
    ----------
    wrong : DataFrame
        What `wrong_periods` returns.
    most : int
        Channels that are named in a sentence.
    """
    for (stated, seen, mean), group in wrong.groupby(["stated_s", "seen_s", "mean"], sort=False):
        names = [str(name) for name in group["channel"]]
        more = f" and {len(names) - most} more" if len(names) > most else ""
        yield (
            f"period_s = {stated:g} is stated, but samples come every {seen:g} s: "
            f"{', '.join(names[:most])}{more}: write period_s = {seen:g}; all stages went on with "
            f"{stated:g} s, by which gaps, late samples and thresholds are judged"
            + (", and over which each mean is taken to be" if mean else "")
        )


def _period(lane: IntArray, time: IntArray, stated: float) -> float | None:
    """The period that a channel's sorted stamps show, if they show one and it is not ``stated``."""
    later = np.diff(time)[np.diff(lane) == 0]
    d = np.sort(later[later > 0]) / 1e6
    count = np.searchsorted(d, WINDOW * d, side="right") - np.arange(len(d))
    # Regular losses show the period and its double about equally often: the shorter one is it.
    first = int(np.argmax(count >= 0.8 * count.max()))
    start = first + int(np.argmax(count[first : first + count[first]]))
    cluster = d[start : start + count[start]]
    period = float(np.median(cluster))
    share, multiple = len(cluster) / len(d), d / period
    whole = np.abs(multiple - np.rint(multiple)) <= _WHOLE
    periodic = share >= REGULAR_SHARE or (
        # Fewer, where losses are many and leave multiples of it.
        share >= LOSSY_SHARE and np.mean(whole) >= 1.0 - SHORT_SHARE
    )
    short = multiple < 1.0 / WINDOW
    between = short & (multiple > 0.25)
    if not periodic or np.mean(short) > SHORT_SHARE or np.mean(between) > BETWEEN_SHARE:
        return None
    whole_run = lane[RUN:] == lane[:-RUN]
    runs = (time[RUN:] - time[:-RUN])[whole_run] / (RUN * 1e6)
    run_mean = float(np.median(runs)) if len(runs) else np.nan
    slower = period >= WRONG * stated and run_mean >= _RUN_OFF * stated
    faster = period * WRONG <= stated and run_mean * _RUN_OFF <= stated
    if not (slower or faster):
        return None
    low, high = np.quantile(cluster, (0.25, 0.75))
    return float(f"{period:.6g}") if high - low <= _SHARP * period else _usual(period)


def _usual(period: float) -> float:
    """A period that jitter blurs: a usual one within `_BLUR` of it, or else two digits of it."""
    usual = np.array([u * x for x in (1.0, 60.0, 3600.0) for u in _USUAL] + list(_FAST))
    near = float(usual[np.argmin(np.abs(np.log(usual / period)))])
    return near if abs(near / period - 1.0) <= _BLUR else float(f"{period:.2g}")
