"""What must not be exceeded along a curve, and where on it that first happens."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.errors import NotConverged
from pse_analysis.grid.continuation.curve import Curve, Located
from pse_analysis.grid.network import Network
from pse_analysis.measurement import FROM, IM, TO, MeasurementModel, SensorLayout
from pse_analysis.scoring.transfer_limit.sections import SectionPower

_TOLERANCE = 1e-9


class Constraint(Protocol):
    """Several quantities that are positive where they are violated."""

    def values(self, x: FloatArray) -> FloatArray:
        """Values at states (2N, k). (m, k)"""

    def gradient(self, which: int, y: FloatArray) -> FloatArray:
        """Derivative of one of them by the unknowns of a loaded grid. (2N + 2,)"""

    def base_gradient(self, which: int) -> FloatArray:
        """Derivative of one of them by the base state, at fixed unknowns. (2N,)"""

    def name(self, which: int) -> str:
        """The element that one of them is about."""


class LowVoltage:
    """Voltages of load buses below what each needs.

    Parameters
    ----------
    network : Network
    buses : (m,) ndarray of int
    base_vm : (N,) ndarray
        Voltages of the base state. [p.u.]
    rated, normal : float
        Least voltage as share of the rated one and of that in the base state; the larger counts.
    """

    def __init__(
        self, network: Network, buses: IntArray, base_vm: FloatArray, rated: float, normal: float
    ) -> None:
        self.network, self.buses, self.n = network, buses, network.n_bus
        self.least = np.maximum(rated, normal * base_vm[buses])
        self.slope = np.where(normal * base_vm[buses] > rated, normal, 0.0)

    def values(self, x: FloatArray) -> FloatArray:
        """What each bus lacks. (m, k) [p.u.]"""
        return np.asarray(self.least[:, None] - x[self.n + self.buses])

    def gradient(self, which: int, y: FloatArray) -> FloatArray:
        """Derivative by the unknowns. (2N + 2,)"""
        out = np.zeros(2 * self.n + 2)
        out[self.n + self.buses[which]] = -1.0
        return out

    def base_gradient(self, which: int) -> FloatArray:
        """Derivative by the base state: the least voltage follows the normal one. (2N,)"""
        out = np.zeros(2 * self.n)
        out[self.n + self.buses[which]] = self.slope[which]
        return out

    def name(self, which: int) -> str:
        """The bus."""
        return f"bus/{self.network.buses.name[self.buses[which]]}"


class HighCurrent:
    """Currents at either end of branches above their limits, as shares of these.

    Parameters
    ----------
    network : Network
    limits_ka : mapping of str to float
        By branch; what is out of service is left out. [kA]
    """

    def __init__(self, network: Network, limits_ka: Mapping[str, float]) -> None:
        branch = network.branches
        position = np.array([network.branch(name) for name in limits_ka], dtype=np.int64)
        limit = np.array(list(limits_ka.values()), dtype=float)
        closed = branch.in_service[position] if len(position) else np.zeros(0, dtype=bool)
        position, limit = position[closed], limit[closed]
        self.network, self.position = network, np.concatenate([position, position])
        self.model = MeasurementModel(
            network, SensorLayout.of(network, (IM, position, FROM), (IM, position, TO))
        )
        ends = np.concatenate([branch.from_bus[position], branch.to_bus[position]])
        self.limit = np.concatenate([limit, limit]) / network.base_ka[ends]

    def values(self, x: FloatArray) -> FloatArray:
        """By how much each end exceeds its limit, as share of it. (m, k)"""
        return np.asarray(self.model.h(x) / self.limit[:, None] - 1.0)

    def gradient(self, which: int, y: FloatArray) -> FloatArray:
        """Derivative by the unknowns. (2N + 2,)"""
        row = self.model.jacobian(y[:-2])[[which]].toarray().ravel()
        return np.append(row / self.limit[which], [0.0, 0.0])

    def base_gradient(self, which: int) -> FloatArray:
        """Derivative by the base state: none. (2N,)"""
        return np.zeros(2 * self.network.n_bus)

    def name(self, which: int) -> str:
        """The branch."""
        return f"branch/{self.network.branches.name[self.position[which]]}"


class HighPower:
    """Power through a section above a value.

    Parameters
    ----------
    power : SectionPower
    most_mw : float
    slope : (2N,) ndarray
        Derivative of that value by the base state.
    """

    def __init__(self, power: SectionPower, most_mw: float, slope: FloatArray) -> None:
        self.power, self.most_mw, self.slope = power, most_mw, slope
        self.scale = float(np.abs(power.weight).max())

    def values(self, x: FloatArray) -> FloatArray:
        """What flows beyond the value. (1, k) [p.u.]"""
        return np.atleast_2d((self.power.power_mw(x) - self.most_mw) / self.scale)

    def gradient(self, which: int, y: FloatArray) -> FloatArray:
        """Derivative by the unknowns. (2N + 2,)"""
        return self.power.gradient(y) / self.scale

    def base_gradient(self, which: int) -> FloatArray:
        """Derivative by the base state. (2N,)"""
        return -self.slope / self.scale

    def name(self, which: int) -> str:
        """Nothing: the section itself."""
        return ""


def first_violation(curve: Curve, constraint: Constraint) -> tuple[Located, str] | None:
    """Returns the first state before the nose at which a constraint is violated, and by what.

    Parameters
    ----------
    curve : Curve
        Not violated at its start.
    constraint : Constraint

    Returns
    -------
    located : Located
    element : str
        Nothing is returned where the constraint holds up to the nose.

    Raises
    ------
    NotConverged
        If the state cannot be located.
    """
    values = constraint.values(curve.x[:, : curve.nose + 1])
    violated = (values > _TOLERANCE).any(axis=0)
    if not violated.any():
        return None
    end = int(np.argmax(violated))
    if end == 0:
        raise ValueError("the constraint is violated at the start of the curve")
    segment, before, after = end - 1, values[:, end - 1], values[:, end]
    furthest = 1.0
    for _ in range(len(values)):
        beyond = np.flatnonzero(after > _TOLERANCE)
        room = np.maximum(-before[beyond], 0.0)
        fraction = furthest * room / (room + after[beyond])
        first = int(np.argmin(fraction))
        which = int(beyond[first])

        def condition(y: FloatArray, which: int = which) -> tuple[float, FloatArray]:
            value = float(constraint.values(y[:-2, None])[which, 0])
            return value, constraint.gradient(which, y)

        found = curve.located(condition, segment, float(fraction[first]))
        if found is None:
            break
        after = constraint.values(found.y[:-2, None])[:, 0]
        after[which] = -np.inf
        if not (after > _TOLERANCE).any():
            return found.with_base_gradient(constraint.base_gradient(which)), constraint.name(which)
        furthest = float(fraction[first])
    raise NotConverged(
        f"{curve.grid.network.name}: the first violation at {constraint.name(which)!r} between "
        f"λ = {curve.loading[segment]:g} and {curve.loading[end]:g} could not be located: lower "
        "largest_step"
    )
