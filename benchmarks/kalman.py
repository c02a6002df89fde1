"""A step of the Kalman filter beside filterpy's and beside a textbook step of its own functions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from filterpy.kalman import KalmanFilter

from benchmarks.timing import Row, alternate
from pse_analysis.estimation.bad_data import adaptive_threshold, innovation_test
from pse_analysis.estimation.core.interface import Estimator, Snapshot
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.filters import intervals
from pse_analysis.estimation.filters.kalman import KalmanState, kalman_filter
from pse_analysis.estimation.process import covariance_matching
from pse_analysis.estimation.process.dynamics import local_trend
from pse_analysis.estimation.process.load_noise import LoadStatistics, ProcessNoise, load_noise
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
from pse_analysis.validation.adaptive import AdaptiveParams

SEED = 33
STEP_S = 300.0
STEPS = 288
NOON = np.datetime64("2016-06-09T12:00:00", "us")
REPEATS = 51
LAGS = 4
NETWORK = library.load("ieee33")


def run() -> list[Row]:
    """One step on ieee33 with 96 channels, read as of the instant and over their intervals."""
    layout = metered()
    nominal = np.abs(np.concatenate([NETWORK.p_nominal_pu, NETWORK.q_nominal_pu]))
    statistics = LoadStatistics(0.02 * nominal[None, :], np.eye(66), 1e-3, 86400.0)
    noise = load_noise(NETWORK, statistics)
    now = snapshot(layout)
    instant = made(layout, noise, instant=True)
    interval = made(layout, noise, reach_s=LAGS * STEP_S)
    rows = []
    for name, ours in (("as of the instant", instant), ("over intervals", interval)):
        state, _ = ours.init(now)
        theirs = textbook(layout, noise, state, now, LAGS if ours is interval else 0)
        after = ours.step(state, now)[0]
        difference = np.abs(after.x[:66] - theirs()[:66]).max()
        what = f"Kalman step, ieee33, {len(layout)} rows {name} ({len(state.x)} numbers kept)"
        times = alternate(lambda ours=ours, state=state: ours.step(state, now), theirs, REPEATS)
        rows.append(Row(what, *times, "textbook", f"states differ by {difference:.0e}"))
    state, _ = instant.init(now)
    times = alternate(lambda: instant.step(state, now), filterpy_step(layout, state, now), REPEATS)
    note = "ours also transforms the measurements and makes Q"
    rows.append(Row("Kalman step, ieee33, as of the instant", *times, "filterpy", note))
    for name, plain, options in (
        ("screened by innovation", instant, {"instant": True, "refuse": innovation_test.refuse()}),
        (
            "over intervals, screened by innovation",
            interval,
            {"reach_s": LAGS * STEP_S, "refuse": innovation_test.refuse()},
        ),
        ("local trend", instant, {"instant": True, "process": local_trend()}),
    ):
        rows.append(beside(name, made(layout, noise, **options), plain, now))
    rows.append(behind_threshold(layout, instant))
    learning = made(layout, covariance_matching.of_loads(NETWORK), instant=True)
    rows.append(beside("noise from innovations", learning, instant, now))
    state, _ = interval.init(now)
    times = alternate(lambda: interval.read(state), lambda: interval.step(state, now), REPEATS)
    rows.append(Row("Kalman estimate read in polar form, ieee33", *times, "the step before it", ""))
    return rows


def metered() -> SensorLayout:
    """Phasors at ten buses, twelve powers of branches, and quarter-hour means of every load."""
    bus, load, branch = np.arange(1, 31, 3), np.arange(1, 33), np.arange(6, 30, 4)
    layout = SensorLayout.of(
        NETWORK, (VM, bus, BUS), (VA, bus, BUS), (P, branch, 1), (Q, branch, 1)
    )
    meters = SensorLayout.of(NETWORK, (P, load, BUS), (Q, load, BUS))
    joined = {
        f.name: np.concatenate([getattr(layout, f.name), getattr(meters, f.name)])
        for f in dataclasses.fields(SensorLayout)
    }
    joined["channel"], joined["source"] = tuple(joined["channel"]), tuple(joined["source"])
    joined["window_s"] = np.where(np.arange(len(layout) + len(meters)) < len(layout), 0.0, 900.0)
    return SensorLayout(**joined)


def snapshot(layout: SensorLayout) -> Snapshot:
    """Every channel at once, some seconds or a minute old."""
    sigma = np.full(len(layout), 2e-3)
    exact = MeasurementModel(NETWORK, layout).h(solve(NETWORK).x)
    z = exact + sigma * np.random.default_rng(SEED).normal(size=len(sigma))
    on, zero = np.ones(len(layout), dtype=bool), np.zeros(len(layout))
    age = np.where(layout.window_s > 0, 60.0, np.where(layout.quantity == VM, 1.0, 7.0))
    age = np.where(layout.quantity == VA, 1.0, age)
    return Snapshot(NOON, z, sigma, zero, on, on, age)


def made(layout: SensorLayout, noise: object, **options: object) -> Estimator:
    """The filter of the project."""
    return kalman_filter("kf", NETWORK, layout, noise, step_s=STEP_S, **options)  # type: ignore[arg-type]


def beside(name: str, ours: Estimator, plain: Estimator, now: Snapshot) -> Row:
    """A filter with an option beside the plain one."""
    mine, theirs = ours.init(now)[0], plain.init(now)[0]
    times = alternate(lambda: ours.step(mine, now), lambda: plain.step(theirs, now), 3 * REPEATS)
    return Row(f"Kalman step, ieee33, {name}", *times, "plain step", "")


def behind_threshold(layout: SensorLayout, plain: Estimator) -> Row:
    """A day of steps behind the adaptive threshold of every channel beside the same without it."""
    days = series(layout, 2 * STEPS)
    past, snapshots = days.between(None, NOON), list(days.between(NOON, None).snapshots())
    ours = adaptive_threshold.screened(plain, layout, AdaptiveParams(), past)

    def through(estimator: Estimator) -> Callable[[], None]:
        begun = estimator.init(snapshots[0])[0]

        def run() -> None:
            state = begun
            for now in snapshots[1:]:
                state, _ = estimator.step(state, now)

        return run

    times = [t / (STEPS - 1) for t in alternate(through(ours), through(plain), 7)]
    what = "Kalman step, ieee33, behind an adaptive threshold, mean of a day"
    return Row(what, *times, "plain step", "expected: at least 0.83 ×")


def series(layout: SensorLayout, steps: int) -> Record:
    """Noise about one state, a day of it before noon; meters report at every third instant."""
    now = snapshot(layout)
    rng = np.random.default_rng(SEED)
    z = now.z + now.sigma * rng.normal(size=(steps, len(layout)))
    time = NOON + (np.arange(steps) - steps // 2) * np.timedelta64(int(STEP_S), "s")
    fresh = (layout.window_s == 0) | (np.arange(steps) % 3 == 0)[:, None]
    wide, zero = (np.broadcast_to(part, z.shape) for part in (now.sigma, now.sigma_age))
    return Record(time, z, wide, zero, np.ones(z.shape, dtype=bool), fresh, 0.0 * z + now.age_s)


def textbook(
    layout: SensorLayout, noise: ProcessNoise, state: KalmanState, now: Snapshot, lags: int
) -> Callable[[], np.ndarray]:
    """F P Fᵀ + Q, K = P Hᵀ S⁻¹ and (I - K H) P on the whole dense state, every pass anew."""
    model = RectangularModel(NETWORK, layout)
    blocks = lags + 1
    wide = np.arange(66 * blocks) % 66 + 66 * np.minimum(np.arange(66 * blocks) // 66, lags - 1)
    wide = wide if lags else np.arange(66)
    x0, P0 = state.x[wide], state.P[np.ix_(wide, wide)]
    F = np.eye(66 * blocks, k=-66) if lags else np.zeros((66, 66))
    F[:66, :66] = np.eye(66)
    on = now.available
    interval = now.age_s, layout.window_s, STEP_S, lags

    def step() -> np.ndarray:
        voltage = x0[:33] + 1j * x0[33:66]
        walk = noise(voltage, now.time)
        x, P = F @ x0, F @ P0 @ F.T
        P[:66, :66] += walk
        share = intervals.weights(*interval) if lags else np.ones((len(on), 1))
        bridge = intervals.bridge_covariance(*interval) if lags else 0.0
        for _ in range(3):
            H, z, spread = model.rows(now.z, now.sigma, on, voltage, "derivative")
            H = H.toarray()
            R = np.diag(spread**2) + bridge * (H @ walk @ H.T)
            H = np.hstack([share[:, [lag]] * H for lag in range(blocks)])
            S = H @ P @ H.T + R
            K = P @ H.T @ np.linalg.inv(S)
            after, _ = x + K @ (z - H @ x), (np.eye(len(x)) - K @ H) @ P
            reached = after[:33] + 1j * after[33:66]
            if np.abs(reached - voltage).max() < 1e-3:
                break
            voltage = reached
        return np.asarray(after)

    return step


def filterpy_step(layout: SensorLayout, state: KalmanState, now: Snapshot) -> Callable[[], None]:
    """Predict and update of filterpy on ready matrices."""
    voltage = state.x[:33] + 1j * state.x[33:66]
    H, linear, spread = RectangularModel(NETWORK, layout).rows(
        now.z, now.sigma, now.available, voltage
    )
    peer = KalmanFilter(dim_x=66, dim_z=len(layout))
    peer.F, peer.H, peer.R, peer.Q = np.eye(66), H.toarray(), np.diag(spread**2), 1e-8 * np.eye(66)

    def step() -> None:
        peer.x, peer.P = state.x, state.P
        peer.predict()
        peer.update(linear)

    return step


if __name__ == "__main__":
    for each in run():
        print(f"{each.what:75s} {1e3 * each.ours_s:7.3f} ms  {each.ratio:5.2f} × {each.peer}")
