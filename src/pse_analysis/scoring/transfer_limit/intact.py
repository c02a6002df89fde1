"""The grid without outage along one loading vector, and what its outages allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pse_analysis.errors import GridError, NotConverged
from pse_analysis.grid.continuation import Curve, LoadedGrid, trace
from pse_analysis.scoring.transfer_limit.constraints import Constraint, HighCurrent
from pse_analysis.scoring.transfer_limit.outages import (
    Outage,
    Reached,
    Setting,
    curve_points,
    described,
    largest_power,
    safely_traced,
    where,
)
from pse_analysis.scoring.transfer_limit.params import Criterion
from pse_analysis.scoring.transfer_limit.sections import SectionPower


class IntactGrid:
    """The grid without outage under one loading vector, and what its outages allow.

    Attributes
    ----------
    rows : list of (str, Reached)
        Contingency, "" without one, and a criterion with the power before the outage.
    points : list of DataFrame
        Curves, one row per point.

    Raises
    ------
    GridError
        If the section's power does not rise along the loading vector.
    """

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        network, params = setting.network, setting.params
        self.power = SectionPower(network, setting.section)
        self.grid = LoadedGrid(network, setting.base, setting.direction)
        self.curve = trace(self.grid, params.continuation)
        self._check_rise()
        self.scale = self.curve.limit
        self.curve, constraints = safely_traced(
            self.grid, params.continuation, self._constraints, self.scale, self.curve
        )
        largest = largest_power(self.curve, self.power, gradients=setting.gradients)
        if largest.power_mw <= 0:
            raise GridError(
                f"section {setting.section.name!r} carries {largest.power_mw:.4g} MW at the limit "
                f"of loading {setting.loading!r}, against its direction: turn its signs, and the "
                "loading with them"
            )
        self.rows = [("", _share_of(largest, params.power_share))]
        for criterion, constraint in constraints.items():
            met = where(self.curve, self.power, criterion, constraint, gradients=setting.gradients)
            self.rows.append(("", met))
        self.points = [curve_points(self.curve, self.power, setting, "")]

    def _constraints(self, curve: Curve) -> dict[Criterion, Constraint]:
        params = self.setting.params
        found: dict[Criterion, Constraint] = {
            Criterion.VOLTAGE: self.setting.low_voltage(curve.grid, params.voltage_share)
        }
        if params.continuous_ka:
            found[Criterion.CURRENT] = HighCurrent(self.setting.network, params.continuous_ka)
        return found

    def _check_rise(self) -> None:
        """Refuse a loading vector along which the section's power does not rise."""
        curve, setting = self.curve, self.setting
        power = self.power.power_mw(curve.x[:, : curve.nose + 1])
        if power.max() - power[0] <= 1e-6 * setting.network.base_mva:
            raise GridError(
                f"loading {setting.loading!r} does not raise the power of section "
                f"{setting.section.name!r} ({power[0]:.4g} MW at first, {power[-1]:.4g} MW at the "
                "limit): raise generation in the sending area and lower it, or raise load, in the "
                "receiving one (Loading.transfer), or turn the section's signs"
            )

    def add(self, outage: Outage) -> None:
        """Take the criteria of an outage, as what flows in the grid without it."""
        self.points.append(outage.points)
        for reached in outage.reached:
            self.rows.append((outage.contingency, self._before(reached)))

    def _before(self, reached: Reached) -> Reached:
        if reached.state != "found":
            return reached
        if reached.loading < self.curve.loading[0]:
            start = reached.loading - 1e-6 * abs(self.scale)
            try:
                self.curve = trace(self.grid, self.setting.params.continuation, start=start)
            except NotConverged as error:
                return replace(reached, state="unresolved", detail=str(error), power_mw=np.nan)
        located = self.curve.at(reached.loading)
        if located is None:
            detail = "the grid without outage reaches its limit first"
            return replace(reached, state="not_reached", detail=detail, power_mw=np.nan)
        if reached.loading_gradient is not None:
            located = located.with_base_gradient(-reached.loading_gradient)
        return described(
            located,
            self.power,
            reached.criterion,
            reached.element,
            gradients=self.setting.gradients,
        )


def _share_of(reached: Reached, share: float) -> Reached:
    by_power = reached.power_gradient
    return replace(
        reached,
        power_mw=share * reached.power_mw,
        power_gradient=None if by_power is None else share * by_power,
    )
