"""Claim: the unscented filter is the textbook's, whatever it is composed of, and stays definite."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from qu_bench import VARIANCE, Bench, real_day, still

from pse_analysis.errors import ParameterError, TableError
from pse_analysis.estimation.core import cholesky
from pse_analysis.estimation.core.run import run
from pse_analysis.estimation.core.run_arrays import EPOCH, run_arrays
from pse_analysis.estimation.filters import recursion, unscented
from pse_analysis.estimation.filters.composition import Composition, build, scalar
from pse_analysis.estimation.filters.conditioning import Prior
from pse_analysis.estimation.filters.unscented import Scaling
from pse_analysis.estimation.process import dynamics, sage_husa
from pse_analysis.estimation.process.sage_husa import Learnt
from pse_analysis.measurement import IA, IM, VA, VM, MeasurementModel, P, SensorLayout
from pse_analysis.vocabulary import Status

SEED = 7


def prior_of(b: Bench, order: int, rng: np.random.Generator) -> Prior:
    n = len(b.start)
    half = rng.standard_normal((order * n, order * n))
    x = b.truth[0]
    covariance = 1e-3 * (half @ half.T / n + np.eye(order * n))
    s = np.concatenate([x, np.zeros((order - 1) * n)])
    return Prior(s, covariance, x, np.arange(n))


@pytest.mark.parametrize("order", [1, 2], ids=["voltages", "with_slopes"])
@pytest.mark.parametrize(("alpha", "beta"), [(1.0, 2.0), (0.4, 2.0), (1.0, 0.0)])
def test_moments_equal_the_weighted_sums(order: int, alpha: float, beta: float) -> None:
    """χ = x ± √((n+λ)P), ŷ = Σ Wᵐγ, S = Σ Wᶜ(γ-ŷ)(γ-ŷ)ᵀ, C = Σ Wᶜ(χ-x)(γ-ŷ)ᵀ, some rows only.

    The n of s² = α²n is that of the voltages: points along slopes would all read the same.
    """
    b = still("ieee14")
    rng = np.random.default_rng(SEED)
    prior = prior_of(b, order, rng)
    rows = np.flatnonzero(rng.random(len(b.layout)) < 0.7)
    observe = unscented.fixed(b.filter().model, Scaling(alpha, 0.0, beta)).predict
    found = observe(prior, b.snapshot(b.exact[0]), rows, alpha, prior.s)
    n, size = prior.n, len(prior.s)
    spread = alpha * np.sqrt(n) * np.linalg.cholesky(prior.P)
    points = np.column_stack([prior.s, prior.s[:, None] + spread, prior.s[:, None] - spread])
    y = b.filter().model.h(points[:n])[rows]
    mean_weight = np.full(2 * size + 1, 0.5 / (alpha**2 * n))
    mean_weight[0] = 1.0 - size / (alpha**2 * n)
    weight = mean_weight.copy()
    weight[0] += 1.0 - alpha**2 + beta
    mean = y @ mean_weight
    apart = y - mean[:, None]
    np.testing.assert_allclose(found.mean, mean, atol=1e-10)
    own = (weight * apart) @ apart.T
    np.testing.assert_allclose(cholesky.symmetric(found.own), own, atol=1e-10)
    cross = (weight * (points - prior.s[:, None])) @ apart.T
    np.testing.assert_allclose(found.cross, cross, atol=1e-10)


def test_rows_that_are_not_available_count_for_nothing() -> None:
    b = still("ieee14")
    rng = np.random.default_rng(SEED)
    z = b.measure(rng)
    known = rng.random(z.shape) < 0.8
    whole = run_arrays(
        b.filter(), b.truth[0], b.start, np.where(known, z, 1e6), b.layout.sigma, available=known
    )
    state = b.filter().begin(b.truth[0], b.start, EPOCH)
    for k in range(1, len(z)):
        rows = np.flatnonzero(known[k])
        part = Bench(b.network, b.layout.take(rows), b.truth, b.exact[:, rows])
        # A filter built for just these rows, on the same state.
        state, _ = part.filter().step(
            dataclasses.replace(state, refusals=np.zeros(len(rows), dtype=np.int64)),
            part.snapshot(z[k, rows]),
        )
        np.testing.assert_allclose(whole.x[k], state.x, atol=1e-10)
    assert not whole.field("used")[~known[1:]].any()


def test_instant_without_any_measurement_is_only_predicted() -> None:
    b = still("ieee14")
    made = b.filter(process="holt", holt=dynamics.HoltParams(as_printed=True))
    state = made.begin(b.truth[0], b.start, EPOCH)
    after, info = made.step(state, b.snapshot(b.exact[0], np.zeros(len(b.layout), dtype=bool)))
    assert info.status is Status.PREDICTED
    factor = (0.85 * 1.05) ** 2
    np.testing.assert_allclose(after.P, factor * b.start + VARIANCE * np.eye(len(b.start)))


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_without_any_angle_the_slacks_angle_is_the_reference(kind: str) -> None:
    full = still("ieee14")
    rows = np.flatnonzero(full.layout.quantity != VA)
    b = Bench(full.network, full.layout.take(rows), full.truth, full.exact[:, rows])
    z = b.measure(np.random.default_rng(SEED))
    choice = Composition(process="local_trend", scaling="moments", robustness="per_channel")
    made = build("f", kind, choice, b.network, b.layout, scalar(b.network, b.layout, 1e-5))
    result = run(made, (b.snapshot(row) for row in z), b.network, b.layout)
    slack = result.estimated.query(
        f"element == 'bus/{b.network.buses.name[b.network.slack]}' and quantity == 'va_degree'"
    )
    assert (slack["value"] == 0.0).all()
    assert (slack["sigma"] == 0.0).all()
    assert result.steps["status"].isin([Status.OK, Status.INCONSISTENT]).all()
    assert np.abs(b.filter().model.columns - b.network.slack).min() > 0


@pytest.mark.parametrize("name", ["unscented", "extended"])
def test_currents_and_their_angles_may_be_measured(name: str) -> None:
    """∠I passes the end of its turn: the points and the innovation are folded."""
    b = still("ieee14")
    network = b.network
    layout = SensorLayout.of(
        network,
        *((q, np.arange(network.n_bus), 0) for q in (VM, VA)),
        *((q, np.arange(network.n_branch), 1) for q in (IM, IA)),
    )
    layout = dataclasses.replace(layout, sigma=np.full(len(layout), 0.01))
    truth = b.truth.copy()
    truth[:, : network.n_bus] += np.pi - 0.2  # currents' angles then lie around ±π
    model = MeasurementModel(network, layout)
    c = Bench(network, layout, truth, model.h(truth.T).T)
    z = c.measure(np.random.default_rng(SEED))
    done = c.run(c.filter("ukf" if name == "unscented" else "ekf"), z)
    assert max(done.rmse(truth)) < 0.01


def test_alpha_on_ieee30_settles_as_published() -> None:
    """P₀ = Q = R read as each bus's sensor variances, θ without a phasor unit as 0.02²."""
    b = real_day()
    size = b.layout.sigma[b.layout.quantity == VM]
    angle = np.where(size < 0.02, 0.002, 0.02)
    model = MeasurementModel(b.network, b.layout)
    variance = np.concatenate([angle, size]) ** 2
    printed = dynamics.holt(dynamics.HoltParams(as_printed=True))
    made = recursion.GaussianFilter(
        model,
        printed,
        unscented.by_moments(model),
        sage_husa.known(sage_husa.constant(variance), printed),
    )
    z = b.measure(np.random.default_rng(SEED))[:30]
    alpha = run_arrays(made, b.truth[0], np.diag(variance), z, b.layout.sigma).alpha
    np.testing.assert_allclose(alpha[:3], [0.309, 0.301, 0.303], atol=1e-3)
    assert np.ptp(alpha[3:]) < 1e-3


