"""From the truth to samples: what each channel reads, with which noise, and when it arrives."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.special import ndtr

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import ParameterError
from pse_analysis.grid import power_flow
from pse_analysis.grid.network import Network
from pse_analysis.measurement import (
    IM,
    MeasurementModel,
    P,
    Q,
    SensorLayout,
    standard_deviation,
)
from pse_analysis.simulation.scenario import SECOND, Truth
from pse_analysis.simulation.settings import SensorParams
from pse_analysis.vocabulary import UNITS, Quantity


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one trial as flat columns, by channel and sampling time.

    Attributes
    ----------
    channel : (n,) ndarray of int
        Row of the channels table.
    sampled, arrival : (n,) ndarray of int64
        True sampling time and time of arrival. [µs since 1970 UTC]
    value, truth, sigma : (n,) ndarray
        With noise, without, and the noise's σ, in the channel's unit.
    kind : (n,) ndarray of int8
        0, or 1 + position of the fault's kind in `FaultKind`.
    size : (n,) ndarray
        Size of the fault; 0 without one.
    taken : (n,) ndarray of bool
        Whether a fault refers to the sample, so that no other may touch it: faulty ones, but also
        the first copy of a duplicated one and the value that a stale channel repeats.
    """

    channel: IntArray
    sampled: IntArray
    arrival: IntArray
    value: FloatArray
    truth: FloatArray
    sigma: FloatArray
    kind: npt.NDArray[np.int8]
    size: FloatArray
    taken: npt.NDArray[np.bool_]


def elements(network: Network, at: tuple[str, ...], where: str = "simulate.sensors") -> list[str]:
    """Elements that a list of elements and groups names, in its order and without repetition.

    Raises
    ------
    GridError
        If the grid has no such element; the message offers a close match.
    ParameterError
        If an entry is neither an element nor a group.
    """
    buses = network.buses
    load = (buses.p_load_mw != 0) | (buses.q_load_mvar != 0)
    generation = (buses.p_gen_mw != 0) | (buses.kind != 1)
    groups = {
        "buses": [f"bus/{n}" for n in buses.name],
        "loads": [f"bus/{buses.name[i]}" for i in np.flatnonzero(load)],
        "injections": [f"bus/{buses.name[i]}" for i in np.flatnonzero(load | generation)],
        "branches": [
            f"branch/{network.branches.name[i]}"
            for i in np.flatnonzero(network.branches.in_service)
        ],
    }
    named: list[str] = []
    for entry in at:
        kind, _, name = entry.partition("/")
        if entry in groups:
            named += groups[entry]
        elif kind == "bus" and name:
            network.bus(name)
            named.append(entry)
        elif kind == "branch" and name:
            network.branch(name)
            named.append(entry)
        else:
            raise ParameterError(
                f"[{where}] at: expected 'bus/NAME', 'branch/NAME' or a group "
                f"({', '.join(groups)}), received {entry!r}"
            )
    return list(dict.fromkeys(named))


def channels(network: Network, sensors: tuple[SensorParams, ...]) -> list[pd.DataFrame]:
    """Channels of each group of sensors, one row per channel.

    Raises
    ------
    GridError, ParameterError
        If an element is unknown, or two groups give the same channel.
    """
    tables = []
    taken: set[str] = set()
    for group in sensors:
        rows = []
        for element in elements(network, group.at):
            side = group.side if element.startswith("branch/") else ""
            for quantity in group.quantities:
                channel = ":".join(p for p in (group.source, element, side, quantity) if p)
                if channel in taken:
                    raise ParameterError(
                        f"[simulate.sensors] channel {channel!r} is given twice: drop one"
                    )
                taken.add(channel)
                lower, upper = group.limits.get(quantity, (np.nan, np.nan))
                rows.append(
                    {
                        "channel": channel,
                        "source": group.source,
                        "quantity": quantity,
                        "element": element,
                        "side": side,
                        "unit": UNITS[Quantity(quantity)][0],
                        "sigma": float(group.sigma),
                        "sigma_kind": group.sigma_kind,
                        "lower": float(lower),
                        "upper": float(upper),
                        "period_s": float(group.period_s),
                        "sign": np.int8(group.sign),
                        "aggregation": group.aggregation,
                    }
                )
        table = pd.DataFrame(rows).astype({"sign": "int8"})
        if group.limit_factor:
            table = _with_nominal_limits(network, table, group.limit_factor)
        tables.append(table)
    return tables


def _with_nominal_limits(network: Network, table: pd.DataFrame, factor: float) -> pd.DataFrame:
    """Limits at a multiple of the apparent power or current at nominal load."""
    layout = SensorLayout.from_channels(table, network)
    x = power_flow.solve(network).x

    def nominal(quantity: int) -> FloatArray:
        """|h| at the nominal state, with every channel's quantity replaced."""
        swapped = dataclasses.replace(layout, quantity=np.full(len(layout), quantity))
        return np.abs(MeasurementModel(network, swapped).h(x))

    power = np.isin(layout.quantity, (P, Q))
    current = layout.quantity == IM
    span = np.full(len(layout), np.nan)
    span[power] = np.hypot(nominal(P), nominal(Q))[power]
    span[current] = nominal(IM)[current]
    upper = factor * np.abs(layout.from_per_unit(span))
    lower = np.where(current, 0.0, -upper)
    given = table["lower"].notna().to_numpy() | table["upper"].notna().to_numpy()
    return table.assign(
        lower=np.where(given, table["lower"], lower), upper=np.where(given, table["upper"], upper)
    )


