"""Claim: over 10⁵ steps the unscented filter's covariance needs no repair and stays definite.

The grid has three buses: what wears a covariance off is the number of updates, not its size, and a
step of any size takes the same time in Python. For that reason the recursion runs without what a
filter does around it, that is to choose channels and to report, and the powers report at every
fifth instant only: sigma points are most of a step's time, and an update takes its product from P
in the same way whatever it was made of.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest
from qu_bench import Bench, paper_layout

from pse_analysis.estimation.filters import conditioning
from pse_analysis.estimation.filters.conditioning import Prior
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import VA, VM, MeasurementModel

SEED = 3
STEPS = 100_000
SLOW = 5
"""Instants from one report of the powers to the next; voltages report at each."""
NOISE = 1e-14
"""Next to none, so that P shrinks to a millionth of its start."""


def three_buses() -> Bench:
    """A slack and two loads, all joined."""
    network = Network.from_tables(
        pd.DataFrame({"name": ["three"], "base_mva": [100.0]}),
        pd.DataFrame(
            {
                "name": ["1", "2", "3"],
                "kind": [3, 1, 1],
                "vn_kv": 110.0,
                "p_load_mw": [0.0, 60.0, 45.0],
                "q_load_mvar": [0.0, 20.0, 15.0],
            }
        ),
        pd.DataFrame(
            {
                "from_bus": ["1", "2", "1"],
                "to_bus": ["2", "3", "3"],
                "r_pu": [0.01, 0.02, 0.015],
                "x_pu": [0.08, 0.12, 0.1],
                "b_pu": 0.02,
            }
        ),
    )
    layout, x = paper_layout(network, ("1",)), solve(network).x
    return Bench(network, layout, x[None], MeasurementModel(network, layout).h(x)[None])


def test_covariance_of_the_default_form_stays_definite(monkeypatch: pytest.MonkeyPatch) -> None:
    b = three_buses()
    rng = np.random.default_rng(SEED)
    n, m = len(b.start), len(b.layout)
    R, Q = b.layout.sigma**2, NOISE * np.eye(n)
    voltages = np.flatnonzero(np.isin(b.layout.quantity, (VM, VA)))
    few = dataclasses.replace(b, layout=b.layout.take(voltages), exact=b.exact[:, voltages])
    # A filter, its rows of the whole layout, a snapshot for their σ, its own rows.
    every, some = (
        (each.filter(), rows, each.snapshot(each.exact[0]), np.arange(len(rows)))
        for each, rows in ((b, np.arange(m)), (few, voltages))
    )
    turns = [some if k % SLOW else every for k in range(1000)]
    # A repair would raise the diagonal, which only `cholesky` does.
    monkeypatch.setattr(conditioning.np, "diag", lambda _: pytest.fail("P had to be repaired"))
    s, P = b.truth[0], b.start
    for _ in range(STEPS // 1000):
        measured = b.exact[0] + b.layout.sigma * rng.standard_normal((1000, m))
        for (ukf, rows, snapshot, own), z in zip(turns, measured, strict=True):
            prior = Prior(s, P + Q, s, ukf.model.columns)
            predicted = ukf.observation.predict(prior, snapshot, own, 1.0, s)
            s, P, *_ = predicted.condition(prior, z[rows] - predicted.mean, R[rows], None)
        assert np.linalg.eigvalsh(P)[0] > 1e-12
        np.testing.assert_array_equal(P, P.T)
    assert np.abs(s - b.truth[0]).max() < 4.0 * np.sqrt(np.diagonal(P).max())
    assert np.diagonal(P).max() < 1e-3 * np.diagonal(b.start).max()
