"""Claim: bad data cost a screened filter less than half of what they cost a plain one.

Table 3 of [qi2025], on smooth aggregated load and a clean history, for the mean |V| error.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
from simulated_case import curves, feeder

from pse_analysis.alignment import align
from pse_analysis.estimation import estimate
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.stages import check_case
from pse_analysis.scoring import errors
from pse_analysis.simulation import simulate
from pse_analysis.simulation.settings import FaultParams, LoadParams, LoadStepParams
from pse_analysis.validation import validate

SEED = 401
SHARE = 0.10


@cache
def mean_errors(share: float) -> dict[str, float]:
    """Mean |V| error by screening. [p.u.]"""
    case = check_case(load_case("qi2025"))
    study = replace(case.study, history_s=86400.0)
    faults = (FaultParams("spike", share, (0.05, 0.05), relative=True, start=study.start),)
    params = replace(
        case.simulate,
        seed=SEED,
        faults=faults if share else (),
        load=LoadParams(per_bus=14, concentration=10.0),
        load_steps=LoadStepParams(),
        source_voltage=replace(case.simulate.source_voltage, taps_per_day=0.0),
        pv=(),
    )
    raw = simulate(feeder(), curves(), study, params)
    validated = validate(raw.telemetry, raw.channels, case.validate, history_end=study.start)
    variants = tuple(v for v in case.align.variants if v.name == "none_pseudo")
    aligned = align(
        validated, raw.channels, feeder(), study, replace(case.align, variants=variants)
    )
    plain = next(m for m in case.estimate.methods if m.name == "ekf")
    out = {}
    for screening in ("none", "scaled", "innovation"):
        method = replace(plain, screening=screening, variant="none_pseudo")
        done = estimate(aligned, raw.channels, feeder(), study, method)
        scores = errors.of_states(
            errors.against_truth(done.estimated, raw.truth), by_element=False
        ).set_index("metric")
        out[screening] = float(scores.loc["vm_error_mean", "value"])
    return out


@pytest.mark.parametrize("screening", ["scaled", "innovation"])
def test_error_grows_by_less_than_half(screening: str):
    clean, bad = mean_errors(0.0), mean_errors(SHARE)
    growth = {name: bad[name] / clean[name] - 1.0 for name in clean}
    assert growth["none"] > 0.5
    assert growth[screening] < 0.5 * growth["none"]
    assert bad[screening] < bad["none"]


@pytest.mark.parametrize("screening", ["scaled", "innovation"])
def test_without_bad_data_screening_changes_the_error_by_less_than_two_per_cent(screening: str):
    clean = mean_errors(0.0)
    assert abs(clean[screening] / clean["none"] - 1.0) < 0.02
