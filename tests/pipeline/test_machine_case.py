"""Claim: a machine runs through the stages that a grid runs through, past a spike and a gap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pse_analysis import pipeline
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.estimation import Method, estimate
from pse_analysis.machine import Machine
from pse_analysis.parameters import build
from pse_analysis.pipeline import runner
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.plan import NAMES, Options
from pse_analysis.pipeline.stages import Parameters, check_case
from pse_analysis.scoring import Published, ScoreParams, score
from pse_analysis.scoring.observers import SettlingParams, settling_time
from pse_analysis.telemetry import ingest

CASE = Path(__file__).parents[2] / "pipelines" / "cases" / "machine.toml"
GAP = (pd.Timestamp("2025-08-12T00:00:08Z"), pd.Timestamp("2025-08-12T00:00:08.500Z"))
SPIKE = pd.Timestamp("2025-08-12T00:00:07Z")


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> Options:
    """The project's own case, cut to 10 s and one trial."""
    folder = tmp_path_factory.mktemp("machine")
    text = CASE.read_text(encoding="utf-8")
    for old, new in (
        ("end = 2025-08-12T00:01:00Z", "end = 2025-08-12T00:00:10Z"),
        ("trials = 3", "trials = 1"),
        ("00:00:20Z", "00:00:07Z"),
        ("00:00:20.010Z", "00:00:07.010Z"),
        ("00:00:30Z", "00:00:08Z"),
        ("00:00:31Z", "00:00:08.500Z"),
        ("after_s = 35.0", "after_s = 5.5"),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "cases").mkdir()
    (folder / "cases" / "machine.toml").write_text(text, encoding="utf-8")
    return Options(data=folder / "data", cases=folder / "cases", workers=1)


@pytest.fixture(scope="module")
def results(options: Options) -> pipeline.Results:
    assert runner.run("machine", options).ran == NAMES
    return pipeline.load("machine", data=options.data, cases=options.cases)


@pytest.fixture(scope="module")
def parameters(options: Options) -> Parameters:
    return check_case(load_case("machine", options.cases))


def errors(results: pipeline.Results, method: str) -> pd.DataFrame:
    """Error and σ by instant, one column per state."""
    key = ["trial", "time_utc", "element", "quantity"]
    own = results["estimated"][results["estimated"].method == method]
    both = own.merge(results["truth"].rename(columns={"value": "true"}), on=key)
    both = both.assign(error=both.value - both.true)
    return both.pivot_table(index="time_utc", columns="quantity", values=["error", "sigma"])


def test_second_run_finds_everything_current(results: pipeline.Results, options: Options) -> None:
    assert len(results.recordings) == 4
    assert runner.run("machine", options).ran == ()


def test_raw_folder_brings_the_machine_back(results: pipeline.Results) -> None:
    assert results.machine == Machine(200.0, 6.4, 0.032, 50.0, 13.8)
    assert set(results["channels"].quantity) == {"rotor_angle_rad", "delta_m_pu"}
    with pytest.raises(TableError, match="not a grid"):
        _ = results.network


def test_spike_is_flagged_and_no_good_sample_is(results: pipeline.Results) -> None:
    flagged = results["validated"][results["validated"].flag > 0]
    assert flagged.time_utc.tolist() == [SPIKE]


def test_spike_and_gap_are_predicted_and_do_not_throw_the_observer_off(
    results: pipeline.Results,
) -> None:
    steps = results["steps"].set_index(["method", "time_utc"]).loc["matched"].status
    held = steps[(steps.index >= GAP[0]) & (steps.index < GAP[1])]
    assert set(held) | {steps[SPIKE]} == {"predicted"}
    assert len(held) == 50
    late = errors(results, "matched").loc[pd.Timestamp("2025-08-12T00:00:06Z") :]
    assert (late["error"].abs() < 5 * late["sigma"]).all(axis=None)


def test_scores_stand_beside_theory_and_print(results: pipeline.Results) -> None:
    whole = results["scored"][results["scored"].element == ""]
    scored = whole.set_index(["method", "metric"], verify_integrity=True).sort_index()
    ratio = (
        scored.loc[("matched", "angle_rms"), "value"]
        / scored.loc[("matched", "angle_rms_theory"), "value"]
    )
    assert 0.5 < ratio < 1.6  # 4.5 s hold few independent errors
    assert scored.loc[("case_1", "angle_gain"), "published"] == -1001.0
    assert scored.loc[("case_1", "speed_gain"), "value"] == pytest.approx(-995.0, abs=0.1)
    settled = scored.xs("speed_settling", level="metric").value
    assert settled["luenberger"] < settled["matched"] < 5.0
    assert results.summary.count("\n") > 8
    assert "θ RMS" in results.summary


def test_without_torque_it_says_what_it_needs(
    results: pipeline.Results, parameters: Parameters
) -> None:
    channels = results["channels"][results["channels"].quantity == "rotor_angle_rad"]
    aligned = results["aligned"][results["aligned"].channel.isin(channels.channel)]
    method = parameters.estimate.methods[3]
    with pytest.raises(TableError, match=r"needs the machine's input ΔM.*delta_m_pu at machine/1"):
        estimate(aligned, channels, results.machine, parameters.study, method)


def test_methods_of_a_grid_and_of_a_machine_do_not_mix(
    results: pipeline.Results, parameters: Parameters
) -> None:
    wls = build(Method, {"name": "wls", "filter": "wls"}, "methods")
    with pytest.raises(ParameterError, match="estimates a grid, but the case is about machine/1"):
        estimate(results["aligned"], results["channels"], results.machine, parameters.study, wls)
    with pytest.raises(ParameterError, match="key 'observer' is missing"):
        build(Method, {"name": "o", "filter": "observer"}, "methods")


def test_telemetry_of_ones_own_machine_is_taken_in(results: pipeline.Results) -> None:
    raw = ingest(
        results["telemetry"].drop(columns=["seq", "quality"]), results["channels"], results.machine
    )
    assert raw.model == results.machine
    assert len(raw.telemetry) == len(results["telemetry"])
    wrong = results["channels"].assign(element="bus/1")
    with pytest.raises(TableError, match=r"machine/1 has no bus '1'.*machine/1"):
        ingest(results["telemetry"], wrong, results.machine)


def test_printed_number_without_a_score_is_refused(results: pipeline.Results) -> None:
    params = ScoreParams(published=(Published("matched", "angle_rsm", 1.0, "nowhere"),))
    with pytest.raises(ParameterError, match=r"no score 'angle_rsm'.*angle_rmse"):
        score(
            results["estimated"], results["steps"], results["validated"], results["truth"],
            params=params,
        )  # fmt: skip


def test_case_is_about_a_grid_or_a_machine(options: Options, tmp_path: Path) -> None:
    assert options.cases is not None
    text = (options.cases / "machine.toml").read_text(encoding="utf-8")
    (tmp_path / "both.toml").write_text('grid = "ieee33"\n' + text, encoding="utf-8")
    with pytest.raises(ParameterError, match="a grid or about a machine"):
        load_case("both", tmp_path)


def test_settling_is_the_first_time_from_which_errors_stay_as_small_as_theory() -> None:
    time = np.arange(0.0, 10.0, 0.01)
    error = 8.0 * np.exp(-time)
    assert settling_time(time, error, 0.5) == pytest.approx(np.log(8.0) - 0.2, abs=0.02)
    params = SettlingParams(window_s=2.0, share=1.0)
    assert settling_time(time, error, 0.5, params) == pytest.approx(np.log(8.0), abs=0.011)
    assert np.isnan(settling_time(time, np.ones_like(time), 0.1))
