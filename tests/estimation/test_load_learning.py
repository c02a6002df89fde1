"""Claim: earlier telemetry teaches how loads and the source move, without the meters' own noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.process.learn_from_history import learn_load
from pse_analysis.estimation.process.learn_source import learn_source
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VA, VM, P, Q, SensorLayout

SEED = 4321
MIDNIGHT = np.datetime64("2016-06-06T00:00:00", "us")
STEP_S = 300.0
COMMON = 0.3  # correlation of the changes of any two loads
SHARE = 0.004  # σ of a load's change per step, as a share of its nominal value
SOURCE = 6e-4


@dataclasses.dataclass(frozen=True)
class World:
    """A feeder whose loads and source move as random walks, and the meters' history of it."""

    network: Network
    layout: SensorLayout
    history: Record


def world(
    seed: int,
    *,
    source: float = SOURCE,
    window_s: float = 900.0,
    meter: float = 1e-7,
    volt: float = 2e-4,
    every_step: int = 1,
    day_factor: float = 1.0,
    days: int = 2,
) -> World:
    network = library.load("ieee33")
    n, load = network.n_bus, np.arange(1, network.n_bus)
    rng = np.random.default_rng([SEED, seed])
    fine = 5
    steps = int(days * 86400 / STEP_S)
    count = steps * fine
    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    shared, own = rng.normal(size=count), rng.normal(size=(2 * n, count))
    move = np.sqrt(COMMON) * shared + np.sqrt(1 - COMMON) * own
    hour = (np.arange(count) * STEP_S / fine / 3600) % 24
    busy = np.where((hour >= 6) & (hour < 18), day_factor, 1.0)
    move *= busy * SHARE * np.abs(nominal)[:, None] / np.sqrt(fine)
    injection = nominal[:, None] + np.cumsum(move, axis=1)
    level = 1.0 + np.cumsum(source / np.sqrt(fine) * rng.normal(size=count))
    at = np.arange(fine - 1, count, fine)
    vm_set = np.where((np.arange(n) == network.slack)[:, None], level[at], 1.0)
    flow = solve(network, injection[:n][:, at], injection[n:][:, at], vm_set)
    bus = np.array([1, 5, 11, 17, 24, 30])
    layout = SensorLayout.of(
        network, (VM, bus, BUS), (VA, bus, BUS), (P, load, BUS), (Q, load, BUS)
    )
    power = np.isin(layout.quantity, (P, Q))
    layout = dataclasses.replace(
        layout,
        sigma=np.where(power, meter, volt),
        window_s=np.where(power, window_s, 0.0),
    )
    z = np.zeros((steps, len(layout)))
    z[:, layout.quantity == VM] = flow.vm[bus].T
    z[:, layout.quantity == VA] = flow.theta[bus].T
    rows = np.concatenate([injection[load], injection[n + load]])
    if window_s:
        width = int(window_s / STEP_S) * fine
        total = np.cumsum(rows, axis=1)
        mean = rows.copy()
        mean[:, width:] = (total[:, width:] - total[:, :-width]) / width
        rows = mean
    z[:, power] = rows[:, at].T
    z += layout.sigma * rng.normal(size=z.shape)
    k = np.arange(steps)[:, None]
    fresh = np.where(power, (k + 1) % max(int(window_s / STEP_S), 1) == 0, k % every_step == 0)
    zero = np.zeros(z.shape)
    time = MIDNIGHT + np.arange(steps) * np.timedelta64(int(STEP_S), "s")
    on = np.ones(z.shape, dtype=bool)
    return World(
        network,
        layout,
        Record(time, z, np.broadcast_to(layout.sigma, z.shape), zero, on, fresh, zero),
    )


def of_loads(network: Network) -> np.ndarray:
    nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
    return np.flatnonzero(nominal)


@pytest.mark.parametrize("window_s", [900.0, 0.0])
def test_variance_of_loads_is_recovered(window_s: float) -> None:
    """Mean over meters and slots, five histories: within 4 standard errors and 4 %."""
    ratio, off = [], []
    for seed in range(5):
        w = world(seed, window_s=window_s)
        learnt = learn_load(w.history, w.layout, w.network, STEP_S, source=1e-3)
        loads = of_loads(w.network)
        nominal = np.concatenate([w.network.p_nominal_pu, w.network.q_nominal_pu])[loads]
        ratio.append(np.mean((learnt.deviation[:, loads] / (SHARE * np.abs(nominal))) ** 2))
        among = learnt.correlation[np.ix_(loads, loads)]
        off.append(among[~np.eye(len(loads), dtype=bool)].mean())
    error = np.std(ratio, ddof=1) / np.sqrt(len(ratio))
    assert np.mean(ratio) == pytest.approx(1.0, abs=4 * error + 0.04)
    assert error < 0.05
    # Shrinkage towards independence takes a stated part of the correlation, never adds to it.
    assert 0.6 * COMMON < np.mean(off) < 1.1 * COMMON


