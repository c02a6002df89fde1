"""Claim: the runner runs the stages that are not current, in order, and no others."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_work import CASE, WORK, change, edit, prepare

from pse_analysis.checksums import RAW
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.pipeline import cli, runner
from pse_analysis.pipeline.cache import CacheError
from pse_analysis.pipeline.plan import NAMES, STAGES, Job, Options, Reporter

RUN = runner.run


@pytest.fixture
def options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Options:
    return prepare(tmp_path, monkeypatch)


def test_first_run_runs_everything_and_the_second_nothing(options: Options) -> None:
    first = runner.run("small", options, work=WORK)
    second = runner.run("small", options, work={})
    assert first.ran == NAMES
    assert second.cached == NAMES
    assert second.summary == "all is well\n"


@pytest.mark.parametrize(
    ("old", "new", "ran"),
    [
        ("seed = 3", "seed = 4", NAMES),
        ("limit = 1.1", "limit = 1.2", NAMES[1:]),
        ("max_age_s = 900", "max_age_s = 901", NAMES[2:]),
        ("[score]", "[score]\nbuses = 3", NAMES[4:]),
        ("step_s = 300", "step_s = 600", NAMES),
        ("[study]", 'notebook = "n.ipynb"\n[study]', ()),
    ],
)
def test_changed_parameter_reruns_what_depends_on_it(
    options: Options, old: str, new: str, ran: tuple[str, ...]
) -> None:
    runner.run("small", options, work=WORK)
    edit(options, old, new)
    result = runner.run("small", options, work=WORK)
    assert result.ran == ran


def test_stage_whose_output_did_not_change_stops_the_wave(options: Options) -> None:
    calm = {**WORK, "validate": lambda job: (job.output / "validated.parquet").write_text("same")}
    runner.run("small", options, work=calm)
    edit(options, "limit = 1.1", "limit = 1.2")
    # The score's summary tells what the checks were asked for, whatever came of it.
    assert runner.run("small", options, work=calm).ran == ("validate", "score")


def test_until_stops_there_and_the_next_run_goes_on(options: Options) -> None:
    assert runner.run("small", change(options, until="align"), work=WORK).ran == NAMES[:3]
    assert runner.run("small", options, work=WORK).ran == NAMES[3:]


def test_force_runs_all_stages_again(options: Options) -> None:
    runner.run("small", options, work=WORK)
    assert runner.run("small", change(options, force=True), work=WORK).ran == NAMES


def test_single_stage_needs_current_inputs(options: Options) -> None:
    with pytest.raises(CacheError, match="needs a current result of 'simulate'"):
        runner.run("small", change(options, only="align"), work=WORK)
    runner.run("small", change(options, until="validate"), work=WORK)
    assert runner.run("small", change(options, only="align"), work=WORK).ran == ("align",)
    forced = change(options, only="align", force=True)
    assert runner.run("small", forced, work=WORK).ran == ("align",)


def test_failed_stage_leaves_nothing_and_the_next_run_repeats_it(options: Options) -> None:
    def fail(job: Job) -> None:
        (job.output / "half.parquet").write_text("half")
        raise TableError("no")

    with pytest.raises(TableError):
        runner.run("small", options, work={**WORK, "align": fail})
    assert not list((options.data_folder / "processed" / "small" / "align").iterdir())
    assert runner.run("small", options, work=WORK).ran == NAMES[2:]


def test_raw_data_changed_by_hand_is_refused_and_force_simulates_again(options: Options) -> None:
    runner.run("small", options, work=WORK)
    path = options.data_folder / "raw" / "small" / "channels.parquet"
    before = path.read_text()
    path.write_text("mine")
    with pytest.raises(CacheError, match="not as the simulation wrote it: --force"):
        runner.run("small", options, work=WORK)
    assert path.read_text() == "mine"
    runner.run("small", change(options, force=True), work=WORK)
    assert path.read_text() == before


def test_raw_data_of_the_user_is_used_and_its_changes_are_seen(options: Options) -> None:
    edit(options, "[simulate]\nseed = 3\n", "")
    edit(options, 'grid = "ieee14"\n', "")
    raw = options.data_folder / "raw" / "small"
    with pytest.raises(TableError, match=r"no raw data .* expected .*raw/small"):
        runner.run("small", options, work=WORK)
    (raw / "telemetry").mkdir(parents=True)
    (raw / "channels.parquet").write_text("1")
    (raw / "telemetry" / "part-0.parquet").write_text("1")
    assert runner.run("small", options, work=WORK).ran == NAMES[1:]
    (raw / "telemetry" / "part-0.parquet").write_text("2")
    assert runner.run("small", options, work=WORK).ran == ("validate",)
    with pytest.raises(ParameterError, match="nothing to simulate"):
        runner.run("small", change(options, only="simulate"), work=WORK)


def test_files_of_the_raw_folder_are_those_that_stages_read() -> None:
    assert set(RAW) == {name for stage in STAGES for name in stage.raw}


def test_raw_data_without_marker_is_not_simulated_over(options: Options) -> None:
    raw = options.data_folder / "raw" / "small"
    raw.mkdir(parents=True)
    (raw / "channels.parquet").write_text("mine")
    with pytest.raises(CacheError, match="was not made by a simulation"):
        runner.run("small", change(options, force=True), work=WORK)
    assert (raw / "channels.parquet").read_text() == "mine"


def test_reporter_hears_every_stage(options: Options) -> None:
    heard: list[str] = []

    class Listener(Reporter):
        def cached(self, stage: str) -> None:
            heard.append(f"cached {stage}")

        def started(self, stage: str) -> None:
            heard.append(f"started {stage}")

        def finished(self, stage: str, seconds: float) -> None:
            heard.append(f"finished {stage}")

    runner.run("small", change(options, until="validate"), work=WORK)
    runner.run("small", change(options, until="align"), Listener(), work=WORK)
    assert heard == ["cached simulate", "cached validate", "started align", "finished align"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"until": "algin"}, "did you mean 'align'"),
        ({"only": "x"}, "unknown stage 'x'"),
        ({"workers": 0}, "expected 1 or more"),
    ],
)
def test_impossible_options_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Options(**values)  # type: ignore[arg-type]


class TestCommandLine:
    """The command line turns results and errors into text and exit codes."""

    def arguments(self, options: Options, *more: str) -> list[str]:
        return ["run", *more, "--data", str(options.data), "--cases", str(options.cases)]

    @pytest.fixture(autouse=True)
    def fakes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(runner, "run", lambda n, o, r: RUN(n, o, r, work=WORK))

    def test_run_prints_stages_summary_and_places(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert cli.main(self.arguments(options, "small")) == 0
        assert cli.main(self.arguments(options, "small")) == 0
        text = capsys.readouterr().out
        assert text.count("all is well") == 2
        assert text.count(" cached\n") == len(NAMES)
        assert "scored.parquet" in text

    def test_one_failing_case_does_not_stop_the_others(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert cli.main(self.arguments(options, "nowhere", "small")) == 1
        captured = capsys.readouterr()
        assert "no case 'nowhere'" in captured.err
        assert "1 of 2 cases failed: nowhere" in captured.err
        assert "all is well" in captured.out

    def test_all_runs_every_case(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert options.cases is not None
        (options.cases / "other.toml").write_text(CASE, encoding="utf-8")
        assert cli.main(self.arguments(options, "all")) == 0
        assert capsys.readouterr().out.count("all is well") == 2

    @pytest.mark.parametrize(
        ("error", "message"),
        [
            (TableError("aligned: no"), "error: aligned: no"),
            (FileNotFoundError(2, "No such file", "/x"), "error: /x: No such file"),
            (OSError(28, "No space left on device"), "left on device: free some space and run"),
            (MemoryError(), "out of memory"),
            (ZeroDivisionError("division"), "This is a bug of pse_analysis"),
        ],
    )
    def test_error_is_a_sentence_and_debug_shows_where(
        self,
        options: Options,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        error: Exception,
        message: str,
    ) -> None:
        def fail(*_: object) -> None:
            raise error

        monkeypatch.setattr(runner, "run", fail)
        assert cli.main(self.arguments(options, "small")) == 1
        text = capsys.readouterr().err
        assert message in text
        assert "Traceback" not in text
        assert cli.main(self.arguments(options, "small", "--debug")) == 1
        assert "Traceback" in capsys.readouterr().err

    def test_interruption_ends_with_130(
        self,
        options: Options,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        def stop(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(runner, "run", stop)
        assert cli.main(self.arguments(options, "small")) == 130
        assert "the next run goes on" in capsys.readouterr().err

    def test_cases_are_listed_with_their_titles(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert cli.main(["cases", "--cases", str(options.cases)]) == 0
        assert capsys.readouterr().out == "small  A small study\n"

    def test_view_before_a_run_says_what_to_run(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert cli.main(["view", *self.arguments(options, "small")[1:]]) == 1
        assert "pse run small" in capsys.readouterr().err

    def test_view_opens_the_recordings_on_this_machine_only(
        self, options: Options, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def record(job: Job) -> None:
            WORK["validate"](job)
            (job.output / "validate.rrd").write_text("x")

        monkeypatch.setattr(
            runner, "run", lambda n, o, r: RUN(n, o, r, work={**WORK, "validate": record})
        )
        started: list[list[str]] = []
        monkeypatch.setattr("os.execve", lambda _, command, __: started.append(command))
        monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
        assert cli.main(self.arguments(options, "small", "--force")) == 0
        cli.main(["view", *self.arguments(options, "small")[1:]])
        (command,) = started
        assert command[0].endswith("rerun")
        assert command[1].endswith("validate.rrd")
        assert command[2:] == ["--bind", "127.0.0.1"]
