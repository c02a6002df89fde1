"""Claim: trials of filters give the same numbers on any number of processes, and count errors."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from qu_bench import still

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.filters.composition import Composition
from pse_analysis.estimation.process.load_noise import LoadStatistics
from pse_analysis.measurement import VM
from pse_analysis.pipeline.monte_carlo_filters import (
    Errors,
    Experiment,
    Recipe,
    monte_carlo_filters,
)

SEEDS = (3, 4, 5)
PLAIN = Recipe(Composition())
ROBUST = Recipe(Composition(robustness="per_channel"))


def experiment(errors: Errors = Errors(), **recipes: Recipe) -> Experiment:  # noqa: B008
    b = still("ieee14")
    return Experiment(b.network, b.layout, b.truth, recipes or {"ukf": PLAIN}, errors)


def test_numbers_do_not_depend_on_the_number_of_processes() -> None:
    tried = {
        "clean": experiment(ukf=PLAIN, robust=ROBUST),
        "bad": experiment(Errors(0.05), ukf=PLAIN, robust=ROBUST),
    }
    alone, two = (monte_carlo_filters(tried, SEEDS, workers=n) for n in (1, 2))
    # The workers have one BLAS thread; this process has as many as it was given.
    pd.testing.assert_frame_equal(alone, two, rtol=1e-9)
    assert list(alone.columns[:3]) == ["experiment", "filter", "seed"]
    assert len(alone) == 2 * 2 * len(SEEDS)


def test_experiments_share_the_noise_of_a_seed_and_seeds_do_not() -> None:
    tried = {"a": experiment(), "b": experiment(Errors(1.0, 100.0, 9, "vm_pu@bus/4"))}
    table = monte_carlo_filters(tried, SEEDS, workers=1).set_index(["experiment", "seed"])
    assert table.loc["a", "vm_rmse"].is_unique
    assert (table.loc["b", "vm_rmse"] > 5.0 * table.loc["a", "vm_rmse"]).all()
    noise = [tried[name].measured(3)[0][:9] for name in tried]
    np.testing.assert_array_equal(*noise)


def test_named_channels_are_counted_against_what_was_spoilt() -> None:
    errors = Errors(1.0, 10.0, 9, "vm_pu@bus/4")
    table = monte_carlo_filters({"one": experiment(errors, robust=ROBUST)}, SEEDS, workers=1)
    for column in ("bad", "named", "right", "large", "found"):
        assert list(table[column]) == [1, 1, 1]
    assert not table["lost"].any()
    z, bad = experiment(errors).measured(3)
    at = still("ieee14").layout.quantity == VM
    assert bad.sum() == 1
    assert bad[9, at].sum() == 1
    assert z[bad][0] > 5.0


def test_noise_learnt_from_loads_can_be_a_recipe() -> None:
    b = still("ieee14")
    n = 2 * b.network.n_bus
    known = LoadStatistics(np.full((1, n), 0.01), np.eye(n), 1e-3, 86400.0)
    table = monte_carlo_filters(
        {"clean": experiment(load=Recipe(Composition(), known))}, SEEDS, workers=1
    )
    assert (table["vm_rmse"] < 0.01).all()


def test_unknown_channel_is_refused() -> None:
    with pytest.raises(ParameterError, match="no channel 'vm' in the layout: take one of"):
        experiment(Errors(1.0, channel="vm")).measured(3)
