"""Claim: where h is linear, every unscented and extended filter is the Kalman filter, to 1e-10."""

from __future__ import annotations

import numpy as np
import pytest
from qu_bench import VARIANCE
from reference import kalman_step

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.core.run_arrays import EPOCH
from pse_analysis.estimation.filters.composition import Composition, compose, scalar
from pse_analysis.estimation.filters.unscented import Scaling
from pse_analysis.estimation.process.dynamics import HoltParams
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, SensorLayout

SEED = 2
ALPHA, BETA = 0.85, 0.05
STEPS = 20

CHOICES = {
    "fixed": ("ukf", Composition()),
    "narrow": ("ukf", Composition(points=Scaling(alpha=0.1, kappa=1.0))),
    "cubature": ("ukf", Composition(points=Scaling(beta=0.0))),
    "square_root": ("ukf", Composition(form="square_root")),
    "square_root_trend": ("ukf", Composition(form="square_root", process="local_trend")),
    "square_root_per_channel": (
        "ukf",
        Composition(form="square_root", robustness="per_channel"),
    ),
    "moments": ("ukf", Composition(scaling="moments")),
    "likelihood": ("ukf", Composition(scaling="likelihood")),
    "trace": ("ukf", Composition(robustness="trace")),
    "per_channel": ("ukf", Composition(robustness="per_channel")),
    "holt": ("ukf", Composition(process="holt", holt=HoltParams(as_printed=True))),
    "local_trend": ("ukf", Composition(process="local_trend")),
    "extended": ("ekf", Composition()),
    "iterated": ("ekf", Composition(passes=5)),
    "iterated_trend": ("ekf", Composition(process="local_trend", passes=5)),
}


@pytest.mark.parametrize("name", CHOICES)
def test_filter_equals_the_textbook_on_voltage_phasors(name: str) -> None:
    kind, choice = CHOICES[name]
    network = library.load("ieee14")
    n = network.n_bus
    layout = SensorLayout.of(network, (VM, np.arange(n), BUS), (VA, np.arange(0, n, 2), BUS))
    made = compose(kind, choice, network, layout, scalar(network, layout, VARIANCE))
    truth = solve(network).x
    size = 2 * n
    H = made.model.jacobian(truth).toarray()
    sigma = np.full(len(layout), 0.01)
    state = made.begin(truth, VARIANCE * np.eye(size), EPOCH)
    factor = ALPHA * (1 + BETA) if choice.process == "holt" else 1.0
    F, g = factor * np.eye(size), np.zeros(size)
    Q = VARIANCE * np.eye(size)
    if choice.process == "local_trend":
        F = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(size))
        H = np.hstack([H, np.zeros_like(H)])
        Q, g = made.process.noise(Q), np.zeros(2 * size)
    x, P = state.s, state.P
    forecast, before, slope = x, x, np.zeros(len(x))
    rng = np.random.default_rng(SEED)
    for _ in range(STEPS):
        if choice.process == "holt":
            level = ALPHA * x + (1 - ALPHA) * forecast
            slope = BETA * (level - before) + (1 - BETA) * slope
            forecast, before = level + slope, level
            g = forecast - factor * x
        z = made.model.h(truth) + sigma * rng.standard_normal(len(layout))
        on, zero = np.ones(len(z), dtype=bool), np.zeros(len(z))
        after, info = made.step(state, Snapshot(EPOCH, z, sigma, zero, on, on, zero))
        assert after is not None
        state = after
        assert not info.inflation.any()
        # The textbook's affine step: its z is moved by what g adds to the forecast.
        x, P = kalman_step(x, P, F, Q, H, np.diag(sigma**2), z - H @ g)
        x = x + g
        np.testing.assert_allclose(state.s, x, atol=1e-10, rtol=0)
        np.testing.assert_allclose(state.P, P, atol=1e-10, rtol=0)
