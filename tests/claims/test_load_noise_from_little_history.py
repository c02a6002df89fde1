"""Claim: with `load` noise from a few hours of history filters are calibrated beyond feeders.

|V|, P and Q at every bus every five minutes, power meters of 1 %, no phasor units, real load, a
source whose voltage drifts and steps. Held voltages other than the source's stand still, and a
filter that takes them all to move alike is wrong in most of its angles.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pse_analysis.alignment import AlignParams, align
from pse_analysis.estimation import Method, estimate
from pse_analysis.grid import library
from pse_analysis.parameters import Study
from pse_analysis.simulation import SimulateParams, profiles, simulate
from pse_analysis.simulation.settings import LoadParams, SensorParams
from pse_analysis.validation import ValidateParams, validate
from pse_analysis.validation.rules import Rule

START = datetime(2016, 6, 9, 6, tzinfo=UTC)
PROFILES = Path(__file__).parents[2] / "data" / "raw" / "load_profiles"


@cache
def world(grid: str, hours: int, seed: int) -> tuple[Any, ...]:
    """Network, study, aligned telemetry, channels and truth."""
    network = library.load(grid)
    study = Study(START, START + timedelta(hours=4), 300.0, 3600.0 * hours)
    at = tuple(f"bus/{name}" for name in network.buses.name)
    sensors = (
        SensorParams("scada", ("vm_pu",), at, sigma=0.003, period_s=300.0),
        SensorParams(
            "scada", ("p_mw", "q_mvar"), at, sigma=0.01, period_s=300.0, sigma_kind="relative"
        ),
    )
    world = SimulateParams(seed, sensors, truth_step_s=300.0, load=LoadParams(level=0.8))
    raw = simulate(network, profiles.load(PROFILES), study, world)
    checks = ValidateParams((Rule(checks=("time",)),))
    checked = validate(raw.telemetry, raw.channels, checks, history_end=START, model=network)
    aligned = align(checked, raw.channels, network, study, AlignParams())
    return network, study, aligned, raw.channels, raw.truth


@cache
def errors(grid: str, hours: int, seed: int, kind: str) -> tuple[np.ndarray, ...]:
    """Errors and σ of four hours, and which are angles."""
    network, study, aligned, channels, truth = world(grid, hours, seed)
    found = estimate(aligned, channels, network, study, Method.of(kind, kind)).estimated
    key = ["time_utc", "element", "quantity"]
    both = found.merge(truth, on=key, suffixes=("", "_true"))
    angle = (both["quantity"] == "va_degree").to_numpy()
    error, sigma = (both["value"] - both["value_true"]).to_numpy(), both["sigma"].to_numpy()
    free = sigma > 1e-9
    return error[free], sigma[free], angle[free]


GRIDS = [
    ("ieee14", 6, (1, 2, 3)),
    ("ieee14", 12, (1, 2, 3)),
    ("ieee30", 6, (1, 2, 3)),
    ("ieee33", 6, (1, 2, 3)),
    ("ieee57", 12, (1, 2)),
    ("ieee118", 12, (1, 2)),
]
"""Grid, hours of history, seeds: fifty instants of a seed hold little of what all angles share."""


@pytest.mark.parametrize("kind", ["kalman", "ekf", "ukf"])
@pytest.mark.parametrize(("grid", "hours", "seeds"), GRIDS)
def test_angles_and_magnitudes_are_as_certain_as_they_say(
    grid: str, hours: int, seeds: tuple[int, ...], kind: str
) -> None:
    """95 % inside 3σ, rms(error/σ) up to 1.4, no worse than least squares on the same rows."""
    for angles in (True, False):
        scaled, own, plain = [], [], []
        for seed in seeds:
            error, sigma, angle = errors(grid, hours, seed, kind)
            scaled.append((error / sigma)[angle == angles])
            own.append(error[angle == angles])
            error, _, angle = errors(grid, hours, seed, "wls")
            plain.append(error[angle == angles])
        ratio = np.concatenate(scaled)
        assert (np.abs(ratio) < 3.0).mean() >= 0.95
        assert np.sqrt(np.mean(ratio**2)) <= 1.4
        assert rms(own) <= rms(plain)


def rms(parts: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
