"""Claim: the status of least squares is an exact test, and names a meter only with reason."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from reference import conventional, snapshot
from scipy import stats

from pse_analysis.errors import ParameterError
from pse_analysis.estimation import LeastSquares, Method
from pse_analysis.estimation.core.interface import Info
from pse_analysis.estimation.static.chi_square import Residuals, contradiction
from pse_analysis.estimation.static.tracking import WlsParams, tracking_wls
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VM, MeasurementModel, P, Q, SensorLayout

SEED = 11


def exact(network: Network, layout: SensorLayout) -> tuple[np.ndarray, np.ndarray]:
    """Readings without noise and the σ that they should have. [p.u.]"""
    z = MeasurementModel(network, layout).h(solve(network).x)
    return z, np.where(layout.quantity == VM, 0.004, 0.01)


def of_snapshot(
    network: Network,
    layout: SensorLayout,
    z: np.ndarray,
    sigma: np.ndarray,
    confidence: float = 0.99,
) -> Info:
    made = tracking_wls("wls", network, layout, WlsParams(confidence=confidence))
    return made.init(snapshot(z, sigma))[1]


def doubled() -> tuple[Network, SensorLayout, np.ndarray, np.ndarray]:
    """A grid that is just observable, but for a second voltmeter at the slack."""
    network = library.load("ieee14")
    bus = np.flatnonzero(np.arange(14) != network.slack)
    slack = np.array([network.slack])
    rows = [(VM, slack, BUS), (VM, slack, BUS), (P, bus, BUS), (Q, bus, BUS)]
    layout = SensorLayout.of(network, *rows)
    return network, layout, *exact(network, layout)


@pytest.mark.parametrize("apart", [0.5, 2.5, 2.65, 3.5])
def test_two_voltmeters_that_differ_are_judged_by_their_difference(apart: float) -> None:
    """Their difference d has variance 2σ², so χ² is d²/(2σ²) with one degree of freedom."""
    network, layout, z, sigma = doubled()
    z[0] += apart * np.sqrt(2.0) * sigma[0]
    info = of_snapshot(network, layout, z, sigma)
    assert info.dof == 1
    assert info.nis == pytest.approx(apart**2, rel=1e-6)
    # Half of one per cent is for χ², the other half for the two residuals, which say the same.
    bound = stats.chi2.ppf(0.995, 1)
    assert (info.status == "inconsistent") == (info.nis > bound)
    assert ("nothing tells which is wrong" in info.detail) == (info.nis > bound)
    np.testing.assert_allclose(
        (info.innovation / info.sigma_innovation)[:2], [apart, -apart], rtol=1e-5
    )


def test_critical_measurements_are_never_accused() -> None:
    network, layout, z, sigma = doubled()
    z[5] += 30.0 * sigma[5]  # nothing else sees it
    assert of_snapshot(network, layout, z, sigma).status == "ok"


def test_normalised_residuals_are_the_textbooks() -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    z, sigma = exact(network, layout)
    z = z + sigma * np.random.default_rng(SEED).normal(size=len(z))
    made = tracking_wls("wls", network, layout)
    state, info = made.init(snapshot(z, sigma))
    estimate = made.read(state)
    assert estimate is not None
    model = MeasurementModel(network, layout, np.delete(np.arange(28), network.slack))
    H, R = model.jacobian(estimate.x).toarray(), np.diag(sigma**2)
    omega = R - H @ np.linalg.inv(H.T @ np.linalg.inv(R) @ H) @ H.T
    np.testing.assert_allclose(info.sigma_innovation, np.sqrt(np.diagonal(omega)), rtol=1e-6)


@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_at_least_the_promised_share_of_good_snapshots_passes(confidence: float) -> None:
    network = library.load("ieee14")
    layout = conventional(network)
    z, sigma = exact(network, layout)
    rng = np.random.default_rng(SEED)
    made = tracking_wls("wls", network, layout, WlsParams(confidence=confidence))
    state, passed, objective, count = None, 0, [], 300
    for _ in range(count):
        shot = snapshot(z + sigma * rng.normal(size=len(z)), sigma)
        state, info = made.init(shot) if state is None else made.step(state, shot)
        passed += info.status == "ok"
        objective.append(info.nis)
    spread = np.sqrt(confidence * (1.0 - confidence) / count)
    # Bonferroni's inequality gives away no more than the half that goes to single residuals.
    assert confidence - 3.0 * spread < passed / count
    assert passed / count < 0.5 * (1.0 + confidence) + 3.0 * spread
    assert stats.kstest(objective, stats.chi2(info.dof).cdf).pvalue > 0.01


@pytest.mark.parametrize("size", [40.0, -25.0])
def test_one_gross_error_among_hundreds_is_seen_and_named(size: float) -> None:
    network = library.load("ieee118")
    layout = conventional(network)
    z, sigma = exact(network, layout)
    z = z + sigma * np.random.default_rng(SEED).normal(size=len(z))
    row = int(np.flatnonzero((layout.quantity == P) & (layout.side == BUS))[48])
    z[row] += size * sigma[row]
    info = of_snapshot(network, layout, z, sigma)
    assert info.status == "inconsistent"
    assert f"without {layout.channel[row]} the others agree" in info.detail


def test_a_residual_of_eight_sigma_does_not_hide_among_hundreds_in_chi_square() -> None:
    network = library.load("ieee118")
    layout = conventional(network)
    z, sigma = exact(network, layout)
    row = int(np.flatnonzero(layout.quantity == VM)[60])
    z[row] += 8.5 * sigma[row]
    info = of_snapshot(network, layout, z, sigma)
    assert info.nis < stats.chi2.ppf(0.99, info.dof)
    assert info.status == "inconsistent"
    assert layout.channel[row] in info.detail


def test_two_gross_errors_are_no_single_meters_fault() -> None:
    network = library.load("ieee30")
    layout = conventional(network)
    z, sigma = exact(network, layout)
    z[[3, 17]] += 30.0 * sigma[[3, 17]]
    info = of_snapshot(network, layout, z, sigma)
    assert info.status == "inconsistent"
    assert "no single measurement explains it" in info.detail


def test_meters_that_cannot_be_told_apart_are_both_named() -> None:
    normalised = np.array([6.0, -6.0, 1.0])
    found = Residuals(37.0, 2, np.ones(3), normalised)
    assert "without a or b the others agree" in contradiction(found, ("a", "b", "c"), 0.99)
    assert contradiction(found, ("a", "b", "c"), 1.0 - 1e-12) == ""
    assert contradiction(found._replace(dof=0), ("a", "b", "c"), 0.99) == ""


def test_confidence_of_a_case_file_reaches_the_test_and_other_filters_refuse_it() -> None:
    network, layout, z, sigma = doubled()
    z[0] += 2.65 * np.sqrt(2.0) * sigma[0]
    assert of_snapshot(network, layout, z, sigma, 0.99).status == "ok"
    assert of_snapshot(network, layout, z, sigma, 0.95).status == "inconsistent"
    lax = Method.of("wls", "wls", confidence=0.9)
    assert isinstance(lax, LeastSquares)
    assert lax.numbers.confidence == 0.9
    with pytest.raises(ParameterError, match="confidence has no effect with filter = 'ukf'"):
        Method.of("ukf", "ukf", confidence=0.9)


@pytest.mark.parametrize(
    ("part", "value"),
    [("confidence", 1.0), ("confidence", 0.2), ("tolerance", 0.0), ("max_iterations", 0)],
)
def test_numbers_that_make_no_sense_are_refused(part: str, value: float) -> None:
    with pytest.raises(ParameterError, match="least squares: "):
        dataclasses.replace(WlsParams(), **{part: value})
