"""Whether the residuals of least squares are noise, and which measurement is wrong if not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from pse_analysis.arrays import FloatArray

CRITICAL = 1e-5
"""Share of a row's variance in its residual below which nothing else sees what it measures."""
ALIKE = 1e-3
"""Relative difference of normalised residuals that tells no two measurements apart."""


class Residuals(NamedTuple):
    """Residuals of a least-squares estimate.

    Attributes
    ----------
    objective : float
        Sum of the squared whitened residuals.
    dof : int
        Its degrees of freedom.
    deviation : (m,) ndarray
        σ of each residual, at least a thousandth of the measurement's own. [p.u., rad]
    normalised : (m,) ndarray
        Residuals in units of it; 0 where nothing was measured, and for critical measurements, whose
        residual is zero whatever they say.
    """

    objective: float
    dof: int
    deviation: FloatArray
    normalised: FloatArray

    @classmethod
    def of(
        cls,
        objective: float,
        dof: int,
        residual: FloatArray,
        sigma: FloatArray,
        explained: FloatArray,
    ) -> Residuals:
        """Returns the residuals of an estimate, given the variance that it gives each row.

        Parameters
        ----------
        objective : float
        dof : int
        residual : (m,) ndarray
            z - h(x); NaN where nothing was measured. [p.u., rad]
        sigma : (m,) ndarray
            Of the measurements.
        explained : (m,) ndarray
            Diagonal of J (JᵀR⁻¹J)⁻¹ Jᵀ.
        """
        left = np.maximum(sigma**2 - explained, 0.0)
        deviation = np.sqrt(np.maximum(left, (1e-3 * sigma) ** 2))
        seen = np.isfinite(residual) & (left > CRITICAL * sigma**2)
        return cls(objective, dof, deviation, np.where(seen, residual / deviation, 0.0))


def contradiction(residuals: Residuals, channel: tuple[str, ...], confidence: float) -> str:
    """Returns what is wrong with the residuals, and which measurement explains it, or "".

    Parameters
    ----------
    residuals : Residuals
    channel : tuple of str, length m
        What the measurements are called.
    confidence : float
        Least share of the snapshots without gross errors that pass.

    Returns
    -------
    str
        "" if the residuals pass.

    Notes
    -----
    Of the 1 - confidence that may fail without reason, one half goes to the exact χ² test of the
    objective, the other one to the largest normalised residual, by Bonferroni's inequality: χ² of
    hundreds of measurements does not see one of them that is 8 σ off. Without a row the objective
    is less by the square of its normalised residual, with one degree of freedom less.
    """
    objective, dof = residuals.objective, residuals.dof
    if dof == 0:
        return ""
    half = 0.5 * (1.0 - confidence)
    size = np.abs(residuals.normalised)
    largest = float(size.max(initial=0.0))
    bound = special.chdtri(dof, half)
    most = -special.ndtri(0.5 * half / max(int(np.count_nonzero(size)), 1))
    if objective <= bound and largest <= most:
        return ""
    text = (
        f"the measurements contradict each other: χ² is {objective:.1f} with {dof} degrees of "
        f"freedom (passes up to {bound:.1f}), the largest normalised residual is {largest:.1f} "
        f"(passes up to {most:.1f})"
    )
    rest = special.chdtri(dof - 1, half) if dof > 1 else 0.0
    alike = np.flatnonzero(size > (1.0 - ALIKE) * largest)
    if dof == 1 or not largest:
        return f"{text}; with one measurement to spare nothing tells which is wrong"
    if objective - largest**2 > rest:
        return f"{text}; no single measurement explains it"
    names = [channel[row] for row in alike[:4]] + (["…"] if len(alike) > 4 else [])
    return f"{text}; without {' or '.join(names)} the others agree"
