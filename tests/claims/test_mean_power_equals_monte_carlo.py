"""Claim: the closed mean of powers under a normal state is what a million draws average to."""

from __future__ import annotations

import numpy as np

from pse_analysis.estimation.filters.conditioning import Prior
from pse_analysis.estimation.filters.unscented import PowerMean
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, TO, VM, MeasurementModel, P, Q, SensorLayout

SEED = 3
DRAWS = 1_000_000
CHUNK = 10_000


def test_mean_of_powers_equals_a_million_draws() -> None:
    network = library.load("ieee14")
    n = network.n_bus
    bus, branch = np.arange(n), np.arange(network.n_branch)
    layout = SensorLayout.of(
        network,
        (VM, bus[:2], BUS),
        (Q, bus, BUS),
        (P, bus, BUS),
        (P, branch, FROM),
        (Q, branch, TO),
    )
    columns = np.delete(np.arange(2 * n), network.slack)
    model = MeasurementModel(network, layout, columns)
    rng = np.random.default_rng(SEED)
    half = rng.standard_normal((len(columns), len(columns)))
    covariance = 0.03**2 * (half @ half.T / len(columns) + np.eye(len(columns)))
    x = solve(network).x
    prior = Prior(x[columns], covariance, x, columns)
    rows = np.arange(1, len(layout), 2)
    mean, which = PowerMean(model).mean(prior, rows)
    assert (layout.quantity[rows[which]] != VM).all()
    factor = np.linalg.cholesky(covariance)
    total, square = np.zeros(len(which)), np.zeros(len(which))
    for _ in range(DRAWS // CHUNK):
        points = np.repeat(x[:, None], CHUNK, axis=1)
        points[columns] += factor @ rng.standard_normal((len(columns), CHUNK))
        y = model.h(points)[rows[which]]
        total, square = total + y.sum(axis=1), square + (y**2).sum(axis=1)
    drawn = total / DRAWS
    error = np.sqrt((square / DRAWS - drawn**2) / DRAWS)
    assert np.abs((mean - drawn) / error).max() < 4.0
    # What is compared is no rounding: at the mean state the powers are elsewhere.
    assert (np.abs(model.h(x)[rows[which]] - drawn) > 10.0 * error).mean() > 0.5
