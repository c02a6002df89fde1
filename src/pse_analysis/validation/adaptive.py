"""Bad data by an adaptive threshold on each channel's own past, eqs. (20)–(24) of [qi2025].

Three thresholds:

``literal``
    ξ = σ_e² z̄ / σ_L² on |z - z₋₁|, with the square that eq. (22) lacks. It has the unit of z but is
    not invariant under shifts: levels below or near zero are always flagged.
``absolute``
    The same with |z̄|.
``scaled``
    ξ = c max(σ_e √(1 + x'(X'X)⁻¹x), 1.4826 median |r|) on the residual r of a line through the last
    four values; the root is 1.58 for that design.

What is flagged is replaced by the weighted mean of the window, eq. (24), and the replacement enters
the window. On a ramp that would latch a channel to old values for ever, so a run of more than
``release`` flagged samples that agree with each other becomes the window.

A step is a function of a state and one sample per channel; many at once are the same steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from pse_analysis.errors import ParameterError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

Threshold = Literal["literal", "absolute", "scaled"]

LINE = 4
"""Values that the local line runs through."""
_AHEAD = np.array([-0.5, 0.0, 0.5, 1.0])
"""Weights of the last four values in the value that their line predicts next."""
SPREAD_OF_LINE = float(np.sqrt(1.0 + _AHEAD @ _AHEAD))
"""√(1 + x'(X'X)⁻¹x) of that prediction, 1.58."""
MEMORY = 60
"""Residuals that the median is taken of."""
FEWEST = 6
"""Residuals below which there is no median, and the meter's own σ is all there is."""
MAD = 1.4826
"""σ of a normal law over its median absolute deviation."""


@dataclass(frozen=True)
class AdaptiveParams:
    """How a channel is compared with its own past.

    Attributes
    ----------
    threshold : {"scaled", "absolute", "literal"}
    window : int
        L_w, values of the window, the newest included.
    factor : float
        c of the ``scaled`` threshold.
    decay : float
        μ of the weights w_i = μ^(k-i) of a replacement.
    release : int
        A longer run of flagged samples that agree with each other is accepted.
    sigma_factor : float
        σ of a replacement over that of a sample.
    """

    threshold: Threshold = "scaled"
    window: int = 5
    factor: float = 4.0
    decay: float = 0.7
    release: int = 6
    sigma_factor: float = 3.0

    def __post_init__(self) -> None:
        if self.window < 4:
            raise ParameterError(f"adaptive: expected window ≥ 4, received {self.window}")
        if not (self.factor > 0 and 0 < self.decay <= 1 and self.sigma_factor >= 1):
            raise ParameterError(
                "adaptive: expected factor > 0, 0 < decay ≤ 1 and sigma_factor ≥ 1, received "
                f"{self.factor}, {self.decay} and {self.sigma_factor}"
            )
        if self.release < LINE:
            raise ParameterError(f"adaptive: expected release ≥ {LINE}, received {self.release}")


class AdaptiveState(NamedTuple):
    """The past of m channels; rows run from old to new, NaN where there is none yet.

    Attributes
    ----------
    values : (L, m) ndarray
        Accepted and replaced values.
    residuals : (MEMORY, m) ndarray
        |r| of accepted samples about their local line.
    suspects : (release + 1, m) ndarray
        Raw values of the present run of flagged samples.
    run, releases : (m,) ndarray of int
        Length of the run, and how often one was accepted.
    """

    values: FloatArray
    residuals: FloatArray
    suspects: FloatArray
    run: IntArray
    releases: IntArray

    @classmethod
    def empty(cls, m: int, params: AdaptiveParams) -> AdaptiveState:
        """State of m channels of which nothing is known."""
        return cls(
            np.full((max(params.window - 1, LINE), m), np.nan),
            np.full((MEMORY, m), np.nan),
            np.full((params.release + 1, m), np.nan),
            np.zeros(m, dtype=np.int64),
            np.zeros(m, dtype=np.int64),
        )


class Decision(NamedTuple):
    """What was decided about one sample of each of m channels.

    Attributes
    ----------
    flagged : (m,) ndarray of bool
    released : (m,) ndarray of bool
        A run of flagged samples was accepted with this one.
    value, sigma : (m,) ndarray
        The sample and its σ, or the replacement and its larger σ.
    statistic, threshold : (m,) ndarray
        |z - z₋₁| or |r|, and ξ; NaN before the window is full.
    """

    flagged: BoolArray
    released: BoolArray
    value: FloatArray
    sigma: FloatArray
    statistic: FloatArray
    threshold: FloatArray


