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
from pse_analysis.estimation import Method, estimate, screening
from pse_analysis.estimation.screening import InnovationParams
from pse_analysis.simulation.settings import FaultParams
from pse_analysis.validation import Rule, ValidateParams, validate
from pse_analysis.vocabulary import Reason

SEED = 12
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


def innovations(rng: np.random.Generator, m: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Innovations of a common movement under independent noise, with their covariance."""
    common = rng.normal(0, 1, (m, 3))
    S = 4.0 * common @ common.T + np.diag(rng.uniform(0.5, 2.0, m))
    return np.linalg.cholesky(S) @ rng.standard_normal(m), S


def test_gross_errors_are_refused_one_by_one_and_nothing_else():
    rng = np.random.default_rng(SEED)
    refuse = screening.refuse()
    missed = false = 0
    for _ in range(200):
        eta, S = innovations(rng)
        bad = rng.choice(30, 3, replace=False)
        eta[bad] += 20.0 * rng.choice((-1.0, 1.0), 3)
        found = refuse(eta, np.linalg.cholesky(S))
        missed += 3 - found[bad].sum()
        false += found.sum() - found[bad].sum()
    assert missed <= 0.02 * 600
    assert false <= 0.001 * 200 * 27


def test_a_common_movement_is_not_refused():
    rng = np.random.default_rng(SEED)
    eta, S = innovations(rng)
    values, vectors = np.linalg.eigh(S)
    moved = eta + 3.5 * np.sqrt(values[-1]) * vectors[:, -1]
    assert (np.abs(moved) > 4).any()
    assert not screening.refuse()(moved, np.linalg.cholesky(S)).any()


def test_what_only_the_others_speak_against_is_not_refused():
    common = np.random.default_rng(SEED).normal(0, 1, (30, 3))
    S = 4.0 * common @ common.T + 0.1 * np.eye(30)
    own = np.sqrt(S[7, 7])
    inverse = np.linalg.inv(S)
    for far, refused in ((2.0, False), (3.0, True)):
        moved = np.zeros(30)
        moved[7] = far * own
        assert np.abs((inverse @ moved)[7]) / np.sqrt(inverse[7, 7]) > 6
        assert screening.refuse()(moved, np.linalg.cholesky(S))[7] == refused


def test_first_refusal_is_the_largest_normalised_residual():
    rng = np.random.default_rng(SEED)
    eta, S = innovations(rng)
    eta[7] += 30.0
    inverse = np.linalg.inv(S)
    largest = np.argmax(np.abs(inverse @ eta) / np.sqrt(np.diagonal(inverse)))
    assert largest == 7
    found = screening.refuse(InnovationParams(factor=4.0, largest_share=0.04))(
        eta, np.linalg.cholesky(S)
    )
    np.testing.assert_array_equal(np.flatnonzero(found), [7])


def test_more_than_a_share_is_never_refused():
    rng = np.random.default_rng(SEED)
    eta, S = innovations(rng)
    assert (
        screening.refuse(InnovationParams(largest_share=0.2))(
            1e3 * eta, np.linalg.cholesky(S)
        ).sum()
        <= 6
    )


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
    method = Method(
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
    plain = Method("m", "kalman", noise="scalar", variance=1e-5, reading="instant")
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
    done = estimate(aligned, raw.channels, feeder(), STUDY, Method("m", "wls", screening="scaled"))
    found = spiked_rows(done.residuals)["reasons"] & int(Reason.INCREMENT)
    assert (found > 0).all()


def test_screening_by_innovation_is_for_the_kalman_filter():
    with pytest.raises(ParameterError, match="kalman"):
        Method("m", "wls", screening="innovation")
