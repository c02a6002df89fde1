"""Claim: odd and even parts of h in closed form are those of h at the points themselves."""

from __future__ import annotations

import numpy as np
import pytest
from reference import every_quantity

from pse_analysis.estimation.filters.conditioning import Prior
from pse_analysis.estimation.filters.sigma_points import SigmaPoints
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import IA, IM, MeasurementModel, wrap

SEED = 29


def prior_of(grid: str, sigma: float, *, fixed: bool, slopes: bool) -> tuple[Prior, np.ndarray]:
    """Around the nominal state, with or without the slack's angle and slopes; and chol(P)."""
    network = library.load(grid)
    x = solve(network).x
    columns = np.arange(len(x))
    if fixed:
        columns = np.delete(columns, network.slack)
    size = len(columns) * (1 + slopes)
    half = np.random.default_rng(SEED).standard_normal((size, size))
    P = sigma**2 * (half @ half.T / size + np.eye(size))
    s = np.concatenate([x[columns], np.zeros(size - len(columns))])
    return Prior(s, P, x, columns), np.linalg.cholesky(P)


@pytest.mark.parametrize("grid", ["ieee14", "ieee57", "ieee300"])
@pytest.mark.parametrize("fixed", [False, True], ids=["all_angles", "slack_fixed"])
@pytest.mark.parametrize("sigma", [1e-6, 0.02, 0.3])
def test_parts_of_every_quantity(grid: str, fixed: bool, sigma: float) -> None:
    """At σ = 0.3 the points turn by whole turns, and voltages change their sign."""
    network = library.load(grid)
    prior, chol_P = prior_of(grid, sigma, fixed=fixed, slopes=False)
    every = every_quantity(network)
    # A current of zero has no angle.
    current = MeasurementModel(network, every).h(prior.x)[every.quantity == IM]
    angle = np.flatnonzero(every.quantity == IA)
    layout = every.take(np.delete(np.arange(len(every)), angle[current < 1e-6]))
    model = MeasurementModel(network, layout, prior.columns)
    points = SigmaPoints(model)
    rng = np.random.default_rng(SEED)
    direction = rng.choice(prior.n, 12, replace=False)
    for rows in (np.arange(len(layout)), np.flatnonzero(rng.random(len(layout)) < 0.3)):
        found = points.spread(prior, float(prior.n), rows)
        step = np.zeros((len(prior.x), len(direction)))
        step[prior.columns] = np.sqrt(prior.n) * chol_P[:, direction]
        centre = model.h(prior.x)[rows]
        away = [model.h(prior.x[:, None] + sign * step)[rows] - centre[:, None] for sign in (1, -1)]
        for part in away:
            angular = model.angular[rows]
            part[angular] = wrap(part[angular])
        odd, even = 0.5 * (away[0] - away[1]), 0.5 * (away[0] + away[1])
        scale = np.abs(away[0]).max()
        np.testing.assert_allclose(found.centre, centre)
        # Whole turns of an angle that is read as it stands are turns of the state.
        linear = np.arange(len(rows))[found.linear]
        np.testing.assert_allclose(
            wrap(np.sqrt(prior.n) * chol_P[found.entry][:, direction]), wrap(odd[linear]), atol=1e-9
        )
        np.testing.assert_allclose(found.odd[:, direction], odd[found.curved], atol=1e-9 * scale)
        np.testing.assert_allclose(found.even[:, direction], even[found.curved], atol=1e-9 * scale)
        np.testing.assert_allclose(found.shift, found.even.sum(axis=1) / prior.n)


def test_even_part_of_a_small_step_has_digits_that_a_difference_loses() -> None:
    """Halved twice, a step has a sixteenth of the even part, to far below the last digit of h."""
    network = library.load("ieee14")
    layout = every_quantity(network).take(np.arange(2 * 14, 4 * 14))
    prior, _ = prior_of("ieee14", 1e-6, fixed=False, slopes=False)
    points = SigmaPoints(MeasurementModel(network, layout))
    rows = np.arange(len(layout))
    whole, quarter = (points.spread(prior, square, rows).even for square in (16.0, 1.0))
    assert np.abs(whole).max() < 1e-9
    np.testing.assert_allclose(quarter, whole / 16.0, atol=1e-6 * np.abs(whole).max(), rtol=0)


def test_slopes_move_no_measurement() -> None:
    network = library.load("ieee14")
    layout = every_quantity(network)
    prior, _ = prior_of("ieee14", 0.02, fixed=False, slopes=True)
    alone = Prior(prior.s[:28], prior.P[:28, :28], prior.x, prior.columns)
    points = SigmaPoints(MeasurementModel(network, layout))
    both, one = (points.spread(each, 28.0, np.arange(len(layout))) for each in (prior, alone))
    np.testing.assert_allclose(both.odd, one.odd, atol=1e-12)
    np.testing.assert_allclose(both.even, one.even, atol=1e-12)
