"""Claim: on ieee33 under real load the `load` filter is consistent and twice as accurate as WLS.

Ten seeds, which also draw ten ways of mixing the load curves: errors on a feeder are common to all
buses and slow in time, so a day is hardly more than a handful of independent looks at a filter. The
bounds are the wide ones that heavy-tailed load needs; elsewhere the filter's own model has narrow
ones.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest

from pse_analysis.alignment import align
from pse_analysis.estimation import estimate
from pse_analysis.grid import library
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.stages import check_case
from pse_analysis.scoring import score
from pse_analysis.simulation import profiles, simulate
from pse_analysis.validation import validate

ROOT = Path(__file__).parents[2]
SEEDS = range(1, 11)


@pytest.fixture(scope="module")
def scores() -> pd.DataFrame:
    """Scores of wls and kf_load, one row per method and seed, metrics in columns."""
    case = load_case("ieee33", ROOT / "pipelines" / "cases")
    settings = check_case(case)
    assert settings.simulate is not None
    network = library.load("ieee33")
    curves = profiles.load(ROOT / "data" / "raw" / "load_profiles")
    methods = [m for m in settings.estimate.methods if m.name in ("wls", "kf_load")]
    rows = []
    for seed in SEEDS:
        drawn = dataclasses.replace(settings.simulate, seed=seed, trials=1)
        raw = simulate(network, curves, settings.study, drawn)
        validated = validate(
            raw.telemetry, raw.channels, settings.validate, history_end=settings.study.start
        )
        aligned = align(validated, raw.channels, network, settings.study, settings.align)
        results = [
            estimate(aligned, raw.channels, network, settings.study, method, truth=raw.truth)
            for method in methods
        ]
        scored = score(
            pd.concat([r.estimated for r in results]),
            pd.concat([r.steps for r in results]),
            validated,
            raw.truth,
        )
        whole = scored[scored["element"] == ""]
        rows.append(whole.pivot_table(index="method", columns="metric", values="value"))
    return pd.concat(rows, keys=SEEDS, names=["seed"]).reset_index()


def test_nis_and_coverage_lie_in_the_bounds_of_real_load(scores: pd.DataFrame) -> None:
    filtered = scores[scores["method"] == "kf_load"]
    assert 0.8 <= filtered["nis_ratio"].mean() <= 1.25, filtered["nis_ratio"].round(2).tolist()
    for metric in ("coverage_vm", "coverage_va"):
        assert 0.90 <= filtered[metric].mean() <= 0.99, filtered[metric].round(3).tolist()


def test_load_noise_at_least_halves_the_voltage_error_of_tracking_wls(
    scores: pd.DataFrame,
) -> None:
    error = scores.pivot_table(index="seed", columns="method", values="vm_error_mean")
    ratio = error["kf_load"] / error["wls"]
    assert ratio.mean() <= 0.5, ratio.round(2).to_dict()
    assert ratio.max() < 1.0, ratio.round(2).to_dict()
