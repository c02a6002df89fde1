"""Tables of telemetry, channels, grids, machines and results, changed in odd ways."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pandas as pd
from hypothesis import strategies as st
from tests.endurance import tiny_case
from tests.endurance.odd_frames import MUTATIONS, VALUE_MUTATIONS, Mutation, apply
from tests.endurance.outcomes import NotFinite
from tests.study_tables import study_tables

from pse_analysis.grid import power_flow
from pse_analysis.grid.network import Network
from pse_analysis.machine import Densities, Machine, sample
from pse_analysis.measurement import SensorLayout
from pse_analysis.telemetry import check_channels, ingest
from pse_analysis.vocabulary import KEYS, Status, check

FRAME = MUTATIONS

_ODD_ARGUMENTS: tuple[dict[str, Any], ...] = (
    {},
    {},
    {},
    {"timezone": "Europe/Berlin"},
    {"timezone": "nowhere"},
    {"timezone": 3},
    {"columns": {"x": "value"}},
    {"columns": {"quality": "value"}},
    {"columns": {7: "channel", "VALUE": "value", "channel ": "channel"}},
    {"tags": {"U1": ("U1", "A1")}},
    {"tags": {"U1": "nobody"}},
    {"tags": {"P3": ("P3", "Q3"), "P4": []}},
    {"shunts": "accept", "units": "accept"},
)

INGEST = st.tuples(
    MUTATIONS, st.one_of(st.just([]), MUTATIONS), st.integers(0, len(_ODD_ARGUMENTS) - 1)
)
"""Changes of the telemetry and of the channels, and arguments."""


def _some_rows() -> pd.DataFrame:
    """Six samples of each channel, which is enough to read."""
    frame = tiny_case.telemetry()
    return frame.groupby("channel", sort=False).head(3).reset_index(drop=True)


def ingest_odd(drawn: tuple[list[Mutation], list[Mutation], int]) -> None:
    """Ingest changed tables; what is taken in is a sound raw case."""
    frame, channels, arguments = drawn
    raw = ingest(
        apply(_some_rows(), frame),
        apply(tiny_case.channel_table(), channels),
        tiny_case.network(),
        **_ODD_ARGUMENTS[arguments],
    )
    check("telemetry", raw.telemetry)
    check_channels(raw.channels, raw.model)
    if (raw.channels["sign"] != 1).any():
        raise NotFinite("a sign is left to turn")


def read_channels(drawn: list[Mutation]) -> None:
    """Check changed channels; those that pass have a finite scale and σ."""
    given = tiny_case.plain_run().raw.channels
    channels = check_channels(apply(given, drawn), tiny_case.network())
    layout = SensorLayout.from_channels(channels, tiny_case.network())
    if not (np.isfinite(layout.scale).all() and (layout.sigma > 0).all()):
        raise NotFinite("scale or σ of a channel that passed")


GRID = st.tuples(st.sampled_from(["network", "buses", "branches", "branches"]), MUTATIONS)


def read_grid(drawn: tuple[str, list[Mutation]]) -> None:
    """Make a grid of changed tables, and solve it."""
    table, mutations = drawn
    tables = tiny_case.grid_tables()
    tables[table] = apply(tables[table], mutations)
    network = Network.from_tables(**tables)
    if not np.isfinite(network.y_bus.data).all():
        raise NotFinite("an admittance")
    flow = power_flow.solve(network)
    if not np.isfinite(flow.x).all():
        raise NotFinite("a solved voltage")


def read_machine(drawn: list[Mutation]) -> None:
    """Make a machine of a changed table, and sample it."""
    table = Machine(s_mva=200.0, t_j_s=6.4, k_d_pu=0.03, u_kv=13.8).to_table()
    machine = Machine.from_table(apply(table, drawn))
    done = sample(machine, Densities(0.005, 0.005, 0.0001), 0.01)
    if not all(np.isfinite(array).all() for array in done):
        raise NotFinite("a sampled machine")


@cache
def _results() -> dict[str, pd.DataFrame]:
    """Small sound tables of every schema that the study tables hold."""
    made = study_tables(n_instant=60, n_trial=1)
    return {
        name: getattr(made, name).head(12).reset_index(drop=True)
        for name in sorted(KEYS)
        if isinstance(getattr(made, name, None), pd.DataFrame)
    }


SCHEMA = st.tuples(st.integers(0, 20), MUTATIONS)


def check_schema(drawn: tuple[int, list[Mutation]]) -> None:
    """Check a changed table against its schema."""
    number, mutations = drawn
    names = sorted(_results())
    name = names[number % len(names)]
    check(name, apply(_results()[name], mutations))


PIPELINE = st.tuples(
    st.lists(VALUE_MUTATIONS, max_size=3),
    st.lists(VALUE_MUTATIONS, max_size=2),
    st.sampled_from(["network", "buses", "branches"]),
    st.one_of(st.just([]), st.lists(VALUE_MUTATIONS, max_size=1)),
    st.integers(0, len(tiny_case.METHODS) - 1),
)
"""Changes of telemetry, channels and one table of the grid, and the method to estimate with."""


def run_odd(
    drawn: tuple[list[Mutation], list[Mutation], str, list[Mutation], int],
) -> None:
    """Run all stages on changed tables; what is ok is finite."""
    telemetry, channels, table, grid, method = drawn
    tables = tiny_case.grid_tables()
    tables[table] = apply(tables[table], grid)
    raw = ingest(
        apply(tiny_case.telemetry(), telemetry),
        apply(tiny_case.channel_table(), channels),
        Network.from_tables(**tables),
        units="accept",
    )
    require_finite(tiny_case.estimate_raw(raw, (tiny_case.METHODS[method],)))


def require_finite(run: tiny_case.Run) -> None:
    """See that aligned values are finite, and estimates wherever their step is ok.

    Raises
    ------
    NotFinite
        With the table and the row.
    """
    aligned = run.aligned[["value_pu", "sigma_pu"]].to_numpy()
    if not np.isfinite(aligned).all():
        raise NotFinite(f"aligned: {run.aligned[~np.isfinite(aligned).all(axis=1)].iloc[0]}")
    for done in run.estimated:
        key = ["method", "trial", "time_utc"]
        good = done.steps[done.steps["status"].isin([Status.OK, Status.INCONSISTENT])]
        claimed = done.estimated.merge(good[key], on=key)
        numbers = claimed[["value", "sigma"]].to_numpy()
        bad = ~np.isfinite(numbers).all(axis=1)
        if bad.any():
            raise NotFinite(f"estimated as ok: {claimed[bad].iloc[0].to_dict()}")
        if not np.isfinite(done.residuals[["innovation", "sigma_innovation"]].to_numpy()).all():
            raise NotFinite("an innovation")
