"""Newton power flow for one or many states, on the measurement model's own injection rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import GridError, NotConverged
from pse_analysis.grid.dc import DcPowerFlow
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.grid.newton import NewtonPowerFlow, rounding_pu

_USUAL_ITERATIONS = 10
"""Newton iterations that a flat start takes at most where it is any good."""


@dataclass(frozen=True, eq=False)
class PowerFlow:
    """Solved states; arrays are (n_bus,) or (n_bus, n_state) as the injections were.

    Attributes
    ----------
    theta, vm
        Voltage angle [rad] and magnitude [p.u.].
    p_pu, q_pu
        Net injections, positive into the grid, with the slack's and the PV buses' results. [p.u.]
    iterations
        Newton iterations of the slowest state.
    limited : ndarray of bool
        PV buses that stand at a reactive limit and so gave up their voltage.
    """

    theta: FloatArray
    vm: FloatArray
    p_pu: FloatArray
    q_pu: FloatArray
    iterations: int
    limited: npt.NDArray[np.bool_]

    @property
    def x(self) -> FloatArray:
        """State [θ; |V|] of the measurement model."""
        return np.concatenate([self.theta, self.vm])


def solve(
    network: Network,
    p_pu: FloatArray | None = None,
    q_pu: FloatArray | None = None,
    vm_set_pu: FloatArray | None = None,
    *,
    start: FloatArray | None = None,
    enforce_q_limits: bool = False,
    own_references: bool = False,
    tolerance: float = 1e-10,
    max_iterations: int = 30,
) -> PowerFlow:
    """Solve the power flow.

    Parameters
    ----------
    network : Network
    p_pu, q_pu : (n_bus,) or (n_bus, n_state) ndarray, optional
        Net injections, positive into the grid; nominal by default. At PV buses Q is the load's
        share only, from which the generation's reactive limits are counted. [p.u.]
    vm_set_pu : like p_pu, optional
        Voltage of slack and PV buses; nominal by default. [p.u.]
    start : (2 n_bus,) or (2 n_bus, n_state) ndarray, optional
        [θ; |V|] to start from; by default flat, but for what phase shifters turn, and with the
        angles of DC power flow where that leads nowhere.
    enforce_q_limits : bool
        Turn PV buses whose generation leaves its reactive limits into PQ buses at the limit.
    own_references : bool
        Let a part of the grid without a path to the slack bus be held by a bus of its own
        (`Network.references`) at its voltage set-point and angle zero.
    tolerance : float
        Largest mismatch of a solved state; where a bus's power cannot be computed that well, as on
        a small base power, what rounding leaves counts instead. [p.u.]
    max_iterations : int
        Newton iterations from each start. A step that would raise the mismatch is halved.

    Returns
    -------
    PowerFlow

    Raises
    ------
    GridError
        If a part of the grid is not connected to the slack bus, unless ``own_references``, or an
        injection is not finite.
    NotConverged
        With the state, the bus and the size of the worst mismatch.
    """
    if not own_references:
        _require_one_island(network)
    p, q, vm_set, points = _given(network, p_pu, q_pu, vm_set_pu)
    cold = (
        None
        if start is None
        else np.broadcast_to(
            start if np.ndim(start) == 2 else np.asarray(start)[:, None],
            (2 * network.n_bus, p.shape[1]),
        )
    )
    problem = _Problem(network, p, q, vm_set, cold, tolerance, max_iterations)
    try:
        x, limit, iterations = problem.solve(enforce_q_limits, one_at_a_time=False)
    except NotConverged:
        if not enforce_q_limits:
            raise
        # Generators that leave their limits together may leave no solution where the worst does.
        x, limit, iterations = problem.solve(enforce_q_limits, one_at_a_time=True)
    solved_p, solved_q = _injections(network, x)
    shape = (network.n_bus, points) if points else (network.n_bus,)
    return PowerFlow(
        theta=x[: network.n_bus].reshape(shape),
        vm=x[network.n_bus :].reshape(shape),
        p_pu=solved_p.reshape(shape),
        q_pu=solved_q.reshape(shape),
        iterations=iterations,
        limited=(~np.isnan(limit)).reshape(shape),
    )


def _given(
    network: Network,
    p_pu: FloatArray | None,
    q_pu: FloatArray | None,
    vm_set_pu: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Returns injections and set-points as (n_bus, n_state), and n_state, 0 for a single state."""
    given = [
        np.asarray(default if value is None else value, dtype=float)
        for value, default in (
            (p_pu, network.p_nominal_pu),
            (q_pu, network.q_nominal_pu),
            (vm_set_pu, network.buses.vm_set_pu),
        )
    ]
    points = max((g.shape[1] if g.ndim == 2 else 0 for g in given), default=0)
    p, q, vm_set = (
        np.broadcast_to(g if g.ndim == 2 else g[:, None], (network.n_bus, max(points, 1)))
        for g in given
    )
    for name, values in (("p_pu", p), ("q_pu", q), ("vm_set_pu", vm_set)):
        if not np.isfinite(values).all():
            bus, state = np.argwhere(~np.isfinite(values))[0]
            raise GridError(
                f"power flow: {name} must be finite, received {values[bus, state]} at bus "
                f"{network.buses.name[bus]!r}, state {state}"
            )
    return p, q, vm_set, points


