"""What a measured |I| says across the current's direction, where the current is small."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import FloatArray, IntArray
from pse_analysis.estimation.core.normal import NormalEquations
from pse_analysis.measurement import IA, IM, MeasurementModel
from pse_analysis.measurement.layout import metered_bus

SMALL = 10.0
"""Current, in units of σ, below which its direction counts as hardly known."""
LEAST = 1e-3
"""Current, in units of σ, below which its curvature grows no more."""


class Curved(NamedTuple):
    """Rows of a step; those across the currents come after the layout's own.

    Attributes
    ----------
    weight, white : (m + k,) ndarray
        Weights, and residuals times weights.
    sign : (m + k,) ndarray
        -1 for a row whose curvature is negative: the current is smaller than was measured.
    """

    weight: FloatArray
    white: FloatArray
    sign: FloatArray

    @property
    def convex(self) -> Curved:
        """The rows without those of negative curvature."""
        return self._replace(
            weight=np.where(self.sign < 0, 0.0, self.weight), sign=np.ones(len(self.sign))
        )


class SmallCurrents:
    """Rows that let a step of Gauss-Newton see how |I| bends near zero current.

    Every row of |I| gets a row across it: the derivative of the angle of I against the voltage at
    the meter, times |I|. Its residual is zero, so it moves no estimate: it holds back a step that
    would turn the current instead of changing its size.

    Parameters
    ----------
    model : MeasurementModel

    Notes
    -----
    In the plane of the current as the voltage sees it, (|I| - z)²/2 has the curvature 1 along I and
    1 - z/|I| across, of which Gauss-Newton takes the first only.
    """

    def __init__(self, model: MeasurementModel) -> None:
        self._layout = model
        self.rows = np.flatnonzero(model.layout.quantity == IM)

    @cached_property
    def model(self) -> MeasurementModel:
        """The layout's rows, and after them those across the currents."""
        across = self._layout.layout.take(self.rows)
        across = replace(across, quantity=np.full(len(self.rows), IA))
        return MeasurementModel(
            self._layout.network, self._layout.layout.joined(across), self._layout.columns
        )

    @cached_property
    def equations(self) -> NormalEquations:
        """Normal equations of all these rows."""
        return NormalEquations(self.model)

    @cached_property
    def _own_angle(self) -> IntArray:
        """Entries of the angle of the metered voltage in the rows across; none if it is fixed."""
        own = self._layout
        place = np.full(2 * own.network.n_bus, -1)
        place[own.columns] = np.arange(len(own.columns))
        position, side = own.layout.position[self.rows], own.layout.side[self.rows]
        asked = np.full(self.model.shape[0], -1)
        asked[len(own.layout) :] = place[metered_bus(own.network, position, side)]
        return np.flatnonzero(self.model.indices == asked[self.model.row_of_entry])

    def jacobian_data(self, x: FloatArray) -> FloatArray:
        """Returns the entries of the Jacobian of the layout's rows and those across. (nnz,)"""
        data = self.model.jacobian_data(x)
        data[self._own_angle] -= 1.0
        return data

    def curved(self, weight: FloatArray, residual: FloatArray, z: FloatArray) -> Curved | None:
        """Returns what the rows weigh where currents are small; None if none of them is.

        Parameters
        ----------
        weight, residual, z : (m,) ndarray
            1/σ, z - h(x) and z of the layout's rows. [p.u., rad]
        """
        own, reading = weight[self.rows], z[self.rows]
        current = reading - residual[self.rows]
        small = (own > 0) & (own * current < SMALL)
        if not small.any():
            return None
        size = np.maximum(current, LEAST / np.where(own > 0, own, 1.0))
        bend = np.where(small, 1.0 - reading / size, 0.0)
        return Curved(
            np.concatenate([weight, own * current * np.sqrt(np.abs(bend))]),
            np.concatenate([weight * residual, np.zeros(len(self.rows))]),
            np.concatenate([np.ones(len(weight)), np.where(bend < 0, -1.0, 1.0)]),
        )
