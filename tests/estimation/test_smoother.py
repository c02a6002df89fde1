"""Claim: a smoother knows what a batch over all instants knows; forecasts spread as their walk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.endurance import tiny_case

from pse_analysis.errors import ParameterError
from pse_analysis.estimation import Method, Record, Setting, variants
from pse_analysis.estimation.core.interface import (
    Estimate,
    Estimator,
    Info,
    Snapshot,
    Transition,
)
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.filters.smoother import Ahead, Smoothed, Trail, look_back
from pse_analysis.measurement import SensorLayout
from pse_analysis.vocabulary import Status

SEED = 1965
Q = 4e-6
NETWORK = tiny_case.network()
N = NETWORK.n_bus


def phasors() -> SensorLayout:
    """Voltage and angle of every bus, which are linear in the state."""
    rows = [
        (f"{q}{bus}", "pmu", q, f"bus/{bus}", "", unit, 0.004, "absolute", -180.0, 180.0)
        for bus in NETWORK.buses.name
        for q, unit in (("vm_pu", "pu"), ("va_degree", "degree"))
    ]
    columns = list(tiny_case.channel_table().columns[:10])
    table = tiny_case.pd.DataFrame([dict(zip(columns, row, strict=True)) for row in rows])
    table = table.assign(period_s=tiny_case.STEP_S, sign=1, aggregation="instant")
    return SensorLayout.from_channels(table, NETWORK)


def walk(layout: SensorLayout, count: int, seed: int, lost: float) -> Record:
    """A random walk of all voltages, read with noise; the first snapshot is whole."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.normal(0.0, np.sqrt(Q), (count, 2 * N)), axis=0) + np.repeat([0.1, 1.0], N)
    place = layout.position + np.where(np.char.startswith(layout.channel, "vm"), N, 0)
    z = x[:, place] + layout.sigma * rng.normal(size=(count, len(layout)))
    on = rng.random(z.shape) >= lost
    on[0] = True
    start = np.datetime64(tiny_case.START.replace(tzinfo=None), "us")
    time = start + np.arange(count) * np.timedelta64(round(tiny_case.STEP_S * 1e6), "us")
    sigma = np.broadcast_to(layout.sigma, z.shape)
    nothing = np.zeros_like(z)
    return Record(time, np.where(on, z, 0.0), sigma, nothing, on, on, nothing)


def made(layout: SensorLayout, **keys: object) -> Estimator:
    """A filter with noise for every voltage."""
    study = replace(tiny_case.STUDY, step_s=tiny_case.STEP_S)
    empty = walk(layout, 2, 0, 0.0).between(None, np.datetime64("1990-01-01", "us"))
    setting = Setting(NETWORK, layout, study, empty)
    whole = {"noise": "scalar", "variance": Q, "angle_reference": "fixed", **keys}
    return Method.of("f", **whole).estimator(setting)


def smoothed(estimator: Estimator, taken: Record) -> list[Estimate | None]:
    """Smoothed estimates of all instants."""
    snapshots = list(taken.snapshots())
    trail = Trail(estimator, snapshots)
    run(estimator, iter(snapshots), NETWORK, phasors(), watch=[trail.watch])
    return trail.smoothed()


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(["ekf", "ukf"]), st.integers(2, 30), st.booleans())
def test_smoother_is_dense_least_squares_over_all_instants(
    seed: int, kind: str, count: int, gaps: bool
) -> None:
    layout = phasors()
    taken = walk(layout, count, seed, 0.4 if gaps else 0.0)
    found = smoothed(made(layout, filter=kind), taken)
    place = layout.position + np.where(np.char.startswith(layout.channel, "vm"), N, 0)
    rows, right = [], []
    for k in range(count):
        for i in np.flatnonzero(taken.available[k]):
            row = np.zeros((count, 2 * N))
            row[k, place[i]] = 1.0 / layout.sigma[i]
            rows.append(row.ravel())
            right.append(taken.z[k, i] / layout.sigma[i])
    for k in range(1, count):
        for j in range(2 * N):
            row = np.zeros((count, 2 * N))
            row[k, j], row[k - 1, j] = 1.0 / np.sqrt(Q), -1.0 / np.sqrt(Q)
            rows.append(row.ravel())
            right.append(0.0)
    A = np.array(rows)
    covariance = np.linalg.inv(A.T @ A)
    x = (covariance @ (A.T @ np.array(right))).reshape(count, 2 * N)
    for k, one in enumerate(found):
        assert one is not None
        np.testing.assert_allclose(one.x, x[k], atol=1e-8)
        at = slice(2 * N * k, 2 * N * (k + 1))
        np.testing.assert_allclose(one.covariance, covariance[at, at], atol=1e-8 * 0.004**2)


