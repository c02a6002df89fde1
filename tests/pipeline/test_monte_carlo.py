"""Claim: many seeds give the same numbers however many processes try them, and pairs are pairs."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.monte_carlo import monte_carlo
from pse_analysis.pipeline.stages import Parameters, check_case

SEEDS = (11, 12)


@pytest.fixture(scope="module")
def hour() -> Parameters:
    """An hour of the smallest case, two methods."""
    settings = check_case(load_case("ieee33"))
    study = replace(settings.study, end=settings.study.start + timedelta(hours=1), history_s=7200.0)
    methods = [m for m in settings.estimate.methods if m.name in ("wls", "kf_scalar")]
    return replace(
        settings, study=study, estimate=replace(settings.estimate, methods=tuple(methods))
    )


def test_numbers_do_not_depend_on_the_number_of_processes(hour: Parameters) -> None:
    told: list[tuple[int, int]] = []
    alone = monte_carlo(
        "ieee33", {"a": hour}, SEEDS, workers=1, progress=lambda *of: told.append(of)
    )
    assert told == [(1, 2), (2, 2)]
    assert monte_carlo("ieee33", {"a": hour}, SEEDS, workers=2).equals(alone)


def test_worlds_share_the_noise_of_a_seed_and_seeds_do_not(hour: Parameters) -> None:
    table = monte_carlo("ieee33", {"a": hour, "b": hour}, SEEDS, workers=1)
    wide = table.pivot(index=["seed", "method", "metric"], columns="world", values="value")
    assert (wide["a"].fillna(0) == wide["b"].fillna(0)).all()
    errors = table[(table["metric"] == "vm_error_mean") & (table["world"] == "a")]
    assert errors["value"].is_unique


def test_a_case_without_a_simulated_grid_is_refused(hour: Parameters) -> None:
    with pytest.raises(ParameterError, match=r"expected worlds with \[simulate\] of a grid"):
        monte_carlo("ieee33", {"a": replace(hour, simulate=None)}, SEEDS)
