"""A grid of four buses with an hour of telemetry, small enough to be estimated in a moment."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache

import numpy as np
import pandas as pd

from pse_analysis.alignment import AlignParams, align
from pse_analysis.estimation import Estimated, Method, Record, estimate, record
from pse_analysis.grid import power_flow
from pse_analysis.grid.network import Network
from pse_analysis.measurement import MeasurementModel, SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.telemetry import RawCase, ingest
from pse_analysis.validation import validate

SEED = 1711
START = datetime(2016, 6, 9, 8, tzinfo=UTC)
STEPS, STEP_S = 4, 300.0
HISTORY = 24
STUDY = Study(START, START + timedelta(seconds=STEPS * STEP_S), STEP_S, HISTORY * STEP_S)

METHODS = (
    Method.of("wls", "wls"),
    Method.of("kalman_load", "kalman", noise="load"),
    Method.of("kalman_scalar", "kalman", noise="scalar", screening="innovation"),
)
"""Static, and two of the filters; the work of the others is tried in their own tests."""


def grid_tables() -> dict[str, pd.DataFrame]:
    """Tables of the grid: a ring of three buses and a spur, with a shunt, a tap and a generator."""
    return {
        "network": pd.DataFrame({"name": ["tiny"], "base_mva": [10.0]}),
        "buses": pd.DataFrame(
            {
                "name": ["1", "2", "3", "4"],
                "kind": [3, 2, 1, 1],
                "vn_kv": [20.0, 20.0, 20.0, 20.0],
                "p_load_mw": [0.0, 1.0, 2.0, 1.5],
                "q_load_mvar": [0.0, 0.3, 0.6, 0.5],
                "p_gen_mw": [0.0, 0.8, 0.0, 0.0],
                "vm_set_pu": [1.02, 1.0, 1.0, 1.0],
                "q_min_mvar": [-np.inf, -2.0, -np.inf, -np.inf],
                "q_max_mvar": [np.inf, 2.0, np.inf, np.inf],
                "b_shunt_pu": [0.0, 0.0, 0.02, 0.0],
            }
        ),
        "branches": pd.DataFrame(
            {
                "name": ["1-2", "2-3", "1-3", "3-4"],
                "from_bus": ["1", "2", "1", "3"],
                "to_bus": ["2", "3", "3", "4"],
                "r_pu": [0.02, 0.03, 0.02, 0.04],
                "x_pu": [0.05, 0.06, 0.05, 0.08],
                "b_pu": [0.01, 0.0, 0.01, 0.0],
                "tap": [1.0, 1.0, 0.98, 1.0],
                "in_service": [True, True, True, True],
            }
        ),
    }


@cache
def network() -> Network:
    """The grid."""
    return Network.from_tables(**grid_tables())


_CHANNELS = (
    ("U1", "pmu", "vm_pu", "bus/1", "", "pu", 0.005, "absolute", 0.8, 1.2),
    ("A1", "pmu", "va_degree", "bus/1", "", "degree", 0.1, "absolute", -180.0, 180.0),
    ("U3", "scada", "vm_pu", "bus/3", "", "kv", 0.2, "absolute", 15.0, 25.0),
    ("P2", "ami", "p_mw", "bus/2", "", "mw", 0.02, "relative", -5.0, 5.0),
    ("Q2", "ami", "q_mvar", "bus/2", "", "mvar", 0.05, "absolute", -20.0, 20.0),
    ("P3", "ami", "p_mw", "bus/3", "", "kw", 0.02, "relative", -5000.0, 5000.0),
    ("Q3", "ami", "q_mvar", "bus/3", "", "mvar", 0.05, "absolute", -20.0, 20.0),
    ("P4", "ami", "p_mw", "bus/4", "", "mw", 0.02, "relative", -5.0, 5.0),
    ("Q4", "ami", "q_mvar", "bus/4", "", "mvar", 0.05, "absolute", -20.0, 20.0),
    ("I12", "pmu", "i_ka", "branch/1-2", "from", "a", 0.5, "absolute", 0.0, 500.0),
)


def channel_table() -> pd.DataFrame:
    """Ten channels in mixed units."""
    names = [
        "channel",
        "source",
        "quantity",
        "element",
        "side",
        "unit",
        "sigma",
        "sigma_kind",
        "lower",
        "upper",
    ]
    table = pd.DataFrame(dict(zip(names, column, strict=True)) for column in _CHANNELS)
    return table.assign(period_s=STEP_S, sign=1, aggregation="instant")


@cache
def telemetry() -> pd.DataFrame:
    """A frame as users have it: one row per sample, in the channels' own units."""
    rng = np.random.default_rng(SEED)
    grid, about = network(), channel_table()
    count = HISTORY + STEPS
    level = 1.0 + np.cumsum(rng.normal(0.0, 0.01, (1, count)), axis=1)
    flow = power_flow.solve(
        grid, grid.p_nominal_pu[:, None] * level, grid.q_nominal_pu[:, None] * level
    )
    layout = SensorLayout.from_channels(about, grid)
    exact = MeasurementModel(grid, layout).h(flow.x)
    noise = layout.sigma_pu(np.abs(exact).mean(axis=1))[:, None] * rng.normal(size=exact.shape)
    value = layout.from_per_unit(exact + noise)
    first = pd.Timestamp(START) - pd.Timedelta(seconds=HISTORY * STEP_S)
    times = first + pd.to_timedelta(STEP_S * np.arange(count), unit="s")
    return pd.DataFrame(
        {
            "channel": np.repeat(about["channel"].to_numpy(), count),
            "time_utc": np.tile(times, len(about)),
            "value": value.ravel(),
            "arrival_utc": np.tile(times + pd.Timedelta(seconds=2), len(about)),
            "quality": np.tile(np.int64(192), value.size),
            "trial": 0,
        }
    )


@dataclass(frozen=True, eq=False)
class Run:
    """What came of a run."""

    raw: RawCase
    validated: pd.DataFrame
    aligned: pd.DataFrame
    estimated: tuple[Estimated, ...]


def estimate_raw(raw: RawCase, methods: tuple[Method, ...] = METHODS) -> Run:
    """Run all stages on a raw case."""
    validated = validate(raw.telemetry, raw.channels, history_end=STUDY.start, model=raw.model)
    aligned = align(validated, raw.channels, raw.model, STUDY, AlignParams())
    found = tuple(
        estimate(aligned, raw.channels, raw.model, STUDY, method, trial=int(trial))
        for trial in sorted(set(aligned["trial"]))[:2]
        for method in methods
    )
    return Run(raw, validated, aligned, found)


@cache
def plain_run() -> Run:
    """The run of the tables as they stand here."""
    return estimate_raw(ingest(telemetry(), channel_table(), network()))


def record_of(run: Run, layout: SensorLayout) -> Record:
    """Aligned telemetry of a run as arrays."""
    return record(run.aligned[run.aligned["trial"] == 0], layout)
