"""Claim: metered loads are what the case says: generated as stated, real ones untouched."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.parameters import Study
from pse_analysis.simulation import profiles
from pse_analysis.simulation.series import (
    CurveParams,
    GeneratedParams,
    SeriesSimulateParams,
    StepParams,
    simulate_series,
)
from pse_analysis.simulation.settings import FaultParams
from pse_analysis.telemetry import RawCase, check_channels
from pse_analysis.vocabulary import check

SEED = 2018
PLANT, CURVE = "scada:bus/plant:p_mw", "scada:bus/G4-H:p_mw"
STUDY = Study(
    datetime(2016, 6, 9, tzinfo=UTC), datetime(2016, 6, 11, tzinfo=UTC), 120.0, 3 * 86400.0
)
STEP = StepParams(datetime(2016, 6, 9, 9, tzinfo=UTC), 6.0)
CLEAN = SeriesSimulateParams(
    seed=SEED,
    generated=(GeneratedParams("plant", 60.0, 0.15, rho1=0.5),),
    curves=(CurveParams("G4-H", "G4-H_pload", 10.0),),
)
FAULTS = (
    FaultParams("spike", 0.02, (0.01, 6.0), at=("bus/plant",)),
    FaultParams("spike", 0.05, (0.2, 1.0), relative=True, at=("bus/G4-H",)),
    FaultParams("empty", 0.01),
    FaultParams("duplicated", 0.01, (1.0, 30.0)),
    FaultParams("lost", 0.01),
)
FAULTY = dataclasses.replace(CLEAN, faults=FAULTS)


@pytest.fixture(scope="module")
def curves() -> pd.DataFrame:
    return profiles.load(Path(__file__).parents[2] / "data" / "raw" / "load_profiles")


@pytest.fixture(scope="module")
def faulty(curves: pd.DataFrame) -> RawCase:
    return simulate_series(curves, STUDY, FAULTY)


def of(table: pd.DataFrame, channel: str) -> pd.DataFrame:
    return table[table.channel == channel].reset_index(drop=True)


def test_generated_load_has_the_increments_it_was_asked_for(curves: pd.DataFrame) -> None:
    long = dataclasses.replace(
        CLEAN, curves=(), generated=(GeneratedParams("plant", 60.0, 0.15, 0.5, period_s=5.0),)
    )
    change = np.diff(simulate_series(curves, STUDY, long).telemetry.value)
    error = 1.0 / np.sqrt(len(change))
    assert change.std() == pytest.approx(0.15, rel=4 * error)
    for lag, rho in ((1, 0.5), (2, 0.25), (3, 0.125)):
        found = np.mean(change[lag:] * change[:-lag]) / change.var()
        assert found == pytest.approx(rho, abs=5 * error)


def test_real_curve_is_read_at_its_own_points_only(curves: pd.DataFrame) -> None:
    raw = simulate_series(curves, STUDY, CLEAN)
    own = of(raw.telemetry, CURVE).set_index("time_utc").value
    assert (np.diff(own.index.asi8) == 900_000_000).all()
    points = curves["G4-H_pload"].loc[own.index[0] : own.index[-1]]
    pd.testing.assert_series_equal(own, 10.0 * points, check_names=False, check_freq=False)
    assert own.index[0] == pd.Timestamp(STUDY.history_start)
    assert own.index[-1] < pd.Timestamp(STUDY.end)
    assert of(raw.channels, CURVE).period_s[0] == 900.0
    truth = raw.truth[raw.truth.element == "bus/G4-H"]
    assert (truth.time_utc.dt.minute % 15 == 0).all()


def test_truth_is_an_injection_and_the_meter_counts_consumption(curves: pd.DataFrame) -> None:
    raw = simulate_series(curves, STUDY, CLEAN)
    truth = raw.truth[raw.truth.element == "bus/plant"].set_index("time_utc").value
    meter = of(raw.telemetry, PLANT).set_index("time_utc").value
    pd.testing.assert_series_equal(-truth, meter.loc[truth.index], check_names=False)
    assert (raw.channels.sign == -1).all()
    assert len(truth) == 2 * 720


def test_step_is_true_and_stays(curves: pd.DataFrame) -> None:
    stepped = dataclasses.replace(
        CLEAN, generated=(dataclasses.replace(CLEAN.generated[0], steps=(STEP,)),)
    )
    before, after = (simulate_series(curves, STUDY, p) for p in (CLEAN, stepped))
    change = of(after.telemetry, PLANT).value - of(before.telemetry, PLANT).value
    late = of(before.telemetry, PLANT).time_utc >= STEP.at
    np.testing.assert_allclose(change, np.where(late, 6.0, 0.0), atol=1e-9)
    assert after.faults.empty
    np.testing.assert_array_equal(after.sample_truth.value, after.telemetry.value)


def test_faults_are_recorded_with_kind_and_size(faulty: RawCase) -> None:
    both = faulty.telemetry.merge(
        faulty.sample_truth, on=["trial", "channel", "seq"], suffixes=("", "_true")
    )
    known = faulty.faults.dropna(subset=["seq"]).astype({"seq": "int64"})
    both = both.merge(
        known[["trial", "channel", "seq", "kind", "size"]], how="left",
        on=["trial", "channel", "seq"],
    )  # fmt: skip
    off = both.value - both.value_true
    spike, empty = both.kind == "spike", both.kind == "empty"
    np.testing.assert_allclose(off[spike], both["size"][spike])
    assert both.value[empty].isna().all()
    assert (off[~spike & ~empty] == 0.0).all()
    assert set(faulty.faults.kind) == {"spike", "empty", "duplicated", "lost"}
    plant = spike & (both.channel == PLANT)
    assert both["size"][plant].abs().max() <= 6 * 0.15
    assert plant.sum() == pytest.approx(0.02 * 3600, abs=4 * np.sqrt(0.02 * 3600))
    share = (both["size"] / both.value_true)[spike & (both.channel == CURVE)].abs()
    assert share.between(0.2, 1.0).all()


def test_tables_keep_their_schemas_and_the_grid_is_a_star(faulty: RawCase) -> None:
    for name in ("telemetry", "channels", "truth", "sample_truth", "faults"):
        check(name, getattr(faulty, name))
    check_channels(faulty.channels, faulty.model)
    assert faulty.network.buses.name == ("source", "plant", "G4-H")
    assert faulty.network.n_branch == 2


def test_one_seed_gives_one_case_whatever_the_number_of_trials(curves: pd.DataFrame) -> None:
    one, again, more = (
        simulate_series(curves, STUDY, dataclasses.replace(FAULTY, trials=n)) for n in (1, 1, 2)
    )
    for name in ("telemetry", "truth", "faults"):
        first = getattr(more, name)
        first = first[first.trial == 0].reset_index(drop=True)
        pd.testing.assert_frame_equal(getattr(one, name), getattr(again, name))
        pd.testing.assert_frame_equal(getattr(one, name), first)
    loads = more.sample_truth[more.sample_truth.channel == PLANT]
    assert loads[loads.trial == 0].value.iloc[9] != loads[loads.trial == 1].value.iloc[9]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"generated": (), "curves": ()}, r"expected \[\[simulate.generated\]\]"),
        ({"curves": (CurveParams("plant", "G4-H_pload", 1.0),)}, "'plant' stands twice"),
        ({"curves": (CurveParams("source", "G4-H_pload", 1.0),)}, "'source' stands twice or is"),
        ({"trials": 0}, "trials must be ≥ 1"),
        ({"accuracy": 0.0}, "accuracy must be > 0"),
    ],
)
def test_settings_that_cannot_hold_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        dataclasses.replace(CLEAN, **change)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GeneratedParams("a", 1.0, 0.0), "sigma_mw > 0"),
        (lambda: GeneratedParams("a", 1.0, 0.1, rho1=1.0), "rho1 < 1"),
        (lambda: CurveParams("a", "b", 0.0), "peak_mw > 0"),
        (lambda: StepParams(datetime(2016, 6, 9), 1.0), "no time zone"),
    ],
)
def test_series_that_cannot_be_are_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(ParameterError, match=message):
        make()


def test_curves_that_do_not_reach_or_do_not_exist_are_named(curves: pd.DataFrame) -> None:
    early = dataclasses.replace(STUDY, history_s=9 * 86400.0)
    with pytest.raises(ParameterError, match="load curves reach from"):
        simulate_series(curves, early, CLEAN)
    unknown = dataclasses.replace(CLEAN, curves=(CurveParams("a", "G9-H_pload", 1.0),))
    with pytest.raises(ParameterError, match="no curve 'G9-H_pload'"):
        simulate_series(curves, STUDY, unknown)
