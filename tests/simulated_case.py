"""A short simulated case of the 33-bus feeder, for tests that need raw tables with physics."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import pandas as pd

from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.parameters import Study
from pse_analysis.simulation import SimulateParams, profiles, simulate
from pse_analysis.simulation.settings import FaultParams, PvParams, SensorParams
from pse_analysis.telemetry import RawCase

SEED = 33
PROFILES = Path(__file__).parents[1] / "data" / "raw" / "load_profiles"
STUDY = Study(
    start=datetime(2016, 6, 9, 10, tzinfo=UTC),
    end=datetime(2016, 6, 9, 12, tzinfo=UTC),
    step_s=300.0,
    history_s=7200.0,
)
SENSORS = (
    SensorParams("pmu", ("vm_pu",), ("bus/2", "bus/6", "bus/18"), 0.005, 60.0, delay_s=0.5),
    SensorParams(
        "scada",
        ("p_mw", "q_mvar"),
        ("branch/7-8", "branch/24-25"),
        0.01,
        60.0,
        sigma_kind="relative",
        delay_s=2.0,
        jitter_s=8.0,
        limit_factor=3.0,
    ),
    SensorParams(
        "ami",
        ("p_mw", "q_mvar"),
        ("loads",),
        0.005,
        900.0,
        sigma_kind="relative",
        aggregation="mean",
        delay_s=60.0,
    ),
)
FAULTS = (
    FaultParams("spike", 0.02, (10.0, 40.0)),
    FaultParams("stale", 0.02, (300.0, 900.0), source="scada"),
    FaultParams("lost", 0.02),
    FaultParams("duplicated", 0.02, (1.0, 30.0)),
    FaultParams("delayed", 0.02, (120.0, 900.0)),
)
PARAMS = SimulateParams(
    seed=SEED, sensors=SENSORS, trials=2, faults=FAULTS, pv=(PvParams("18", 0.2, "PV3"),)
)


@cache
def feeder() -> Network:
    """The 33-bus feeder."""
    return library.load("ieee33")


@cache
def curves() -> pd.DataFrame:
    """The committed load curves."""
    return profiles.load(PROFILES)


def make(params: SimulateParams = PARAMS, study: Study = STUDY, **changes: object) -> RawCase:
    """Simulate the case anew, with changed parameters."""
    return simulate(feeder(), curves(), study, dataclasses.replace(params, **changes))


@cache
def case() -> RawCase:
    """The case as it stands here; shared, so not to be changed."""
    return make()
