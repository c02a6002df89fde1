"""Claim: without history and stated limits, a sample of 1e6 p.u. costs no more than its absence."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime
from functools import cache

import numpy as np
import pandas as pd
import pytest
from simulated_case import curves, feeder

from pse_analysis.alignment import align
from pse_analysis.estimation import Method, estimate
from pse_analysis.grid import Network
from pse_analysis.measurement import SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.simulation import SimulateParams, simulate
from pse_analysis.simulation.settings import SensorParams
from pse_analysis.telemetry import RawCase
from pse_analysis.validation import DefaultLimits, ValidateParams, validate
from pse_analysis.vocabulary import Flag, Reason

SEED = 11
STUDY = Study(
    start=datetime(2016, 6, 9, 10, tzinfo=UTC),
    end=datetime(2016, 6, 9, 10, 20, tzinfo=UTC),
    step_s=60.0,
    history_s=600.0,  # ten samples, too few for a threshold
)
AT = 15
"""Position of the wrong sample in its channel: five minutes into the study."""
QUANTITIES = ("vm_pu", "va_degree", "p_mw", "q_mvar", "i_ka", "ia_degree")
GRIDS = ("ieee33", "own on 1 MVA", "own on 10 MVA", "own on 100 MVA", "own without loads")
METHOD = Method.of("kf", "kalman", noise="scalar", variance=1e-6)


def own_grid(base_mva: float) -> Network:
    """Five buses in a row at 20 kV, a tie to the last, 6 MW of load."""
    ohm = 20.0**2 / base_mva
    names = list("ABCDE")
    ends = pd.DataFrame({"from_bus": list("ABCDB"), "to_bus": list("BCDEE")})
    return Network.from_tables(
        pd.DataFrame({"name": ["own"], "base_mva": [base_mva]}),
        pd.DataFrame(
            {
                "name": names,
                "kind": [3, 1, 1, 1, 1],
                "vn_kv": 20.0,
                "p_load_mw": [0.0, 2.0, 1.5, 1.0, 1.5],
                "q_load_mvar": [0.0, 0.6, 0.5, 0.2, 0.4],
            }
        ),
        ends.assign(r_pu=0.5 / ohm, x_pu=0.9 / ohm),
    )


@cache
def case(grid: str) -> RawCase:
    """A noisy hour without faults, every quantity metered; a share of them is redundant."""
    base = {"own on 1 MVA": 1.0, "own on 100 MVA": 100.0}.get(grid, 10.0)
    network = feeder() if grid == "ieee33" else own_grid(base)
    if grid == "ieee33":
        bus, branch = ("bus/2", "bus/6", "bus/18", "bus/25"), ("branch/2-3", "branch/7-8")
    else:
        bus, branch = ("bus/A", "bus/C", "bus/E"), ("branch/A-B", "branch/C-D")
    sensors = (
        SensorParams("pmu", ("vm_pu",), bus, 0.002, 60.0),
        SensorParams("pmu", ("va_degree",), bus, 0.05, 60.0),
        SensorParams("pmu", ("ia_degree",), branch, 0.5, 60.0),
        SensorParams("pmu", ("i_ka",), branch, 0.01, 60.0, sigma_kind="relative"),
        SensorParams("scada", ("p_mw", "q_mvar"), ("buses",), 0.01, 60.0, sigma_kind="relative"),
    )
    raw = simulate(network, curves(), STUDY, SimulateParams(seed=SEED, sensors=sensors))
    if grid == "own without loads":
        buses = network.buses
        idle = np.zeros(network.n_bus)
        bare = dataclasses.replace(buses, p_load_mw=idle, q_load_mvar=idle, p_gen_mw=idle)
        raw = dataclasses.replace(raw, model=dataclasses.replace(network, buses=bare))
    return raw


def run(raw: RawCase, telemetry: pd.DataFrame, params: ValidateParams | None = None):
    """Validated samples, estimates and steps of the filter."""
    validated = validate(telemetry, raw.channels, params, history_end=STUDY.start, model=raw.model)
    aligned = align(validated, raw.channels, raw.model, STUDY)
    done = estimate(aligned, raw.channels, raw.model, STUDY, METHOD)
    return validated, done.estimated, done.steps


def spoilt(raw: RawCase, quantity: str) -> np.ndarray:
    """Row of the wrong sample: one of the second channel of the quantity."""
    name = raw.channels.loc[raw.channels["quantity"] == quantity, "channel"].iloc[1]
    own = np.flatnonzero(raw.telemetry["channel"] == name)
    return own[[AT]]


def million(raw: RawCase, row: int) -> float:
    """1e6 p.u. (rad) in the unit of a row's channel."""
    layout = SensorLayout.from_channels(raw.channels, raw.model)
    at = layout.channel.index(raw.telemetry["channel"].iloc[row])
    return 1e6 / float(layout.scale[at])


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_sample_is_out_and_the_filter_does_as_if_it_had_not_come(
    grid: str, quantity: str
) -> None:
    raw = case(grid)
    row = spoilt(raw, quantity)
    wrong, absent = raw.telemetry.copy(), raw.telemetry.drop(index=row)
    wrong.loc[row, "value"] = million(raw, int(row[0]))
    validated, estimated, steps = run(raw, wrong)
    assert validated["threshold"].drop(index=row).isna().all()
    assert validated["reasons"].iloc[row].tolist() == [Reason.LIMIT]
    assert (validated["flag"].drop(index=row) == Flag.GOOD).all()
    _, without, _ = run(raw, absent)
    for column in ("value", "sigma"):
        np.testing.assert_array_equal(estimated[column], without[column])
    assert steps["status"].isin(["ok", "inconsistent"]).all()


@pytest.mark.parametrize("grid", ["ieee33", "own on 100 MVA"])
def test_without_default_limits_that_one_sample_changes_estimates(grid: str) -> None:
    raw = case(grid)
    wrong = raw.telemetry.copy()
    # A meter whose σ is a share of its reading would be believed the less the further it is off.
    row = spoilt(raw, "vm_pu")
    wrong.loc[row, "value"] = million(raw, int(row[0]))
    off = ValidateParams(default_limits=DefaultLimits(apply=False))
    validated, estimated, _ = run(raw, wrong, off)
    assert (validated["flag"] == Flag.GOOD).all()
    _, right, _ = run(raw, raw.telemetry)
    error = (estimated["value"] - right["value"])[estimated["quantity"] == "vm_pu"].abs()
    later = estimated["time_utc"] >= wrong["time_utc"].loc[row].iloc[0]
    # How much is the filter's matter: one that starts again from what is impossible loses little.
    assert not (error[later] == 0.0).all()
    assert (error[~later] == 0.0).all()
