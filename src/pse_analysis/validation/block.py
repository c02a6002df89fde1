"""All value checks on a block of (time × channel) samples, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import FloatArray
from pse_analysis.validation.motion import Motion
from pse_analysis.validation.sieve import Chunk
from pse_analysis.validation.walk import Walk
from pse_analysis.vocabulary import SEVERITY, Flag, Reason

RULED_OUT = np.int32(
    sum(int(reason) for reason, level in SEVERITY.items() if level in (Flag.BAD, Flag.MISSING))
)
"""Reasons after which a sample is no reference for those that follow."""

CHUNK_SAMPLES = 1 << 20
"""Samples worked on at once; what bounds the memory beside the results."""

_LARGEST = np.finfo(float).max


@dataclass(frozen=True, eq=False)
class Criteria:
    """What the value checks compare with, per channel (arrays of length n_channel).

    Attributes
    ----------
    lower, upper : (n_channel,)
        Limits; NaN or ±inf where there is none. [unit]
    motion : Motion
        Increments and extrapolation.
    stuck : (n_channel,) array of int
        Length of a run of equal values from which it is stuck; 0 where it is not checked.
    stuck_at_zero : (n_channel,) array of bool
        Whether a run of exact zeros counts; plant at rest reads zero.
    """

    lower: FloatArray
    upper: FloatArray
    motion: Motion
    stuck: npt.NDArray[np.int64]
    stuck_at_zero: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Findings:
    """What was found in a block; arrays of its shape.

    Attributes
    ----------
    reasons : (n, n_channel) array of int32
        Bits of `Reason`.
    statistic, threshold : (n, n_channel) or None
        Of the decisive check; NaN where none was made. [unit, or samples for a stuck value]
    """

    reasons: npt.NDArray[np.int32]
    statistic: FloatArray | None
    threshold: FloatArray | None


def screen(
    value: npt.ArrayLike,
    time: npt.ArrayLike,
    criteria: Criteria,
    *,
    reasons: npt.NDArray[np.int32] | None = None,
    scale: FloatArray | None = None,
    backward: npt.NDArray[np.bool_] | None = None,
    n_row: npt.NDArray[np.int64] | None = None,
    detail: bool = True,
    chunk_samples: int = CHUNK_SAMPLES,
) -> Findings:
    """Flag the samples of a block; a sample's flags depend on it and on those above it only.

    Parameters
    ----------
    value : (n, n_channel) array_like
        Samples in order of arrival; NaN where there is none. [unit]
    time : (n,), (n, 1) or (n, n_channel) array_like
        Time stamps in sampling periods.
    criteria : Criteria
    reasons : (n, n_channel) array of int32, optional
        What earlier checks found; written in place. Samples it rules out are not compared.
    scale : (n, 1) or (n, n_channel), optional
        Factor on the σ of increments, for a σ that follows the time of day.
    backward : (n, 1) or (n, n_channel) array of bool, optional
        Samples older than one that arrived before them.
    n_row : (n_channel,) array of int, optional
        Rows that belong to each channel where channels are padded to a common length.
    detail : bool
        Whether statistic and threshold are kept; they are two thirds of the memory.
    chunk_samples : int
        Samples worked on at once.

    Returns
    -------
    Findings
    """
    x = np.asarray(value, dtype=float)
    if x.ndim != 2:
        raise ValueError(f"value has shape {x.shape}: expected (time, channel); reshape it")
    t = np.asarray(time, dtype=float)
    t = t[:, None] if t.ndim == 1 else t
    n, n_channel = x.shape
    found = np.zeros(x.shape, dtype=np.int32) if reasons is None else reasons
    statistic = np.empty(x.shape) if detail else None
    threshold = np.empty(x.shape) if detail else None
    lower = np.where(np.isfinite(criteria.lower), criteria.lower, -_LARGEST)
    upper = np.where(np.isfinite(criteria.upper), criteria.upper, _LARGEST)
    count = np.where(criteria.stuck > 0, criteria.stuck, np.iinfo(np.int64).max)
    at_rest = np.where(criteria.stuck_at_zero, np.nan, 0.0)

    walk = Walk(criteria.motion, n_row=n_row)
    last = np.full(n_channel, np.nan)
    run = np.ones(n_channel, dtype=np.int64)
    step = max(1, chunk_samples // max(n_channel, 1))
    for start in range(0, n, step):
        rows = slice(start, min(start + step, n))
        part, bits = x[rows], found[rows]
        work = walk.samples(len(part))
        np.copyto(work, part)
        if reasons is not None:
            work[(bits & RULED_OUT) != 0] = np.nan
        inside = (part >= lower) & (part <= upper)
        at = np.nonzero(~inside)
        if len(at[0]):
            bits[at] |= np.where(np.isfinite(part[at]), Reason.LIMIT, Reason.NOT_FINITE).astype(
                np.int32
            )
            work[at] = np.nan
        stuck_at, run_there, run, last = _stuck(part, last, run, count, at_rest)
        bits[stuck_at] |= np.int32(Reason.STUCK)
        work[stuck_at] = np.nan
        walk.step(
            Chunk(
                value=work,
                time=t[rows],
                reasons=bits,
                statistic=None if statistic is None else statistic[rows],
                threshold=None if threshold is None else threshold[rows],
                scale=None if scale is None else scale[rows],
                backward=None if backward is None else backward[rows],
            )
        )
        if statistic is not None and threshold is not None:
            statistic[rows][stuck_at] = run_there
            threshold[rows][stuck_at] = count[stuck_at[1]]
            value_out = part[at]
            low, high = lower[at[1]], upper[at[1]]
            real = np.isfinite(value_out)
            statistic[rows][at] = np.where(real, value_out, np.nan)
            threshold[rows][at] = np.where(real, np.where(value_out < low, low, high), np.nan)
    return Findings(found, statistic, threshold)


_Where = tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]


def _stuck(
    part: FloatArray,
    last: FloatArray,
    run: npt.NDArray[np.int64],
    count: npt.NDArray[np.int64],
    at_rest: FloatArray,
) -> tuple[_Where, npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    """Where a run of equal values has reached its count; its length there; state to carry on."""
    n = len(part)
    none = np.zeros(0, dtype=np.intp)
    same = np.empty(part.shape, dtype=bool)
    same[:1] = part[:1] == last
    np.equal(part[1:], part[:-1], out=same[1:])
    columns = np.flatnonzero(same.any(axis=0) & (count < np.iinfo(np.int64).max))
    carried = np.ones_like(run)
    where: _Where = (none, none)
    lengths = np.zeros(0, dtype=np.int64)
    if len(columns):
        repeat = same[:, columns] & (part[:, columns] != at_rest[columns])
        index = np.arange(n)[:, None]
        broken = np.maximum.accumulate(np.where(repeat, -1, index), axis=0)
        length = np.where(broken < 0, index + 1 + run[columns], index - broken + 1)
        rows, inner = np.nonzero(repeat & (length >= count[columns]))
        where, lengths = (rows, columns[inner]), length[rows, inner]
        carried[columns] = length[-1]
    return where, lengths, carried, part[-1].copy() if n else last
