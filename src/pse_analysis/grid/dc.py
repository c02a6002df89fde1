"""The linear (DC) power flow: angles from active injections at rated voltage without losses."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.arrays import FloatArray
from pse_analysis.grid.network import Network


class DcPowerFlow:
    """Angles θ of B'θ = P - P_shift, where B' holds the branches' series susceptances.

    The matrix is factorised once per grid; the reference of each island has angle zero.

    Parameters
    ----------
    network : Network

    Notes
    -----
    A branch carries b (θ_from - θ_to - φ), b = Im(-y/t), as in MATPOWER's DC model but with the
    resistance counted: b = x/(r² + x²). A branch without reactance counts with 1/r.
    """

    def __init__(self, network: Network) -> None:
        n, branch = network.n_bus, network.branches
        closed = np.flatnonzero(branch.in_service)
        begin, end = branch.from_bus[closed], branch.to_bus[closed]
        impedance = branch.r_pu[closed] + 1j * branch.x_pu[closed]
        b = -(1.0 / impedance).imag
        b = np.where(b != 0, b, 1.0 / np.abs(impedance)) / branch.tap[closed]
        flow = b * branch.shift_rad[closed]
        self._shift_pu = np.bincount(end, flow, n) - np.bincount(begin, flow, n)
        every = np.concatenate([begin, end, begin, end])
        other = np.concatenate([begin, end, end, begin])
        matrix = sparse.coo_array((np.concatenate([b, b, -b, -b]), (every, other)), shape=(n, n))
        self._free = np.setdiff1d(np.arange(n), network.references)
        self._resting = network.resting_angle_rad
        self._factor: sparse_linalg.SuperLU | None = None
        if len(self._free):
            inner = sparse.csc_array(matrix.tocsr()[self._free][:, self._free])
            try:
                self._factor = sparse_linalg.splu(inner)
            except RuntimeError:  # exactly singular, as series capacitors may make it
                self._factor = None

    def angles(self, p_pu: FloatArray) -> FloatArray:
        """Returns the angles at given injections; those without load where B' is singular.

        Parameters
        ----------
        p_pu : (N,) or (N, n_state) ndarray
            Net active injections; those of the references are not read. [p.u.]

        Returns
        -------
        (N,) or (N, n_state) ndarray
            Angles against the reference of each island. [rad]
        """
        shape = (len(self._shift_pu), *p_pu.shape[1:])
        if self._factor is None:
            return np.broadcast_to(
                self._resting.reshape(-1, *([1] * (p_pu.ndim - 1))), shape
            ).copy()
        given = p_pu - self._shift_pu.reshape(-1, *([1] * (p_pu.ndim - 1)))
        angle = np.zeros(shape)
        angle[self._free] = self._factor.solve(np.ascontiguousarray(given[self._free]))
        return angle
