"""The six criteria of the maximum allowed power flow, with their margins."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from pse_analysis.errors import ParameterError
from pse_analysis.grid.continuation import ContinuationParams


class Criterion(enum.StrEnum):
    """What limits the power through a section."""

    STABILITY = "stability"
    VOLTAGE = "voltage"
    STABILITY_AFTER = "stability_after_outage"
    VOLTAGE_AFTER = "voltage_after_outage"
    CURRENT = "current"
    CURRENT_AFTER = "current_after_outage"


DESCRIPTION = MappingProxyType(
    {
        Criterion.STABILITY: "share of the largest power before the limit of stability",
        Criterion.VOLTAGE: "first load bus without its margin to the critical voltage",
        Criterion.STABILITY_AFTER: "margin of stability after an outage",
        Criterion.VOLTAGE_AFTER: "margin of voltage after an outage",
        Criterion.CURRENT: "first branch at its continuous current limit",
        Criterion.CURRENT_AFTER: "first branch at its emergency current limit after an outage",
    }
)
"""What each criterion is, in words."""


@dataclass(frozen=True)
class Contingency:
    """Branches that trip together.

    Attributes
    ----------
    name : str
    branches : tuple of str
    """

    name: str
    branches: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.branches:
            raise ParameterError(f"contingency {self.name!r} trips no branch: name one at least")


@dataclass(frozen=True)
class TransferLimitParams:
    """Margins of the maximum allowed power flow.

    Attributes
    ----------
    power_share, power_share_after : float
        Share of the largest power that may flow: before an outage (criterion 1), and after one
        (criterion 3).
    voltage_share, voltage_share_after : float
        Critical voltage over the least allowed one, before an outage (criterion 2) and after one
        (criterion 4).
    critical_rated, critical_normal : float
        Critical voltage of a load bus, as share of its rated voltage and of its voltage in the
        base state; the larger counts.
    irregular_factor : float
        K of the irregular oscillations ΔP = K √(P₁P₂/(P₁ + P₂)) of the areas' loads P₁ and P₂;
        1.5, or 0.75 with automatic control of the exchange. [√MW]
    irregular_mw : float, optional
        These oscillations themselves, where they are known. [MW]
    continuous_ka, emergency_ka : mapping of str to float
        Current limits by branch, before (criterion 5) and after an outage (criterion 6); branches
        that are not named have none. [kA]
    continuation : ContinuationParams
    """

    power_share: float = 0.80
    power_share_after: float = 0.92
    voltage_share: float = 0.85
    voltage_share_after: float = 0.90
    critical_rated: float = 0.70
    critical_normal: float = 0.75
    irregular_factor: float = 1.5
    irregular_mw: float | None = None
    continuous_ka: Mapping[str, float] = field(default_factory=dict)
    emergency_ka: Mapping[str, float] = field(default_factory=dict)
    continuation: ContinuationParams = field(default_factory=ContinuationParams)

    def __post_init__(self) -> None:
        for name in (
            "power_share",
            "power_share_after",
            "voltage_share",
            "voltage_share_after",
        ):
            if not 0 < getattr(self, name) <= 1:
                raise ParameterError(
                    f"transfer limit: {name} must lie in 0 … 1, received {getattr(self, name)}"
                )
        for name in ("critical_rated", "critical_normal"):
            if not 0 <= getattr(self, name) < 1:
                raise ParameterError(
                    f"transfer limit: {name} must lie in 0 … 1, received {getattr(self, name)}"
                )
        for name, value in (
            ("irregular_factor", self.irregular_factor),
            ("irregular_mw", self.irregular_mw or 0.0),
        ):
            if not 0 <= value < np.inf:
                raise ParameterError(
                    f"transfer limit: {name} must be finite and not negative, received {value}"
                )
        for name in ("continuous_ka", "emergency_ka"):
            for branch, value in getattr(self, name).items():
                if not 0 < value < np.inf:
                    raise ParameterError(
                        f"transfer limit: {name} of branch {branch!r} must be positive and "
                        f"finite, received {value}; leave out branches without a limit"
                    )
