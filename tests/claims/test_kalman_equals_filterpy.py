"""Claim: on the same linear model the Kalman filter equals filterpy's to 1e-9 over 20 steps."""

from __future__ import annotations

import dataclasses

import numpy as np
from filterpy.kalman import KalmanFilter

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.kalman import kalman_filter
from pse_analysis.estimation.process.load_noise import LoadStatistics, load_noise
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, IA, IM, VA, VM, MeasurementModel, SensorLayout

SEED = 20
STEPS = 20


def test_estimator_on_phasors_equals_filterpy_on_their_rectangular_form() -> None:
    """The peer gets e, f and 2×2 covariances; the estimator turns each phasor's frame instead."""
    network = library.load("ieee14")
    n, branch = network.n_bus, np.arange(network.n_branch)
    bus = np.array([0, 3, 8, 12])
    layout = SensorLayout.of(
        network, (VM, bus, BUS), (VA, bus, BUS), (IM, branch, FROM), (IA, branch, FROM)
    )
    names = tuple(
        f"d{p}.{s}:{q}"
        for p, s, q in zip(layout.position, layout.side, layout.quantity, strict=True)
    )
    layout = dataclasses.replace(layout, channel=names)
    sigma = np.where(np.isin(layout.quantity, (VM, IM)), 2e-3, 1e-3)
    size, angle = (np.flatnonzero(np.isin(layout.quantity, q)) for q in ((VM, IM), (VA, IA)))
    y = np.concatenate([np.eye(n)[bus], network.y_from.toarray()])
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    statistics = LoadStatistics(0.02 * nominal[None, :], np.eye(2 * n), 1e-3, 86400.0)
    noise = load_noise(network, statistics)
    # Phasors are linear in [e; f] as they are; powers would be turned.
    estimator = kalman_filter("kf", network, layout, noise, step_s=300.0, linearisation="transform")
    model = MeasurementModel(network, layout)
    rng = np.random.default_rng(SEED)
    scale = 1.0 + 0.002 * np.cumsum(rng.normal(size=(n, STEPS + 1)), axis=1)
    flow = solve(network, network.p_nominal_pu[:, None] * scale)
    exact = model.h(flow.x)

    def snapshot(k: int) -> Snapshot:
        on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
        z = exact[:, k] + sigma * rng.normal(size=len(sigma))
        time = np.datetime64("2016-06-09T00:00:00", "us") + k * np.timedelta64(300, "s")
        return Snapshot(time, z, sigma, zero, on, on, zero)

    state, _ = estimator.init(snapshot(0))
    peer = KalmanFilter(dim_x=2 * n, dim_z=2 * len(size))
    peer.x, peer.P, peer.F = state.x.copy(), state.P.copy(), np.eye(2 * n)
    peer.H = np.block([[y.real, -y.imag], [y.imag, y.real]])
    moved = 0.0
    for k in range(1, STEPS + 1):
        now = snapshot(k)
        peer.Q = noise(state.x[:n] + 1j * state.x[n:], now.time)
        magnitude, phase = now.z[size], now.z[angle]
        sine, cosine = np.sin(phase), np.cos(phase)
        along, across = sigma[size] ** 2, magnitude**2 * sigma[angle] ** 2
        both = np.diag(sine * cosine * (along - across))
        peer.R = np.block(
            [
                [np.diag(cosine**2 * along + sine**2 * across), both],
                [both, np.diag(sine**2 * along + cosine**2 * across)],
            ]
        )
        peer.predict()
        peer.update(np.concatenate([magnitude * cosine, magnitude * sine]))
        before = state.x
        state, info = estimator.step(state, now)
        moved = max(moved, np.abs(state.x - before).max())
        np.testing.assert_allclose(state.x, peer.x, atol=1e-9)
        np.testing.assert_allclose(state.P, peer.P, atol=1e-9)
        assert abs(info.nis - peer.mahalanobis**2) < 1e-6
    assert moved > 1e-4
