"""Claim: the truth is a solved power flow of real loads behind a source voltage that moves."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pytest
import simulated_case
from simulated_case import PARAMS, STUDY, curves, feeder

from pse_analysis.errors import ParameterError
from pse_analysis.grid import BusKind, library, power_flow
from pse_analysis.measurement import BUS, MeasurementModel, P, Q, SensorLayout
from pse_analysis.simulation import scenario
from pse_analysis.simulation.settings import (
    LoadParams,
    LoadStepParams,
    PvParams,
    SourceVoltageParams,
)

SEED = 7


def truth(network=None, params=PARAMS, seed=SEED):
    network = network or feeder()
    time = scenario.truth_times(STUDY, params.truth_step_s)
    start, end = (pd.Timestamp(int(t), unit="us", tz="UTC") for t in time[[0, -1]])
    mix = scenario.mix_loads(
        network, curves(), start, end, params.load, np.random.default_rng(SEED)
    )
    drawn = scenario.draw_truth(network, curves(), mix, time, params, np.random.SeedSequence(seed))
    return mix, drawn


@pytest.mark.parametrize("grid", ["ieee14", "ieee33"])
def test_the_truth_solves_the_power_flow(grid: str):
    network = library.load(grid)
    params = dataclasses.replace(PARAMS, pv=())
    _, drawn = truth(network, params)
    every = np.arange(network.n_bus)
    h = MeasurementModel(network, SensorLayout.of(network, (P, every, BUS), (Q, every, BUS))).h(
        drawn.x
    )
    np.testing.assert_allclose(h, np.concatenate([drawn.p_pu, drawn.q_pu]), atol=1e-12)
    regulated = network.buses.kind == BusKind.PV
    vm = drawn.x[network.n_bus :]
    np.testing.assert_allclose(vm[regulated], network.buses.vm_set_pu[regulated, None] + 0 * vm[:1])


def test_generation_follows_the_total_load_and_the_slack_takes_the_rest():
    network = library.load("ieee14")
    _, drawn = truth(network, dataclasses.replace(PARAMS, pv=()))
    buses = network.buses
    alone = (buses.p_gen_mw != 0) & (buses.p_load_mw == 0) & (buses.kind == BusKind.PV)
    both = np.flatnonzero((buses.p_gen_mw != 0) & (buses.kind == BusKind.PV))
    rest = drawn.p_pu.sum(axis=0)
    assert np.all(rest > 0)  # losses
    assert rest.max() < 0.1 * network.base_mva
    assert alone.any() or len(both)


def test_loads_reach_the_stated_level_over_the_week():
    network = feeder()
    start, end = curves().index[0], curves().index[-1]
    mix = scenario.mix_loads(
        network, curves(), start, end, LoadParams(level=0.6), np.random.default_rng(SEED)
    )
    np.testing.assert_allclose(mix.weight.sum(axis=1), 1.0)
    assert ((mix.weight > 0).sum(axis=1) == 3).all()
    np.testing.assert_allclose(mix.p.mean(axis=1), 0.6, rtol=1e-6)
    assert len(mix.bus) == 32


def test_trials_share_the_mix_but_not_the_path():
    _, first = truth(seed=1)
    _, second = truth(seed=2)
    assert not np.allclose(first.p_pu[5], second.p_pu[5])
    # At the quarter hours the real curve is known, so trials agree there.
    np.testing.assert_allclose(first.p_pu[5, ::15], second.p_pu[5, ::15], atol=1e-9)


def test_buses_of_the_same_class_move_independently():
    load = LoadParams(classes=("H0-H",), per_bus=1)
    params = dataclasses.replace(PARAMS, load=load, pv=())
    mix, drawn = truth(params=params)
    moves = np.diff(np.log(-drawn.p_pu[mix.bus]), axis=1)
    moves -= moves.reshape(len(moves), -1, 15).mean(axis=2).repeat(15, axis=1)
    correlation = np.corrcoef(moves)
    assert np.abs(correlation[np.triu_indices(len(moves), 1)]).mean() < 0.1


def test_pv_adds_to_the_injection_of_its_bus_only():
    _, without = truth(params=dataclasses.replace(PARAMS, pv=()))
    _, with_pv = truth(params=dataclasses.replace(PARAMS, pv=(PvParams("18", 0.5, "PV2"),)))
    added = (with_pv.p_pu - without.p_pu) * feeder().base_mva
    bus = feeder().bus("18")
    quarter = curves()["PV2"].loc["2016-06-09 08:00":"2016-06-09 12:00"].to_numpy()
    np.testing.assert_allclose(added[bus, ::15], 0.5 * quarter, atol=1e-7)
    others = np.setdiff1d(np.arange(1, feeder().n_bus), bus)
    np.testing.assert_allclose(added[others], 0.0, atol=1e-7)


def test_source_voltage_is_slow_bounded_and_steps():
    params = SourceVoltageParams(
        sigma_pu=0.002, time_constant_s=1800, tap_pu=0.00625, taps_per_day=8, max_taps=2
    )
    n = 1440 * 60
    dv = scenario.source_voltage(n, 60.0, params, np.random.default_rng(SEED))
    taps = scenario.source_voltage(
        n, 60.0, dataclasses.replace(params, sigma_pu=0.0), np.random.default_rng(SEED)
    )
    slow = dv - taps
    assert slow.std() == pytest.approx(0.002, rel=0.1)
    assert np.corrcoef(slow[:-30], slow[30:])[0, 1] == pytest.approx(np.exp(-1), abs=0.08)
    assert np.abs(taps).max() == pytest.approx(2 * 0.00625)
    steps = np.flatnonzero(np.diff(taps))
    np.testing.assert_allclose(np.abs(np.diff(taps)[steps]), 0.00625, rtol=1e-9)
    assert len(steps) / 60 == pytest.approx(8, rel=0.15)
    still = dataclasses.replace(params, max_taps=0, sigma_pu=0.0)
    assert not scenario.source_voltage(n, 60.0, still, np.random.default_rng(SEED)).any()


@pytest.mark.parametrize(
    ("study", "message"),
    [
        (dataclasses.replace(STUDY, step_s=90.0), "step_s must be a multiple"),
        (dataclasses.replace(STUDY, history_s=100.0), "history_s must be a multiple"),
        (
            dataclasses.replace(STUDY, end=datetime(2016, 6, 9, 11, 0, 30, tzinfo=UTC)),
            "end − start must be a multiple",
        ),
        (
            dataclasses.replace(
                STUDY,
                start=datetime(2016, 6, 9, 10, 0, 30, tzinfo=UTC),
                end=datetime(2016, 6, 9, 12, 0, 30, tzinfo=UTC),
            ),
            "after a quarter hour: move start",
        ),
    ],
)
def test_times_off_the_truth_grid_are_refused(study, message: str):
    with pytest.raises(ParameterError, match=message):
        simulated_case.make(study=study)


@pytest.mark.parametrize("grid", ["ieee14", "ieee33", "ieee118"])
def test_states_found_with_one_jacobian_are_those_of_newton_from_a_flat_start(grid: str):
    network = library.load(grid)
    level = np.linspace(0.05, 1.5, 12)
    p, q = (np.outer(v, level) for v in (network.p_nominal_pu, network.q_nominal_pu))
    vm_set = np.repeat(network.buses.vm_set_pu[:, None], 12, axis=1)
    vm_set[network.slack] += np.linspace(-0.02, 0.02, 12)
    solved = scenario._solve(network, np.arange(12), p, q, vm_set)
    exact = power_flow.solve(network, p, q, vm_set, tolerance=1e-12)
    np.testing.assert_allclose(solved.x, exact.x, atol=1e-7)


def test_load_steps_move_the_named_loads_and_leave_everything_else_as_it_was():
    steps = LoadStepParams(per_day=48.0, size=(0.3, 0.6), at=("18", "25"))
    _, without = truth()
    _, stepped = truth(params=dataclasses.replace(PARAMS, load_steps=steps))
    moved = np.abs(stepped.p_pu - without.p_pu).max(axis=1) > 1e-9
    named = np.isin(np.arange(feeder().n_bus), [feeder().bus(b) for b in steps.at])
    slack = np.arange(feeder().n_bus) == feeder().slack
    np.testing.assert_array_equal(moved[~slack], named[~slack])


def test_a_load_step_lasts_as_long_as_stated():
    params = LoadStepParams(per_day=20.0, size=(0.5, 0.5), duration_s=(600.0, 600.0))
    jumps = scenario.load_steps((3, 1440), 60.0, params, np.random.default_rng(SEED))
    change = np.diff(jumps, axis=1, prepend=0.0)
    assert np.abs(change).any()
    # What steps up and what steps back ten points later cancel.
    np.testing.assert_allclose(np.cumsum(change, axis=1), jumps)
    single = scenario.load_steps((1, 1440), 60.0, params, np.random.default_rng(3))[0]
    assert set(np.unique(np.abs(single)).round(6)) <= {0.0, 0.5, 1.0, 1.5}
    assert (single != 0).sum() <= 10 * np.count_nonzero(np.diff(single, prepend=0.0))
