"""Sampling times of a day, and DTW of one window beside a plain dynamic program."""

from __future__ import annotations

import math
import time

import numpy as np
import numpy.typing as npt

from benchmarks.timing import Row, alternate
from pse_analysis.alignment import dtw
from pse_analysis.alignment.dtw import Reference, TimeParams

DEVICES = 6
DAY_S = 86400.0
PERIOD_S = 60.0
BAND_S = 270.0
PHASOR_S = 1.0
PARAMS = TimeParams(largest_delay_s=BAND_S)

Array = npt.NDArray[np.float64]


def device(seed: int, phasor_s: float = PHASOR_S) -> tuple[Array, Array, Array, Reference]:
    """A day of arrivals, currents and σ of a device, and of the phasor unit beside it."""
    rng = np.random.default_rng(seed)
    minute = np.arange(0.0, DAY_S + 60.0, 60.0)
    level = np.exp(np.cumsum(rng.normal(0, 0.02, len(minute))))
    time = np.arange(0.0, DAY_S, phasor_s)
    phasor = np.interp(time, minute, level) * (1 + rng.normal(0, 0.005, len(time)))
    taken = np.arange(7.0, DAY_S - 600.0, PERIOD_S)
    value = np.interp(taken, minute, level) * (1 + rng.normal(0, 0.005, len(taken)))
    slow = 0.5 - 0.5 * np.cos(2 * np.pi * (taken / 7200.0 + rng.random()))
    arrival = taken + 30.0 + 200.0 * slow + rng.uniform(0.0, 20.0, len(taken))
    return arrival, value, 0.005 * value, Reference(time, time, phasor)


def plain(device: Array, other: Array, radius: int, penalty: float) -> float:
    """Cost of eq. (2) of [qi2025] inside a band, cell by cell, with a penalty off the diagonal."""
    before = np.full(len(other), np.inf)
    for i, z in enumerate(device):
        row = np.full(len(other), np.inf)
        for j in range(max(0, i - radius), min(len(other), i + radius + 1)):
            aside = min(row[j - 1] if j else np.inf, before[j]) + penalty
            reach = min(aside, before[j - 1] if j else np.inf)
            row[j] = abs(z - other[j]) + (0.0 if i == j == 0 else reach)
        before = row
    return float(before[-1])


def run() -> list[Row]:
    """A day of six devices with phasors at 1 Hz, and one window."""
    made = [device(seed) for seed in range(DEVICES)]
    instants = np.arange(0.0, DAY_S, 300.0)

    def day() -> None:
        for arrival, value, sigma, reference in made:
            dtw.recover(arrival, value, sigma, reference, instants, PARAMS)

    arrival, value, _, reference = made[0]
    inside = (arrival > 7200.0 - PARAMS.window_s) & (arrival <= 7200.0)

    def window() -> dtw.Match:
        return dtw.match_window(arrival[inside], value[inside], reference, 7200.0, PARAMS)

    match = window()
    radius = round(0.5 * BAND_S / PHASOR_S)
    begun = time.process_time()
    day()
    whole = time.process_time() - begun
    ours, peer = alternate(
        window, lambda: plain(match.device, match.reference, radius, PARAMS.warp_penalty), 1
    )
    return [
        Row(
            "sampling times of a day, 6 devices, phasors at 1 Hz",
            whole,
            math.nan,
            "–",
            f"a sample a minute; 288 windows of 45 min each, band of {BAND_S:g} s",
        ),
        Row(
            "DTW of 45 min at 1 Hz",
            ours,
            peer,
            "plain Python",
            f"2700 samples, band of {BAND_S:g} s; ours also backtracks",
        ),
    ]
