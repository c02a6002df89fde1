"""Claim: samples of another time enter as in a textbook filter whose state holds the past."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from reference import kalman_step

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.augmented_state import MOST_SIGMAS
from pse_analysis.estimation.filters.intervals import bridge_covariance, weights
from pse_analysis.estimation.filters.kalman import kalman_filter
from pse_analysis.estimation.process.dynamics import Process, holt, local_trend, random_walk
from pse_analysis.estimation.process.load_noise import LoadStatistics, load_noise
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
from pse_analysis.measurement.rectangular import Linearisation

SEED = 5
STEP_S = 300.0


def rows_about(
    at: np.ndarray, share: np.ndarray, now: Snapshot, used: np.ndarray, linear: RectangularModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every row by itself, about the mean voltages of its own interval."""
    n, on = at.shape[1] // 2, now.available & now.fresh
    found = []
    for row, weight in zip(used, share, strict=True):
        mean = weight @ at
        H, z, spread = linear.rows(now.z, now.sigma, on, mean[:n] + 1j * mean[n:], "derivative")
        found.append((H.toarray()[row], z[row], spread[row]))
    return tuple(np.array(part) for part in zip(*found, strict=True))  # type: ignore[return-value]


def transformed(
    at: np.ndarray, now: Snapshot, used: np.ndarray, linear: RectangularModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All rows, in frames of one voltage."""
    n = len(at) // 2
    H, z, spread = linear.rows(
        now.z, now.sigma, now.available & now.fresh, at[:n] + 1j * at[n:], "transform"
    )
    return H.toarray()[used], z[used], spread[used]


def varied(
    forecast: np.ndarray, at: np.ndarray, share: np.ndarray, model: MeasurementModel,
    used: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """By how much the mean of a power is not the power of the mean, over |V| of the meter."""
    before, n = forecast.reshape(at.shape), at.shape[1] // 2

    def power(state: np.ndarray) -> np.ndarray:
        voltage = state[:n] + 1j * state[n:]
        return model.h(np.concatenate([np.angle(voltage), np.abs(voltage)]))

    out = np.zeros(len(used))
    each = np.array([power(state) for state in before])
    for k, (row, weight) in enumerate(zip(used, share, strict=True)):
        quantity, bus = model.layout.quantity[row], model.layout.position[row]
        if quantity in (P, Q):
            mean = weight @ at
            apart = weight @ each[:, row] - power(weight @ before)[row]
            out[k] = (-apart if quantity == Q else apart) / abs(mean[bus] + 1j * mean[n + bus])
    return out


def turned(
    before: np.ndarray, after: np.ndarray, covariance: np.ndarray, m: int, lags: int
) -> np.ndarray:
    """A corrected state, each voltage turned by what goes across it unless it is told exactly."""
    out = after.copy()
    for place in (m * lag + bus for lag in range(lags) for bus in range(m // 2)):
        both = [place, place + m // 2]
        old, new = (complex(*s[both]) for s in (before, after))
        change = new / old - 1
        moved = old * (1 + change.real) * np.exp(1j * change.imag)
        along = np.array([new.real, new.imag]) / abs(new)
        step = np.array([(moved - new).real, (moved - new).imag])
        axes = np.array([along, [-along[1], along[0]]])
        variance = np.diagonal(axes @ covariance[np.ix_(both, both)] @ axes.T)
        if (np.abs(axes @ step) <= MOST_SIGMAS * np.sqrt(variance)).all():
            out[both] = moved.real, moved.imag
    return out


@pytest.mark.parametrize("linearisation", ["derivative", "transform"])
@pytest.mark.parametrize(
    "process", [random_walk(), holt(), local_trend()], ids=["walk", "holt", "trend"]
)
def test_lagged_filter_equals_augmented_textbook_filter(
    process: Process, linearisation: Linearisation
) -> None:
    """The textbook's state keeps one instant more: it holds what it reads while it updates."""
    network = library.load("ieee14")
    n, bus = network.n_bus, np.arange(network.n_bus)
    layout = SensorLayout.of(
        network, (VM, bus[::3], BUS), (VA, bus[::3], BUS), (P, bus, BUS), (Q, bus, BUS)
    )
    power = np.isin(layout.quantity, (P, Q))
    names = tuple(f"d{p}:{q}" for p, q in zip(layout.position, layout.quantity, strict=True))
    layout = dataclasses.replace(layout, channel=names, window_s=np.where(power, 900.0, 0.0))
    sigma = np.where(power, 1e-2, 2e-3)
    nominal = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    statistics = LoadStatistics(0.01 * nominal[None, :] + 1e-4, np.eye(2 * n), 3e-4, 86400.0)
    noise = load_noise(network, statistics)
    lags = 4
    ours = kalman_filter(
        "kf", network, layout, noise, step_s=STEP_S, reach_s=1200.0, process=process,
        linearisation=linearisation,
    )  # fmt: skip
    wide = kalman_filter(
        "kf", network, layout, noise, step_s=STEP_S, reach_s=1500.0, process=process,
        linearisation=linearisation,
    )  # fmt: skip
    linear = RectangularModel(network, layout)
    model = MeasurementModel(network, layout)
    exact = model.h(solve(network).x)
    rng = np.random.default_rng(SEED)

    def snapshot(k: int) -> Snapshot:
        z = exact + sigma * rng.normal(size=len(sigma))
        age = np.where(power, 120.0, rng.uniform(0, 60, len(sigma)))
        fresh = ~power | (k % 3 == 0)
        available = rng.random(len(sigma)) < 0.9 if k else np.ones(len(sigma), dtype=bool)
        time = np.datetime64("2016-06-09T00:00:00", "us") + k * np.timedelta64(300, "s")
        return Snapshot(time, z, sigma, np.zeros(len(sigma)), available, fresh, age)

    first = snapshot(0)
    state, start = ours.init(first)[0], wide.init(first)[0]
    m, order = 2 * n, process.order
    size = m * (lags + order)
    assert state.x.shape == (size - m,)
    x, covariance = start.x.copy(), start.P.copy()
    now_to_next = process.transition
    F = np.eye(size, k=-m)
    F[m * (lags + 1) :] = 0.0
    head = [0, lags + 1][:order]
    for i, to in enumerate(head):
        for j, come in enumerate(head):
            F[m * to : m * (to + 1), m * come : m * (come + 1)] = now_to_next[i, j] * np.eye(m)
    memory = start.process
    kept = np.arange(size).reshape(-1, m)[[*range(lags), *head[1:]]].ravel()
    present = np.arange(size).reshape(-1, m)[head].ravel()
    for k in range(1, 13):
        now = snapshot(k)
        ahead, _, memory = process.forecast(
            x[present], covariance[np.ix_(present, present)], memory
        )
        offset = np.zeros(size)
        offset[present] = ahead - (F @ x)[present]
        forecast = F @ x + offset
        walk = np.zeros((size, size))
        walk[np.ix_(present, present)] = process.noise(noise(ahead[:n] + 1j * ahead[n:m], now.time))
        used = np.flatnonzero(now.available & now.fresh)
        interval = now.age_s[used], layout.window_s[used], STEP_S, lags
        share, bridge = weights(*interval), bridge_covariance(*interval)
        state, info = ours.step(state, now)
        assert info.used.sum() == len(used)
        about, oldest = forecast, forecast[m * lags : m * (lags + 1)]
        for _ in range(info.iterations):
            at = about[: m * (lags + 1)].reshape(lags + 1, m)
            H, z, spread = (
                rows_about(at, share, now, used, linear)
                if linearisation == "derivative"
                else transformed(at[0], now, used, linear)
            )
            if linearisation == "derivative":
                z = z - varied(forecast[: m * (lags + 1)], at, share, model, used)
            slopes = np.zeros((len(used), m * (order - 1)))
            lagged = np.hstack([*(share[:, [lag]] * H for lag in range(lags + 1)), slopes])
            R = np.diag(spread**2) + bridge * (H @ walk[:m, :m] @ H.T)
            after = kalman_step(x, covariance, F, walk, lagged, R, z - lagged @ offset)
            about = after[0] + offset
            # What is forgotten after the step is not told of either.
            about[m * lags : m * (lags + 1)] = oldest
        x, covariance = after[0] + offset, after[1]
        if linearisation == "derivative":
            x = turned(forecast, x, covariance, m, lags)
        np.testing.assert_allclose(state.x, x[kept], rtol=1e-9, atol=1e-11)
        deviation = np.sqrt(np.maximum(np.diagonal(covariance)[kept], 1e-20))
        difference = (state.P - covariance[np.ix_(kept, kept)]) / np.outer(deviation, deviation)
        assert np.abs(difference).max() < 1e-8
    assert np.abs(state.x[:m] - state.x[m * (lags - 1) : m * lags]).max() > 1e-4
