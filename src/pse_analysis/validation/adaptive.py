"""Bad data by an adaptive threshold on each channel's own past, eqs. (20)–(24) of [qi2025].

Three thresholds:

``literal``
    ξ = σ_e² z̄ / σ_L² on |z - z₋₁|, with the square that eq. (22) lacks. It has the unit of z but is
    not invariant under shifts: levels below or near zero are always flagged.
``absolute``
    The same with |z̄|.
``scaled``
    ξ = c max(σ_e √(1 + x'(X'X)⁻¹x), 1.4826 median |r|, tail |r|) on the residual r of a local
    forecast: the mean of the last four values, the last one, or their line, whichever served the
    channel best of late. The root is 1.12, 1.41 or 1.58. The tail is what keeps channels that jump
    by themselves: the residual that they exceed as rarely as a normal law exceeds c σ, over c.

What is flagged is replaced by the weighted mean of the window, eq. (24), and the replacement enters
the window. Behind ``scaled`` its σ is at least its distance from the sample: as far as the channel
alone can tell the truth lies between the two, so that a false alarm costs about as much as a
missing sample.

On a ramp the window would latch a channel to old values for ever, so a run of more than ``release``
flagged samples that agree with each other becomes the window, and one of twice that length whether
they agree or not. What is flagged is not learnt from, unless the next sample deviates to the same
side: then the channel moved. Nor is anything flagged where more than three in four channels of a
kind deviate to one side at once, by half their thresholds at least: errors are independent, and it
is the grid that moved, and with it their windows.

A step is a function of a state and one sample per channel; many at once are the same steps. What
matters only in the long run, the scale of each channel and the forecast that serves it, is worked
out for some steps at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import ParameterError
from pse_analysis.validation import tails, windows
from pse_analysis.validation.forecasts import SPAN, Choice

Threshold = Literal["literal", "absolute", "scaled"]

COMMON = 0.75
"""Share of a kind beyond which it is the grid that moved.

One in ten samples being bad, half of five channels would err to one side once a day.
"""


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
        σ of a replacement over that of a sample, at least.
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
        if self.release <= SPAN:
            raise ParameterError(f"adaptive: expected release > {SPAN}, received {self.release}")


class Seen(NamedTuple):
    """A step of which the long run is still to be told.

    Attributes
    ----------
    past : (L, m) ndarray
        Values before it.
    z, size : (m,) ndarray
        Samples, and their |r|.
    present, learns : (m,) ndarray of bool
        Where there was one, and where |r| is one to learn from.
    """

    past: FloatArray
    z: FloatArray
    size: FloatArray
    present: BoolArray
    learns: BoolArray


class AdaptiveState(NamedTuple):
    """The past of m channels; rows run from old to new, NaN where there is none yet.

    Attributes
    ----------
    values : (L, m) ndarray
        Accepted and replaced values.
    choice : Choice
        The forecast that served each channel best.
    residuals : Residuals
        |r| that were learnt, and the scales that they tell.
    seen : tuple of Seen
        Steps of which these two do not know yet.
    suspects : (release + 1, m) ndarray
        Raw values of the present run of flagged samples.
    deviation : (m,) ndarray
        Signed residual of the newest of them.
    run, releases : (m,) ndarray of int
        Length of the run, and how often one was accepted.
    """

    values: FloatArray
    choice: Choice
    residuals: tails.Residuals
    seen: tuple[Seen, ...]
    suspects: FloatArray
    deviation: FloatArray
    run: IntArray
    releases: IntArray

    @classmethod
    def empty(cls, m: int, params: AdaptiveParams) -> AdaptiveState:
        """State of m channels of which nothing is known."""
        return cls(
            np.full((max(params.window - 1, SPAN), m), np.nan),
            Choice.of(np.zeros((3, m))),
            tails.Residuals.empty(m),
            (),
            np.full((params.release + 1, m), np.nan),
            np.zeros(m),
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
        |z - z₋₁| or |r|, and ξ; NaN before there is a past to compare with.
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
    kind: IntArray | None = None,
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
    kind : (m,) ndarray of int, optional
        Number of what the grid moves together, as all angles of one source; for ``scaled``.

    Returns
    -------
    state : AdaptiveState
    decision : Decision
    """
    z_near = windows.near(z, state.values[-1], turn)
    deviation = z_near - state.choice.forecast(state.values)
    residual = np.abs(deviation)
    noise = state.choice.growth * sigma
    if params.threshold == "scaled":
        # NaN, which flags nothing, as long as a channel has no scale yet.
        statistic, threshold = residual, params.factor * np.maximum(noise, state.residuals.scale)
    else:
        statistic, threshold = _printed(state.values, z_near, sigma, params)
    suspicious = present & (statistic > threshold)
    found = bool(suspicious.any())
    past = state.values
    if found and kind is not None and params.threshold == "scaled":
        off = present & (residual > 0.5 * threshold)
        moved = _together(off, deviation > 0, present, kind)
        past = np.where(moved, past + deviation, past)
        suspicious &= ~moved
        found = bool(suspicious.any())
    seen = Seen(state.values, z_near, residual, present, present)
    values = windows.pushed(past, z_near, present)
    if not found:
        decision = Decision(suspicious, suspicious, z, sigma, statistic, threshold)
        run = np.where(present, 0, state.run) if state.run.any() else state.run
        following = state._replace(values=values, seen=(*state.seen, seen), run=run)
        return _renewed(following, params.factor), decision

    suspects = windows.pushed(state.suspects, z_near, suspicious)
    run = np.where(suspicious, state.run + 1, np.where(present, 0, state.run))
    released = suspicious & (run > params.release)
    if released.any():
        bound = params.factor * np.fmax(noise, state.residuals.scale)
        released &= windows.agree(suspects, bound) | (run > 2 * params.release)
    flagged = suspicious & ~released
    replacement, wide = _replacement(state.values, z_near, sigma, params)
    values[-1, flagged] = replacement[flagged]
    size, learns = _moved(state, z_near, deviation, suspicious, run)
    waiting = (*state.seen, seen._replace(size=size, learns=present & learns))
    choice = state.choice
    if released.any():
        # A window may be longer than the run that released it: what came before is forgotten.
        kept = min(len(values), len(suspects))
        values[:, released] = np.nan
        values[-kept:, released] = suspects[-kept:, released]
        # What was seen of them before tells no more how well a forecast serves.
        waiting = tuple(step._replace(present=step.present & ~released) for step in waiting)
        choice = choice.begun_again(released, suspects)
    following = AdaptiveState(
        values,
        choice,
        state.residuals,
        waiting,
        suspects,
        np.where(suspicious, deviation, state.deviation),
        np.where(released, 0, run),
        state.releases + released,
    )
    decision = Decision(
        flagged,
        released,
        np.where(flagged, replacement, z),
        np.where(flagged, wide, sigma),
        statistic,
        threshold,
    )
    return _renewed(following, params.factor), decision