def test_changes_of_a_day_to_come_have_unit_nis_under_what_three_days_taught() -> None:
    """What few days teach of 64 correlated loads is too sure of itself, unless it is scaled."""
    ratio, plain = [], []
    for seed in range(4):
        w = world(seed, window_s=0.0, days=4)
        past = w.history.between(None, MIDNIGHT + np.timedelta64(3, "D"))
        day = w.history.between(MIDNIGHT + np.timedelta64(3, "D"), None)
        learnt = learn_load(past, w.layout, w.network, STEP_S, source=1e-3)
        power = np.flatnonzero(np.isin(w.layout.quantity, (P, Q)))
        place = w.layout.position[power] + 33 * (w.layout.quantity[power] == Q)
        change = np.diff(day.z[:, power], axis=0)
        nis = [
            d @ np.linalg.solve(learnt.covariance(t)[np.ix_(place, place)], d)
            for d, t in zip(change, day.time[1:], strict=True)
        ]
        ratio.append(np.mean(nis) / len(power))
        deviation = learnt.deviation[:, place]
        plain.append(np.mean((deviation / (SHARE * np.abs(level_of(w.network)[place]))) ** 2))
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.06)
    assert 1.0 < np.mean(plain) < 1.25


def level_of(network: Network) -> np.ndarray:
    return np.concatenate([network.p_nominal_pu, network.q_nominal_pu])


def test_meters_own_noise_is_not_taken_for_movement() -> None:
    nominal = library.load("ieee33").p_nominal_pu
    noise = 1.0 * SHARE * np.median(np.abs(nominal))
    ratio = []
    for seed in range(4):
        w = world(seed, window_s=0.0, meter=noise)
        learnt = learn_load(w.history, w.layout, w.network, STEP_S, source=1e-3)
        loads = of_loads(w.network)[:32]
        ratio.append(np.mean((learnt.deviation[:, loads] / (SHARE * np.abs(nominal[loads]))) ** 2))
    # Left in, twice its variance would make this ratio about 3.
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15)


def test_busy_hours_are_told_from_quiet_ones() -> None:
    w = world(1, window_s=0.0, day_factor=3.0)
    learnt = learn_load(w.history, w.layout, w.network, STEP_S, source=1e-3)
    loads = of_loads(w.network)
    hour = (np.arange(len(learnt.deviation)) + 0.5) * learnt.slot_s / 3600
    day = (learnt.deviation[(hour > 9) & (hour < 15)][:, loads] ** 2).mean(axis=0)
    night = (learnt.deviation[(hour < 3) | (hour > 21)][:, loads] ** 2).mean(axis=0)
    assert np.sqrt(day / night).mean() == pytest.approx(3.0, abs=0.4)


def test_load_without_a_meter_moves_by_the_share_of_the_others() -> None:
    w = world(0)
    lost = w.layout.position == w.network.bus("14")
    keep = np.flatnonzero(~lost)
    columns = {
        f.name: getattr(w.history, f.name)[:, keep]
        for f in dataclasses.fields(Record)
        if f.name != "time"
    }
    history = dataclasses.replace(w.history, **columns)
    learnt = learn_load(history, w.layout.take(keep), w.network, STEP_S, source=1e-3)
    bus = w.network.bus("14")
    expected = SHARE * abs(w.network.p_nominal_pu[bus])
    assert np.sqrt((learnt.deviation[:, bus] ** 2).mean()) == pytest.approx(expected, rel=0.15)
    assert learnt.correlation[bus, bus] == 1.0


def test_meter_that_never_moves_does_not_spoil_the_rest() -> None:
    w = world(0)
    z = w.history.z.copy()
    stuck = int(np.flatnonzero(w.layout.quantity == Q)[4])
    z[:, stuck] = 0.0
    learnt = learn_load(
        dataclasses.replace(w.history, z=z), w.layout, w.network, STEP_S, source=1e-3
    )
    assert np.isfinite(learnt.deviation).all()
    assert np.isfinite(learnt.correlation).all()
    assert np.linalg.eigvalsh(learnt.correlation).min() > 0


@pytest.mark.parametrize("every_step", [1, 3])
def test_source_is_recovered(every_step: int) -> None:
    """Five histories of three days: within 4 standard errors and 8 %, whatever the meters' rate."""
    learnt = []
    for seed in range(5):
        w = world(seed, every_step=every_step, days=3)
        learnt.append(learn_source(w.history, w.layout, w.network, STEP_S) / SOURCE)
    error = np.std(learnt, ddof=1) / np.sqrt(len(learnt))
    assert np.mean(learnt) == pytest.approx(1.0, abs=4 * error + 0.08)
    assert error < 0.06


def test_source_that_stands_still_is_seen_to() -> None:
    w = world(0, source=0.0)
    assert learn_source(w.history, w.layout, w.network, STEP_S) < 0.2 * SOURCE


def test_history_without_voltages_gives_the_usual_source() -> None:
    w = world(0)
    keep = np.flatnonzero(w.layout.quantity != VM)
    columns = {
        f.name: getattr(w.history, f.name)[:, keep]
        for f in dataclasses.fields(Record)
        if f.name != "time"
    }
    history = dataclasses.replace(w.history, **columns)
    assert learn_source(history, w.layout.take(keep), w.network, STEP_S) == 1e-3


def test_voltage_meter_that_never_spoke_is_passed_over() -> None:
    w = world(0)
    fresh = w.history.fresh.copy()
    fresh[:, 0] = False
    silent = learn_source(dataclasses.replace(w.history, fresh=fresh), w.layout, w.network, STEP_S)
    assert silent == pytest.approx(learn_source(w.history, w.layout, w.network, STEP_S), rel=0.2)


def test_no_history_at_all_gives_something_usable() -> None:
    w = world(0)
    empty = w.history.between(None, w.history.time[0])
    learnt = learn_load(empty, w.layout, w.network, STEP_S)
    assert np.isfinite(learnt.deviation).all()
    assert (learnt.deviation[:, of_loads(w.network)] > 0).all()
    np.testing.assert_array_equal(learnt.correlation, np.eye(66))