@dataclass(frozen=True, eq=False)
class _Problem:
    """States to be solved; arrays are (n_bus, n_state), ``start`` (2 n_bus, n_state) or None."""

    network: Network
    p: FloatArray
    q: FloatArray
    vm_set: FloatArray
    start: FloatArray | None
    tolerance: float
    max_iterations: int

    def solve(
        self, enforce_q_limits: bool, one_at_a_time: bool
    ) -> tuple[FloatArray, FloatArray, int]:
        """Solve the states in passes, each for those whose set of voltage-controlled buses changed.

        Returns
        -------
        x : (2 n_bus, n_state) ndarray
        limit : (n_bus, n_state) ndarray
            Reactive injection of buses at a limit; NaN elsewhere. [p.u.]
        iterations : int
        """
        network, p, q, vm_set = self.network, self.p, self.q, self.vm_set
        x = np.empty((2 * network.n_bus, p.shape[1]))
        if self.start is not None:
            x[:] = self.start
        held = np.broadcast_to((network.buses.kind == BusKind.PV)[:, None], p.shape).copy()
        limit = np.full(p.shape, np.nan)
        iterations = 0
        pending = np.arange(p.shape[1])
        passes = (4 if one_at_a_time else 1) * network.n_bus + 1
        for number in range(passes):
            for pattern, states in _groups(held, pending):
                cold = number == 0 and self.start is None
                starts = (
                    _starts(network, p, vm_set, self.max_iterations)
                    if cold
                    else [(lambda some: x[:, some], self.max_iterations)]
                )
                x[:, states], used = _solve_from(
                    NewtonPowerFlow(network, pattern, self.tolerance),
                    starts,
                    states,
                    p[:, states],
                    np.where(np.isnan(limit[:, states]), q[:, states], limit[:, states]),
                    vm_set[:, states],
                )
                iterations = max(iterations, used)
            if not enforce_q_limits:
                return x, limit, iterations
            pending = _switch(network, x, q, vm_set, held, limit, one_at_a_time)
            if not len(pending):
                return x, limit, iterations
        raise NotConverged(
            f"power flow of {network.name}: the set of buses at a reactive limit still changed "
            f"after {passes} passes in {len(pending)} of {p.shape[1]} states: widen the "
            "limits or solve without them"
        )


def _require_one_island(network: Network) -> None:
    island = network.islands()
    apart = island != island[network.slack]
    if apart.any():
        names = [network.buses.name[i] for i in np.flatnonzero(apart)]
        raise GridError(
            f"{network.name}: {len(names)} buses have no path to the slack bus "
            f"({', '.join(names[:5])}{', …' if len(names) > 5 else ''}): close a branch or drop "
            "them, or give own_references=True"
        )


