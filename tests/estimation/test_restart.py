"""Claim: a filter of a grid calls no impossible state an estimate, and finds back by itself."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pytest
from qu_bench import Bench, still

from pse_analysis import parameters
from pse_analysis.errors import ParameterError
from pse_analysis.estimation import Method, Record, Setting
from pse_analysis.estimation.core.interface import (
    Dynamics,
    Estimate,
    Estimator,
    Info,
    Snapshot,
    Transition,
)
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.filters.restart import (
    ABSURD,
    Contradiction,
    Guarded,
    RestartParams,
    gross_errors,
    guarded,
)
from pse_analysis.grid import library
from pse_analysis.measurement import BUS, VM, SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.vocabulary import Reason, Status

SEED = 21
STEPS = 30
STUDY = Study(datetime(2016, 6, 9, tzinfo=UTC), datetime(2016, 6, 10, tzinfo=UTC), step_s=600.0)
METHODS = {
    "kalman": {"filter": "kalman"},
    "kalman refusing": {"filter": "kalman", "screening": "innovation"},
    "ekf": {"filter": "ekf"},
    "ukf": {"filter": "ukf"},
    "trace": {"filter": "ukf", "compose": {"robustness": "trace"}},
    "per channel": {"filter": "ukf", "compose": {"robustness": "per_channel"}},
    "Sage-Husa": {"filter": "ukf", "compose": {"learning": "sage_husa"}},
}


def made(b: Bench, data: dict[str, object]) -> Estimator:
    """A case file's filter with noise for every voltage, and no history to learn from."""
    none = np.zeros((0, len(b.layout)))
    history = Record(np.zeros(0, "datetime64[us]"), none, none, none, none > 0, none > 0, none)
    whole = {"name": "f", "noise": "scalar", "variance": 1e-8, **data}
    method = parameters.build(Method, whole, "estimate.methods")
    return method.estimator(Setting(b.network, b.layout, STUDY, history))


