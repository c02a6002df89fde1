"""The truth: loads, infeed and source voltage of one trial, and the power flow they give."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
import pandas as pd
from scipy.linalg import lu_factor, lu_solve

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import ParameterError
from pse_analysis.grid import power_flow
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, MeasurementModel, P, Q, SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.simulation.profiles import PROFILE_STEP_S, ar1, between, bridge, column
from pse_analysis.simulation.settings import (
    LoadParams,
    LoadStepParams,
    SimulateParams,
    SourceVoltageParams,
)

SECOND = 1_000_000
"""Microseconds: times are integers on that scale, so that no stamp is ever rounded twice."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_CHUNK = 1440
"""States per call of the power flow, which bounds its memory."""

_TOLERANCE = 1e-9
"""Largest mismatch of a true state. [p.u.]"""

_SHARED_STEPS = 15
"""Steps that may share one Jacobian; on a feeder each gains a factor of about eight."""


def microseconds(time: datetime) -> int:
    """Microseconds since 1970 UTC."""
    return (time - _EPOCH) // timedelta(microseconds=1)


@dataclass(frozen=True, eq=False)
class Truth:
    """The state of the grid on the truth grid of one trial.

    Attributes
    ----------
    time : (n_point,) ndarray of int64
        Microseconds since 1970 UTC, equidistant; the last is the end of the study.
    x : (2 n_bus, n_point) ndarray
        [θ; |V|]. [rad; p.u.]
    p_pu, q_pu : (n_bus, n_point) ndarray
        Net injections, positive into the grid. [p.u.]
    """

    time: IntArray
    x: FloatArray
    p_pu: FloatArray
    q_pu: FloatArray


