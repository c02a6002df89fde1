"""Newton power flow for one or many states, on the measurement model's own injection rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.errors import GridError, NotConverged
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.measurement import BUS, MeasurementModel, P, Q, SensorLayout

FloatArray = npt.NDArray[np.float64]

_BLOCK = 64
"""States solved in one block-diagonal factorisation; more gain nothing and cost memory."""


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
        [θ; |V|] to start from; by default flat, but for what phase shifters turn.
    enforce_q_limits : bool
        Turn PV buses whose generation leaves its reactive limits into PQ buses at the limit.
    tolerance : float
        Largest mismatch of a solved state. [p.u.]
    max_iterations : int

    Returns
    -------
    PowerFlow

    Raises
    ------
    GridError
        If a part of the grid is not connected to the slack bus, or an injection is not finite.
    NotConverged
        With the state, the bus and the size of the worst mismatch.
    """
    _require_one_island(network)
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
    x = np.empty((2 * network.n_bus, p.shape[1]))
    if start is None:
        x[: network.n_bus] = network.resting_angle_rad[:, None]
        x[network.n_bus :] = np.where((network.buses.kind == BusKind.PQ)[:, None], 1.0, vm_set)
    else:
        x[:] = start if np.ndim(start) == 2 else np.asarray(start)[:, None]
    held = np.broadcast_to((network.buses.kind == BusKind.PV)[:, None], p.shape).copy()
    limit = np.full(p.shape, np.nan)
    iterations = 0
    # Every pass solves the states whose set of voltage-controlled buses changed.
    pending = np.arange(p.shape[1])
    for _ in range(network.n_bus + 1):
        for pattern, states in _groups(held, pending):
            target_q = np.where(np.isnan(limit[:, states]), q[:, states], limit[:, states])
            x[:, states], used = _newton(
                network,
                pattern,
                p[:, states],
                target_q,
                vm_set[:, states],
                x[:, states],
                states,
                tolerance,
                max_iterations,
            )
            iterations = max(iterations, used)
        if not enforce_q_limits:
            break
        pending = _switch(network, x, q, vm_set, held, limit)
        if not len(pending):
            break
    else:
        raise NotConverged(
            f"power flow of {network.name}: the set of buses at a reactive limit still changed "
            f"after {network.n_bus + 1} passes in {len(pending)} of {p.shape[1]} states: widen the "
            "limits or solve without them"
        )
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


def _require_one_island(network: Network) -> None:
    island = network.islands()
    apart = island != island[network.slack]
    if apart.any():
        names = [network.buses.name[i] for i in np.flatnonzero(apart)]
        raise GridError(
            f"{network.name}: {len(names)} buses have no path to the slack bus "
            f"({', '.join(names[:5])}{', …' if len(names) > 5 else ''}): close a branch or drop "
            "them"
        )


def _groups(
    held: npt.NDArray[np.bool_], states: npt.NDArray[np.int64]
) -> list[tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]]:
    """States that share one set of voltage-controlled buses."""
    patterns, member = np.unique(held[:, states], axis=1, return_inverse=True)
    return [(patterns[:, g], states[np.ravel(member) == g]) for g in range(patterns.shape[1])]


def _newton(
    network: Network,
    held: npt.NDArray[np.bool_],
    p: FloatArray,
    q: FloatArray,
    vm_set: FloatArray,
    x: FloatArray,
    states: npt.NDArray[np.int64],
    tolerance: float,
    max_iterations: int,
) -> tuple[FloatArray, int]:
    n = network.n_bus
    free_angle = np.flatnonzero(np.arange(n) != network.slack)
    free_size = np.flatnonzero((np.arange(n) != network.slack) & ~held)
    model = MeasurementModel(
        network,
        SensorLayout.of(network, (P, free_angle, BUS), (Q, free_size, BUS)),
        columns=np.concatenate([free_angle, n + free_size]),
    )
    target = np.concatenate([p[free_angle], q[free_size]])
    fixed = np.setdiff1d(np.arange(n), free_size)
    x = x.copy()
    x[n + fixed] = vm_set[fixed]
    x[network.slack] = 0.0
    active = np.arange(x.shape[1])
    with np.errstate(all="ignore"):  # a diverging state ends in NotConverged, not in warnings
        for iteration in range(max_iterations + 1):
            mismatch = model.h(x[:, active]) - target[:, active]
            worst = np.abs(mismatch).max(axis=0, initial=0.0)
            open_ = ~(worst <= tolerance)
            active, mismatch = active[open_], mismatch[:, open_]
            if not len(active):
                return x, iteration
            if iteration == max_iterations or not np.isfinite(mismatch).all():
                break
            for first in range(0, len(active), _BLOCK):
                part = active[first : first + _BLOCK]
                step = _block_solve(model, x[:, part], mismatch[:, first : first + _BLOCK])
                if step is None:
                    x[:, part] = np.nan
                else:
                    x[np.ix_(model.columns, part)] -= step
    size = np.where(np.isfinite(mismatch), np.abs(mismatch), np.inf)
    row, column = np.unravel_index(int(np.argmax(size)), size.shape)
    kind = "P" if row < len(free_angle) else "Q"
    bus = np.concatenate([free_angle, free_size])[row]
    raise NotConverged(
        f"power flow of {network.name} did not converge in {iteration} iterations: "
        f"{len(active)} of {x.shape[1]} states are open, worst mismatch of {kind} "
        f"{size[row, column]:.3g} p.u. at bus {network.buses.name[bus]!r} "
        f"(state {states[active[column]]}): lower the load or start closer to the solution"
    )


def _block_solve(model: MeasurementModel, x: FloatArray, mismatch: FloatArray) -> FloatArray | None:
    """Newton steps of several states by one factorisation of their block-diagonal Jacobian."""
    data = model.jacobian_data(x)
    if not np.isfinite(data).all():
        return None
    m, count = model.shape[0], x.shape[1]
    nnz = data.shape[0]
    # The CSR pattern read as CSC is the transpose, which SuperLU solves just as well.
    indices = (model.indices[None, :] + m * np.arange(count)[:, None]).ravel()
    indptr = (model.indptr[None, :-1] + nnz * np.arange(count)[:, None]).ravel()
    transposed = sparse.csc_array(
        (data.T.ravel(), indices, np.append(indptr, nnz * count)), shape=(m * count, m * count)
    )
    try:
        factor = sparse_linalg.splu(transposed)
    except RuntimeError:  # exactly singular
        return None
    return np.asarray(factor.solve(mismatch.T.ravel(), trans="T").reshape(count, m).T)


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
) -> npt.NDArray[np.int64]:
    """Turn PV buses beyond a limit into PQ, and back where the voltage allows; states that changed.

    A bus at its upper limit whose voltage exceeds the set-point (or at its lower limit with a
    voltage below it) would need less than the limit, so it controls its voltage again.
    """
    _, q = _injections(network, x)
    controlled = (network.buses.kind == BusKind.PV)[:, None]
    upper = (network.buses.q_max_mvar / network.base_mva)[:, None] + q_load
    lower = (network.buses.q_min_mvar / network.base_mva)[:, None] + q_load
    vm = x[network.n_bus :]
    margin = 1e-9
    over, under = held & (q > upper + margin), held & (q < lower - margin)
    released = controlled & ~held
    back = released & np.where(limit >= upper - margin, vm > vm_set + margin, vm < vm_set - margin)
    limit[over], limit[under] = upper[over], lower[under]
    limit[back] = np.nan
    held[over | under] = False
    held[back] = True
    return np.flatnonzero((over | under | back).any(axis=0))
