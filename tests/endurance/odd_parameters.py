"""Parameters of the stages with odd values, and the stages run with those that are accepted."""

from __future__ import annotations

import copy
from datetime import timedelta
from functools import cache
from typing import Any

import pandas as pd
from hypothesis import strategies as st
from tests.endurance import tiny_case
from tests.endurance.odd_case_files import ANY, LIKE, NONE, VALUES_OF_KEYS, changed
from tests.endurance.odd_tables import require_finite

from pse_analysis.alignment import AlignParams, align
from pse_analysis.estimation import EstimateParams, estimate
from pse_analysis.machine import Densities, Machine
from pse_analysis.parameters import Study, build
from pse_analysis.scoring import ScoreParams, score
from pse_analysis.simulation import MachineSimulateParams, simulate_machine
from pse_analysis.telemetry import RawCase
from pse_analysis.validation import ValidateParams, validate

_COMPOSE = {
    "process": "holt",
    "holt": {"alpha": 0.8, "beta": 0.1},
    "points": {"alpha": 0.5, "kappa": 0.0, "beta": 2.0},
    "protection": {"patience": 3, "share": 0.1},
    "robustness": "per_channel",
    "learning": "sage_husa",
    "forgetting": 0.97,
}
_RULE = {
    **{"source": "*", "quantity": "vm_pu", "lower": 0.5, "upper": 1.5, "quantile": 4.0},
    **{"criterion": "bayes", "amplitude": 5.0, "q": 0.01, "q_max": 0.5, "k": 0.5, "confirm": 2},
    **{"stuck": 6, "late_s": 60.0, "time_of_day_bins": 4, "increment": 0.1, "bad_quality": [0]},
    **{"checks": ["limits", "increment", "extrapolation", "stuck", "time"]},
}
_TIME = {"window_s": 1800.0, "largest_delay_s": 60.0, "lag_window_s": 3600.0, "warp_penalty": 1.0}
_PSEUDO = {"window_s": 100.0, "relative": 0.3, "sigma": "relative", "sources": ["ami"]}

SECTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("validate", {"rules": [_RULE, {"quantity": "p_*", "cost_miss": 2.0, "unit": "kw"}]}),
    (
        "align",
        {
            "latency_s": 10.0,
            "interpolate": ["pmu"],
            "max_age_s": {"ami": 1800.0},
            "default_max_age_s": 3600.0,
            "growth": "history",
            "time": _TIME,
            "pseudo": _PSEUDO,
            "variants": [
                {"name": "last", "time": "xcorr", "pseudo": "hold"},
                {"name": "plain", "face_value": ["scada"]},
            ],
        },
    ),
    ("estimate", {"methods": [{"name": "kf", "filter": "kalman", "source_sigma": 0.001}]}),
    ("estimate", {"methods": [{"name": "kf", "filter": "kalman", "noise": "innovation"}]}),
    ("estimate", {"methods": [{"name": "w", "filter": "wls", "screening": "scaled"}]}),
    (
        "estimate",
        {
            "methods": [
                {
                    "name": "ukf",
                    "filter": "ukf",
                    "noise": "scalar",
                    "variance": 1e-6,
                    "compose": {**_COMPOSE, "scaling": "fixed", "form": "covariance"},
                }
            ]
        },
    ),
    (
        "estimate",
        {"methods": [{"name": "ekf", "filter": "ekf", "compose": {**_COMPOSE, "passes": 3}}]},
    ),
    (
        "machine",
        {
            "methods": [
                {
                    "name": "o",
                    "filter": "observer",
                    "observer": {"q": [0.1, 0.1], "r": 0.01, "start_sigma": [3.0, 2.0]},
                },
            ]
        },
    ),
    (
        "machine",
        {
            "methods": [
                {
                    "name": "p",
                    "filter": "observer",
                    "observer": {
                        "poles": [-2.0, -3.0],
                        "belief_q": [0.1, 0.1],
                        "belief_r": 0.01,
                    },
                }
            ]
        },
    ),
    ("score", {"by_hour": True, "by_element": True, "settling": {"after_s": 1.0, "window_s": 2.0}}),
)
"""Sections of a case, each with most of what may be said in it."""

PARAMETERS = st.tuples(
    st.integers(0, len(SECTIONS) - 1),
    st.lists(
        st.tuples(
            st.integers(0, 60),
            st.integers(0, len(VALUES_OF_KEYS) - 1),
            st.sampled_from([LIKE, LIKE, LIKE, ANY, NONE]),
        ),
        max_size=2,
    ),
)


@cache
def _machine() -> tuple[RawCase, Study, pd.DataFrame]:
    """A second of a machine's telemetry, aligned."""
    study = Study(tiny_case.START, tiny_case.START + timedelta(seconds=1), 0.1, 1.0)
    params = MachineSimulateParams(seed=3, densities=Densities(0.005, 0.005, 1e-4), period_s=0.1)
    raw = simulate_machine(Machine(s_mva=200.0, t_j_s=6.4, k_d_pu=0.032), study, params)
    validated = validate(raw.telemetry, raw.channels, history_end=study.start, model=raw.model)
    aligned = align(validated, raw.channels, raw.model, study, AlignParams(growth="none"))
    return raw, study, aligned


def run_stage(drawn: tuple[int, list[tuple[int, int, int]]]) -> None:
    """Build a section with odd values, and run its stage on a sound input."""
    number, changes = drawn
    name, section = SECTIONS[number]
    data = changed({"section": copy.deepcopy(section)}, changes).get("section", {})
    plain = tiny_case.plain_run()
    raw = plain.raw
    if name == "validate":
        rules = build(ValidateParams, data, "validate")
        validate(
            raw.telemetry, raw.channels, rules, history_end=tiny_case.STUDY.start, model=raw.model
        )
    elif name == "align":
        ways = build(AlignParams, data, "align")
        aligned = align(plain.validated, raw.channels, raw.model, tiny_case.STUDY, ways)
        require_finite(tiny_case.Run(raw, plain.validated, aligned, ()))
    elif name == "score":
        done = plain.estimated[0]
        judged = build(ScoreParams, data, "score")
        truth = done.estimated.drop(columns=["method", "sigma"])
        score(done.estimated, done.steps, plain.validated, truth, params=judged)
    else:
        methods = build(EstimateParams, data, "estimate").methods
        raw, study, aligned = (
            _machine() if name == "machine" else (raw, tiny_case.STUDY, plain.aligned)
        )
        for method in methods[:2]:
            done = estimate(aligned, raw.channels, raw.model, study, method)
            require_finite(tiny_case.Run(raw, plain.validated, aligned, (done,)))
