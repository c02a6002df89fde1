"""Claim: what a case file composes is the filter that runs, and what does not fit is refused."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from qu_bench import still

from pse_analysis import parameters
from pse_analysis.errors import ParameterError
from pse_analysis.estimation import EstimateParams, Method, Record, Setting
from pse_analysis.estimation.core.interface import Estimator
from pse_analysis.estimation.filters.composition import Composition
from pse_analysis.parameters import Study

CASES = Path(__file__).parents[2] / "pipelines" / "cases"
SEED = 9
STUDY = Study(datetime(2016, 6, 9, tzinfo=UTC), datetime(2016, 6, 9, 1, tzinfo=UTC), step_s=600.0)


def made(method: Method) -> Estimator:
    """The method's estimator on ieee14, with no history to learn from."""
    b = still("ieee14")
    none = np.zeros((0, len(b.layout)))
    history = Record(np.zeros(0, "datetime64[us]"), none, none, none, none > 0, none > 0, none)
    return method.estimator(Setting(b.network, b.layout, STUDY, history))


@pytest.mark.parametrize("case", ["ieee30", "ieee118"])
def test_methods_of_the_cases_track_the_state(case: str) -> None:
    section = tomllib.loads((CASES / f"{case}.toml").read_text(encoding="utf-8"))["estimate"]
    methods = parameters.build(EstimateParams, section, "estimate").methods
    assert {"ukf", "improved_ukf", "rukf", "rukf_channel"} <= {m.name for m in methods}
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))
    for method in methods:
        estimator = made(method)
        state, _ = estimator.init(b.snapshot(z[0]))
        for row in z[1:]:
            state, _ = estimator.step(state, b.snapshot(row))
        found = estimator.read(state)
        assert found is not None
        assert np.abs(found.x - b.truth[-1]).max() < 0.04, method.name


def test_scalar_noise_is_added_to_every_voltage() -> None:
    b = still("ieee14")
    estimator = made(Method.of("f", "ekf", noise="scalar", variance=1e-3, angle_reference="fixed"))
    state, _ = estimator.init(b.snapshot(b.exact[0]))
    nothing = np.zeros(len(b.layout), dtype=bool)
    after, _ = estimator.step(state, b.snapshot(b.exact[0], nothing))
    np.testing.assert_allclose(np.diagonal(after.inner.P - state.inner.P), 1e-3)


def test_load_noise_moves_what_the_loads_move_and_not_the_reference() -> None:
    b = still("ieee14")
    estimator = made(
        Method.of("f", "ukf", noise="load", source_sigma=1e-3, angle_reference="fixed")
    )
    state, _ = estimator.init(b.snapshot(b.exact[0]))
    nothing = np.zeros(len(b.layout), dtype=bool)
    after, _ = estimator.step(state, b.snapshot(b.exact[0], nothing))
    added = np.diagonal(after.inner.P - state.inner.P)
    slack, n = b.network.slack, b.network.n_bus
    assert added[slack] == pytest.approx(0.0, abs=1e-15)
    assert added[n + slack] == pytest.approx(1e-6)
    assert (np.delete(added[:n], slack) > 1e-8).all()


def test_composition_belongs_to_the_filters_that_have_one() -> None:
    with pytest.raises(
        ParameterError, match=r'compose\.robustness has no effect here: .*filter = "ukf" or "ekf"'
    ):
        Method.of("f", "kalman", compose=Composition(process="holt", robustness="trace"))
    with pytest.raises(ParameterError, match="trace"):
        parameters.build(
            Method, {"name": "f", "filter": "ukf", "compose": {"robustness": "tracer"}}, "m"
        )
