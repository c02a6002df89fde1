"""States to start least squares from when no estimate is at hand."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import NotConverged
from pse_analysis.grid.dc import DcPowerFlow
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, IA, IM, VA, VM, P, RectangularModel, SensorLayout

MOST = 10
"""Iterations of the power flow that gives the nominal state; more are not worth their time."""
BELIEVABLE = (0.5, 1.5)
"""Measured |V| outside of which it is no start. [p.u.]"""


class ColdStart:
    """States to start from, for one sensor layout.

    Parameters
    ----------
    network : Network
    layout : SensorLayout
    """

    def __init__(self, network: Network, layout: SensorLayout) -> None:
        self.network, self.layout = network, layout
        self._current = np.isin(layout.quantity, (IM, IA))
        self._injection = np.flatnonzero((layout.quantity == P) & (layout.side == BUS))
        self._magnitude = np.flatnonzero(layout.quantity == VM)
        self._angle = np.flatnonzero(layout.quantity == VA)

    def flat(self) -> FloatArray:
        """Returns [θ; |V|] with rated voltage and no angle but that of phase shifters. (2N,)"""
        return np.concatenate([self.network.resting_angle_rad, np.ones(self.network.n_bus)])

    def states(self, z: FloatArray, sigma: FloatArray, rows: BoolArray) -> Iterator[FloatArray]:
        """Yields the states that are worth a try, the likeliest first.

        Parameters
        ----------
        z, sigma : (m,) ndarray
            Measurements and their σ. [p.u., rad]
        rows : (m,) ndarray of bool
            Rows that are available.

        Yields
        ------
        (2N,) ndarray
            [θ; |V|]: nominal and turned to what was measured, flat, linear where there are
            currents, and by DC power flow.
        """
        yield self.measured(z, rows, self.nominal)
        yield self.flat()
        if (self._current & rows).any():
            yield self.linear(z, sigma, rows)
        yield self.measured(z, rows, self._linear_flow)

    @cached_property
    def _dc(self) -> DcPowerFlow:
        return DcPowerFlow(self.network)

    @cached_property
    def _linear_flow(self) -> FloatArray:
        """[θ; |V|] by DC power flow at nominal injections, with rated voltage. (2N,)"""
        angle = self._dc.angles(self.network.p_nominal_pu)
        return np.concatenate([angle, np.ones(self.network.n_bus)])

    @cached_property
    def nominal(self) -> FloatArray:
        """[θ; |V|] by power flow at nominal injections, or by DC power flow without one. (2N,)"""
        try:
            return solve(self.network, own_references=True, max_iterations=MOST).x
        except NotConverged:
            return self._linear_flow

    def measured(self, z: FloatArray, rows: BoolArray, nominal: FloatArray) -> FloatArray:
        """Returns a nominal state, moved to what was measured.

        Magnitudes are measured where they are, angles follow the difference between measured and
        nominal injections by DC power flow, and those of an island are turned as a whole to the
        angles that were measured there.
        """
        n, start = self.network.n_bus, nominal.copy()
        change = np.zeros(n)
        read = self._injection[rows[self._injection]]
        bus = self.layout.position[read]
        change[bus] = z[read] - self.network.p_nominal_pu[bus]
        start[:n] += self._dc.angles(change) - self._dc.angles(np.zeros(n))
        read = self._magnitude[rows[self._magnitude]]
        read = read[(z[read] > BELIEVABLE[0]) & (z[read] < BELIEVABLE[1])]
        start[n + self.layout.position[read]] = z[read]
        read = self._angle[rows[self._angle]]
        bus, reference = self.layout.position[read], self.network.references
        turn = np.zeros(n, dtype=np.complex128)
        np.add.at(turn, reference[bus], np.exp(1j * (z[read] - start[bus])))
        start[:n] += np.angle(np.where(turn == 0, 1.0, turn))[reference]
        return start

    @cached_property
    def _rectangular(self) -> RectangularModel:
        return RectangularModel(self.network, self.layout)

    def linear(self, z: FloatArray, sigma: FloatArray, rows: BoolArray) -> FloatArray:
        """Returns [θ; |V|] by linear least squares from rated voltage, which unmeasured parts keep.

        A current has no tangent in polar coordinates where it vanishes, as it does at rated
        voltage; in rectangular ones its phasor is linear. Half a phasor is left out.
        """
        n = self.network.n_bus
        linear = self._rectangular
        resting = np.exp(1j * self.network.resting_angle_rad)
        H, target, spread = linear.rows(z, sigma, rows, resting)
        read = rows & (~self._current | linear.paired(rows))
        weight = np.where(read, 1.0 / np.where(read, spread, 1.0), 0.0)
        whitened = sparse.csr_array(sparse.diags_array(weight) @ H)
        rated = np.concatenate([resting.real, resting.imag])
        # A prior of σ = 1 p.u. makes the gain regular and moves what is measured next to nothing.
        gain = sparse.csc_array(whitened.T @ whitened + sparse.eye_array(2 * n))
        x = rated + sparse_linalg.splu(gain).solve(
            whitened.T @ (weight * np.where(read, target, 0.0) - whitened @ rated)
        )
        voltage = x[:n] + 1j * x[n:]
        if not (self.layout.angular & rows).any():
            voltage = voltage * np.exp(-1j * np.angle(voltage[self.network.slack]))
        if (np.abs(voltage) < 0.1).any():
            return self.flat()
        return np.concatenate([np.angle(voltage), np.abs(voltage)])
