"""Claim: a cold WLS of ieee118 takes at most 15 ms, and pandapower at least 5 times as long."""

from __future__ import annotations

import statistics
import time
import warnings

import numpy as np
from reference import pandapower_measurements

from pse_analysis.estimation.wls import WeightedLeastSquares
from pse_analysis.grid import library
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, VM, MeasurementModel, P, Q, SensorLayout

SEED = 118


def test_wls_of_ieee118_is_quick_beside_pandapower() -> None:
    network = library.load("ieee118")
    bus, branch = np.arange(network.n_bus), np.arange(network.n_branch)
    rows = [(q, bus, BUS) for q in (VM, P, Q)] + [(q, branch, FROM) for q in (P, Q)]
    layout = SensorLayout.of(network, *rows)
    sigma = np.full(len(layout), 0.01)
    rng = np.random.default_rng(SEED)
    z = MeasurementModel(network, layout).h(solve(network).x) + sigma * rng.normal(size=len(layout))
    net = pandapower_measurements("ieee118", network, layout, z, sigma)
    wls = WeightedLeastSquares(network, layout)
    spent: tuple[list[float], list[float]] = ([], [])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pandapower.estimation

        works = (
            lambda: wls.solve(z, sigma),
            lambda: pandapower.estimation.estimate(net, zero_injection=None),
        )
        for _ in range(6):
            for work, kept in zip(works, spent, strict=True):
                begun = time.process_time()
                work()
                kept.append(time.process_time() - begun)
    ours, theirs = (statistics.median(times[1:]) for times in spent)
    assert ours <= 0.015
    assert theirs >= 5 * ours