def spoilt(b: Bench, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Readings (T, m) of a state that stands still, and which of them report."""
    rng = np.random.default_rng(SEED)
    z = b.exact[0] + b.layout.sigma * rng.standard_normal((STEPS, len(b.layout)))
    on = np.ones(z.shape, dtype=bool)
    if kind == "zeros":
        z[5:8] = 0.0
        on[8:] = rng.random(z[8:].shape) > 0.2
    elif kind == "zeros first":
        z[:3] = 0.0
        on[3:] = rng.random(z[3:].shape) > 0.2
    else:
        z[5] += {"all by 1e6": 1e6, "all by 100": 100.0}[kind]
    return z, on


@pytest.mark.parametrize("kind", ["zeros", "zeros first", "all by 1e6", "all by 100"])
@pytest.mark.parametrize("name", METHODS)
def test_bad_polls_do_not_lose_the_filter(name: str, kind: str) -> None:
    b = still("ieee14")
    z, on = spoilt(b, kind)
    snapshots = (b.snapshot(row, given) for row, given in zip(z, on, strict=True))
    done = run(made(b, METHODS[name]), snapshots, b.network, b.layout)
    n = b.network.n_bus
    value, sigma = (
        done.estimated[c].to_numpy().reshape(STEPS, 2 * n)[:, n:] for c in ("value", "sigma")
    )
    status = done.steps["status"].to_numpy()
    ratio = np.abs(value - b.truth[0, n:]) / sigma
    assert not ((ratio > 8).any(axis=1) & (status == Status.OK)).any()
    assert np.isfinite(value[-10:]).all()
    assert ratio[-10:].max() < 4.5
    assert (status[-10:] == Status.OK).all()


@pytest.mark.parametrize("size", [-1.01, 0.03, 5.0])
@pytest.mark.parametrize("name", ["ukf", "per channel"])
def test_voltage_that_no_grid_has_is_no_estimate(name: str, size: float) -> None:
    """A mirrored voltage fits |V|, P and Q as well as the true one."""
    b = still("ieee14")
    filter_ = made(b, METHODS[name])
    state, _ = filter_.init(b.snapshot(b.exact[0]))
    x = state.inner.x.copy()
    x[b.network.n_bus + 4] = size
    lost = state.inner.s.copy()
    lost[np.flatnonzero(state.inner.x[b.network.n_bus :] == state.inner.x[-1])] = size
    lost[-10] = size
    broken = state._replace(
        inner=dataclasses.replace(state.inner, x=x, s=lost, P=1e-8 * np.eye(len(lost)))
    )
    after, info = filter_.step(broken, b.snapshot(b.exact[0]))
    assert info.status is Status.RESTARTED
    assert np.abs(filter_.read(after).x - b.truth[0]).max() < 1e-4


def test_low_voltage_is_one_if_its_meter_confirms_it() -> None:
    b = still("ieee14")
    guard = made(b, METHODS["ukf"]).step.__self__  # type: ignore[attr-defined]
    state, _ = guard.init(b.snapshot(b.exact[0]))
    x = state.inner.x.copy()
    x[b.network.n_bus + 4] = 0.2
    s = x[guard.inner.step.__self__.model.columns]
    low, z = dataclasses.replace(state.inner, x=x, s=s), b.exact[0].copy()
    assert "0.2 p.u. at bus number 4" in guard.impossible(low, b.snapshot(z))
    meter = (b.layout.quantity == VM) & (b.layout.position == 4)
    z[meter] = 0.22
    assert guard.impossible(low, b.snapshot(z)) == ""
    assert guard.impossible(low, b.snapshot(z, ~meter)) != ""


def test_few_absurd_readings_are_left_out_and_many_are_a_contradiction() -> None:
    variance = np.full(10, 4.0)
    eta = np.full(10, 2.0)
    assert not gross_errors(eta, variance, float(eta @ eta) / 4.0).any()
    eta[3] = 2e5
    found = gross_errors(eta, variance, float(eta @ eta) / 4.0)
    assert float(eta @ eta) / 4.0 > ABSURD * 10
    np.testing.assert_array_equal(np.flatnonzero(found), [3])
    eta[:4] = 100.0
    with pytest.raises(Contradiction, match="4 of 10 measurements are off by more than 30 σ"):
        gross_errors(eta, variance, float(eta @ eta) / 4.0)


@pytest.mark.parametrize("name", ["kalman", "ukf"])
def test_absurd_reading_is_named_and_not_used(name: str) -> None:
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))[:4]
    z[2, 20] = 1e6
    done = run(made(b, METHODS[name]), (b.snapshot(row) for row in z), b.network, b.layout)
    named = done.residuals[(done.residuals["reasons"] & int(Reason.INNOVATION)) != 0]
    assert named["channel"].tolist() == [b.layout.channel[20]]
    assert np.abs(done.estimated["value"].to_numpy()[-28:]).max() < 30.0


@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("singular"), FloatingPointError("over"), ValueError("nan")]
)
def test_run_outlives_what_a_snapshot_raises(error: Exception) -> None:
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))[:6]
    plain = made(b, METHODS["ukf"]).step.__self__.inner  # type: ignore[attr-defined]
    count = iter(range(100))

    def step(state: object, snapshot: Snapshot) -> tuple[object, Info]:
        if next(count) == 2:
            raise error
        return plain.step(state, snapshot)

    done = run(plain._replace(step=step), (b.snapshot(row) for row in z), b.network, b.layout)
    assert done.steps["status"].tolist() == ["ok"] * 3 + ["diverged"] + ["ok"] * 2
    assert type(error).__name__ in done.steps["detail"][3]
    kept = run(
        guarded(plain._replace(step=step), b.layout), (b.snapshot(row) for row in z),
        b.network, b.layout,
    )  # fmt: skip
    assert np.isfinite(kept.estimated["value"]).all()


def test_programming_error_is_not_hidden() -> None:
    b = still("ieee14")
    plain = made(b, METHODS["ukf"]).step.__self__.inner  # type: ignore[attr-defined]

    def step(state: object, snapshot: Snapshot) -> tuple[object, Info]:
        raise KeyError("a mistake of the programmer")

    with pytest.raises(KeyError):
        run(
            plain._replace(step=step), (b.snapshot(row) for row in b.exact[:3]),
            b.network, b.layout,
        )  # fmt: skip


@pytest.mark.parametrize(
    "bad", [{"lowest": 1.2}, {"highest": 0.9}, {"patience": 0}, {"doubt": 1.0}, {"lone": 1.0}]
)
def test_bounds_that_make_no_sense_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match="restart: expected "):
        RestartParams(**bad)  # type: ignore[arg-type]


def pair() -> SensorLayout:
    """Four voltmeters, of which nothing but the number matters here."""
    return SensorLayout.of(library.load("ieee14"), (VM, np.arange(4), BUS))


class Level:
    """Textbook filter of one number that four meters read: P = 1, R = 1, no noise."""

    def __init__(self) -> None:
        self.dynamics = Dynamics(
            lambda state: state,
            lambda state, _snapshot: Transition(*state, state[1]),
            lambda _state, s, P: Estimate(np.array([0.0, s[0]]), np.diag([0.0, P[0, 0]])),
        )

    def init(self, snapshot: Snapshot) -> tuple[object, Info]:
        mean = np.array([snapshot.z.mean()])
        return (mean, np.eye(1) / 4), Info.nothing(4, Status.OK)

    def step(self, state: object, snapshot: Snapshot) -> tuple[object, Info]:
        s, P = state  # type: ignore[misc]
        if not snapshot.available.any():
            return state, Info.nothing(4, Status.PREDICTED)
        S = P[0, 0] * np.ones((4, 4)) + np.eye(4)
        eta = snapshot.z - s[0]
        weighted = np.linalg.solve(S, eta)
        on, none = np.ones(4, dtype=bool), np.zeros(4)
        info = Info(
            Status.OK, 1, float(eta @ weighted), 4, on, eta, np.sqrt(np.diagonal(S)), none,
            misfit=float(np.abs(weighted).max()),
        )  # fmt: skip
        P_after = 1.0 / (1.0 / P + 4.0)
        return (s + P[0, 0] * weighted.sum(), P_after), info

    def guard(self, params: RestartParams) -> Estimator:
        read = lambda state: self.dynamics.read(state, *state)  # noqa: E731
        plain = Estimator(
            "level", self.init, self.step, read, lambda state, P: (state[0], P), self.dynamics
        )
        return guarded(plain, pair(), params)


def of_level(z: list[float]) -> Snapshot:
    on, zero = np.ones(4, dtype=bool), np.zeros(4)
    return Snapshot(np.datetime64("2016-06-09", "us"), np.array(z), np.ones(4), zero, on, on, zero)


ROOMY = RestartParams(highest=50.0)


def begun() -> Guarded:
    return Guarded((np.array([1.0]), np.eye(1)))


def test_snapshot_that_fits_makes_the_estimate_surer() -> None:
    after, info = Level().guard(ROOMY).step(begun(), of_level([1.0, 2.0, 0.0, 1.0]))
    assert info.status is Status.OK
    assert after.inner[1][0, 0] == pytest.approx(1 / 5)


def test_what_a_contradicting_snapshot_changed_is_doubtful() -> None:
    """η = (10, 0, 0, 0) and P = 1e-4: x moves by 1e-4 · 10/(1 + 4e-4), and is no surer for it."""
    sure = Guarded((np.array([1.0]), np.eye(1) * 1e-4))
    after, info = Level().guard(ROOMY).step(sure, of_level([11.0, 1.0, 1.0, 1.0]))
    moved = 1e-3 / (1 + 4e-4)
    assert info.status is Status.INCONSISTENT
    assert "what the snapshot changed is doubtful" in info.detail
    assert after.inner[0][0] == pytest.approx(1 + moved)
    assert after.inner[1][0, 0] == pytest.approx(1e-4 + moved**2)
    assert after.strange == 1


def test_filter_that_is_to_believe_everything_does() -> None:
    trusting = RestartParams(highest=50.0, doubt=np.inf, lone=np.inf)
    sure = Guarded((np.array([1.0]), np.eye(1) * 1e-4))
    after, info = Level().guard(trusting).step(sure, of_level([11.0, 1.0, 1.0, 1.0]))
    assert info.status is Status.OK
    assert after.inner[1][0, 0] == pytest.approx(1 / (1e4 + 4))


def test_three_contradictions_in_a_row_start_the_filter_again() -> None:
    guard = Level().guard(ROOMY)
    state: object = Guarded((np.array([1.0]), np.eye(1) * 1e-4))
    told = []
    for _ in range(3):
        state, info = guard.step(state, of_level([9.0, 1.0, 1.0, 1.0]))
        told.append(info.status)
    assert told == [Status.INCONSISTENT, Status.INCONSISTENT, Status.RESTARTED]
    assert state.inner[0][0] == pytest.approx(3.0)  # type: ignore[attr-defined]


def test_correction_beyond_what_is_linear_is_not_made() -> None:
    """The level would move by 8 · 0.8 = 6.4: the snapshot alone is asked instead."""
    after, info = Level().guard(ROOMY).step(begun(), of_level([9.0, 9.0, 9.0, 9.0]))
    assert info.status is Status.RESTARTED
    assert "would move a voltage by 6.4 p.u." in info.detail
    assert after.inner[0][0] == pytest.approx(9.0)


def test_forecast_that_knows_nothing_any_more_gives_way_to_a_snapshot() -> None:
    guard = Level().guard(ROOMY)
    silent, info = guard.step(begun(), of_level([1.0] * 4).silent())
    assert info.status is Status.PREDICTED
    assert silent.loose
    after, info = guard.step(silent, of_level([1.2] * 4))
    assert info.status is Status.RESTARTED
    assert after.inner[0][0] == pytest.approx(1.2)
    assert after.inner[1][0, 0] == pytest.approx(1 / 4)


def test_suspicion_ends_with_a_snapshot_that_passes() -> None:
    """99 % of χ² with 4 degrees lie below 13.3, and 4 η² / 5 of the four alike is NIS."""
    guard = Level().guard(ROOMY)
    state: object = Guarded((np.array([1.0]), np.eye(1)), suspect=True)
    worse = [1.0, 1.0, 1.0, 5.0]  # NIS 16 - 16/5 = 12.8, and 3.5 σ off
    assert guard.step(state, of_level(worse))[1].status is Status.OK
    worse[3] = 5.2  # 14.1
    after, info = guard.step(state, of_level(worse))
    assert info.status is Status.INCONSISTENT
    assert after.suspect
    assert after.strange == 0
    fresh = Guarded((np.array([1.0]), np.eye(1)))
    assert guard.step(fresh, of_level(worse))[1].status is Status.OK
    assert not guard.step(after, of_level([1.0, 1.0, 1.0, 1.0]))[0].suspect


@pytest.mark.parametrize(
    ("nis", "dof", "off", "misfit", "found"),
    [
        (4.0, 4, 1.0, 1.0, ""),
        (11.0, 1, 3.3, 1.0, ""),  # 3.3 σ of a single one is no proof
        (46.0, 1, 5.9, 1.0, "NIS is 46 per measurement"),
        (400.0, 100, 1.0, 1.0, "NIS is 4 per measurement"),
        (100.0, 100, 6.5, 1.0, "6.5 σ off its forecast"),
        (100.0, 100, 1.0, 7.0, "7 σ off the estimate"),
        (100.0, 100, 1.0, np.nan, ""),
        (np.nan, 0, 9.0, 9.0, ""),
    ],
)
def test_contradiction_is_told_by_all_or_by_one(
    nis: float, dof: int, off: float, misfit: float, found: str
) -> None:
    on = np.ones(1, dtype=bool)
    info = Info(Status.OK, 1, nis, dof, on, np.array([off]), np.ones(1), np.zeros(1), misfit=misfit)
    told = RestartParams().contradiction(info)
    assert told == "" if not found else found in told
    named = dataclasses.replace(info, inflation=np.ones(1), misfit=np.nan)
    if "forecast" in found:
        assert RestartParams().contradiction(named) == ""


def test_dead_voltmeter_confirms_no_dead_bus() -> None:
    b = still("ieee14")
    guard = made(b, METHODS["ukf"]).step.__self__  # type: ignore[attr-defined]
    state, _ = guard.init(b.snapshot(b.exact[0]))
    x = state.inner.x.copy()
    x[b.network.n_bus + 4] = 0.02
    dead, z = dataclasses.replace(state.inner, x=x), b.exact[0].copy()
    dead = dataclasses.replace(dead, s=x[guard.inner.step.__self__.model.columns])
    z[(b.layout.quantity == VM) & (b.layout.position == 4)] = 0.0
    assert "0.02 p.u. at bus number 4" in guard.impossible(dead, b.snapshot(z))