@pytest.mark.parametrize("form", ["covariance", "square_root"])
def test_what_is_kept_of_the_states_changes_nothing(
    form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = phasors()
    taken = walk(layout, 17, SEED, 0.2)
    estimator = made(layout, filter="ukf", compose={"form": form})
    some = smoothed(estimator, taken)
    for span in (1, 17):
        monkeypatch.setattr(Trail, "span", span)
        for one, other in zip(some, smoothed(estimator, taken), strict=True):
            assert one is not None
            assert other is not None
            np.testing.assert_array_equal(one.x, other.x)
            np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize("process", ["random_walk", "local_trend"])
def test_a_filter_that_keeps_past_instants_knows_them_as_its_smoother_does(process: str) -> None:
    """Its state at the end holds the last instants given everything: blocks of s, known exactly."""
    table = tiny_case.channel_table()
    layout = SensorLayout.from_channels(
        table.assign(aggregation=np.where(table["source"] == "ami", "mean", "instant")), NETWORK
    )
    run_ = tiny_case.plain_run()
    taken = tiny_case.record_of(run_, layout)
    keys = {"filter": "kalman", "compose": {"process": process}}
    setting = Setting(NETWORK, layout, tiny_case.STUDY, taken)
    plain = Method.of("f", noise="scalar", variance=Q, **keys).estimator(setting)
    estimator = Method.of("f", noise="scalar", variance=Q, smooth=True, **keys).estimator(setting)
    snapshots = list(taken.snapshots())
    trail = Trail(estimator, snapshots)
    states: list[object] = []
    found = run(
        estimator,
        iter(snapshots),
        NETWORK,
        layout,
        watch=[trail.watch, lambda _k, state, _info: states.append(state)],
    )
    # One instant more in the state only moves where the rows are expanded.
    same = run(plain, iter(snapshots), NETWORK, layout).estimated
    np.testing.assert_allclose(found.estimated["value"], same["value"], atol=1e-4)
    back = trail.smoothed()
    assert estimator.dynamics is not None
    s, P = estimator.dynamics.belief(states[-1])
    size = 2 * N
    for lag in range(2):
        block = slice(lag * size, (lag + 1) * size)
        known = estimator.dynamics.read(states[-1], s[block], P[block, block])
        one = back[len(snapshots) - 1 - lag]
        assert one is not None
        np.testing.assert_allclose(one.x, known.x, atol=1e-9)
        np.testing.assert_allclose(one.covariance, known.covariance, atol=1e-12)


def test_nothing_is_carried_back_over_a_restart() -> None:
    layout = phasors()
    taken = walk(layout, 12, SEED, 0.0)
    taken.z[6:] += 0.5
    estimator = made(layout, filter="ekf")
    found = run(estimator, taken.snapshots(), NETWORK, layout)
    assert list(found.steps["status"]).index(Status.RESTARTED) == 6
    alone = smoothed(estimator, taken.between(None, taken.time[6]))
    for one, other in zip(smoothed(estimator, taken), alone, strict=False):
        assert one is not None
        assert other is not None
        np.testing.assert_array_equal(one.x, other.x)


def test_what_later_instants_confirm_is_doubted_no_longer() -> None:
    """A voltage moves by 0.1, 10 σ of its walk: the filter doubts it, its smoother does not.

    What nobody confirms, one reading that is off by as much, is doubted by the smoother as well.
    """
    layout = phasors()
    taken = walk(layout, 12, SEED, 0.0)
    row, state = 0, N
    assert layout.channel[row].startswith("vm")
    estimator = made(layout, filter="ekf", variance=1e-4)
    moved, spoilt = taken.z.copy(), taken.z.copy()
    moved[6:, row] += 0.1
    spoilt[6, row] += 0.1
    found = {}
    for name, z in (("plain", taken.z), ("moved", moved), ("spoilt", spoilt)):
        record = replace(taken, z=z)
        told = run(estimator, record.snapshots(), NETWORK, layout).steps["detail"][6]
        assert ("doubtful" in told) is (name != "plain")
        found[name] = smoothed(estimator, record)[6]
    plain, after, wrong = found["plain"], found["moved"], found["spoilt"]
    assert plain is not None
    assert after is not None
    assert wrong is not None
    assert after.x[state] - plain.x[state] == pytest.approx(0.1, abs=0.012)
    assert after.covariance[state, state] < 1.2 * plain.covariance[state, state]
    assert wrong.covariance[state, state] > 1.2 * plain.covariance[state, state]
    off = wrong.x[state] - plain.x[state]
    assert abs(off) < 3.0 * np.sqrt(wrong.covariance[state, state])


def test_an_instant_without_a_state_stays_without_one() -> None:
    layout = phasors()
    taken = walk(layout, 6, SEED, 0.0)
    taken.available[:2] = False
    found = smoothed(made(layout, filter="ekf"), taken)
    assert [one is None for one in found] == [True, True, False, False, False, False]


def test_angles_are_compared_by_their_shorter_way() -> None:
    layout = phasors()
    taken = walk(layout, 20, SEED, 0.0)
    turning = np.char.startswith(layout.channel, "va")
    moved = taken.z.copy()
    moved[:, turning] = np.angle(np.exp(1j * (moved[:, turning] + np.pi - 0.1)))
    plain = smoothed(made(layout, filter="ekf"), taken)
    for one, other in zip(
        smoothed(made(layout, filter="ekf"), replace(taken, z=moved)), plain, strict=True
    ):
        assert one is not None
        assert other is not None
        off = np.angle(np.exp(1j * (one.x - other.x)[:N]))
        np.testing.assert_allclose(np.abs(off), np.pi - 0.1, atol=1e-9)


def test_what_is_certain_stays_as_it_is() -> None:
    P = np.diag([1.0, 0.0])
    later = Smoothed(np.array([3.0, 5.0]), np.diag([0.5, 0.0]))
    before = Transition(np.array([1.0, 5.0]), np.diag([2.0, 0.0]), P)
    found = look_back((np.array([1.0, 5.0]), P), before, later)
    # By hand: G = 1/2, so 1 + (3 - 1)/2 and 1 + (0.5 - 2)/4.
    np.testing.assert_allclose(found.s, [2.0, 5.0])
    np.testing.assert_allclose(found.P, np.diag([0.625, 0.0]))


def test_forecast_of_a_random_walk_stays_and_spreads() -> None:
    layout = phasors()
    taken = walk(layout, 8, SEED, 0.0)
    estimator = made(layout, filter="ekf")
    snapshots = list(taken.snapshots())
    states: list[object] = []
    ahead = Ahead(estimator, snapshots, (1, 3))
    run(
        estimator,
        iter(snapshots),
        NETWORK,
        layout,
        watch=[ahead.watch, lambda _k, state, _info: states.append(state)],
    )
    assert sorted(ahead.found[1]) == list(range(1, 8))
    assert sorted(ahead.found[3]) == list(range(3, 8))
    for steps, found in ahead.found.items():
        for k, one in found.items():
            now = estimator.read(states[k - steps])
            assert now is not None
            np.testing.assert_allclose(one.x, now.x, atol=1e-12)
            expected = now.covariance + steps * Q * np.eye(2 * N)
            np.testing.assert_allclose(one.covariance, expected, atol=1e-15)


def test_variants_stand_in_the_tables_as_methods() -> None:
    layout = phasors()
    taken = walk(layout, 8, SEED, 0.0)
    found = variants.run(
        made(layout, filter="ekf"),
        list(taken.snapshots()),
        NETWORK,
        layout,
        smooth=True,
        ahead=(2,),
        truth=np.zeros((8, 2 * N)),
    )
    count = found.steps.groupby("method").size()
    assert count.to_dict() == {"f": 8, "f_smoothed": 8, "f_ahead_2": 6}
    assert found.estimated.groupby("method").size().to_dict() == {
        name: 2 * N * steps for name, steps in count.items()
    }
    assert set(found.residuals["method"]) == {"f"}
    assert found.steps["nees"].notna().all()


def test_estimators_without_dynamics_are_not_smoothed() -> None:
    info = Info.nothing(2 * N, Status.NOT_CONVERGED)
    nothing = Estimator(
        "f", lambda _s: (None, info), lambda _state, _s: (None, info), lambda _: None
    )
    taken = list(walk(phasors(), 3, SEED, 0.0).snapshots())
    found = variants.run(nothing, taken, NETWORK, phasors(), smooth=True, ahead=(1,))
    assert found.estimated["value"].isna().all()
    count = found.steps.groupby("method").size()
    assert count.to_dict() == {"f": 3, "f_smoothed": 3, "f_ahead_1": 2}
    assert set(found.steps["status"]) == {"not_converged"}
    with pytest.raises(TypeError, match="does not say how its state moves"):
        Trail(nothing, []).smoothed()


@pytest.mark.parametrize("ahead", [[0], [1, 1], [-3], [5000]])
def test_steps_ahead_that_make_no_sense_are_refused(ahead: list[int]) -> None:
    with pytest.raises(ParameterError, match="expected ahead to list different numbers"):
        Method.of("f", "ekf", ahead=ahead)


def test_a_state_that_cannot_be_moved_ends_no_run() -> None:
    """Where the smoother meets numbers that allow nothing, an estimate stays the filter's own."""
    layout = phasors()
    taken = list(walk(layout, 9, SEED, 0.0).snapshots())
    plain = made(layout, filter="ekf")
    assert plain.dynamics is not None
    predict = plain.dynamics.predict

    def fails(state: object, snapshot: Snapshot) -> Transition:
        if snapshot.time == taken[5].time:
            raise np.linalg.LinAlgError("covariance is not positive definite")
        return predict(state, snapshot)

    estimator = plain._replace(dynamics=plain.dynamics._replace(predict=fails))
    found = variants.run(estimator, taken, NETWORK, layout, smooth=True)
    value = found.estimated.pivot_table(
        index=["time_utc", "element", "quantity"], columns="method", values="value"
    )
    same = (value["f"] == value["f_smoothed"]).groupby(level="time_utc").all()
    # The last instant has no later one, and that before the failure cannot look back on any.
    assert np.flatnonzero(same).tolist() == [4, 8]


def test_a_forecast_that_fails_ends_no_run() -> None:
    layout = phasors()
    taken = list(walk(layout, 5, SEED, 0.0).snapshots())
    plain = made(layout, filter="ekf")

    def step(state: object, snapshot: Snapshot) -> tuple[object, Info]:
        if not snapshot.available.any():
            raise FloatingPointError("overflow")
        return plain.step(state, snapshot)

    found = variants.run(plain._replace(step=step), taken, NETWORK, layout, ahead=(1,))
    ahead = found.estimated[found.estimated["method"] == "f_ahead_1"]
    assert len(ahead) == 4 * 2 * N
    assert ahead["value"].isna().all()
