"""Claim: gross errors are named and ridden out, and a filter that refuses everything comes back."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from qu_bench import Bench, gross_errors, real_day, still

from pse_analysis.errors import ParameterError
from pse_analysis.estimation.bad_data import robust
from pse_analysis.estimation.bad_data.robust import GATE_SQ, InnovationStats, Protection, gate
from pse_analysis.estimation.core.cholesky import Root
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.core.run_arrays import EPOCH, ArrayRun, run_arrays
from pse_analysis.estimation.filters.recursion import estimator
from pse_analysis.estimation.process.dynamics import HoltParams
from pse_analysis.estimation.static.start import Start
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import VA, VM, MeasurementModel, Q
from pse_analysis.vocabulary import Reason, Status

SEED = 30
TRIALS = 12


def suspicion(
    rng: np.random.Generator, m: int = 12, wrong: tuple[int, ...] = ()
) -> InnovationStats:
    half = rng.standard_normal((m, 4))
    noise = rng.uniform(0.5, 1.5, m)
    S = half @ half.T + np.diag(noise)
    eta = np.linalg.cholesky(S) @ rng.standard_normal(m)
    eta[list(wrong)] += 40.0
    return of(eta, S, noise)


def of(eta: np.ndarray, S: np.ndarray, noise: np.ndarray) -> InnovationStats:
    chol = np.linalg.cholesky(S)
    return InnovationStats(
        eta, np.diagonal(S).copy(), noise, np.linalg.solve(chol, eta), Root(chol)
    )


def test_gate_lets_good_snapshots_pass_as_often_as_it_says() -> None:
    rng = np.random.default_rng(SEED)
    total, largest = gate(20)
    eta = rng.standard_normal((200_000, 20))
    beyond = (eta**2).sum(axis=1) > total
    outlying = (eta**2).max(axis=1) > largest
    assert beyond.mean() == pytest.approx(1e-3, abs=3e-4)
    assert outlying.mean() == pytest.approx(1e-3, abs=3e-4)


@pytest.mark.parametrize("judge", robust.GROSS_ERROR_TESTS.values(), ids=robust.GROSS_ERROR_TESTS)
def test_good_snapshot_is_believed(judge: robust.GrossErrorTest) -> None:
    found = suspicion(np.random.default_rng(SEED))
    assert found.nis < gate(12)[0]
    assert not judge(found).any()


def test_trace_matches_the_trace() -> None:
    found = suspicion(np.random.default_rng(SEED), wrong=(3,))
    phi = robust.trace(found)
    assert np.ptp(phi) == 0.0
    inflated = found.variance.sum() + phi[0] * found.noise.sum()
    assert inflated == pytest.approx(found.innovation @ found.innovation)


def test_trace_is_raised_until_the_snapshot_passes() -> None:
    """Forecasts that are loose to any degree, beside a factorisation for every factor tried."""
    rng = np.random.default_rng(SEED)
    raised = 0
    for _ in range(40):
        m = 30
        half = 10.0 ** rng.uniform(-2.0, 3.0) * rng.standard_normal((m, 12))
        noise = 10.0 ** rng.uniform(-3.0, 0.0, m)
        S = half @ half.T + np.diag(noise)
        eta = rng.standard_normal(m)
        eta[3] = 10.0 ** rng.uniform(0.9, 2.0) * np.sqrt(S[3, 3])
        first = phi = max(0.0, (eta @ eta - np.trace(S)) / noise.sum())
        while eta @ np.linalg.solve(S + phi * np.diag(noise), eta) > gate(m)[0]:
            phi = 4.0 * max(phi, 1.0)
        np.testing.assert_allclose(robust.trace(of(eta, S, noise)), phi)
        raised += phi > first
    assert raised > 10


def test_wrong_channels_are_named_and_no_others() -> None:
    rng = np.random.default_rng(SEED)
    for wrong in ((3,), (0, 5), (1, 4, 9)):
        found = suspicion(rng, wrong=wrong)
        phi = robust.per_channel(found)
        assert tuple(np.flatnonzero(phi)) == wrong
        S = found.root.chol @ found.root.chol.T + np.diag(phi * found.noise)
        assert found.innovation @ np.linalg.solve(S, found.innovation) < gate(12)[0]


def test_error_that_the_forecasts_uncertainty_covers_is_found_by_the_other_channels() -> None:
    """All channels see one uncertain level, of variance 100; one of them is 8σ off the others."""
    noise = np.ones(20)
    S = np.full((20, 20), 100.0) + np.diag(noise)
    eta = np.full(20, 10.0)
    eta[4] += 8.0
    found = of(eta, S, noise)
    assert eta[4] ** 2 < GATE_SQ * S[4, 4]
    assert tuple(np.flatnonzero(robust.per_channel(found))) == (4,)


def test_suspects_that_the_other_channels_confirm_are_cleared() -> None:
    """The level is off by 4 of its 1; two channels lie a little beyond 3σ, a third one is wrong."""
    S = np.full((20, 20), 1.0) + np.eye(20)
    eta = np.full(20, 4.0)
    eta[[2, 6]] = 4.5
    eta[11] = 40.0
    found = of(eta, S, np.ones(20))
    assert (eta[[2, 6]] ** 2 > GATE_SQ * found.variance[[2, 6]]).all()
    assert tuple(np.flatnonzero(robust.per_channel(found))) == (11,)


# --------------------------------------------------------------------------------------------------
# The paper's experiments on IEEE 30: Holt's process, Q = 10⁻⁴ I, a day of real load
# --------------------------------------------------------------------------------------------------


@cache
def clean(robustness: str, trials: int) -> np.ndarray:
    """Mean RMSE of |V| and θ without gross errors."""
    b = real_day()
    rng = np.random.default_rng(SEED)
    made = b.filter(process="holt", robustness=robustness)
    return np.mean([b.run(made, b.measure(rng)).rmse(b.truth) for _ in range(trials)], axis=0)


@pytest.mark.parametrize("robustness", ["trace", "per_channel"])
def test_robust_filter_is_within_2_percent_of_the_plain_one_on_clean_data(robustness: str) -> None:
    assert (clean(robustness, 6) <= 1.02 * clean("none", 6)).all()


@cache
def voltage_times_hundred(robustness: str) -> np.ndarray:
    """Mean RMSE where |V| at bus 10 reads a hundred times too high at k = 50."""
    b = real_day()
    rng = np.random.default_rng(SEED)
    at = (b.layout.quantity == VM) & (b.layout.position == b.network.bus("10"))
    rmse = []
    for _ in range(6):
        z = b.measure(rng)
        z[50, at] *= 100.0
        done = b.run(b.filter(process="holt", robustness=robustness), z)
        if robustness == "per_channel":
            assert np.flatnonzero(done.info[49].inflation) == np.flatnonzero(at)
        rmse.append(done.rmse(b.truth))
    return np.asarray(np.mean(rmse, axis=0))


@pytest.mark.parametrize("robustness", ["trace", "per_channel"])
def test_robust_filter_rides_out_a_voltage_a_hundred_times_too_high(robustness: str) -> None:
    assert (voltage_times_hundred(robustness) <= 1.05 * clean(robustness, 6)).all()


def test_plain_filter_is_thrown_off_by_a_voltage_a_hundred_times_too_high() -> None:
    assert voltage_times_hundred("none")[0] >= 3.0 * clean("none", 6)[0]


def test_per_channel_rides_out_gross_errors_at_every_instant() -> None:
    """Twelve trials, 5 % of all samples times 10: error, precision and recall."""
    b = real_day()
    rng = np.random.default_rng(SEED)
    made = b.filter(process="holt", robustness="per_channel")
    rmse, right, named, found, large = [], 0, 0, 0, 0
    for _ in range(TRIALS):
        z, wrong = gross_errors(b.measure(rng), 0.05, rng)
        done = b.run(made, z)
        rmse.append(done.rmse(b.truth))
        suspect, wrong = done.field("inflation") > 0, wrong[1:]
        beyond = np.abs(done.field("innovation")) > 6.0 * done.field("sigma_innovation")
        right += int((suspect & wrong).sum())
        named += int(suspect.sum())
        found += int((suspect & wrong & beyond).sum())
        large += int((wrong & beyond).sum())
    best = np.min([clean_at(q) for q in (1e-5, 3e-5, 1e-4, 3e-4)], axis=0)
    assert (np.mean(rmse, axis=0) <= 2.0 * best).all()
    assert right / named >= 0.95
    assert found / large >= 0.9


@cache
def clean_at(q: float) -> np.ndarray:
    """Mean RMSE of the plain filter without gross errors, for another Q."""
    b = real_day()
    rng = np.random.default_rng(SEED)
    made = b.filter(process="holt", q=q)
    return np.mean([b.run(made, b.measure(rng)).rmse(b.truth) for _ in range(4)], axis=0)


@pytest.mark.parametrize("q", [1e-6, 1e-2], ids=["Q/100", "100Q"])
@pytest.mark.parametrize("robustness", ["trace", "per_channel"])
def test_protected_filter_does_not_diverge_where_q_is_wrong(robustness: str, q: float) -> None:
    """Ten trials: at no time is a voltage or an angle off by 0.15."""
    b = real_day()
    rng = np.random.default_rng(SEED)
    made = b.filter(process="holt", q=q, robustness=robustness)
    for _ in range(10):
        done = b.run(made, b.measure(rng))
        assert np.abs(done.x - b.truth).max() < 0.15


@pytest.mark.parametrize("q", [1e-4, 1e-2], ids=["Q", "100Q"])
def test_protected_trace_stays_near_with_gross_errors_at_every_instant(q: float) -> None:
    """5 % of all samples times 10: half of the steps are within 0.05 rad, nearly all in 0.5."""
    b = real_day()
    rng = np.random.default_rng(SEED)
    made = b.filter(process="holt", q=q, robustness="trace")
    done = b.run(made, gross_errors(b.measure(rng), 0.05, rng)[0])
    off = np.abs(done.x - b.truth)[:, : b.network.n_bus].max(axis=1)
    assert np.median(off) < 0.05
    assert np.quantile(off, 0.95) < 0.5
    # After two snapshots that were refused as a whole, each channel is judged by itself.
    refused = (done.field("inflation") > 0).mean(axis=1)
    assert (refused == 1.0).mean() < 0.3
    assert all(
        "refused as a whole" in i.detail for i in done.info if 0 < (i.inflation > 0).mean() < 1
    )


# --------------------------------------------------------------------------------------------------
# Latching
# --------------------------------------------------------------------------------------------------


def stepped(b: Bench, share: float = 0.3, at: int = 30) -> Bench:
    """The load of every other bus grows at one instant and stays."""
    power = b.network.p_nominal_pu[:, None] * np.ones(2 * at)
    power[::2, at:] *= 1.0 + share
    x = solve(b.network, power).x.T
    return Bench(b.network, b.layout, x, MeasurementModel(b.network, b.layout).h(x.T).T)


@pytest.mark.parametrize("robustness", ["trace", "per_channel"])
def test_filter_with_too_small_q_comes_back_after_a_real_step_of_load(robustness: str) -> None:
    """Q a hundred times below the best, clean data: back within five steps, for it said so."""
    b = stepped(still("ieee30"))
    moved = np.abs(b.truth[-1] - b.truth[0]).max()
    rng = np.random.default_rng(SEED)
    made = b.filter(process="holt", q=1e-6, robustness=robustness)
    for _ in range(5):
        done = b.run(made, b.measure(rng))
        off = np.abs(done.x - b.truth).max(axis=1)
        assert off[30] > 0.3 * moved
        assert off[35:].max() < 0.35 * moved
        assert off[50:].max() < 0.04
        assert done.times(Status.RESTARTED) >= 1


def test_unprotected_trace_does_not_come_back_after_a_real_step_of_load() -> None:
    b = stepped(still("ieee30"))
    moved = np.abs(b.truth[-1] - b.truth[0]).max()
    printed = HoltParams(as_printed=True)
    made = b.filter(process="holt", holt=printed, q=1e-6, robustness="trace", protected=False)
    done = b.run(made, b.measure(np.random.default_rng(SEED)))
    assert np.abs(done.x - b.truth).max(axis=1)[-1] > 0.5 * moved


def jump(b: Bench, made: object, at: int = 8) -> ArrayRun:
    """All angles jump by up to 0.1 rad at one instant and stay, under next to no process noise."""
    truth = np.repeat(b.truth[:1], 21, axis=0)
    truth[at:, : b.network.n_bus] += 0.1 * np.linspace(0.5, 1.0, b.network.n_bus)
    exact = made.model.h(truth.T).T  # type: ignore[attr-defined]
    c = Bench(b.network, b.layout, truth, exact)
    return c.run(made, c.measure(np.random.default_rng(SEED)))  # type: ignore[arg-type]


@pytest.mark.parametrize("robustness", ["trace", "per_channel"])
def test_real_jump_is_refused_at_first_then_followed_and_said_so(robustness: str) -> None:
    b = still("ieee14")
    truth = b.truth[0].copy()
    truth[: b.network.n_bus] += 0.1 * np.linspace(0.5, 1.0, b.network.n_bus)
    protected, alone = (
        jump(b, b.filter(q=1e-8, robustness=robustness, protected=p)) for p in (True, False)
    )
    assert np.abs(protected.x[-1] - truth).max() < 0.03
    assert np.abs(alone.x[-1] - truth).max() > np.abs(protected.x[-1] - truth).max()
    assert protected.times(Status.RESTARTED) >= 1
    told = [i.detail for i in protected.info if i.status is Status.RESTARTED]
    assert "refused 3 times in a row: the forecast was widened in their directions" in told[0]
    assert alone.times(Status.RESTARTED) == 0


def test_forecast_is_widened_where_a_snapshot_alone_is_not_enough() -> None:
    """Half of the magnitudes and no reactive power: least squares cannot start."""
    b = still("ieee14")
    made = b.filter(q=1e-8, robustness="trace")
    seen = b.layout.quantity != Q
    seen &= (b.layout.quantity != VM) | (b.layout.position % 2 == 0)
    truth = np.repeat(b.truth[:1], 21, axis=0)
    truth[8:, : b.network.n_bus] += 0.1 * np.linspace(0.5, 1.0, b.network.n_bus)
    z = made.model.h(truth.T).T
    z += b.layout.sigma * np.random.default_rng(SEED).standard_normal(z.shape)
    known = np.broadcast_to(seen, z.shape)
    done = run_arrays(made, truth[0], b.start, z, b.layout.sigma, available=known)
    told = [i.detail for i in done.info if i.status is Status.RESTARTED]
    assert "the forecast was widened" in told[0]
    assert np.abs(done.x[-1] - truth[-1])[: b.network.n_bus].max() < 0.05


def test_movement_that_many_channels_see_is_no_error() -> None:
    """All angles turn by 0.04 rad, far more than Q allows: acquitted by the snapshot itself."""
    b = still("ieee30")
    made = b.filter(q=1e-5, robustness="per_channel", protected=False)
    truth = np.repeat(b.truth[:1], 3, axis=0)
    truth[2:, : b.network.n_bus] += 0.04
    z = made.model.h(truth.T).T
    z += b.layout.sigma * np.random.default_rng(SEED).standard_normal(z.shape)
    angles = b.layout.quantity == VA
    done = run_arrays(made, truth[0], 1e-5 * np.eye(len(b.start)), z, b.layout.sigma)
    last = done.info[-1]
    assert (np.abs(last.innovation[angles]) > 3.0 * last.sigma_innovation[angles]).all()
    assert not last.inflation.any()


def test_meter_that_stays_wrong_is_not_believed_for_it() -> None:
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))
    broken = np.flatnonzero(b.layout.quantity == VM)[[2, 5, 8]]
    z[5:, broken] += 0.5
    done = b.run(b.filter(robustness="per_channel"), z)
    assert (done.field("inflation")[4:, broken] > 0).all()
    assert any("the snapshot alone refuses" in i.detail for i in done.info)
    assert max(done.rmse(b.truth)) < 0.02


@pytest.mark.parametrize("robustness", ["trace", "per_channel"])
def test_absurd_readings_that_stay_are_survived(robustness: str) -> None:
    """Two meters read ten million from one instant on."""
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))
    z[5:, [3, 20]] = 1e7
    done = b.run(b.filter(robustness=robustness), z)
    assert done.times(Status.DIVERGED) == 0
    assert np.abs(done.x - b.truth).max() < 0.1


def test_residuals_name_the_bad_channel() -> None:
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))
    z[3, 20] += 5.0
    made = estimator("rukf", b.filter(robustness="per_channel"), Start(b.network, b.layout))
    tables = run(made, (b.snapshot(row) for row in z), b.network, b.layout)
    named = tables.residuals[tables.residuals["inflation"] > 0]
    assert list(named["channel"]) == [b.layout.channel[20]]
    assert (named["reasons"] == Reason.INNOVATION).all()
    assert list(tables.steps["rejected"]) == [0, 0, 0, 1] + [0] * (len(z) - 4)


def test_protection_counts_refusals_in_a_row() -> None:
    protection = Protection(patience=2, share=0.5)
    used = np.array([True, True, True, False])
    assert not protection.latched(np.array([2, 1, 0, 9]), used)
    assert protection.latched(np.array([2, 3, 0, 0]), used)
    with pytest.raises(ParameterError, match="patience ≥ 1"):
        Protection(patience=0)


def test_refusals_are_forgotten_when_a_channel_agrees_again() -> None:
    b = still("ieee14")
    made = b.filter(robustness="per_channel")
    state = made.begin(b.truth[0], b.start, EPOCH)
    z = b.exact[0].copy()
    z[30] += 5.0
    state, _ = made.step(state, b.snapshot(z))
    state, _ = made.step(state, b.snapshot(z))
    assert state.refusals[30] == 2
    state, _ = made.step(state, b.snapshot(b.exact[0]))
    assert not state.refusals.any()
