"""Which measurements of a snapshot contradict the forecast, and how far they are believed.

A gate decides whether a snapshot holds a gross error at all; then the noise of what contradicts is
inflated, of every channel alike (`trace`, the form of [qu2018]) or of those that are wrong
(`per_channel`). Neither can tell a wrong meter from a wrong forecast: a filter that refuses the
same channels again and again doubts its forecast (`Protection`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy import linalg, stats
from scipy.linalg import lapack

from pse_analysis.errors import ParameterError

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

CONFIDENCE = 0.999
"""Share of snapshots without gross errors that pass the gate of a perfectly tuned filter."""
MARGIN = 9.0
"""g: squared deviation, in units of its variance, up to which a channel is fully believed."""


@dataclass(frozen=True, eq=False)
class Suspicion:
    """An innovation, and the covariance S that it should have.

    Attributes
    ----------
    innovation : (m,) ndarray
        η. [p.u., rad]
    variance : (m,) ndarray
        S_ii.
    noise : (m,) ndarray
        R_ii.
    chol_S : (m, m) ndarray
        Lower Cholesky factor of S; what stands above the diagonal does not count.
    nis : float
        ηᵀS⁻¹η.
    """

    innovation: FloatArray
    variance: FloatArray
    noise: FloatArray
    chol_S: FloatArray
    nis: float


Judge = Callable[[Suspicion], FloatArray]
"""Inflation φ (m,) of the noise, R_ii → (1 + φ_i) R_ii; all zero where nothing is contradicted."""


def none(found: Suspicion) -> FloatArray:
    """Believe everything."""
    return np.zeros(len(found.innovation))


@cache
def gate(dof: int) -> tuple[float, float]:
    """Bounds of ηᵀS⁻¹η and of the largest η_i²/S_ii, each passed by `CONFIDENCE` of good snapshots.

    The second one sees a single error among many channels, which the sum hides.
    """
    return (
        float(stats.chi2.ppf(CONFIDENCE, dof)),
        float(stats.chi2.ppf(1.0 - (1.0 - CONFIDENCE) / max(dof, 1), 1)),
    )


def trace(found: Suspicion) -> FloatArray:
    """One factor for all channels, φ = max(0, (ηᵀη - tr S)/tr R), if the gate is passed.

    Notes
    -----
    Eqs. (32) and (33) of [qu2018]. Without the gate a perfectly tuned filter would inflate its
    noise half of the time.
    """
    if found.nis <= gate(len(found.innovation))[0]:
        return np.zeros(len(found.innovation))
    excess = found.innovation @ found.innovation - found.variance.sum()
    return np.full(len(found.innovation), max(0.0, float(excess / found.noise.sum())))


class _Others:
    """What the forecast and all other channels say about each channel, under S + diag(φR).

    The suspects' rows are all in which that matrix differs from S, so that one triangular inverse
    of chol(S) serves every φ: it gives single entries of the inverse, no gain.
    """

    def __init__(self, found: Suspicion) -> None:
        self._found = found
        half, _ = lapack.dtrtri(found.chol_S, lower=1)
        self._half = np.tril(half)
        self._weighted = self._half.T @ (self._half @ found.innovation)
        self._precision = np.einsum("ij,ij->j", self._half, self._half)

    def __call__(self, inflation: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Squared deviation e² and its variance v by channel, and ηᵀ(S + φR)⁻¹η."""
        eta, noise = self._found.innovation, self._found.noise
        precision, weighted = self._precision, self._weighted
        suspect = np.flatnonzero(inflation)
        if len(suspect):
            columns = self._half.T @ self._half[:, suspect]
            core = columns[suspect] + np.diag(1.0 / (inflation[suspect] * noise[suspect]))
            right = np.column_stack([columns.T, weighted[suspect]])
            chol = linalg.cholesky(core, lower=True, check_finite=False)
            solved = linalg.solve_triangular(chol, right, lower=True, check_finite=False)
            across, drawn = solved[:, :-1], solved[:, -1]
            precision = precision - np.einsum("ij,ij->j", across, across)
            weighted = weighted - drawn @ across
        return (
            (weighted / precision) ** 2,
            1.0 / precision - inflation * noise,
            float(weighted @ eta),
        )


def per_channel(found: Suspicion) -> FloatArray:
    """A factor for every channel, which names the wrong ones.

    Returns
    -------
    (m,) ndarray
        φ_i = max(0, e_i² - g v_i)/R_ii. At first e = η and v = diag S. The gate is then closed
        again on what is left: e_i is now the deviation of channel i from what the forecast *and
        all other channels*, with their inflated noise, say, and v_i the variance of that. Suspects
        that the others confirm are cleared; and as long as the snapshot does not pass the gate,
        the channel that deviates most is named as well, one at a time, because a wrong channel
        makes its neighbours look wrong too.

    Notes
    -----
    With S' = S + diag(φR): e_i = (S'⁻¹η)_i/(S'⁻¹)_ii and v_i = 1/(S'⁻¹)_ii - φ_i R_i.
    """
    eta, noise = found.innovation, found.noise
    total, largest = gate(len(eta))
    if found.nis <= total and (eta**2 <= largest * found.variance).all():
        return np.zeros(len(eta))
    others = _Others(found)
    inflation = np.maximum(0.0, eta**2 - MARGIN * found.variance) / noise
    square, variance, nis = others(inflation)
    confirmed = (inflation > 0) & (square < MARGIN * variance)
    if confirmed.any():
        inflation[confirmed] = 0.0
        square, variance, nis = others(inflation)
    for _ in range(len(eta)):
        excess = np.where(inflation > 0, 0.0, square / variance)
        worst = int(np.argmax(excess))
        if nis <= total or excess[worst] <= MARGIN:
            break
        inflation[worst] = (square[worst] - MARGIN * variance[worst]) / noise[worst]
        square, variance, nis = others(inflation)
    return inflation


JUDGES: dict[str, Judge] = {"none": none, "trace": trace, "per_channel": per_channel}


@dataclass(frozen=True)
class Protection:
    """When a filter doubts its forecast rather than its meters.

    Attributes
    ----------
    patience : int
        Consecutive refusals after which a channel counts as stuck.
    share : float
        Share of the channels that must be stuck.
    sigma : float
        Standard deviation by which the forecast is then widened. [p.u., rad]
    """

    patience: int = 3
    share: float = 0.04
    sigma: float = 0.05

    def __post_init__(self) -> None:
        if self.patience < 1 or not 0 < self.share <= 1 or self.sigma <= 0:
            raise ParameterError(
                "protection: expected patience ≥ 1, 0 < share ≤ 1 and sigma > 0, received "
                f"{self.patience}, {self.share}, {self.sigma}"
            )

    def latched(self, refusals: IntArray, used: BoolArray) -> bool:
        """Whether too many of the used channels have been refused too often.

        Parameters
        ----------
        refusals : (m,) ndarray of int
            Consecutive refusals of each channel.
        used : (m,) ndarray of bool
        """
        stuck = int(np.count_nonzero(refusals[used] >= self.patience))
        return stuck >= max(2.0, self.share * np.count_nonzero(used))

    def widening(self, refusals: IntArray) -> float:
        """Variance to add to every voltage; it grows while most channels stay refused.

        Meters that are wrong for good refuse to agree as well, but they are few.
        """
        in_vain = float(np.median(refusals)) // self.patience
        return float((self.sigma * max(1.0, in_vain)) ** 2)