def test_adaptive_scaling_is_no_worse_than_fixed_on_clean_data() -> None:
    b = real_day()
    rng = np.random.default_rng(SEED)
    rmse = {"fixed": [], "moments": []}
    for _ in range(6):
        z = b.measure(rng)
        for scaling, found in rmse.items():
            found.append(b.run(b.filter(process="holt", scaling=scaling), z).rmse(b.truth))
    fixed, moments = (np.mean(rmse[s], axis=0) for s in ("fixed", "moments"))
    assert (moments <= 1.0005 * fixed).all()


def test_alpha_by_likelihood_is_the_likeliest() -> None:
    b = still("ieee14")
    rng = np.random.default_rng(SEED)
    prior = prior_of(b, 1, rng)
    rows = np.arange(len(b.layout))
    snapshot = b.snapshot(b.measure(rng)[0])
    model = b.filter().model

    def log_likelihood(alpha: float) -> float:
        found = unscented.fixed(model, Scaling(alpha)).predict(
            prior, snapshot, rows, alpha, prior.s
        )
        S = cholesky.symmetric(found.own) + np.diag(snapshot.sigma**2)
        eta = snapshot.z - found.mean
        return float(-eta @ np.linalg.solve(S, eta) - np.linalg.slogdet(S)[1])

    best = unscented.by_likelihood(model).predict(prior, snapshot, rows, 1.0, prior.s).alpha
    grid = np.linspace(*unscented.ALPHA_RANGE, 50)
    assert log_likelihood(best) >= max(map(log_likelihood, grid)) - 1e-3


