"""An observer from a case file, and aligned telemetry as it reads it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pse_analysis.errors import ParameterError, TableError
from pse_analysis.estimation.core.interface import Estimator, Snapshot
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.estimation.machine.gain import Poles, Tuning
from pse_analysis.estimation.machine.observer import NEEDS_INPUT, observer
from pse_analysis.machine import Densities, Machine
from pse_analysis.measurement import DELTA_M, ROTOR_ANGLE, SensorLayout


@dataclass(frozen=True)
class ObserverParams:
    """What an observer is designed from: q and r, or poles.

    Attributes
    ----------
    q : (2,) tuple of float, optional
        Diagonal of Q, of θ and ω. [rad²/s, rad²/s³]
    r : float, optional
        R. [rad²·s]
    poles : (2,) tuple of float, optional
        Real poles of the error. [1/s]
    belief_q, belief_r
        Densities from which σ is computed; q and r by default, which poles lack.
    gain : {"constant", "recursive"}
        See `pse_analysis.estimation.machine.observer`.
    start, start_sigma : (2,) tuple of float
        x̂ before the first sample, and how far off it may be. [rad, rad/s]
    """

    q: tuple[float, float] | None = None
    r: float | None = None
    poles: tuple[float, float] | None = None
    belief_q: tuple[float, float] | None = None
    belief_r: float | None = None
    gain: Literal["constant", "recursive"] = "constant"
    start: tuple[float, float] = (0.0, 0.0)
    start_sigma: tuple[float, float] = (10.0, 10.0)

    def __post_init__(self) -> None:
        pairs = (("q", "r"), ("belief_q", "belief_r"))
        for one, other in pairs:
            if (getattr(self, one) is None) != (getattr(self, other) is None):
                raise ParameterError(f"[observer] {one} and {other} belong together: give both")
        if (self.q is None) == (self.poles is None):
            raise ParameterError(
                f"[observer] expected either q and r, or poles; received q = {self.q}, poles = "
                f"{self.poles}"
            )

    @property
    def tuning(self) -> Tuning:
        """What the gain is designed from."""
        if self.poles is not None:
            return Poles(self.poles)
        assert self.q is not None
        assert self.r is not None
        return Densities(*self.q, self.r)

    @property
    def belief(self) -> Densities | None:
        """What σ is computed from; None for the tuning's own densities."""
        if self.belief_q is None or self.belief_r is None:
            return None
        return Densities(*self.belief_q, self.belief_r)


def from_params(name: str, machine: Machine, params: ObserverParams, step_s: float) -> Estimator:
    """The observer that a case file describes; see `observer`."""
    return observer(
        name,
        machine,
        params.tuning,
        step_s,
        belief=params.belief,
        gain=params.gain,
        start=params.start,
        start_sigma=params.start_sigma,
    )


def snapshots(
    record: Record, layout: SensorLayout, machine: Machine
) -> tuple[Iterator[Snapshot], SensorLayout]:
    """Snapshots with the angle as their one row and ΔM as the input.

    Parameters
    ----------
    record : Record
        Of all channels.
    layout : SensorLayout
        Of all channels.
    machine : Machine

    Returns
    -------
    snapshots : iterator of Snapshot
        ``inputs`` is None where no ΔM was young enough.
    layout : SensorLayout
        Of the angle alone.

    Raises
    ------
    TableError
        If there is not exactly one channel of each.
    """
    rows = []
    for quantity, name in ((ROTOR_ANGLE, "rotor_angle_rad"), (DELTA_M, "delta_m_pu")):
        at = np.flatnonzero(layout.quantity == quantity)
        if len(at) == 0 and quantity == DELTA_M:
            raise TableError(NEEDS_INPUT.format(base=machine.s_mva, element=machine.element))
        if len(at) != 1:
            raise TableError(
                f"channels: expected one channel of {name} at {machine.element}, received "
                f"{len(at)}: keep the one to use"
            )
        rows.append(int(at[0]))
    angle, torque = rows

    def each() -> Iterator[Snapshot]:
        for t in range(len(record.time)):
            one = slice(angle, angle + 1)
            yield Snapshot(
                record.time[t],
                record.z[t, one],
                record.sigma[t, one],
                record.sigma_age[t, one],
                record.available[t, one],
                record.fresh[t, one],
                record.age_s[t, one],
                inputs=record.z[t, [torque]] if record.available[t, torque] else None,
            )

    return each(), layout.take(np.array([angle]))
