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
from pse_analysis.estimation.core.interface import Estimator, Info, Snapshot
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.filters.restart import (
    ABSURD,
    Contradiction,
    RestartParams,
    gross_errors,
    guarded,
)
from pse_analysis.measurement import VM
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


@pytest.mark.parametrize("bad", [{"lowest": 1.2}, {"highest": 0.9}, {"patience": 0}])
def test_bounds_that_make_no_sense_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match="restart: expected 0 < lowest < 1 < highest"):
        RestartParams(**bad)  # type: ignore[arg-type]