def truth_times(study: Study, truth_step_s: float) -> IntArray:
    """Instants from the start of the history to the end of the study, both included.

    Raises
    ------
    ParameterError
        If the study's step, length or history is not a multiple of the truth step.
    """
    step = round(truth_step_s * SECOND)
    first, start, end = (microseconds(t) for t in (study.history_start, study.start, study.end))
    for name, value in (
        ("step_s", round(study.step_s * SECOND)),
        ("history_s", start - first),
        ("end − start", end - start),
    ):
        if value % step:
            raise ParameterError(
                f"[study] {name} must be a multiple of simulate.truth_step_s = {truth_step_s:g} s, "
                f"received {value / SECOND:g} s"
            )
    return np.arange(first, end + 1, step, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class LoadMix:
    """Shapes of the loads at the points of the curves: what all trials of a case share.

    Attributes
    ----------
    bus : (n_load,) ndarray of int
        Positions of the buses with a nominal load.
    weight : (n_load, n_class) ndarray
        Share of each class; rows sum to 1.
    p, q : (n_load, n_point) ndarray
        Load relative to the nominal one. [1]
    """

    bus: IntArray
    weight: FloatArray
    p: FloatArray
    q: FloatArray


def mix_loads(
    network: Network,
    profiles: pd.DataFrame,
    start: pd.Timestamp,
    end: pd.Timestamp,
    params: LoadParams,
    rng: np.random.Generator,
) -> LoadMix:
    """Draw the mix of classes of each load.

    P of a class is taken relative to its mean over all of ``profiles``, Q to the mean of its
    magnitude (Q changes sign in some classes), so a bus has ``level`` times its nominal load
    on average.
    """
    buses = network.buses
    bus = np.flatnonzero((buses.p_load_mw != 0) | (buses.q_load_mvar != 0))
    n, n_class = len(bus), len(params.classes)
    weight = np.zeros((n, n_class))
    chosen = rng.permuted(np.tile(np.arange(n_class), (n, 1)), axis=1)[:, : params.per_bus]
    share = rng.dirichlet(np.full(params.per_bus, params.concentration), size=n)
    np.put_along_axis(weight, chosen, share, axis=1)
    part = between(profiles, start, end)
    shapes = []
    for kind in ("pload", "qload"):
        curves = []
        for name in params.classes:
            whole = column(profiles, f"{name}_{kind}", "simulate.load.classes")
            unit = float(np.mean(np.abs(whole)))
            # A class without reactive load stays without.
            curves.append(part[f"{name}_{kind}"].to_numpy(dtype=np.float64) / (unit or 1.0))
        shapes.append(params.level * (weight @ np.array(curves)))
    # The bridge of P runs on the logarithm; a curve that touches zero is lifted by a hair.
    return LoadMix(bus, weight, np.maximum(shapes[0], 1e-4), shapes[1])


def source_voltage(
    n: int, step_s: float, params: SourceVoltageParams, rng: np.random.Generator
) -> FloatArray:
    """Deviation of the source voltage from its set-point, (n,). [p.u.]

    A stationary AR(1) process plus a random walk of tap changes at random times, reflected at
    ``max_taps``.
    """
    decay = float(np.exp(-step_s / params.time_constant_s))
    normal = rng.standard_normal(n) * np.sqrt(1 - decay**2)
    normal[0] /= np.sqrt(1 - decay**2)
    slow = params.sigma_pu * ar1(normal, decay)
    change = rng.random(n) < params.taps_per_day * step_s / 86400.0
    position = np.zeros(n)
    if params.max_taps:
        tap = 0
        for i in np.flatnonzero(change):  # a handful per day
            tap += int(rng.choice((-1, 1)))
            if abs(tap) > params.max_taps:
                tap -= 2 * int(np.sign(tap))
            position[i:] = tap
    return slow + params.tap_pu * position


def load_steps(
    shape: tuple[int, int], step_s: float, params: LoadStepParams, rng: np.random.Generator
) -> FloatArray:
    """Deviation of loads, (n_load, n_point), by steps that end after a while, relative to nominal.

    The reactive load follows at the power factor that the load has.
    """
    n_load, n_point = shape
    out = np.zeros((n_load, n_point + 1))
    for row, count in enumerate(rng.poisson(params.per_day * n_point * step_s / 86400.0, n_load)):
        size = rng.uniform(*params.size, count) * rng.choice((-1.0, 1.0), count)
        begin = rng.integers(0, n_point, count)
        lasting = np.maximum(np.rint(rng.uniform(*params.duration_s, count) / step_s), 1)
        end = np.minimum(begin + lasting.astype(np.int64), n_point)
        np.add.at(out[row], begin, size)
        np.add.at(out[row], end, -size)
    return np.asarray(np.cumsum(out[:, :-1], axis=1))


def draw_truth(
    network: Network,
    profiles: pd.DataFrame,
    mix: LoadMix,
    time: IntArray,
    params: SimulateParams,
    seed: np.random.SeedSequence,
) -> Truth:
    """Truth of one trial.

    Loads are bridged independently at each bus: P on the logarithm, Q additively with innovations
    that correlate with P's as the quarter-hourly increments of the two curves do. Nominal
    generation follows the total load; PV comes on top. PV buses keep their voltage set-point, the
    slack bus follows `source_voltage`.

    Raises
    ------
    NotConverged
        If a state has no power flow: lower ``level``.
    ParameterError
        If the curves do not cover the study.
    """
    load_rng, pv_rng, source_rng, step_rng = (np.random.default_rng(s) for s in seed.spawn(4))
    start, end = (pd.Timestamp(int(t), unit="us", tz="UTC") for t in (time[0], time[-1]))
    index = between(profiles, start, end).index
    k = round(PROFILE_STEP_S / params.truth_step_s)
    steps = (len(index) - 1) * k
    offset, rest = divmod(
        int(time[0]) - microseconds(index[0]), round(params.truth_step_s * SECOND)
    )
    if rest:
        raise ParameterError(
            f"[study] history starts at {start.isoformat()}, which is no multiple of "
            f"truth_step_s = {params.truth_step_s:g} s after a quarter hour: move start"
        )
    window = slice(offset, offset + len(time))
    buses, base = network.buses, network.base_mva

    load = params.load
    own, shared = load_rng.standard_normal((2, len(mix.bus), steps))
    r = _increment_correlation(mix)[:, None]
    p_shape = bridge(mix.p, shared, rho1=load.rho1, window=load.window, scale="log")[:, window]
    q_normal = r * shared + np.sqrt(1 - r**2) * own
    q_shape = bridge(mix.q, q_normal, rho1=load.rho1, window=load.window)[:, window]
    if params.load_steps.per_day:
        jumps = load_steps(p_shape.shape, params.truth_step_s, params.load_steps, step_rng)
        if params.load_steps.at:
            jumps[~np.isin(mix.bus, [network.bus(b) for b in params.load_steps.at])] = 0.0
        # A load cannot be switched off twice: what steps down leaves a tenth.
        p_stepped = np.maximum(p_shape + jumps, 0.1 * p_shape)
        q_shape, p_shape = q_shape * p_stepped / p_shape, p_stepped
    p_load = np.zeros((network.n_bus, len(time)))
    q_load = np.zeros_like(p_load)
    p_load[mix.bus] = buses.p_load_mw[mix.bus, None] * p_shape
    q_load[mix.bus] = buses.q_load_mvar[mix.bus, None] * q_shape

    nominal = float(buses.p_load_mw.sum())
    follow = p_load.sum(axis=0) / nominal if nominal else np.ones(len(time))
    p_mw = buses.p_gen_mw[:, None] * follow - p_load
    if params.pv:
        points = np.array([column(profiles, v.profile, "simulate.pv") for v in params.pv])
        first = int(profiles.index.get_loc(index[0]))
        points = points[:, first : first + len(index)]
        infeed = bridge(points, pv_rng.standard_normal((len(points), steps)), scale="nonnegative")[
            :, window
        ]
        for row, plant in enumerate(params.pv):
            p_mw[network.bus(plant.bus)] += plant.peak_mw * infeed[row]

    vm_set = np.repeat(buses.vm_set_pu[:, None], len(time), axis=1)
    vm_set[network.slack] += source_voltage(
        len(time), params.truth_step_s, params.source_voltage, source_rng
    )
    return _solve(network, time, p_mw / base, -q_load / base, vm_set)


def _increment_correlation(mix: LoadMix) -> FloatArray:
    """Correlation of the quarter-hourly increments of P (logarithmic) and Q at each load."""
    dp, dq = np.diff(np.log(mix.p), axis=1), np.diff(mix.q, axis=1)
    scale = np.sqrt(np.sum(dp**2, axis=1) * np.sum(dq**2, axis=1))
    return np.asarray(np.sum(dp * dq, axis=1) / np.where(scale > 0, scale, 1.0))


def _solve(
    network: Network, time: IntArray, p: FloatArray, q: FloatArray, vm_set: FloatArray
) -> Truth:
    x = np.empty((2 * network.n_bus, len(time)))
    p_out, q_out = np.empty_like(p), np.empty_like(q)
    mean = power_flow.solve(network, p.mean(axis=1), q.mean(axis=1), vm_set.mean(axis=1)).x
    for first in range(0, len(time), _CHUNK):
        part = slice(first, first + _CHUNK)
        given = (p[:, part], q[:, part], vm_set[:, part])
        start = _near_solution(network, mean, *given)
        flow = power_flow.solve(network, *given, start=start, tolerance=_TOLERANCE)
        x[:, part], p_out[:, part], q_out[:, part] = flow.x, flow.p_pu, flow.q_pu
    return Truth(time, x, p_out, q_out)


def _near_solution(
    network: Network, mean: FloatArray, p: FloatArray, q: FloatArray, vm_set: FloatArray
) -> FloatArray:
    """Start for the power flow: Newton with the one Jacobian of the mean state.

    All states then share one factorisation, which costs a fraction of a Jacobian per state; what
    does not converge this way is left to `power_flow.solve`.
    """
    n = network.n_bus
    moving = np.flatnonzero(network.buses.kind != BusKind.SLACK)
    free = np.flatnonzero(network.buses.kind == BusKind.PQ)
    held = np.setdiff1d(np.arange(n), free)
    columns = np.concatenate([moving, n + free])
    layout = SensorLayout.of(network, (P, moving, BUS), (Q, free, BUS))
    model = MeasurementModel(network, layout, columns=columns)
    factor = lu_factor(model.jacobian(mean).toarray())
    start = np.repeat(mean[:, None], p.shape[1], axis=1)
    start[n + held] = vm_set[held]
    x = start.copy()
    target = np.concatenate([p[moving], q[free]])
    going = np.arange(p.shape[1])
    before = np.full(p.shape[1], np.inf)
    for _ in range(_SHARED_STEPS):
        mismatch = target[:, going] - model.h(x[:, going])
        worst = np.abs(mismatch).max(axis=0)
        apart = going[~(worst <= before[going])]
        x[:, apart] = start[:, apart]
        on = (worst > _TOLERANCE) & (worst <= before[going])
        before[going] = worst
        going, mismatch = going[on], mismatch[:, on]
        if not len(going):
            break
        x[np.ix_(columns, going)] += lu_solve(factor, mismatch)
    return x
