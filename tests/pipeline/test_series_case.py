"""Claim: a case of metered loads runs without an estimate, and ends with what its checks found."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

import pytest

from pse_analysis import pipeline
from pse_analysis.errors import ParameterError
from pse_analysis.pipeline import runner
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.plan import NAMES, Options
from pse_analysis.vocabulary import Flag, Reason

CASE = Path(__file__).parents[2] / "pipelines" / "cases" / "industrial_load.toml"
PLANT = "scada:bus/plant:p_mw"


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> Options:
    """The project's own case with one trial."""
    folder = tmp_path_factory.mktemp("series")
    text = CASE.read_text(encoding="utf-8")
    assert "trials = 3" in text
    (folder / "cases").mkdir()
    (folder / "cases" / CASE.name).write_text(text.replace("trials = 3", "trials = 1"))
    return Options(data=folder / "data", cases=folder / "cases", workers=1)


@pytest.fixture(scope="module")
def results(options: Options) -> pipeline.Results:
    assert runner.run(CASE.stem, options).ran == NAMES
    return pipeline.load(CASE.stem, data=options.data, cases=options.cases)


def test_second_run_finds_everything_current(results: pipeline.Results, options: Options) -> None:
    assert set(results.recordings) == {"validate", "align", "score"}
    assert runner.run(CASE.stem, options).ran == ()


def test_reader_that_has_seen_enough_is_no_bug(results: pipeline.Results, options: Options) -> None:
    arguments = ["run", CASE.stem, "--data", str(options.data), "--cases", str(options.cases)]
    code = f"import sys; from pse_analysis.pipeline.cli import main; sys.exit(main({arguments}))"
    run = subprocess.Popen([sys.executable, "-c", code], stdout=PIPE, stderr=PIPE, text=True)
    assert run.stdout is not None
    run.stdout.close()
    run.stdout = None
    _, said = run.communicate(timeout=60)
    assert (run.returncode, said) == (1, "")


def test_nothing_is_estimated_and_everything_is_checked(results: pipeline.Results) -> None:
    assert results["estimated"].empty
    assert results["steps"].empty
    assert len(results["validated"]) == len(results["telemetry"])


def test_summary_has_a_row_per_kind_and_channel_and_fits_the_page(
    results: pipeline.Results,
) -> None:
    lines = [line.split() for line in results.summary.splitlines() if line]
    first = {words[0] for words in lines}
    assert {"spike", "empty", "duplicated", PLANT} <= first
    assert max(map(len, results.summary.splitlines())) <= 100
    assert ["bad", "data:"] in [words[:2] for words in lines]


def test_empty_and_repeated_telegrams_are_all_found(results: pipeline.Results) -> None:
    scored = results["scored"]
    recall = scored[scored.metric == "recall"].set_index("element").value
    assert recall["empty"] == recall["duplicated"] == 1.0
    assert recall["spike"] > 0.4


def test_large_spikes_of_the_plant_are_found_and_small_ones_hide(
    results: pipeline.Results,
) -> None:
    faults, validated = results["faults"], results["validated"]
    spikes = faults[(faults.kind == "spike") & (faults.channel == PLANT)].astype({"seq": "int64"})
    flagged = spikes.merge(validated, on=["trial", "channel", "seq"])
    found, size = flagged.flag == Flag.BAD, flagged["size"].abs() / 0.15
    assert found[size > 5.0].mean() > 0.9
    assert found[size < 1.5].mean() < 0.1


def test_true_steps_are_accepted_after_two_confirming_samples(results: pipeline.Results) -> None:
    own = results["validated"].query("channel == @PLANT and trial == 0").reset_index(drop=True)
    for moment in ("2016-06-09T09:00Z", "2016-06-10T17:00Z"):
        after = own[own.time_utc >= moment].head(6)
        assert after.flag.iloc[0] == Flag.BAD
        assert (after.reasons & int(Reason.STEP_ACCEPTED)).any()
        assert (after.flag.iloc[-2:] == Flag.GOOD).all()


def test_a_case_has_one_subject(options: Options, tmp_path: Path) -> None:
    text = CASE.read_text(encoding="utf-8")
    (tmp_path / "both.toml").write_text('grid = "ieee33"\n' + text, encoding="utf-8")
    with pytest.raises(ParameterError, match=r"received grid and simulate\.generated: keep one"):
        load_case("both", tmp_path)