def screen(
    z: FloatArray,
    sigma: FloatArray,
    params: AdaptiveParams | None = None,
    *,
    present: BoolArray | None = None,
    turn: FloatArray | float = np.inf,
    kind: IntArray | None = None,
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
    turn, kind
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
        state, decision = step(state, z[row], spread[row], here[row], params, turn, kind)
        decisions.append(decision)
    return Decision(*(np.array(part) for part in zip(*decisions, strict=True)))


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


def _together(off: BoolArray, above: BoolArray, present: BoolArray, kind: IntArray) -> BoolArray:
    """Channels off to the side to which three in four of their kind are, and three at least."""
    n = int(kind.max()) + 1
    most = np.maximum(COMMON * np.bincount(kind, present, n), 2.0)
    up = np.bincount(kind, off & above, n) > most
    down = np.bincount(kind, off & ~above, n) > most
    return np.asarray(off & np.where(above, up[kind], down[kind]))


def _replacement(
    values: FloatArray, z: FloatArray, sigma: FloatArray, params: AdaptiveParams
) -> tuple[FloatArray, FloatArray]:
    """Weighted mean of the window, eq. (24), and its σ."""
    weight = params.decay ** np.arange(params.window - 1)[::-1]
    replacement = windows.weighted(weight, values[-(params.window - 1) :]) / weight.sum()
    wide = params.sigma_factor * sigma
    if params.threshold == "scaled":
        wide = np.maximum(wide, np.abs(z - replacement))
    return replacement, wide


def _moved(
    state: AdaptiveState,
    z: FloatArray,
    deviation: FloatArray,
    suspicious: BoolArray,
    run: IntArray,
) -> tuple[FloatArray, BoolArray]:
    """|r| that a sample teaches, and whether it does, where some are suspicious.

    If only accepted residuals were learnt, a channel that begins to move would never be told so. A
    flagged one counts if the next deviates to the same side, by the smaller of the two, and from
    then on by the steps within the run. Independent errors do that once in a while (at a share q in
    q²/2 of all samples), which leaves the quantiles where they are.
    """
    residual = np.abs(deviation)
    moved = suspicious & (run >= 2) & (deviation * state.deviation > 0)
    first = np.minimum(residual, np.abs(state.deviation))
    size = np.where(run == 2, first, np.abs(z - state.suspects[-1]))
    return np.where(moved, size, residual), moved | ~suspicious


def _renewed(state: AdaptiveState, factor: float) -> AdaptiveState:
    """The state that knows of the steps it has seen, once there are enough of them."""
    if len(state.seen) < state.residuals.patience:
        return state
    past, z, size, present, learns = (np.array(part) for part in zip(*state.seen, strict=True))
    learnt = np.where(learns & np.isfinite(size), size, np.inf)
    return state._replace(
        choice=state.choice.told(past, z, present),
        residuals=state.residuals.written(learnt.T, factor),
        seen=(),
    )
