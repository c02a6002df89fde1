"""Claim: a filter refuses gross errors and little else, and says so in its residuals."""

from __future__ import annotations

from datetime import timedelta
from functools import cache

import numpy as np
import pytest
import simulated_case
from simulated_case import PARAMS, STUDY, feeder

from pse_analysis.alignment import align
from pse_analysis.errors import ParameterError
from pse_analysis.estimation import Estimated, Method, estimate
from pse_analysis.simulation.settings import FaultParams
from pse_analysis.validation import Rule, ValidateParams, validate
from pse_analysis.vocabulary import Reason

SPIKE = FaultParams(
    "spike",
    1.0,
    (0.06, 0.06),
    relative=True,
    source="pmu",
    at=("bus/6",),
    start=STUDY.start + timedelta(minutes=29),
    end=STUDY.start + timedelta(minutes=58),
)
SPIKED = slice(6, 12)
"""Instants at which the spiked samples are used."""


@cache
def telemetry(spiked: bool):
    faults = (SPIKE,) if spiked else ()
    raw = simulated_case.make(PARAMS, trials=1, faults=faults)
    rules = ValidateParams(rules=(Rule(checks=("limits", "time")),))
    validated = validate(raw.telemetry, raw.channels, rules, history_end=STUDY.start)
    return raw, align(validated, raw.channels, feeder(), STUDY)


def estimated(screen: str, *, spiked: bool, reading: str = "instant"):
    raw, aligned = telemetry(spiked)
    # Two hours of history teach no load noise.
    method = Method.of(
        "m",
        "kalman",
        noise="scalar",
        variance=1e-5,
        screening=screen,
        reading=reading,  # type: ignore[arg-type]
    )
    return estimate(aligned, raw.channels, feeder(), STUDY, method), raw.truth


def spiked_rows(residuals):
    mine = residuals[residuals["channel"] == "pmu:bus/6:vm_pu"].sort_values("time_utc")
    return mine.iloc[SPIKED]


@pytest.mark.parametrize("reading", ["instant", "interval"])
def test_refused_samples_stand_unused_in_residuals_and_are_counted(reading: str):
    done, _ = estimated("innovation", spiked=True, reading=reading)
    rows = spiked_rows(done.residuals)
    assert len(rows) == 6
    assert not rows["used"].any()
    assert (rows["reasons"] & int(Reason.INNOVATION)).all()
    assert (rows["innovation"].abs() > 4 * rows["sigma_innovation"]).mean() > 0.5
    assert (done.steps["rejected"].to_numpy()[SPIKED] >= 1).all()


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_every_filter_has_the_innovation_test(kind: str):
    """Refused rows are named, and the estimate is all but that without the spike."""
    keys = {"noise": "scalar", "variance": 1e-5}
    raw, aligned = telemetry(True)
    clean, same = telemetry(False)
    method = Method.of("m", kind, screening="innovation", **keys)
    plain = Method.of("m", kind, **keys)
    done = estimate(aligned, raw.channels, feeder(), STUDY, method)
    rows = spiked_rows(done.residuals)
    assert (rows["inflation"] > 0).all()
    assert (rows["reasons"] & int(Reason.INNOVATION)).all()
    assert (done.steps["rejected"].to_numpy()[SPIKED] >= 1).all()

    def off(found: Estimated) -> float:
        reference = estimate(same, clean.channels, feeder(), STUDY, plain).estimated
        vm = found.estimated["quantity"] == "vm_pu"
        return float((found.estimated["value"] - reference["value"])[vm].abs().max())

    spoilt = off(estimate(aligned, raw.channels, feeder(), STUDY, plain))
    assert off(done) < 0.25 * spoilt


def test_replaced_samples_are_used_with_a_larger_sigma():
    done, _ = estimated("scaled", spiked=True)
    rows = spiked_rows(done.residuals)
    found = (rows["reasons"] & int(Reason.INCREMENT)).astype(bool)
    assert found.all()
    assert rows["used"].all()
    # 6 % of |V| is 11σ, and the σ of the replacement reaches as far.
    assert (rows["inflation"] > 8.0**2 - 1.0).all()


def test_a_bad_sample_costs_a_screened_filter_what_a_missing_one_costs():
    raw, aligned = telemetry(True)
    times = np.sort(aligned["time_utc"][aligned["time_utc"] >= STUDY.start].unique())[SPIKED]
    gone = (aligned["channel"] == "pmu:bus/6:vm_pu") & aligned["time_utc"].isin(times)
    plain = Method.of("m", "kalman", noise="scalar", variance=1e-5, reading="instant")
    without = estimate(aligned[~gone], raw.channels, feeder(), STUDY, plain)
    screened, _ = estimated("scaled", spiked=True)
    apart = screened.estimated["value"] - without.estimated["value"]
    here = screened.estimated["time_utc"].isin(times) & (screened.estimated["quantity"] == "vm_pu")
    moved = estimated("none", spiked=True)[0].estimated["value"] - without.estimated["value"]
    assert apart[here].abs().max() < 0.15 * moved[here].abs().max()


def test_without_bad_data_the_innovation_screening_refuses_next_to_nothing():
    # Real loads are heavy-tailed: more than the 6e-5 of a normal law.
    screened, _ = estimated("innovation", spiked=False)
    assert (~screened.residuals["used"]).mean() < 0.02


def test_an_adaptive_threshold_stands_before_any_estimator():
    raw, aligned = telemetry(True)
    done = estimate(
        aligned, raw.channels, feeder(), STUDY, Method.of("m", "wls", screening="scaled")
    )
    found = spiked_rows(done.residuals)["reasons"] & int(Reason.INCREMENT)
    assert (found > 0).all()


def test_screening_by_innovation_is_for_the_kalman_filter():
    with pytest.raises(ParameterError, match="kalman"):
        Method.of("m", "wls", screening="innovation")