def observe(
    network: Network,
    truth: Truth,
    group: SensorParams,
    table: pd.DataFrame,
    first_channel: int,
    rng: np.random.Generator,
) -> Samples:
    """Samples of one group of sensors, without faults.

    Parameters
    ----------
    network, truth
        Grid and its true states.
    group, table
        The sensors and their channels.
    first_channel
        Row of ``table``'s first channel in the table of all channels.
    rng
        Of noise, jitter and wander.

    Returns
    -------
    Samples

    Raises
    ------
    ParameterError
        If a mean's period or phase is not a multiple of the truth step.
    """
    layout = SensorLayout.from_channels(table, network)
    exact = MeasurementModel(network, layout).h(truth.x)
    angle = layout.angular
    # An angle that passes ±π between two instants must not be averaged or interpolated to 0.
    exact[angle] = np.unwrap(exact[angle], axis=1)
    sampled, value = _sample(exact, truth.time, group)
    sigma = standard_deviation(value, layout.sigma[:, None], layout.relative[:, None])
    noisy = value + sigma * rng.standard_normal(value.shape)
    for block in (value, noisy):
        block[angle] = _fold(block[angle])

    _, device = np.unique(table["element"].to_numpy(dtype=str), return_inverse=True)
    late = group.delay_s + group.jitter_s * rng.random((int(device.max()) + 1, len(sampled)))
    if group.wander_s:
        late += group.wander_s * _wander(late.shape, group.period_s / group.wander_time_s, rng)
    arrival = sampled + np.rint(late[device] * SECOND).astype(np.int64)
    n, m = value.shape
    return Samples(
        channel=np.repeat(np.arange(first_channel, first_channel + n, dtype=np.int64), m),
        sampled=np.tile(sampled, n),
        arrival=arrival.ravel(),
        value=layout.from_per_unit(noisy).ravel(),
        truth=layout.from_per_unit(value).ravel(),
        sigma=np.abs(layout.from_per_unit(sigma)).ravel(),
        kind=np.zeros(n * m, dtype=np.int8),
        size=np.zeros(n * m),
        taken=np.zeros(n * m, dtype=bool),
    )


def _wander(shape: tuple[int, int], step: float, rng: np.random.Generator) -> FloatArray:
    """Smooth stationary processes that are uniform on (0, 1) at every instant; rows independent.

    The normal law of a Gaussian process with autocorrelation (1 + a) exp(-a), a = 2·lag/time:
    differentiable, because a queue fills and empties at a bounded rate. Its integral is ``time``;
    ``step`` is relative to it.
    """
    a = 2.0 * step
    # Exact transition of the process and its rate, both scaled to variance 1.
    transition = np.exp(-a) * np.array([[1.0 + a, a], [-a, 1.0 - a]])
    noise = np.linalg.cholesky(np.eye(2) - transition @ transition.T)
    drawn = rng.standard_normal((shape[1], 2, shape[0]))
    state = drawn[0]
    value = np.empty((shape[1], shape[0]))
    for k in range(shape[1]):
        state = state if k == 0 else transition @ state + noise @ drawn[k]
        value[k] = state[0]
    return np.asarray(ndtr(value.T))


def _fold(angle: FloatArray) -> FloatArray:
    """Angles in [-π, π), untouched where they lie there already. [rad]"""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))


def _sample(exact: FloatArray, time: IntArray, group: SensorParams) -> tuple[IntArray, FloatArray]:
    """Sampling times (n_sample,) and noise-free values (m, n_sample)."""
    step = int(time[1] - time[0])
    period, phase = round(group.period_s * SECOND), round(group.phase_s * SECOND)
    mean = group.aggregation == "mean"
    first = int(time[0]) + phase + (period if mean else 0)
    sampled = np.arange(first, int(time[-1]), period, dtype=np.int64)
    if not len(sampled):
        raise ParameterError(
            f"[simulate.sensors] {group.source}: period_s = {group.period_s:g} and phase_s = "
            f"{group.phase_s:g} leave no sample before the study's end"
        )
    if mean:
        if period % step or phase % step:
            raise ParameterError(
                f"[simulate.sensors] {group.source}: the mean needs period_s and phase_s in "
                f"multiples of truth_step_s = {step / SECOND:g} s, received {group.period_s:g} and "
                f"{group.phase_s:g}"
            )
        count, begin = period // step, (phase // step) + 1
        blocks = exact[:, begin : begin + count * len(sampled)]
        return sampled, blocks.reshape(len(exact), len(sampled), count).mean(axis=2)
    index, rest = np.divmod(sampled - time[0], step)
    if not rest.any():
        return sampled, exact[:, index].copy()
    share = rest / step
    return sampled, exact[:, index] * (1 - share) + exact[:, index + 1] * share
