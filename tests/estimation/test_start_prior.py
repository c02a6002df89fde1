"""Claim: a filter starts from any first snapshot, as certain as that and usual loads make it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.static.start import Start
from pse_analysis.estimation.static.start_prior import SHARE, StartPrior, start_prior
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, VM, MeasurementModel, P, Q, SensorLayout
from pse_analysis.vocabulary import Status

SEED = 33
NOW = np.datetime64("2024-05-14T00:00:00", "us")
GRIDS = ["ieee14", "ieee33"]


def metered(network: Network) -> SensorLayout:
    bus = np.arange(network.n_bus)
    layout = SensorLayout.of(network, (VM, bus, BUS), (P, bus, BUS), (Q, bus, BUS))
    size = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu]))
    power = np.tile(0.01 * size[size > 0].mean(), 2 * network.n_bus)
    return dataclasses.replace(layout, sigma=np.concatenate([np.full(len(bus), 3e-3), power]))


def history(layout: SensorLayout, z: np.ndarray, step_s: float = 300.0) -> Record:
    time = NOW - np.arange(len(z), 0, -1) * np.timedelta64(int(step_s), "s")
    on, zero = np.isfinite(z), np.zeros(z.shape)
    return Record(
        time, np.nan_to_num(z), np.broadcast_to(layout.sigma, z.shape), zero, on, on, zero
    )


def nothing(layout: SensorLayout) -> Record:
    return history(layout, np.zeros((0, len(layout))))


def drawn(network: Network, count: int, rng: np.random.Generator) -> np.ndarray:
    """States of loads that move together and alone by half of their size. (2N, T)"""
    together = 1.0 + SHARE * rng.standard_normal((2, 1, count))
    alone = SHARE * rng.standard_normal((2, network.n_bus, count))
    size = np.clip(together + alone, -0.2, 2.2)
    p, q = (network.p_nominal_pu, network.q_nominal_pu)
    return solve(network, p[:, None] * size[0], q[:, None] * size[1], tolerance=1e-8).x


def snapshot(layout: SensorLayout, z: np.ndarray, on: np.ndarray) -> Snapshot:
    zero = np.zeros(len(z))
    return Snapshot(NOW, np.where(on, z, 0.0), layout.sigma, zero, on, on, zero)


def begun(network: Network, layout: SensorLayout) -> Start:
    return Start(network, layout, start_prior(network, layout, nothing(layout)))


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("lost", [0.5, 0.6, 0.7, 0.9])
def test_what_a_poor_snapshot_leaves_open_has_its_true_sigma(grid: str, lost: float) -> None:
    """Thirty snapshots: every one starts, 98 % of all states lie within 3σ, none is claimed."""
    network = library.load(grid)
    layout = metered(network)
    start, rng = begun(network, layout), np.random.default_rng([SEED, int(100 * lost)])
    truth = drawn(network, 30, rng)
    exact = MeasurementModel(network, layout).h(truth).T
    ratio = []
    for x, values in zip(truth.T, exact, strict=True):
        z = values + layout.sigma * rng.standard_normal(len(layout))
        on = rng.random(len(layout)) >= lost
        on[0] = True
        found, info = start.first(snapshot(layout, z, on))
        assert found is not None
        assert info.status is Status.OK
        assert len(info.used) == len(layout)
        assert not (info.used & ~on).any()
        sigma = np.sqrt(np.diagonal(found.covariance()))
        ratio.append((np.abs(found.x - x) / np.maximum(sigma, 1e-12))[sigma > 1e-12])
    ratios = np.concatenate(ratio)
    assert (ratios < 3).mean() >= 0.98
    # A σ without bounds would pass as well.
    assert np.sqrt(np.mean(ratios**2)) > 0.2


@pytest.mark.parametrize("grid", GRIDS)
def test_a_snapshot_that_tells_the_state_starts_alone(grid: str) -> None:
    network = library.load(grid)
    layout = metered(network)
    z = MeasurementModel(network, layout).h(solve(network).x)
    whole = snapshot(layout, z, np.ones(len(z), dtype=bool))
    start = begun(network, layout)
    (with_prior, told), (alone, own) = start.first(whole), start.alone(whole)
    assert with_prior is not None
    assert alone is not None
    np.testing.assert_array_equal(with_prior.x, alone.x)
    np.testing.assert_array_equal(with_prior.covariance(), alone.covariance())
    assert told.detail == own.detail == ""


@pytest.mark.parametrize("grid", GRIDS)
def test_spread_of_usual_loads_is_what_monte_carlo_finds(grid: str) -> None:
    """400 draws: σ of every |V| that a prior alone has is at least theirs, and at most 6 times."""
    network = library.load(grid)
    layout = metered(network)
    start, rng = begun(network, layout), np.random.default_rng(SEED)
    one = np.zeros(len(layout), dtype=bool)
    one[network.slack] = True
    found, info = start.first(snapshot(layout, layout.sigma * 0 + network.buses.vm_set_pu[0], one))
    assert found is not None
    assert info.detail == "usual injections stand beside the measurements"
    n = network.n_bus
    truth = drawn(network, 400, rng)[n:]
    free = np.flatnonzero(truth.std(axis=1) > 1e-6)
    ratio = np.sqrt(np.diagonal(found.covariance()))[n:][free] / truth.std(axis=1)[free]
    assert ratio.min() > 1.0
    assert np.median(ratio) < 6.0


def test_meters_that_all_read_zero_are_no_start() -> None:
    """|V| = 0 everywhere contradicts what is usual; a later snapshot tells the state."""
    network = library.load("ieee14")
    layout = metered(network)
    start = begun(network, layout)
    zeros = snapshot(layout, np.zeros(len(layout)), np.ones(len(layout), dtype=bool))
    found, _ = start.first(zeros)
    assert found is None or not (np.abs(found.x[network.n_bus :] - 1.0) < 0.2).all()


def test_one_gross_error_in_a_poor_snapshot_is_left_out() -> None:
    """Two buses are dark and one |V| reads 1e3: that is named, and the start is near the truth."""
    network = library.load("ieee33")
    layout = metered(network)
    z = MeasurementModel(network, layout).h(solve(network).x)
    on = ~np.isin(layout.position, (16, 17))
    wrong = int(np.flatnonzero((layout.quantity == VM) & (layout.position == 9))[0])
    z[wrong] = 1e3
    start = begun(network, layout)
    assert start.alone(snapshot(layout, z, on))[0] is None
    found, info = start.first(snapshot(layout, z, on))
    assert found is not None
    assert np.flatnonzero(on & ~info.used).tolist() == [wrong]
    assert layout.channel[wrong] in info.detail
    assert np.abs(found.x - solve(network).x)[network.n_bus :].max() < 0.01


def prior_of(layout: SensorLayout, past: Record, network: Network) -> StartPrior:
    found = start_prior(network, layout, past)
    assert found is not None
    return found


def row(prior: StartPrior, quantity: int, bus: int) -> int:
    rows = (prior.layout.quantity == quantity) & (prior.layout.position == bus)
    return int(np.flatnonzero(rows)[0])


def test_history_tells_what_is_usual_whatever_single_samples_read() -> None:
    """A day of a load at 1.5 times its nominal size, one sample of it 1e6."""
    network = library.load("ieee33")
    layout = metered(network)
    rng = np.random.default_rng(SEED)
    z = np.full((288, len(layout)), np.nan)
    read = int(np.flatnonzero((layout.quantity == P) & (layout.position == 7))[0])
    nominal = network.p_nominal_pu[7]
    z[:, read] = nominal * (1.5 + 0.1 * rng.standard_normal(288))
    z[5, read] = 1e6
    prior, bare = (prior_of(layout, h, network) for h in (history(layout, z), nothing(layout)))
    at = row(prior, P, 7)
    assert prior.z[at] == pytest.approx(1.5 * nominal, rel=0.02)
    assert bare.z[at] == nominal
    assert prior.sigma[at] < bare.sigma[at]
    other = row(prior, P, 8)
    assert prior.z[other] == network.p_nominal_pu[8]


def test_grid_without_any_load_has_no_prior() -> None:
    network = library.load("ieee33")
    nothing_drawn = np.zeros(33)
    bare = dataclasses.replace(
        network,
        buses=dataclasses.replace(
            network.buses, p_load_mw=nothing_drawn, q_load_mvar=nothing_drawn
        ),
    )
    layout = metered(network)
    assert start_prior(bare, layout, nothing(layout)) is None
    assert (
        Start(bare, layout, None)
        .first(snapshot(layout, np.ones(len(layout)), np.zeros(len(layout), dtype=bool)))[1]
        .status
        is Status.UNOBSERVABLE
    )


def test_grid_with_a_part_that_has_no_supply_has_no_prior() -> None:
    """Loads that are usual elsewhere are none where nothing holds a voltage."""
    network = library.load("ieee33")
    name = network.branches.name[20]
    layout = metered(network)
    assert start_prior(network.open_branch(str(name)), layout, nothing(layout)) is None
