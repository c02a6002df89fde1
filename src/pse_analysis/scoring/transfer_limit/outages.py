"""One curve and what it says of a section: the largest power, and where criteria are met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import optimize

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import GridError, NotConverged
from pse_analysis.grid.continuation import ContinuationParams, Curve, EndKind, LoadedGrid, trace
from pse_analysis.grid.continuation.base import BaseState
from pse_analysis.grid.continuation.curve import Located
from pse_analysis.grid.continuation.loading import Direction
from pse_analysis.grid.network import Network
from pse_analysis.scoring.transfer_limit.constraints import (
    Constraint,
    HighCurrent,
    HighPower,
    LowVoltage,
    first_violation,
)
from pse_analysis.scoring.transfer_limit.params import (
    Contingency,
    Criterion,
    TransferLimitParams,
)
from pse_analysis.scoring.transfer_limit.sections import Section, SectionPower

STARTS = (0.0, -0.25, -0.5, -1.0)
"""Loadings at which a curve starts until no criterion is violated there, in units of the base
grid's largest."""
_VIOLATED = 1e-9


@dataclass(frozen=True, eq=False)
class Setting:
    """What the curves of one loading vector share.

    Attributes
    ----------
    network : Network
        The base grid.
    base : BaseState
    loading : str
    direction : Direction
    section : Section
    params : TransferLimitParams
    gradients : bool
        Whether sensitivities to the base state are wanted.
    """

    network: Network
    base: BaseState
    loading: str
    direction: Direction
    section: Section
    params: TransferLimitParams
    gradients: bool

    def low_voltage(self, grid: LoadedGrid, share: float) -> LowVoltage:
        """Returns the constraint on the voltages of load buses, with a margin."""
        buses, params = self.network.buses, self.params
        load = ((buses.p_load_mw != 0) | (buses.q_load_mvar != 0)) & grid.alive
        return LowVoltage(
            self.network,
            np.flatnonzero(load),
            self.base.vm,
            params.critical_rated / share,
            params.critical_normal / share,
        )


@dataclass(frozen=True, eq=False)
class Reached:
    """A criterion on one curve: where it is met, or why it is not.

    Attributes
    ----------
    criterion : Criterion
    state : str
        ``found``, ``not_reached`` (it does not limit) or ``unresolved`` (nobody knows).
    loading : float
        λ.
    element : str
        What meets it first: ``bus/…``, ``branch/…``, or the kind of end.
    detail : str
    power_mw : float
        Through the section, on this curve. [MW]
    loading_gradient, power_gradient : (2N,) ndarray
        Derivatives by the base state; zeros where they are not wanted.
    """

    criterion: Criterion
    state: str
    loading: float = np.nan
    element: str = ""
    detail: str = ""
    power_mw: float = np.nan
    loading_gradient: FloatArray | None = None
    power_gradient: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """One contingency under one loading vector; ``scale`` is the base grid's largest λ."""

    setting: Setting
    contingency: Contingency
    scale: float


@dataclass(frozen=True, eq=False)
class Outage:
    """What a task found."""

    loading: str
    contingency: str
    reached: tuple[Reached, ...]
    points: pd.DataFrame
    end: str
    largest_mw: float


def study_outage(task: Task) -> Outage:
    """Trace the grid after an outage and find the loadings at which its criteria are met."""
    setting, params = task.setting, task.setting.params
    network = setting.network
    for branch in task.contingency.branches:
        network = network.open_branch(branch)
    power = SectionPower(network, setting.section)
    wanted = [Criterion.STABILITY_AFTER, Criterion.VOLTAGE_AFTER]
    wanted += [Criterion.CURRENT_AFTER] if params.emergency_ka else []

    def constraints(curve: Curve) -> dict[Criterion, Constraint]:
        largest = largest_power(curve, power, gradients=setting.gradients)
        share = params.power_share_after
        own: dict[Criterion, Constraint] = {
            Criterion.STABILITY_AFTER: HighPower(
                power, share * largest.power_mw, share * _of(largest.power_gradient, network)
            ),
            Criterion.VOLTAGE_AFTER: setting.low_voltage(curve.grid, params.voltage_share_after),
        }
        if Criterion.CURRENT_AFTER in wanted:
            own[Criterion.CURRENT_AFTER] = HighCurrent(network, params.emergency_ka)
        return own

    try:
        grid = LoadedGrid(network, setting.base, setting.direction)
        curve, found = safely_traced(grid, params.continuation, constraints, task.scale)
        largest = largest_power(curve, power, gradients=False)
    except (NotConverged, GridError) as error:
        lost = tuple(Reached(c, "unresolved", detail=str(error)) for c in wanted)
        empty = curve_points(None, power, setting, task.contingency.name)
        return Outage(setting.loading, task.contingency.name, lost, empty, "", np.nan)
    reached = tuple(
        where(curve, power, criterion, constraint, gradients=setting.gradients)
        for criterion, constraint in found.items()
    )
    if largest.power_mw <= 0:
        detail = "the section carries nothing in its direction up to the limit"
        reached = (Reached(wanted[0], "unresolved", detail=detail), *reached[1:])
    points = curve_points(curve, power, setting, task.contingency.name)
    return Outage(
        setting.loading, task.contingency.name, reached, points, str(curve.end), largest.power_mw
    )


