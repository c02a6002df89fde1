"""Claim: the account of a run names what was flagged, what did not work and what stands out."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pse_analysis.pipeline import account
from pse_analysis.vocabulary import Flag, Reason

CHANNELS = ["a", "b", "c", "dead"]
TIMES = pd.date_range("2024-05-14T12:00Z", periods=10, freq="5min")


def validated() -> pd.DataFrame:
    """Ten samples of three channels: most of c are bad, one of a is, the fourth is silent."""
    frame = pd.DataFrame({"channel": np.repeat(CHANNELS[:3], 10), "flag": 0, "reasons": 0})
    frame["threshold"] = np.where(frame["channel"] == "b", np.nan, 0.1)
    frame.loc[[3, *range(20, 29)], ["flag", "reasons"]] = int(Flag.BAD), int(Reason.LIMIT)
    frame.loc[5, ["flag", "reasons"]] = int(Flag.SUSPECT), int(Reason.LATE)
    return frame


def steps(status: list[str], detail: str = "") -> pd.DataFrame:
    """Steps of one method."""
    return pd.DataFrame(
        {"method": "wls", "time_utc": TIMES[: len(status)], "status": status, "detail": detail}
    )


def residuals(**size: float) -> pd.DataFrame:
    """Innovations of two methods, in units of their σ; the second is ten times as far off."""
    parts = [
        pd.DataFrame(
            {"method": m, "channel": c, "innovation": k * s, "sigma_innovation": 1.0, "used": True},
            index=range(5),
        )
        for k, m in ((1.0, "wls"), (10.0, "kf"))
        for c, s in size.items()
    ]
    return pd.concat(parts, ignore_index=True)


def test_samples_are_counted_by_reason_and_silent_channels_are_named() -> None:
    told = account.of_run(CHANNELS, validated(), steps(["ok"] * 10), residuals(a=1.0))
    assert told == [
        "telemetry: 30 samples of 4 channels, 11 flagged, reasons: limit 10, late 1",
        "only limits and stamps were checked (no history to learn it from, or no rule asks for "
        "one) of b, dead",
        "channels without a usable sample: dead",
        "channels of which most samples are flagged: c (90%)",
    ]


def test_steps_that_did_not_work_are_told_with_their_first_reason() -> None:
    wrong = steps(["ok", "unobservable", "unobservable", "diverged"], "add a flow")
    told = account.of_run(CHANNELS, validated(), wrong, residuals(a=1.0))
    assert "wls: 2 × unobservable, 1 × diverged; first at 2024-05-14 12:05: add a flow" in told


def test_a_channel_that_no_method_agrees_with_is_named_and_one_that_a_method_lost_is_not() -> None:
    told = account.of_run(CHANNELS, validated(), steps(["ok"]), residuals(a=1.0, b=8.0))
    assert told[-1].startswith("channels that no method can agree with: b (12 σ): look at")
