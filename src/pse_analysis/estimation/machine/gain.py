"""Observer gains of a machine: Kalman–Bucy by densities, Luenberger by poles, one call for both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg, signal

from pse_analysis.arrays import ComplexArray, FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.machine import Densities, Machine, sample

RANK_TOLERANCE = 1e-9
"""Singular values below this share of the largest count as zero."""


class Finding(NamedTuple):
    """One condition that does not hold: which, why, and what to do."""

    condition: str
    why: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.condition} does not hold: {self.why}; {self.remedy}"


@dataclass(frozen=True)
class Poles:
    """Luenberger observer: where the poles of the error shall lie.

    Attributes
    ----------
    poles : (2,) tuple of complex
        Roots of det(sI - A - LC), distinct and with negative real parts. [1/s]
    """

    poles: tuple[complex, complex]


Tuning = Densities | Poles
"""What an observer is designed from. Densities need not be the true ones: Q and R as weights of
trust are the linear-quadratic estimator, as true densities the Kalman–Bucy filter."""


def findings(A: FloatArray, C: FloatArray, Q: FloatArray, R: FloatArray) -> list[Finding]:
    """Which conditions of a stabilising solution of the Riccati equation fail.

    Parameters
    ----------
    A : (n, n) array
    C : (m, n) array
    Q : (n, n) array
    R : (m, m) array

    Returns
    -------
    list of Finding
        Empty if Q ⪰ 0, R ≻ 0, (C, A) is detectable and (A, Q^½) is stabilisable.

    Notes
    -----
    The paper asks for (A, B) stabilisable; it is the disturbance, not the input, that has to reach
    every mode which does not die out by itself. Popov–Belevitch–Hautus test per mode.
    """
    A, C, Q, R = (np.atleast_2d(np.asarray(M, dtype=float)) for M in (A, C, Q, R))
    n, m = A.shape[0], C.shape[0]
    for name, M, shape in (("A", A, (n, n)), ("C", C, (m, n)), ("Q", Q, (n, n)), ("R", R, (m, m))):
        if M.shape != shape or not np.isfinite(M).all():
            raise ParameterError(
                f"{name} must be finite with shape {shape}, received shape {M.shape}: A is (n, n), "
                "C (m, n), Q (n, n), R (m, m)"
            )
    found = []
    for name, M, strict in (("Q", Q, False), ("R", R, True)):
        least = float(linalg.eigvalsh(0.5 * (M + M.T))[0])
        symmetric = np.allclose(M, M.T, rtol=1e-12, atol=0.0)
        floor = RANK_TOLERANCE * float(np.abs(M).max())
        if not symmetric or (least <= floor if strict else least < -floor):
            why = f"its least eigenvalue is {least:.4g}" if symmetric else "it is not symmetric"
            what = "the measurement's noise" if strict else "the disturbances"
            found.append(
                Finding(
                    f"{name} {'≻' if strict else '⪰'} 0",
                    why,
                    f"give {name} as the {'positive' if strict else 'non-negative'} densities of "
                    f"{what}",
                )
            )
    root = _root(Q)
    for pole in np.unique(np.round(linalg.eigvals(A), 12)):
        if pole.real < -RANK_TOLERANCE * max(1.0, float(np.abs(A).max())):
            continue
        shifted = A - pole * np.eye(n)
        mode = f"the mode at s = {pole:.4g} does not die out and"
        if _rank(np.vstack([shifted, C])) < n:
            found.append(
                Finding(
                    "(C, A) detectable",
                    f"{mode} C = {C.tolist()} does not see it",
                    "measure the rotor angle θ: the speed alone does not tell the angle",
                )
            )
        if _rank(np.hstack([shifted, root])) < n:
            found.append(
                Finding(
                    "(A, Q^½) stabilisable",
                    f"{mode} Q = {Q.tolist()} does not disturb it, so that the gain would fade to "
                    "zero and the estimate would drift",
                    "give the speed a density above 0 (Q[1, 1] > 0)",
                )
            )
    return found


def require_solvable(A: FloatArray, C: FloatArray, Q: FloatArray, R: FloatArray) -> None:
    """Refuse what `findings` finds.

    Raises
    ------
    ParameterError
        With every condition that fails, why, and what to do.
    """
    found = findings(A, C, Q, R)
    if found:
        raise ParameterError(
            "no stabilising observer gain: " + "; ".join(str(finding) for finding in found)
        )


def continuous_gain(machine: Machine, tuning: Tuning) -> FloatArray:
    """Gain L of x̂′ = A x̂ + B u + L (C x̂ - y), eq. (4) of [frolov2025].

    Parameters
    ----------
    machine : Machine
    tuning : Densities or Poles

    Returns
    -------
    (2, 1) ndarray
        L = -P Cᵀ R⁻¹ with P of eq. (6), or the gain that places the poles. [1/s, 1/s²]

    Raises
    ------
    ParameterError
        If the Riccati equation has no stabilising solution, or the poles cannot be placed.
    """
    A, C = machine.A, machine.C
    if isinstance(tuning, Poles):
        return _place(A, C, _checked_poles(tuning), discrete=False)
    require_solvable(A, C, tuning.Q, tuning.R)
    P = linalg.solve_continuous_are(A.T, C.T, tuning.Q, tuning.R)
    return np.asarray(-linalg.solve(tuning.R, C @ P, assume_a="pos").T)


def gain_without_damping(ratio: float) -> FloatArray:
    """L = -[√(a + 2√a); √a] at K_d = 0 and Q = a·R·I: only the ratio matters.

    Parameters
    ----------
    ratio : float
        a = Q/R.

    Returns
    -------
    (2, 1) ndarray
    """
    root = np.sqrt(ratio)
    return -np.array([[np.sqrt(ratio + 2.0 * root)], [root]])


def discrete_gain(machine: Machine, tuning: Tuning, step_s: float) -> FloatArray:
    """Gain K of the discrete equivalent x̂ = x̂⁻ + K (y - C x̂⁻), x̂⁻ = F x̂ + G u.

    Parameters
    ----------
    machine : Machine
    tuning : Densities or Poles
        Densities are sampled with the machine; poles p become e^{ph}.
    step_s : float
        h. [s]

    Returns
    -------
    (2, 1) ndarray
        K/h → -L as h → 0, with an error of first order in h.

    Raises
    ------
    ParameterError
        As `continuous_gain`.
    """
    A, C = machine.A, machine.C
    if isinstance(tuning, Poles):
        poles = np.exp(_checked_poles(tuning) * step_s)
        F = linalg.expm(A * step_s)
        return -_place(F, C @ F, poles, discrete=True)
    require_solvable(A, C, tuning.Q, tuning.R)
    step = sample(machine, tuning, step_s)
    P = linalg.solve_discrete_are(step.F.T, C.T, step.Q, step.R)
    return filter_gain(P, C, step.R)


def filter_gain(P: FloatArray, C: FloatArray, R: FloatArray) -> FloatArray:
    """K = P⁻ Cᵀ S⁻¹ of a predicted covariance P⁻."""
    S = C @ P @ C.T + R
    return np.asarray(linalg.solve(S, C @ P, assume_a="pos").T)


def _place(A: FloatArray, C: FloatArray, poles: ComplexArray, *, discrete: bool) -> FloatArray:
    try:
        placed = signal.place_poles(A.T, C.T, poles)
    except ValueError as error:
        raise ParameterError(
            f"poles {poles.tolist()} cannot be placed ({error}); a single output needs distinct "
            "poles, or a conjugate pair"
        ) from error
    reached = np.sort_complex(linalg.eigvals(A - placed.gain_matrix.T @ C))
    if not np.allclose(reached, np.sort_complex(poles), rtol=1e-6, atol=1e-9):
        where = "of the sampled error" if discrete else "of the error"
        raise ParameterError(
            f"poles {where} would lie at {reached.tolist()} instead of {poles.tolist()}: move them "
            "apart"
        )
    return np.asarray(-placed.gain_matrix.T)


def _checked_poles(tuning: Poles) -> ComplexArray:
    poles = np.asarray(tuning.poles, dtype=complex)
    closed = np.allclose(np.sort_complex(poles), np.sort_complex(poles.conj()))
    if poles.shape != (2,) or not closed or not (poles.real < 0).all():
        raise ParameterError(
            "[poles] expected two poles with negative real parts, both real or a conjugate pair; "
            f"received {list(tuning.poles)}"
        )
    if poles[0] == poles[1]:
        raise ParameterError(
            f"[poles] a single output cannot place a double pole robustly, received "
            f"{list(tuning.poles)}: move them apart, e.g. by 1 %"
        )
    return poles


def _root(Q: FloatArray) -> FloatArray:
    values, vectors = linalg.eigh(0.5 * (Q + Q.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _rank(M: ComplexArray | FloatArray) -> int:
    # Rows of unlike units: scale them, or a weak disturbance would look like none.
    size = np.abs(M).max(axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(M / np.where(size > 0, size, 1.0), tol=RANK_TOLERANCE))
