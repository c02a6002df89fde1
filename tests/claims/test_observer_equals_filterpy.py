"""Claim: the machine's recursive observer is the Kalman filter that filterpy runs."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import KalmanFilter

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.machine import observer
from pse_analysis.machine import Densities, Machine, sample
from pse_analysis.simulation.machine import disturb

MACHINE = Machine(200.0, 6.4, 0.032)
NOISE = Densities(0.005, 0.005, 0.0001)
STEP_S = 0.01


def test_recursive_observer_equals_filterpy_through_a_gap() -> None:
    drawn = disturb(MACHINE, NOISE, STEP_S, 300, 1, np.random.default_rng(3))
    y = drawn.x[:, 0, 0] + drawn.noise[:, 0]
    u = 0.02 * np.sin(np.arange(301) * STEP_S)
    step = sample(MACHINE, NOISE, STEP_S)
    peer = KalmanFilter(dim_x=2, dim_z=1)
    peer.F, peer.H, peer.Q, peer.R = step.F, MACHINE.C, step.Q, step.R
    peer.x, peer.P = np.zeros((2, 1)), np.diag([9.0, 4.0])
    ours = observer(
        "o", MACHINE, NOISE, STEP_S, gain="recursive", start=(0.0, 0.0), start_sigma=(3.0, 2.0)
    )
    state = None
    for k in range(301):
        known = not 100 <= k < 150
        shot = Snapshot(
            np.datetime64("2025-01-01", "us") + np.timedelta64(10_000 * k, "us"),
            y[k : k + 1], np.ones(1), np.zeros(1), np.array([known]), np.array([known]),
            np.zeros(1), inputs=u[k : k + 1],
        )  # fmt: skip
        state, _ = ours.init(shot) if state is None else ours.step(state, shot)
        if k:
            peer.predict()
            peer.x = peer.x + step.G0 * u[k - 1] + step.G1 * u[k]
        if known:
            peer.update(y[k])
        np.testing.assert_allclose(state.x, peer.x[:, 0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(state.P, peer.P, rtol=1e-9, atol=1e-15)
