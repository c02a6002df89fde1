"""The state from which a loading starts: solved from the grid's tables, or an estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import GridError, NotConverged
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import PowerFlow, solve
from pse_analysis.measurement import BUS, MeasurementModel, P, Q, SensorLayout

StatusArray = npt.NDArray[np.int8]
LOAD, VOLTAGE, UPPER, LOWER = range(4)
"""What a bus holds: its load, its voltage, or its generation's upper or lower reactive limit."""


@dataclass(frozen=True, eq=False)
class BaseState:
    """A solved state of a grid, and what its buses hold.

    Attributes
    ----------
    theta, vm : (N,) ndarray
        [rad], [p.u.]
    p_pu, q_pu : (N,) ndarray
        Net injections of the state. [p.u.]
    status : (N,) ndarray of int
        `LOAD`, `VOLTAGE`, `UPPER` or `LOWER`.
    vm_set : (N,) ndarray
        Voltage that generators return to. [p.u.]
    upper, lower : (N,) ndarray
        Limits of the net reactive injection at the base load; ±inf where there are none. [p.u.]
    vm_set_is_base, upper_is_base, lower_is_base : (N,) ndarray of bool
        Where these are not given but read from the state, so that they move with it.
    jacobian : (2N, 2N) sparse array
        ∂(P, Q)/∂x at the state.
    """

    theta: FloatArray
    vm: FloatArray
    p_pu: FloatArray
    q_pu: FloatArray
    status: StatusArray
    vm_set: FloatArray
    upper: FloatArray
    lower: FloatArray
    vm_set_is_base: BoolArray
    upper_is_base: BoolArray
    lower_is_base: BoolArray
    jacobian: sparse.csr_array

    @property
    def x(self) -> FloatArray:
        """State [θ; |V|]. (2N,)"""
        return np.concatenate([self.theta, self.vm])

    @classmethod
    def solved(cls, network: Network, *, enforce_q_limits: bool = True) -> BaseState:
        """Returns the base state of the grid's own tables.

        Raises
        ------
        NotConverged
            If they have no solution.
        """
        try:
            flow = solve(network, enforce_q_limits=enforce_q_limits)
        except NotConverged as error:
            raise NotConverged(
                f"the base case of {network.name} has no solution, so nothing can be loaded "
                f"further: lower its load, raise voltage set-points or reactive limits, or give "
                f"the state of an estimate ({error})"
            ) from error
        return cls._of(network, flow.x, enforce_q_limits, flow)

    @classmethod
    def of_estimate(
        cls, network: Network, x: FloatArray, *, enforce_q_limits: bool = True
    ) -> BaseState:
        """Returns a given state as base: its injections and generator voltages are held.

        A generator that the state shows beyond a reactive limit stands at what it generates; one
        at its upper limit returns to its set-point where that lies above its voltage, likewise at
        the lower.

        Parameters
        ----------
        network : Network
        x : (2N,) ndarray
            [θ; |V|]. [rad, p.u.]
        enforce_q_limits : bool

        Raises
        ------
        GridError
            If the state does not fit the grid.
        """
        x = np.asarray(x, dtype=float)
        if x.shape != (2 * network.n_bus,):
            raise GridError(
                f"the state of {network.name} must have {2 * network.n_bus} values [θ; |V|], "
                f"received shape {x.shape}"
            )
        vm = x[network.n_bus :]
        bad = ~(np.isfinite(x[: network.n_bus]) & np.isfinite(vm) & (vm > 0))
        if bad.any():
            at = int(np.argmax(bad))
            raise GridError(
                f"the state of {network.name} must be finite with |V| > 0: received θ = "
                f"{x[at]:g} rad, |V| = {vm[at]:g} p.u. at bus {network.buses.name[at]!r}; leave "
                "out instants at which the estimate does not cover the whole grid"
            )
        return cls._of(network, x, enforce_q_limits, None)

    @classmethod
    def _of(
        cls, network: Network, x: FloatArray, enforce: bool, flow: PowerFlow | None
    ) -> BaseState:
        n, buses = network.n_bus, network.buses
        every: IntArray = np.arange(n)
        model = MeasurementModel(
            network, SensorLayout.of(network, (P, every, BUS), (Q, every, BUS))
        )
        power = model.h(x)
        p, q, vm = power[:n], power[n:], x[n:]
        controlled = buses.kind == BusKind.PV
        if enforce:
            upper = buses.q_max_mvar / network.base_mva + network.q_nominal_pu
            lower = buses.q_min_mvar / network.base_mva + network.q_nominal_pu
        else:
            upper, lower = np.full(n, np.inf), np.full(n, -np.inf)
        status = np.where(buses.kind == BusKind.PQ, LOAD, VOLTAGE).astype(np.int8)
        margin = 1e-7
        at_upper = controlled & (q >= upper - margin)
        at_lower = controlled & (q <= lower + margin) & ~at_upper
        if flow is not None:  # a bus may touch its limit and yet hold its voltage
            at_upper &= flow.limited
            at_lower &= flow.limited
        status[at_upper], status[at_lower] = UPPER, LOWER
        vm_set = vm.copy()
        vm_set[at_upper] = np.maximum(vm, buses.vm_set_pu)[at_upper]
        vm_set[at_lower] = np.minimum(vm, buses.vm_set_pu)[at_lower]
        above, below = controlled & (q > upper + margin), controlled & (q < lower - margin)
        return cls(
            theta=x[:n],
            vm=vm,
            p_pu=p,
            q_pu=q,
            status=status,
            vm_set=vm_set,
            upper=np.where(above, q, upper),
            lower=np.where(below, q, lower),
            vm_set_is_base=vm_set == vm,
            upper_is_base=above,
            lower_is_base=below,
            jacobian=model.jacobian(x),
        )
