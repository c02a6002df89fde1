"""Which measurements of a snapshot contradict the forecast, and how far they are believed.

A gate decides whether a snapshot holds a gross error at all; then the noise of what contradicts is
inflated, of every channel alike (`trace`, the form of [qu2018]) or of those that are wrong
(`per_channel`). Neither can tell a wrong meter from a wrong forecast: a filter that refuses the
same channels again and again doubts its forecast (`Protection`), and one that refuses whole
snapshots again and again looks at the channels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import stats
from scipy.linalg import blas

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.bad_data.identification import Deletion
from pse_analysis.estimation.bad_data.innovation_test import Refuse
from pse_analysis.estimation.core.cholesky import Root, cleaned

CONFIDENCE = 0.999
"""Share of snapshots without gross errors that pass the gate of a perfectly tuned filter."""
FORGETTING = 1e8
"""A measurement with a gross error η that is to be left out gets the noise of so many η²."""
RAISE, MOST_RAISES = 4.0, 20
"""Factor by which φ is raised, and how often at most."""
GATE_SQ = 9.0
"""g: squared deviation, in units of its variance, up to which a channel is fully believed."""
MIN_CONFIRMED = 2
"""Fewest named channels that a wrong forecast is believed to have misled.

A movement is seen by several channels. A lone one that the forecast contradicts and few others
confirm is as often wrong, together with one of these.
"""
GROSS_ERROR_SIGMAS = 6.0
"""Deviation, in units of its σ, from which a reading is no noise whatever the others say."""


@dataclass(frozen=True, eq=False)
class InnovationStats:
    """An innovation, and the covariance S that it should have.

    Attributes
    ----------
    innovation : (m,) ndarray
        η. [p.u., rad]
    variance : (m,) ndarray
        S_ii.
    noise : (m,) ndarray
        R_ii.
    white : (m,) ndarray
        L⁻¹η, S = L Lᵀ.
    root : Root
        L.
    alone : (j,) ndarray of int -> Deletion, optional
        What the snapshot without the forecast says about some measurements.
    """

    innovation: FloatArray
    variance: FloatArray
    noise: FloatArray
    white: FloatArray
    root: Root
    alone: Callable[[IntArray], Deletion] | None = None

    @property
    def nis(self) -> float:
        """ηᵀS⁻¹η."""
        return float(self.white @ self.white)


GrossErrorTest = Callable[[InnovationStats], FloatArray]
"""Inflation φ (m,) of the noise, R_ii → (1 + φ_i) R_ii; all zero where nothing is contradicted."""


def none(found: InnovationStats) -> FloatArray:
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


def trace(found: InnovationStats) -> FloatArray:
    """One factor for all channels, φ = max(0, (ηᵀη - tr S)/tr R), if the gate is passed.

    Notes
    -----
    Eqs. (32) and (33) of [qu2018]. Without the gate a perfectly tuned filter would inflate its
    noise half of the time. The traces add p.u. and rad, and where a loose forecast of the powers
    fills tr S, the print finds nothing to inflate although a channel is off by
    `GROSS_ERROR_SIGMAS`: φ is then raised until the snapshot passes the gate.
    """
    m = len(found.innovation)
    bound = gate(m)[0]
    if found.nis <= bound:
        return np.zeros(m)
    excess = found.innovation @ found.innovation - found.variance.sum()
    phi = max(0.0, float(excess / found.noise.sum()))
    if (found.innovation**2 <= GROSS_ERROR_SIGMAS**2 * found.variance).all():
        return np.full(m, phi)
    for _ in range(MOST_RAISES):
        if _passes(found, phi, bound):
            break
        phi = RAISE * max(phi, 1.0)
    return np.full(m, phi)


def _passes(found: InnovationStats, phi: float, bound: float) -> bool:
    """Whether ηᵀ(S + φR)⁻¹η is within a bound.

    Conjugate gradients close in on it from below, and S ≥ R says by how much they may be short: a
    few products instead of a factorisation.
    """
    scale = found.variance + phi * found.noise
    least = (1.0 + phi) * found.noise
    left, value = found.innovation, 0.0
    step = left / scale
    size = float(left @ step)
    for _ in range(len(left)):
        through = blas.dtrmv(found.root.chol, step, lower=1, trans=1)
        image = blas.dtrmv(found.root.chol, through, lower=1) + phi * found.noise * step
        length = size / float(step @ image)
        value += length * size
        left = left - length * image
        if value > bound or value + float(left @ (left / least)) <= bound:
            break
        before, size = size, float(left @ (left / scale))
        step = left / scale + (size / before) * step
    return value <= bound


def per_channel(found: InnovationStats) -> FloatArray:
    """A factor for every channel, which names the wrong ones.

    Returns
    -------
    (m,) ndarray
        φ_i = max(0, b_i² - g v_i)/R_i for the channels that are named, where b_i is how far one is
        off what the forecast and all channels that are believed say of it, and v_i the variance
        that this should have; zero for the others.

    Notes
    -----
    Beyond [qu2018]. The search (`Deletion.search`) starts from all that the forecast alone does not
    fully believe, which a gross error elsewhere cannot hide, and ends where no channel is worth
    leaving out, taking back or exchanging, at the price of the gate's bound on one channel. Then
    a named channel is confirmed if the rest of the snapshot *without the forecast* agrees with it
    and rules out its estimated error, and not that channel alone (`MIN_CONFIRMED`). So a movement
    of the load that many channels see is taken for one, whatever little the process noise allows.
    """
    eta, noise = found.innovation, found.noise
    total, largest = gate(len(eta))
    if found.nis <= total and (eta**2 <= largest * found.variance).all():
        return np.zeros(len(eta))
    # Of S⁻¹ only the diagonal and a few columns are asked for.
    weighted = blas.dtrsv(found.root.chol, found.white, lower=1, trans=1)
    deletion = Deletion(weighted, found.root.precision(), found.root.precision_columns, found.nis)
    named = np.flatnonzero(deletion.search(eta**2 > GATE_SQ * found.variance, largest))
    error, variance = deletion.error_estimate(named)
    if len(named) and found.alone is not None:
        right = _confirmed_by_snapshot(found.alone(named), error, largest)
        if right.any():
            named = named[~right]
            error, variance = deletion.error_estimate(named)
    phi = np.zeros(len(eta))
    phi[named] = np.maximum(error**2 - GATE_SQ * variance, 0.0) / noise[named]
    return phi


def _confirmed_by_snapshot(alone: Deletion, error: FloatArray, price: float) -> BoolArray:
    """Returns which named channels the snapshot without the forecast confirms. (k,)

    ``error`` (k,) is the estimated error of each of them.
    """
    contradicted = alone.search(np.ones(len(error), dtype=bool), price, most=1.0)
    if contradicted.all():
        return ~contradicted
    left = alone.without(contradicted)
    confirmed = ~contradicted & (left.ratio < GATE_SQ)
    excluded = (left.error - error) ** 2 > price * left.variance
    both = np.asarray(confirmed & excluded)
    return both & (np.count_nonzero(both) >= MIN_CONFIRMED)


def left_out(refuse: Refuse) -> GrossErrorTest:
    """Test that leaves out the measurements that an innovation test refuses."""

    def judge(found: InnovationStats) -> FloatArray:
        chol = cleaned(found.root.chol.copy())
        refused = refuse(found.innovation, chol, np.sqrt(found.noise))
        return np.where(refused, FORGETTING * found.innovation**2 / found.noise, 0.0)

    return judge


GROSS_ERROR_TESTS: dict[str, GrossErrorTest] = {
    "none": none,
    "trace": trace,
    "per_channel": per_channel,
}


@dataclass(frozen=True)
class Protection:
    """When a filter doubts its forecast rather than its meters.

    Attributes
    ----------
    patience : int
        Consecutive refusals after which a channel counts as stuck. A snapshot that would be as many
        in a row to be refused as a whole is judged by channel instead.
    share : float
        Share of the channels that must be stuck.
    """

    patience: int = 3
    share: float = 0.02

    def __post_init__(self) -> None:
        if self.patience < 1 or not 0 < self.share <= 1:
            raise ParameterError(
                "protection: expected patience ≥ 1 and 0 < share ≤ 1, received "
                f"{self.patience}, {self.share}"
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

    def cause(self, refusals: IntArray) -> str:
        """Why a filter doubts its forecast, in words."""
        stuck = int(np.count_nonzero(refusals >= self.patience))
        return f"{stuck} of {len(refusals)} channels were refused {self.patience} times in a row"