def safely_traced(
    grid: LoadedGrid,
    params: ContinuationParams,
    constraints: Callable[[Curve], dict[Criterion, Constraint]],
    scale: float,
    from_base: Curve | None = None,
) -> tuple[Curve, dict[Criterion, Constraint]]:
    """Returns a curve that starts where no constraint is violated, and its constraints.

    It starts at the base load where that is safe, else at a lower one; at the lowest where none
    is safe. ``from_base`` is the curve from the base load where that is traced already.

    Raises
    ------
    NotConverged
        If the grid has no state at any of them.
    """
    found, failure = None, None
    for share in STARTS:
        try:
            traced = from_base if share == 0.0 else None
            curve = traced or trace(grid, params, start=share * scale)
        except NotConverged as error:
            failure = failure or error
            continue
        own = constraints(curve)
        found = curve, own
        if not any((c.values(curve.x[:, :1]) > _VIOLATED).any() for c in own.values()):
            break
    if found is None:
        raise NotConverged(
            f"there is no state at any loading down to λ = {STARTS[-1] * scale:g}: the section's "
            f"power does not help, so leave this out or mend the grid ({failure})"
        ) from failure
    return found


def where(
    curve: Curve,
    power: SectionPower,
    criterion: Criterion,
    constraint: Constraint,
    *,
    gradients: bool,
) -> Reached:
    """Returns where on a curve a criterion is met first."""
    start = constraint.values(curve.x[:, :1])[:, 0]
    if (start > _VIOLATED).any():
        element = constraint.name(int(np.argmax(start)))
        return Reached(
            criterion,
            "unresolved",
            float(curve.loading[0]),
            element,
            f"violated at every loading down to λ = {curve.loading[0]:g}: another measure than "
            "the section's power must help, or leave this out of the study",
        )
    try:
        first = first_violation(curve, constraint)
    except NotConverged as error:
        return Reached(criterion, "unresolved", detail=str(error))
    if first is None:
        return Reached(criterion, "not_reached", curve.limit, detail="not before the limit")
    located, element = first
    return described(located, power, criterion, element, gradients=gradients)


def described(
    located: Located, power: SectionPower, criterion: Criterion, element: str, *, gradients: bool
) -> Reached:
    """Returns a located state with its power, and both sensitivities where they are wanted."""
    by_loading = by_power = None
    if gradients:
        last = np.zeros(len(located.y))
        last[-1] = 1.0
        by_loading = located.sensitivity(last)
        by_power = located.sensitivity(power.gradient(located.y))
    return Reached(
        criterion,
        "found",
        located.loading,
        element,
        "",
        float(power.power_mw(located.y[:-2])),
        by_loading,
        by_power,
    )


def largest_power(curve: Curve, power: SectionPower, *, gradients: bool) -> Reached:
    """Returns the largest power through a section from a curve's start to its nose.

    It usually flows at the nose; where it falls again before, the largest is sought between the
    points.
    """
    values = power.power_mw(curve.x[:, : curve.nose + 1])
    top = int(np.argmax(values))
    rises = float(power.gradient(curve.y[:, curve.nose]) @ curve.nose_tangent) >= 0
    if top == curve.nose and (rises or curve.end == EndKind.LIMIT_INDUCED or top == 0):
        element = str(curve.end)
        if curve.nose_bus >= 0:
            element += f" at bus/{curve.grid.network.buses.name[curve.nose_bus]}"
        return described(curve.at_nose(), power, Criterion.STABILITY, element, gradients=gradients)
    best: Located | None = None
    for segment in {max(top - 1, 0), min(top, curve.nose - 1)}:

        def lost(fraction: float, segment: int = segment) -> float:
            found = curve.between(segment, fraction)
            return np.inf if found is None else -float(power.power_mw(found.y[:-2]))

        sought = optimize.minimize_scalar(
            lost, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-7}
        )
        found = curve.between(segment, float(sought.x))
        if found is not None and (
            best is None or power.power_mw(found.y[:-2]) > power.power_mw(best.y[:-2])
        ):
            best = found
    if best is None:
        raise NotConverged(
            f"{curve.grid.network.name}: the largest power of the section could not be located: "
            "lower largest_step"
        )
    return described(best, power, Criterion.STABILITY, "largest power", gradients=gradients)


def curve_points(
    curve: Curve | None, power: SectionPower, setting: Setting, contingency: str
) -> pd.DataFrame:
    """Returns a curve as a table, one row a point."""
    columns = {
        "loading": str,
        "contingency": str,
        "point": np.int64,
        "loading_factor": float,
        "p_mw": float,
        "lowest_bus": str,
        "lowest_vm_pu": float,
        "slope": float,
        "stable": bool,
        "event": str,
    }
    if curve is None:
        return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in columns.items()})
    grid = curve.grid
    buses = np.flatnonzero(grid.alive)
    lowest = buses[np.argmin(curve.vm[buses], axis=0)]
    count = curve.y.shape[1]
    return pd.DataFrame(
        {
            "loading": setting.loading,
            "contingency": contingency,
            "point": np.arange(count),
            "loading_factor": curve.loading,
            "p_mw": power.power_mw(curve.x),
            "lowest_bus": [grid.network.buses.name[bus] for bus in lowest],
            "lowest_vm_pu": curve.vm[lowest, np.arange(count)],
            "slope": curve.slope,
            "stable": curve.stable,
            "event": list(curve.event),
        }
    )


def _of(gradient: FloatArray | None, network: Network) -> FloatArray:
    return np.zeros(2 * network.n_bus) if gradient is None else gradient
