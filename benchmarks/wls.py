"""Weighted least squares beside pandapower's, from a flat start, on the same noisy data."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.grid import pandapower_case
from benchmarks.timing import Row, alternate
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, VM, MeasurementModel, P, Q, SensorLayout

SEED = 118
TOLERANCE = 1e-8
REPEATS = 15


def layout_of(network: Network) -> SensorLayout:
    """|V|, P and Q of every bus, P and Q at the from end of every branch."""
    bus, branch = np.arange(network.n_bus), np.arange(network.n_branch)
    rows = [(q, bus, BUS) for q in (VM, P, Q)] + [(q, branch, FROM) for q in (P, Q)]
    return SensorLayout.of(network, *rows)


def as_measurements(net: Any, layout: SensorLayout, z: Any, sigma: Any, base_mva: float) -> Any:
    """Pandapower's measurement table: consumption positive, MW, lines before transformers."""
    lines, kind = len(net.line), {VM: "v", P: "p", Q: "q"}
    rows = []
    for q, p, s, value, deviation in zip(
        layout.quantity, layout.position, layout.side, z, sigma, strict=True
    ):
        base = 1.0 if q == VM else base_mva
        sign = -1.0 if s == BUS and q != VM else 1.0
        place: tuple[str, int, str | None]
        if s == BUS:
            place = ("bus", p, None)
        else:
            place = ("line", p, "from") if p < lines else ("trafo", p - lines, "hv")
        element, index, side = place
        rows.append((None, kind[q], element, index, sign * value * base, deviation * base, side))
    return pd.DataFrame(rows, columns=net.measurement.columns)


def run() -> list[Row]:
    """WLS of ieee118, the model built before, from a flat start."""
    import pandapower.estimation

    network, net = library.load("ieee118"), pandapower_case("ieee118")
    layout = layout_of(network)
    rng = np.random.default_rng(SEED)
    sigma = np.where(layout.quantity == VM, 0.004, 0.01)
    truth = solve(network).x
    z = MeasurementModel(network, layout).h(truth) + sigma * rng.normal(size=len(layout))
    net.measurement = as_measurements(net, layout, z, sigma, network.base_mva)
    wls = WeightedLeastSquares(network, layout, tolerance=TOLERANCE)

    def peer() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pandapower.estimation.estimate(net, tolerance=TOLERANCE, zero_injection=None)

    seconds = alternate(lambda: wls.solve(z, sigma), peer, REPEATS)
    solution = wls.solve(z, sigma)
    difference = np.abs(solution.x[network.n_bus :] - net.res_bus_est.vm_pu.to_numpy()).max()
    note = f"{solution.iterations} iterations; |V| differ by {difference:.0e}"
    return [Row("weighted least squares, ieee118, flat start", *seconds, "pandapower", note)]