def step(
    state: AdaptiveState,
    z: FloatArray,
    sigma: FloatArray,
    present: BoolArray,
    params: AdaptiveParams,
    turn: FloatArray | float = np.inf,
) -> tuple[AdaptiveState, Decision]:
    """Judge one sample of each channel.

    Parameters
    ----------
    state : AdaptiveState
    z, sigma : (m,) ndarray
        Samples and the σ_e of their noise.
    present : (m,) ndarray of bool
        Channels that have a new sample; the others keep their past.
    params : AdaptiveParams
    turn : (m,) ndarray or float
        Full turn of channels that are angles, in their unit; inf for the others.

    Returns
    -------
    state : AdaptiveState
    decision : Decision
    """
    z_near = _near(z, state.values[-1], turn)
    forecast = _weighted(_AHEAD, state.values[-LINE:])
    residual = np.abs(z_near - forecast)
    noise = SPREAD_OF_LINE * sigma
    known = np.isfinite(state.residuals).sum(axis=0)
    typical = MAD * _median(state.residuals, known)
    scaled = params.factor * np.maximum(noise, np.where(known >= FEWEST, typical, 0.0))
    if params.threshold == "scaled":
        statistic, threshold = residual, np.where(np.isfinite(forecast), scaled, np.nan)
    else:
        statistic, threshold = _printed(state.values, z_near, sigma, params)
    suspicious = present & (statistic > threshold)

    weight = params.decay ** np.arange(params.window - 1)[::-1]
    past = state.values[-(params.window - 1) :]
    replacement = _weighted(weight, past) / weight.sum()

    suspects = state.suspects
    if suspicious.any():
        suspects = _pushed(suspects, z_near, suspicious)
    run = np.where(present, np.where(suspicious, state.run + 1, 0), state.run)
    released = suspicious & (run > params.release)
    if released.any():
        released &= _agree(suspects, scaled)
    flagged = suspicious & ~released

    values = _pushed(state.values, np.where(flagged, replacement, z_near), present)
    if released.any():
        values[:, released] = suspects[-len(values) :, released]
    good = present & ~suspicious & np.isfinite(residual)
    following = AdaptiveState(
        values,
        _pushed(state.residuals, residual, good),
        suspects,
        np.where(released, 0, run),
        state.releases + released,
    )
    return following, Decision(
        flagged,
        released,
        np.where(flagged, replacement, z),
        np.where(flagged, params.sigma_factor * sigma, sigma),
        statistic,
        threshold,
    )


def screen(
    z: FloatArray,
    sigma: FloatArray,
    params: AdaptiveParams | None = None,
    *,
    present: BoolArray | None = None,
    turn: FloatArray | float = np.inf,
) -> Decision:
    """Judge whole records, sample by sample.

    Parameters
    ----------
    z : (n, m) ndarray
        NaN where there is no sample.
    sigma : (n, m) or (m,) ndarray
    params : AdaptiveParams, optional
    present : (n, m) ndarray of bool, optional
        Where there is a sample; by default where z is finite.
    turn : (m,) ndarray or float
        As for `step`.

    Returns
    -------
    Decision
        With arrays (n, m).
    """
    params = params or AdaptiveParams()
    here = np.isfinite(z) if present is None else present & np.isfinite(z)
    spread = np.broadcast_to(sigma, z.shape)
    state = AdaptiveState.empty(z.shape[1], params)
    decisions = []
    for row in range(len(z)):
        state, decision = step(state, z[row], spread[row], here[row], params, turn)
        decisions.append(decision)
    return Decision(*(np.array(part) for part in zip(*decisions, strict=True)))


def _near(z: FloatArray, last: FloatArray, turn: FloatArray | float) -> FloatArray:
    """Samples, with angles turned by whole turns to the last value of their channel."""
    angle = np.isfinite(turn) & np.isfinite(last)
    if not angle.any():
        return z
    full = np.broadcast_to(turn, z.shape)[angle]
    near = z.copy()
    near[angle] -= np.rint((z[angle] - last[angle]) / full) * full
    return near


def _printed(
    values: FloatArray, z: FloatArray, sigma: FloatArray, params: AdaptiveParams
) -> tuple[FloatArray, FloatArray]:
    """Statistic and threshold of eqs. (20)–(23), on a window that ends with the new sample."""
    window = np.concatenate([values[-(params.window - 1) :], z[None]])
    difference = np.abs(np.diff(window, axis=0))
    variance = difference.var(axis=0, ddof=1)
    level = window.mean(axis=0)
    if params.threshold == "absolute":
        level = np.abs(level)
    with np.errstate(invalid="ignore", divide="ignore"):
        return difference[-1], sigma**2 * level / variance


def _weighted(weight: npt.NDArray[np.floating], rows: FloatArray) -> FloatArray:
    """Weighted sum of rows, added in one order however many columns there are."""
    return np.asarray((weight[:, None] * rows).sum(axis=0))


def _pushed(past: FloatArray, new: FloatArray, where: BoolArray) -> FloatArray:
    """The past with a new row at its end, in some columns."""
    if where.all():
        return np.concatenate([past[1:], new[None]])
    out = past.copy()
    out[:-1, where] = past[1:, where]
    out[-1, where] = new[where]
    return out


def _median(past: FloatArray, known: IntArray) -> FloatArray:
    """Median of the finite entries of each column, 0 without any."""
    ordered = np.sort(past, axis=0)  # NaN last
    middle = np.maximum(known - 1, 0) / 2.0
    column = np.arange(past.shape[1])
    low, high = np.floor(middle).astype(np.int64), np.ceil(middle).astype(np.int64)
    return np.nan_to_num(0.5 * (ordered[low, column] + ordered[high, column]))


def _agree(suspects: FloatArray, bound: FloatArray) -> BoolArray:
    """Whether the last run of each column lies within a bound about its own line."""
    n = len(suspects)
    time = np.arange(n) - 0.5 * (n - 1)
    centred = suspects - suspects.mean(axis=0)
    slope = _weighted(time, centred) / (time @ time)
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(centred - np.outer(time, slope)) <= bound).all(axis=0))
