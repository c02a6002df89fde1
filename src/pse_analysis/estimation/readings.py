"""Rows of a snapshot in their frames: their innovation, what they gain, and what they leave.

The moments of the functionals that rows read do not depend on the frames; rows turn and scale them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import blas, lapack

from pse_analysis.estimation.lagged import Expected, turned, turned_rows

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]


class Readings(NamedTuple):
    """What rows read of the state, whatever their frames.

    Attributes
    ----------
    group : (r,) ndarray of int
        Functional of each row; both halves of a phasor or power read the same one.
    expected : Expected
        Moments of the functionals.
    plane : (2k, 2N) ndarray
        The functionals.
    moving : (k, k) ndarray or 1
        Share of Q in the covariance of the functionals.
    """

    group: IntArray
    expected: Expected
    plane: FloatArray
    moving: FloatArray | float


class Innovation(NamedTuple):
    """η of rows at a voltage, with the lower Cholesky factor of S and L⁻¹η."""

    turn: ComplexArray
    eta: FloatArray
    sigma: FloatArray
    chol_S: FloatArray
    white: FloatArray


def innovation_of(
    readings: Readings, turn: ComplexArray, z: FloatArray, spread: FloatArray
) -> Innovation:
    """Innovation of rows in their frames.

    Raises
    ------
    numpy.linalg.LinAlgError
        If S is not positive definite.
    """
    group, expected = readings.group, readings.expected
    k = len(expected.mean) // 2
    eta = z - turn.real * expected.mean[group] - turn.imag * expected.mean[k + group]
    S = turned(expected.own, turn, group)
    diagonal = S.reshape(-1)[:: len(S) + 1]
    diagonal += spread**2
    variance = diagonal.copy()
    # A symmetric matrix is its own transpose in the order that LAPACK reads.
    chol_S, failed = lapack.dpotrf(S.T, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the innovation's covariance is not positive definite")
    white, _ = lapack.dtrtrs(chol_S, eta, lower=1)
    return Innovation(turn, eta, np.sqrt(variance), chol_S, white)


def gained(readings: Readings, innovation: Innovation) -> FloatArray:
    """K η = Cᵀ Tᵀ S⁻¹ η, where T turns functionals into rows and C is their covariance with x."""
    group, expected = readings.group, readings.expected
    k = len(expected.mean) // 2
    weight, _ = lapack.dtrtrs(innovation.chol_S, innovation.white, lower=1, trans=1)
    turn = innovation.turn
    carried = np.concatenate(
        [np.bincount(group, turn.real * weight, k), np.bincount(group, turn.imag * weight, k)]
    )
    return np.asarray(carried @ expected.cross)


def conditioned(P: FloatArray, readings: Readings, innovation: Innovation) -> FloatArray:
    """P - K S Kᵀ = P - X Xᵀ with X = Cᵀ Tᵀ L⁻ᵀ, a symmetric product, in the place of P."""
    group, expected = readings.group, readings.expected
    cross = turned_rows(expected.cross, innovation.turn, group)
    X = blas.dtrsm(1.0, innovation.chol_S, cross.T, side=1, lower=1, trans_a=1, overwrite_b=1)
    P -= X @ X.T  # a product with its own transpose is exactly symmetric
    return P


def responses(
    shapes: tuple[FloatArray, ...], readings: Readings, innovation: Innovation
) -> FloatArray:
    """L⁻¹ D_k L⁻ᵀ of rows in their frames, where D_k = ∂S/∂θ_k. (c, m, m)"""
    group, moving = readings.group, readings.moving
    if isinstance(moving, np.ndarray):
        moving = moving[group[:, None], group]
    out = []
    for half in shapes:
        rows = turned_rows(readings.plane @ half, innovation.turn, group)
        left, _ = lapack.dtrtrs(innovation.chol_S, moving * (rows @ rows.T), lower=1)
        out.append(lapack.dtrtrs(innovation.chol_S, left.T, lower=1)[0])
    return np.array(out)
