"""Textbook code to compare with: slow, dense, and written from the definition alone."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pandas as pd

from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, FROM, IA, IM, TO, VA, VM, P, Q, SensorLayout

GRIDS = ("ieee14", "ieee30", "ieee33", "ieee118")


@cache
def pandapower_grid(name: str, **options: Any) -> Any:
    """Pandapower's copy of a grid, mended and solved; its warnings are not ours to mend."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pandapower

        from pse_analysis.grid.tables.from_pandapower import net_of

        net = net_of(name)
        pandapower.runpp(net, tolerance_mva=1e-9, numba=False, **options)
    return net


def every_quantity(network: Network) -> SensorLayout:
    """Layout of everything that can be measured where a current flows.

    |I| and ∠I have no derivative at zero current, so branches out of service give P and Q only.
    """
    bus, branch = np.arange(network.n_bus), np.arange(network.n_branch)
    closed = branch[network.branches.in_service]
    rows = [(q, bus, BUS) for q in (VM, VA, P, Q, IM, IA)]
    rows += [(q, branch, side) for q in (P, Q) for side in (FROM, TO)]
    rows += [(q, closed, side) for q in (IM, IA) for side in (FROM, TO)]
    return SensorLayout.of(network, *rows)


def conventional(network: Network) -> SensorLayout:
    """Voltages, injections and flows, without any angle."""
    bus = np.arange(network.n_bus)
    branch = np.flatnonzero(network.branches.in_service)
    rows = [(VM, bus, BUS), (P, bus, BUS), (Q, bus, BUS), (P, branch, FROM), (Q, branch, TO)]
    return SensorLayout.of(network, *rows)


def snapshot(
    z: np.ndarray, sigma: np.ndarray, available: np.ndarray | None = None, step: int = 0
) -> Snapshot:
    """Snapshot of fresh samples, five minutes after the one before."""
    rows = np.ones(len(z), dtype=bool) if available is None else available
    zero = np.zeros(len(z))
    time = np.datetime64("2016-06-09T00:00:00", "us") + step * np.timedelta64(300, "s")
    return Snapshot(time, np.where(rows, z, 0.0), sigma, zero, rows, rows, zero)


def measured(network: Network, layout: SensorLayout, x: np.ndarray) -> np.ndarray:
    """h(x) one row at a time, from each branch's own impedance, tap and charging."""
    n = network.n_bus
    voltage = x[n:] * np.exp(1j * x[:n])
    b = network.branches
    current_at: dict[tuple[int, int], complex] = {}
    injected = (network.buses.g_shunt_pu + 1j * network.buses.b_shunt_pu) * voltage
    for k in range(network.n_branch):
        f, t = int(b.from_bus[k]), int(b.to_bus[k])
        if b.in_service[k]:
            ratio = b.tap[k] * np.exp(1j * b.shift_rad[k])
            series = 1.0 / (b.r_pu[k] + 1j * b.x_pu[k])
            half = 0.5 * (b.g_pu[k] + 1j * b.b_pu[k])
            behind = voltage[f] / ratio  # the ideal transformer's inner side
            through = series * (behind - voltage[t])
            current_at[k, FROM] = (through + half * behind) / np.conj(ratio)
            current_at[k, TO] = -through + half * voltage[t]
        else:
            current_at[k, FROM] = current_at[k, TO] = 0.0
        injected[f] += current_at[k, FROM]
        injected[t] += current_at[k, TO]
    out = np.empty(len(layout))
    for i, (q, p, s) in enumerate(zip(layout.quantity, layout.position, layout.side, strict=True)):
        at = {BUS: p, FROM: b.from_bus[p % network.n_branch], TO: b.to_bus[p % network.n_branch]}[s]
        current = injected[p] if s == BUS else current_at[int(p), int(s)]
        power = voltage[at] * np.conj(current)
        out[i] = {
            VM: abs(voltage[at]),
            VA: np.angle(voltage[at]),
            P: power.real,
            Q: power.imag,
            IM: abs(current),
            IA: np.angle(current),
        }[int(q)]
    return out


def central_differences(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-6
) -> np.ndarray:
    """Jacobian of a function of a vector, a column at a time."""
    columns = []
    for unit in np.eye(len(x)):
        columns.append((function(x + step * unit) - function(x - step * unit)) / (2 * step))
    return np.stack(columns, axis=1)


def random_state(network: Network, rng: np.random.Generator) -> np.ndarray:
    """[θ; |V|] far from any solution, but with every current away from zero."""
    return np.concatenate(
        [rng.normal(0.0, 0.2, network.n_bus), rng.uniform(0.9, 1.1, network.n_bus)]
    )


def kalman_step(
    x: np.ndarray,
    P: np.ndarray,
    F: np.ndarray,
    Q: np.ndarray,
    H: np.ndarray,
    R: np.ndarray,
    z: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Predict and update by the textbook's formulas, with inverses and Joseph's form."""
    x, P = F @ x, F @ P @ F.T + Q
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    left = np.eye(len(x)) - K @ H
    return x + K @ (z - H @ x), left @ P @ left.T + K @ R @ K.T


def channels_table(network: Network, rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Table ``channels`` with usual values where a row says nothing."""
    usual = {
        "source": "pmu",
        "side": "",
        "sigma_kind": "absolute",
        "lower": np.nan,
        "upper": np.nan,
        "period_s": 60.0,
        "sign": 1,
        "aggregation": "instant",
    }
    table = pd.DataFrame([{**usual, **row} for row in rows])
    if "channel" not in table:
        side = np.where(table["side"] == "", "", ":" + table["side"])
        table["channel"] = table["source"] + ":" + table["element"] + side + ":" + table["quantity"]
    return table.astype({"sign": "int8", "period_s": "float64", "sigma": "float64"})


def pandapower_wls(
    name: str, network: Network, layout: SensorLayout, z: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """[θ; |V|] by pandapower's own weighted least squares, θ against the slack's.

    Its conventions: a bus measurement counts consumption positive and, as here, leaves out shunts;
    powers come in MW; a branch is a line or a transformer with sides of other names.
    """
    net = pandapower_measurements(name, network, layout, z, sigma)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pandapower.estimation

        done = pandapower.estimation.estimate(net, tolerance=1e-10, zero_injection=None)
    assert done if isinstance(done, bool) else done["success"]
    theta = np.deg2rad(net.res_bus_est.va_degree.to_numpy())
    return np.concatenate([theta - theta[network.slack], net.res_bus_est.vm_pu.to_numpy()])


def pandapower_measurements(
    name: str, network: Network, layout: SensorLayout, z: np.ndarray, sigma: np.ndarray
) -> Any:
    """A copy of pandapower's grid with the layout's values as its measurements."""
    net = copy.deepcopy(pandapower_grid(name))
    lines = len(net.line)
    kind = {VM: "v", P: "p", Q: "q"}
    rows = []
    for q, p, s, value, deviation in zip(
        layout.quantity, layout.position, layout.side, z, sigma, strict=True
    ):
        base = 1.0 if q == VM else network.base_mva
        sign = -1.0 if s == BUS and q != VM else 1.0
        if s == BUS:
            element, index, side = "bus", net.bus.index[p], None
        elif p < lines:
            element, index, side = "line", net.line.index[p], ("from", "to")[s - FROM]
        else:
            element, index, side = "trafo", net.trafo.index[p - lines], ("hv", "lv")[s - FROM]
        rows.append(
            (None, kind[int(q)], element, index, sign * value * base, deviation * base, side)
        )
    net.measurement = pd.DataFrame(rows, columns=net.measurement.columns)
    return net
