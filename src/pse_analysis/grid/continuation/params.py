"""How a curve is traced."""

from __future__ import annotations

from dataclasses import dataclass

from pse_analysis.errors import ParameterError


@dataclass(frozen=True)
class ContinuationParams:
    """How a curve is traced.

    Attributes
    ----------
    first_step, largest_step : float
        Largest change of an angle or a voltage from one point to the next. [rad, p.u.]
    past_nose : int
        Points traced past the nose.
    max_points : int
        Points after which a curve without a nose is given up.
    tolerance : float
        Largest mismatch of a point. [p.u.]
    enforce_q_limits : bool
        Let generators give up their voltage at their reactive limits, and take it up again.
    """

    first_step: float = 0.02
    largest_step: float = 0.1
    past_nose: int = 3
    max_points: int = 2000
    tolerance: float = 1e-9
    enforce_q_limits: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.first_step <= self.largest_step <= 1.0:
            raise ParameterError(
                "continuation: steps must satisfy 0 < first_step ≤ largest_step ≤ 1 rad or p.u., "
                f"received {self.first_step:g} and {self.largest_step:g}"
            )
        if self.past_nose < 0 or self.max_points < 2:
            raise ParameterError(
                "continuation: past_nose must be 0 at least and max_points 2, received "
                f"{self.past_nose} and {self.max_points}"
            )
        if not 1e-13 <= self.tolerance <= 1e-3:
            raise ParameterError(
                f"continuation: tolerance must lie in 1e-13 … 1e-3 p.u., received {self.tolerance}"
            )