def _solve_from(
    newton: NewtonPowerFlow,
    starts: Iterable[tuple[Callable[[IntArray], FloatArray], int]],
    states: IntArray,
    p: FloatArray,
    q: FloatArray,
    vm_set: FloatArray,
) -> tuple[FloatArray, int]:
    """Solve states, from the next start where one leads nowhere.

    Raises
    ------
    NotConverged
        If the last start leads nowhere either.
    """
    x, left, iterations = np.empty((2 * len(p), len(states))), np.arange(len(states)), 0
    for start, most in starts:
        found, used, failed, mismatch = newton.solve(
            p[:, left], q[:, left], vm_set[:, left], start(states[left]), most
        )
        x[:, left], iterations, left = found, max(iterations, used), left[failed]
        if not len(left):
            return x, iterations
    raise newton.complaint(mismatch, states[left], len(states), used)


def _starts(
    network: Network, p: FloatArray, vm_set: FloatArray, max_iterations: int
) -> Iterator[tuple[Callable[[IntArray], FloatArray], int]]:
    """Yields where to start some states from, and for how many iterations that is worth a try.

    Flat goes nearly always; the angles of DC power flow help where angles are large.
    """
    size = np.where((network.buses.kind == BusKind.PQ)[:, None], 1.0, vm_set)
    rest = np.broadcast_to(network.resting_angle_rad[:, None], p.shape)

    def flat(states: IntArray) -> FloatArray:
        return np.concatenate([rest[:, states], size[:, states]])

    yield flat, min(max_iterations, _USUAL_ITERATIONS)
    linear = DcPowerFlow(network)
    yield (
        lambda states: np.concatenate([linear.angles(p[:, states]), size[:, states]]),
        max_iterations,
    )
    yield flat, max_iterations


def _groups(
    held: npt.NDArray[np.bool_], states: npt.NDArray[np.int64]
) -> list[tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]]:
    """States that share one set of voltage-controlled buses."""
    patterns, member = np.unique(held[:, states], axis=1, return_inverse=True)
    return [(patterns[:, g], states[np.ravel(member) == g]) for g in range(patterns.shape[1])]


def _injections(network: Network, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    voltage = x[network.n_bus :] * np.exp(1j * x[: network.n_bus])
    power = voltage * (network.y_bus @ voltage).conj()
    return power.real, power.imag


def _switch(
    network: Network,
    x: FloatArray,
    q_load: FloatArray,
    vm_set: FloatArray,
    held: npt.NDArray[np.bool_],
    limit: FloatArray,
    one_at_a_time: bool,
) -> npt.NDArray[np.int64]:
    """Turn PV buses beyond a limit into PQ, and back where the voltage allows; states that changed.

    A bus at its upper limit whose voltage exceeds the set-point (or at its lower limit with a
    voltage below it) would need less than the limit, so it controls its voltage again. One at a
    time, the bus that is furthest beyond its limit or its voltage changes in each state.
    """
    _, q = _injections(network, x)
    controlled = (network.buses.kind == BusKind.PV)[:, None]
    upper = (network.buses.q_max_mvar / network.base_mva)[:, None] + q_load
    lower = (network.buses.q_min_mvar / network.base_mva)[:, None] + q_load
    vm = x[network.n_bus :]
    margin = np.maximum(1e-9, rounding_pu(network, vm))
    over, under = held & (q > upper + margin), held & (q < lower - margin)
    released = controlled & ~held
    back = released & np.where(limit >= upper - margin, vm > vm_set + 1e-9, vm < vm_set - 1e-9)
    if one_at_a_time:
        excess = np.select([over, under, back], [q - upper, lower - q, np.abs(vm - vm_set)], 0.0)
        worst = np.zeros_like(over)
        worst[np.argmax(excess, axis=0), np.arange(excess.shape[1])] = True
        over, under, back = over & worst, under & worst, back & worst
    limit[over], limit[under] = upper[over], lower[under]
    limit[back] = np.nan
    held[over | under] = False
    held[back] = True
    return np.flatnonzero((over | under | back).any(axis=0))
