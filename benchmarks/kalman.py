"""A step of the Kalman filter beside filterpy's on the same matrices."""

from __future__ import annotations

import dataclasses

import numpy as np
from filterpy.kalman import KalmanFilter

from benchmarks.timing import Row, alternate
from pse_analysis.estimation.estimator import Snapshot
from pse_analysis.estimation.kalman import kalman_filter, predict, update
from pse_analysis.estimation.process import LoadStatistics, load_noise
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import (
    BUS,
    VA,
    VM,
    MeasurementModel,
    P,
    Q,
    RectangularModel,
    SensorLayout,
)

SEED = 33
STEP_S = 300.0
REPEATS = 51


def run() -> list[Row]:
    """One step on ieee33: the recursion alone, and with everything that the estimator does."""
    network = library.load("ieee33")
    bus, load = np.array([1, 2, 5, 11, 30]), np.arange(1, network.n_bus)
    layout = SensorLayout.of(
        network, (VM, bus, BUS), (VA, bus, BUS), (P, load, BUS), (Q, load, BUS)
    )
    names = tuple(f"d{p}:{q}" for p, q in zip(layout.position, layout.quantity, strict=True))
    layout = dataclasses.replace(layout, channel=names)
    sigma = np.full(len(layout), 2e-3)
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    statistics = LoadStatistics(0.02 * nominal[None, :], np.eye(66), 1e-3, 86400.0)
    noise = load_noise(network, statistics)
    estimator = kalman_filter("kf", network, layout, noise, step_s=STEP_S)
    flow = solve(network)
    exact = MeasurementModel(network, layout).h(flow.x)
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    rng = np.random.default_rng(SEED)
    z = exact + sigma * rng.normal(size=len(sigma))
    now = Snapshot(np.datetime64("2016-06-09T12:00:00", "us"), z, sigma, zero, on, on, zero)
    state, _ = estimator.init(now)

    voltage = flow.vm * np.exp(1j * flow.theta)
    H, linear, spread = RectangularModel(network, layout).rows(z, sigma, on, voltage)
    H, R, walk = H.toarray(), np.diag(spread**2), noise(voltage, now.time)
    peer = KalmanFilter(dim_x=66, dim_z=len(layout))
    peer.F, peer.H, peer.R, peer.Q = np.eye(66), H, R, walk

    def theirs() -> None:
        peer.x, peer.P = state.x, state.P
        peer.predict()
        peer.update(linear)

    recursion = alternate(lambda: update(predict(state, walk), H, linear, R), theirs, REPEATS)
    ours = update(predict(state, walk), H, linear, R)[0]
    theirs()
    difference = np.abs(ours.x - peer.x).max()
    whole = alternate(lambda: estimator.step(state, now), theirs, REPEATS)
    return [
        Row(
            f"Kalman predict and update, ieee33 (66 states, {len(layout)} rows)",
            *recursion,
            "filterpy",
            f"states differ by {difference:.0e}",
        ),
        Row(
            "Kalman step of the estimator, ieee33",
            *whole,
            "filterpy",
            "ours also transforms the measurements and makes Q and NIS",
        ),
    ]