def test_covariance_stays_positive_over_many_steps_of_next_to_no_noise() -> None:
    b = still("ieee14")
    rng = np.random.default_rng(SEED)
    made = b.filter(q=1e-14, process="random_walk")
    state = made.begin(b.truth[0], b.start, EPOCH)
    for _ in range(4000):
        z = b.exact[0] + b.layout.sigma * rng.standard_normal(len(b.layout))
        state, _ = made.step(state, b.snapshot(z))
    np.testing.assert_array_equal(state.P, state.P.T)
    assert np.linalg.eigvalsh(state.P).min() > 0.0
    assert np.abs(state.x - b.truth[0]).max() < 0.005


def test_iterated_filter_stops_where_its_estimate_does() -> None:
    """U = x⁻ + K [z - h(U) - J (x⁻ - U)] holds at the end, with K of the Jacobian there."""
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))[1]
    made = b.filter("ekf", passes=20)
    state, info = made.step(made.begin(b.truth[0], 100 * b.start, EPOCH), b.snapshot(z))
    assert 1 < info.iterations < 20
    P0 = 100 * b.start + VARIANCE * np.eye(len(b.start))
    J = made.model.jacobian(state.x).toarray()
    S = J @ P0 @ J.T + np.diag(b.layout.sigma**2)
    innovation = z - made.model.h(state.x) - J @ (b.truth[0] - state.x)
    again = b.truth[0] + P0 @ J.T @ np.linalg.solve(S, innovation)
    np.testing.assert_allclose(again, state.x, atol=1e-8)
    few = b.filter("ekf", passes=2)
    _, stopped = few.step(few.begin(b.truth[0], 100 * b.start, EPOCH), b.snapshot(z))
    assert stopped.status is Status.NOT_CONVERGED
    assert "after 2 passes" in stopped.detail


def test_sage_husa_is_its_recursion_and_falls_back_to_a_positive_form() -> None:
    rng = np.random.default_rng(SEED)
    process = dynamics.random_walk()
    made = sage_husa.sage_husa(sage_husa.constant(np.full(3, 0.1)), process, forgetting=0.95)
    memory = made.begin(np.zeros(6), EPOCH)
    moved, correction = rng.standard_normal((2, 3))
    share = (1 - 0.95) / (1 - 0.95**2)
    after = made.learn(memory, Learnt(moved, correction, 0.3 * np.eye(3), 0.2 * np.eye(3)))
    np.testing.assert_allclose(after.mean, share * moved)
    expected = (1 - share) * 0.1 * np.eye(3) + share * (
        np.outer(correction, correction) + 0.1 * np.eye(3)
    )
    np.testing.assert_allclose(after.covariance, expected)
    shrunk = made.learn(memory, Learnt(moved, correction, 0.1 * np.eye(3), 9.0 * np.eye(3)))
    biased = (1 - share) * 0.1 * np.eye(3) + share * np.outer(correction, correction)
    np.testing.assert_allclose(shrunk.covariance, biased)
    with pytest.raises(ParameterError, match="0 < forgetting < 1"):
        sage_husa.sage_husa(sage_husa.constant(np.ones(3)), process, forgetting=1.0)


