"""Faults of telemetry, injected with their truth recorded."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.simulation.scenario import SECOND, microseconds
from pse_analysis.simulation.sensors import Samples
from pse_analysis.simulation.settings import FaultParams
from pse_analysis.vocabulary import FaultKind

KINDS = tuple(FaultKind)


def code(kind: str) -> int:
    """Number of a kind in `Samples.kind`."""
    return 1 + KINDS.index(FaultKind(kind))


def inject(
    samples: Samples,
    channels: pd.DataFrame,
    faults: tuple[FaultParams, ...],
    seed: np.random.SeedSequence,
) -> Samples:
    """The samples with faults.

    Parameters
    ----------
    samples
        By channel and sampling time, without faults.
    channels
        All channels of the case.
    faults
        In order: a sample that has a fault gets no other.
    seed
        One child per entry of ``faults``.

    Returns
    -------
    Samples
        ``kind`` and ``size`` say what was done. Size: spike: what was added, in the channel's unit;
        stale: age of the repeated value [s]; duplicated, delayed: how much later it arrives [s];
        lost, empty: 0. Lost samples are still among them, and the second copies of duplicated ones
        stand at the end; the first copies carry no fault.
    """
    for fault, child in zip(faults, seed.spawn(len(faults)), strict=True):
        rng = np.random.default_rng(child)
        eligible = _eligible(samples, channels, fault)
        if fault.kind == FaultKind.STALE:
            samples = _stale(samples, channels, fault, eligible, rng)
            continue
        n = len(samples.value)
        # Drawn for every sample, so that a narrower selection leaves the others' faults alone.
        hit = eligible & (rng.random(n) < fault.rate)
        size = rng.uniform(*fault.size, n)
        if fault.kind == FaultKind.SPIKE:
            unit = np.abs(samples.truth) if fault.relative else samples.sigma
            shift = size * unit * rng.choice((-1.0, 1.0), n)
            samples = _mark(samples, hit, fault, shift)
            samples = dataclasses.replace(samples, value=samples.value + np.where(hit, shift, 0.0))
        elif fault.kind == FaultKind.LOST:
            samples = _mark(samples, hit, fault, np.zeros(n))
        elif fault.kind == FaultKind.EMPTY:
            samples = _mark(samples, hit, fault, np.zeros(n))
            samples = dataclasses.replace(samples, value=np.where(hit, np.nan, samples.value))
        elif fault.kind == FaultKind.DELAYED:
            samples = _mark(samples, hit, fault, size)
            samples = dataclasses.replace(samples, arrival=samples.arrival + _us(hit * size))
        else:
            copies = Samples(
                **{f.name: getattr(samples, f.name)[hit] for f in dataclasses.fields(Samples)}
            )
            samples = dataclasses.replace(samples, taken=samples.taken | hit)
            copies = _mark(copies, np.ones(int(hit.sum()), dtype=bool), fault, size[hit])
            copies = dataclasses.replace(copies, arrival=copies.arrival + _us(size[hit]))
            samples = Samples(
                **{
                    f.name: np.concatenate([getattr(samples, f.name), getattr(copies, f.name)])
                    for f in dataclasses.fields(Samples)
                }
            )
    return samples


def _us(seconds: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    return np.rint(seconds * SECOND).astype(np.int64)


def _eligible(
    samples: Samples, channels: pd.DataFrame, fault: FaultParams
) -> npt.NDArray[np.bool_]:
    allowed = np.ones(len(channels), dtype=bool)
    if fault.source:
        allowed &= (channels["source"] == fault.source).to_numpy()
    if fault.quantities:
        allowed &= channels["quantity"].isin(fault.quantities).to_numpy()
    if fault.at:
        allowed &= channels["element"].isin(fault.at).to_numpy()
    eligible: npt.NDArray[np.bool_] = allowed[samples.channel] & ~samples.taken
    if fault.start is not None:
        eligible &= samples.sampled >= microseconds(fault.start)
    if fault.end is not None:
        eligible &= samples.sampled < microseconds(fault.end)
    return eligible


def _mark(
    samples: Samples,
    hit: npt.NDArray[np.bool_],
    fault: FaultParams,
    size: npt.NDArray[np.float64],
) -> Samples:
    return dataclasses.replace(
        samples,
        kind=np.where(hit, np.int8(code(fault.kind)), samples.kind),
        size=np.where(hit, size, samples.size),
        taken=samples.taken | hit,
    )


def _stale(
    samples: Samples,
    channels: pd.DataFrame,
    fault: FaultParams,
    eligible: npt.NDArray[np.bool_],
    rng: np.random.Generator,
) -> Samples:
    """Episodes in which a channel repeats the value at their start, which itself is right."""
    period = channels["period_s"].to_numpy(dtype=float)[samples.channel]
    n = len(samples.value)
    expected = np.maximum(np.mean(fault.size) / period, 1.0)
    length = np.maximum(np.rint(rng.uniform(*fault.size, n) / period), 1.0)
    start = eligible & (rng.random(n) < fault.rate / expected)
    position = np.arange(n)
    last = np.maximum.accumulate(np.where(start, position, -1))
    inside = (
        eligible
        & (last >= 0)
        & (position > last)
        & (samples.channel == samples.channel[last])
        & (position - last <= length[last])
    )
    age = (samples.sampled - samples.sampled[last]) / SECOND
    samples = _mark(samples, inside, fault, age)
    repeated = np.zeros(n, dtype=bool)
    repeated[last[inside]] = True
    return dataclasses.replace(
        samples,
        value=np.where(inside, samples.value[last], samples.value),
        taken=samples.taken | repeated,
    )
