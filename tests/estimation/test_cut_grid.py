"""Claim: on a grid that is cut in two every method says what it cannot do and ends no run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tests.endurance import tiny_case

from pse_analysis.estimation import Method

METHODS = (
    Method.of("wls", "wls"),
    Method.of("kalman", "kalman"),
    Method.of("matched", "kalman", noise="innovation"),
    Method.of("ukf", "ukf", noise="scalar"),
    Method.of("ekf", "ekf"),
)


@pytest.mark.parametrize("metered", [True, False], ids=["metered", "unmetered"])
@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_a_part_without_supply_stops_no_method(method: Method, metered: bool) -> None:
    raw = tiny_case.plain_run().raw
    channels, telemetry = raw.channels, raw.telemetry
    if not metered:
        channels = channels[channels["element"] != "bus/4"]
        telemetry = telemetry[telemetry["channel"].isin(channels["channel"])]
    cut = dataclasses.replace(
        raw, model=raw.network.open_branch("3-4"), channels=channels, telemetry=telemetry
    )
    done = tiny_case.estimate_raw(cut, (method,)).estimated[0]
    assert len(done.steps) == tiny_case.STEPS
    assert not done.steps["status"].isin(["ok"]).any()
    assert (done.steps["detail"] != "").all()
    good = done.estimated[["value", "sigma"]].to_numpy()
    assert (np.isfinite(good).all(axis=1) == np.isfinite(good).any(axis=1)).all()