def test_sage_husa_is_as_unsure_as_its_samples_are_few() -> None:
    """Three states and one sample: Q is what was learnt and 3/4 of that size in the start's shape.

    Beyond that, a drift that rests on few samples fades while nothing is measured.
    """
    made = sage_husa.sage_husa(
        sage_husa.constant(np.array([1.0, 2.0, 3.0])), dynamics.random_walk(), forgetting=0.9
    )
    memory = made.begin(np.zeros(6), EPOCH)
    step = Learnt(np.ones(3), np.array([3.0, 0.0, 0.0]), np.eye(3), np.eye(3))
    learnt = made.learn(memory, step)
    share = 0.1 / (1 - 0.9**2)
    own = (1 - share) * np.diag([1.0, 2.0, 3.0]) + share * np.diag([9.0, 0.0, 0.0])
    _, Q, _ = made.current(learnt, np.zeros(6), EPOCH)
    size = np.trace(own) / 6.0
    np.testing.assert_allclose(Q, own + 0.75 * size * np.diag([1.0, 2.0, 3.0]))
    silent = made.wait(made.wait(learnt))
    np.testing.assert_allclose(silent.mean, 0.81 * share)
    np.testing.assert_array_equal(silent.covariance, learnt.covariance)


def test_sage_husa_learns_the_noise_of_its_own_model() -> None:
    """The state walks with a tenth of the σ that the filter starts from."""
    b = still("ieee14")
    rng = np.random.default_rng(SEED)
    walk = b.truth[0] + np.cumsum(1e-3 * rng.standard_normal((400, len(b.start))), axis=0)
    c = Bench(b.network, b.layout, walk, b.filter().model.h(walk.T).T)
    z = c.measure(rng)
    known, learnt = (
        c.run(c.filter(q=1e-4, learning=learning), z).rmse(walk)
        for learning in ("none", "sage_husa")
    )
    assert np.mean(learnt) < np.mean(known)


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_misfit_is_the_largest_residual_after_the_update(kind: str) -> None:
    """R S⁻¹η, by the textbook's inverse, is nearly z - h(x̂); robust filters that name have none."""
    b = still("ieee14")
    z = b.exact[0] + b.layout.sigma * np.random.default_rng(SEED).standard_normal(len(b.layout))
    z[7] += 5 * b.layout.sigma[7]
    made = b.filter(kind, q=1e-8)
    state, info = made.step(made.begin(b.truth[0], 1e-6 * b.start, EPOCH), b.snapshot(z))
    residual = np.abs(z - made.model.h(state.x)) / b.layout.sigma
    assert info.misfit == pytest.approx(residual.max(), rel=1e-3)
    assert residual.argmax() == 7
    z[7] = 1e3
    robust = b.filter(kind, q=1e-8, robustness="per_channel")
    _, info = robust.step(robust.begin(b.truth[0], 1e-6 * b.start, EPOCH), b.snapshot(z))
    assert info.inflation[7] > 0
    assert np.isnan(info.misfit)


def test_any_combination_works() -> None:
    b = still("ieee14")
    z = b.measure(np.random.default_rng(SEED))[:6]
    made = [
        b.filter(kind, process=process, scaling=scaling, learning=learning, robustness=robustness)
        for kind, scalings in (("ukf", ("fixed", "moments", "likelihood")), ("ekf", ("fixed",)))
        for scaling in scalings
        for process in ("random_walk", "holt", "local_trend")
        for learning in ("none", "sage_husa")
        for robustness in ("none", "trace", "per_channel")
    ]
    assert len(made) == 72
    for each in made:
        done = b.run(each, z)
        assert max(done.rmse(b.truth[:6])) < 0.02
        assert {i.status for i in done.info} == {Status.OK}


def test_messages_name_what_to_change() -> None:
    b = still("ieee14")
    with pytest.raises(ParameterError, match="0 < alpha ≤ 1"):
        Scaling(alpha=0.0)
    with pytest.raises(ParameterError, match="expected passes in 1"):
        b.filter("ekf", passes=0)
    with pytest.raises(TableError, match=r"expected z of shape \(T, 46\)"):
        b.run(b.filter(), np.zeros((3, 4)))


def test_covariance_beyond_repair_asks_for_a_new_start() -> None:
    b = still("ieee14")
    made = b.filter()
    state = made.begin(b.truth[0], -np.eye(len(b.start)), EPOCH)
    after, info = made.step(state, b.snapshot(b.exact[0]))
    assert after is None
    assert info.status is Status.DIVERGED
    assert "starts again from least squares" in info.detail


def test_start_that_is_not_observable_says_so() -> None:
    b = still("ieee14")
    made = build("f", "ukf", Composition(), b.network, b.layout, scalar(b.network, b.layout, 1e-4))
    only = b.layout.quantity != P
    state, info = made.init(b.snapshot(b.exact[0], only & (b.layout.position != 7)))
    assert state is None
    assert info.status is Status.UNOBSERVABLE
