"""Claim: damaged, older or foreign files are found before a number of them is used."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from endurance.flips import flips, unnoticed, uses

from pse_analysis import pipeline, telemetry
from pse_analysis.errors import DamagedFile, TableError
from pse_analysis.pipeline import cache, cli, runner, stages
from pse_analysis.pipeline.plan import NAMES, Options, Reporter

CASES = Path(__file__).parent / "cases"
SOURCE = Path(pipeline.__file__).parents[2]
SEED = 8
FLIPS = 10
"""Bits turned in each of some 20 files; `endurance.flips` turns thousands."""
PAGE_FLIPS = 40

TABLES = ("validated", "aligned", "estimated", "residuals", "steps", "scored")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Options:
    """A finished run of the small case."""
    folder = tmp_path_factory.mktemp("whole")
    shutil.copytree(CASES, folder / "cases")
    options = Options(data=folder / "data", cases=folder / "cases", workers=1)
    assert runner.run("small", options).ran == NAMES
    return options


@pytest.fixture
def options(whole: Options, tmp_path: Path) -> Options:
    """A copy of that run, to damage."""
    assert whole.data is not None
    shutil.copytree(whole.data.parent, tmp_path, dirs_exist_ok=True)
    return Options(data=tmp_path / "data", cases=tmp_path / "cases", workers=1)


def change(options: Options, **values: object) -> Options:
    return Options(**{**vars(options), **values})


def edit(options: Options, old: str, new: str) -> None:
    assert options.cases is not None
    path = options.cases / "small.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def load(options: Options, *, older: bool = False) -> pipeline.Results:
    return pipeline.load("small", data=options.data, cases=options.cases, older=older)


def command(options: Options, name: str, *more: str) -> list[str]:
    return [name, "small", *more, "--data", str(options.data), "--cases", str(options.cases)]


def write_manifest(path: Path, value: Any) -> None:
    """Write a manifest whose seals fit, as if the program had written it."""
    parts = {**value["stages"], "raw": value["raw"]}
    seals = {name: cache.seal(part) for name, part in parts.items()}
    path.write_text(json.dumps({**value, "seals": seals}))


class Warnings(Reporter):
    """Keeps what a run warns of."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def warning(self, text: str) -> None:
        self.texts.append(text)


def test_no_number_of_a_file_with_a_turned_bit_is_used(options: Options) -> None:
    generator = np.random.default_rng(SEED)
    seen = set()
    for path, use in uses(options):
        seen.add(path.suffix)
        assert unnoticed(path, use, FLIPS, generator) == 0, path
    assert seen == {".parquet", ".rrd"}


def test_damaged_files_name_their_remedy(options: Options) -> None:
    results, raw = load(options), options.data_folder / "raw" / "small"
    for path in (results.files["aligned"], results.recordings["score"], raw / "truth.parquet"):
        path.write_bytes(next(flips(path, 1, np.random.default_rng(SEED))))
    with pytest.raises(DamagedFile, match=r"aligned\.parquet is not as .*run small --force"):
        results["aligned"]
    with pytest.raises(DamagedFile, match=r"score\.rrd is not as .*run small --force"):
        results.recordings["score"]
    with pytest.raises(DamagedFile, match=r"truth\.parquet is not as .*--force"):
        telemetry.read_raw(raw)


@pytest.mark.parametrize("table", ["validated", "aligned"])
def test_flipped_bits_of_pages_are_found_even_without_a_list_of_checksums(
    options: Options, table: str
) -> None:
    path = load(options).files[table]
    size = path.stat().st_size - 8 - int.from_bytes(path.read_bytes()[-8:-4], "little")
    truth, generator = telemetry.read_table(path, table), np.random.default_rng(SEED)
    copy, silent = path.with_name("copy.parquet"), 0
    content = path.read_bytes()
    for bit in generator.integers(32, 8 * size, PAGE_FLIPS):
        turned = bytearray(content)
        turned[bit // 8] ^= 1 << (bit % 8)
        copy.write_bytes(turned)
        try:
            silent += not telemetry.read_table(copy, table).equals(truth)
        except TableError:
            continue
    assert silent == 0


@pytest.mark.parametrize("kind", ["random bytes", "one bit", "shorter", "gone", "same time"])
def test_damaged_table_is_made_again_with_a_warning(options: Options, kind: str) -> None:
    path = load(options).files["aligned"]
    good, like = path.read_bytes(), path.stat()
    if kind == "gone":
        path.unlink()
    else:
        noise = np.random.default_rng(SEED).bytes(len(good))
        flip = next(flips(path, 1, np.random.default_rng(SEED)))
        damaged = {"random bytes": noise, "shorter": good[:-9]}.get(kind, flip)
        path.write_bytes(damaged)
        if kind == "same time":
            os.utime(path, ns=(like.st_atime_ns, like.st_mtime_ns))
    heard = Warnings()
    assert runner.run("small", options, heard).ran == ("align",)
    (text,) = heard.texts
    assert "aligned.parquet" in text
    assert "made again" in text
    assert load(options).files["aligned"].read_bytes() == good


def test_damage_that_moved_no_time_is_found_before_the_next_stage_reads_it(
    options: Options,
) -> None:
    path = load(options).files["validated"]
    path.write_bytes(next(flips(path, 1, np.random.default_rng(SEED))))
    manifest = options.data_folder / "processed" / "small" / "manifest.json"
    value = json.loads(manifest.read_text())
    status = path.stat()
    facts = value["stages"]["validate"]["files"]["validated.parquet"]
    facts["times"] = [status.st_mtime_ns, status.st_ctime_ns]
    write_manifest(manifest, value)
    assert runner.run("small", options).ran == ()
    edit(options, "[align]", "[align]\nmax_age_s = { pmu = 1200.0 }")
    heard = Warnings()
    ran = runner.run("small", options, heard).ran
    assert ran[:2] == ("validate", "align")
    assert "validated.parquet" in heard.texts[0]


def test_damaged_summary_is_not_printed(options: Options) -> None:
    path = next((options.data_folder / "processed" / "small" / "score").rglob("summary.txt"))
    good = path.read_bytes()
    path.write_bytes(good.replace(b"0", b"1"))
    heard = Warnings()
    result = runner.run("small", options, heard)
    assert result.ran == ("score",)
    assert "wls" in result.summary
    assert "summary.txt" in heard.texts[0]


def test_damaged_part_of_a_worker_is_not_joined(
    options: Options, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = stages.each

    def damage(*arguments: Any) -> Any:
        written = list(whole(*arguments))
        path = next(iter(written[0]))
        # In the footer, which no page's checksum covers.
        content = path.read_bytes()
        path.write_bytes(content[:-40] + bytes([content[-40] ^ 1]) + content[-39:])
        return written

    edit(options, 'filter = "kalman"', 'filter = "kalman"\nnoise = "scalar"')
    with monkeypatch.context() as patch:
        patch.setattr(stages, "each", damage)
        with pytest.raises(DamagedFile, match=r"estimated-000-00000\.parquet is not as it was"):
            runner.run("small", options)
    processed = options.data_folder / "processed" / "small"
    assert not [p for p in processed.rglob("*") if "tmp" in p.name]
    assert runner.run("small", options).ran == ("estimate", "score")


def test_results_of_other_parameters_are_left_out(options: Options) -> None:
    edit(options, "seed = 14", "seed = 15")
    with pytest.raises(TableError, match=r"all results .* are older .*\(simulate: simulate of the"):
        load(options)
    runner.run("small", change(options, until="validate"))
    tables = load(options)
    assert set(tables.files) == {"validated"}
    assert set(tables.recordings) == {"validate"}
    assert tables.summary == ""
    assert set(tables.older) == {"align", "estimate", "score"}
    with pytest.raises(TableError, match=r"estimated is older .*align is older: .* has changed"):
        tables["estimated"]
    shown = load(options, older=True)
    assert set(TABLES) <= set(shown)
    assert set(shown.older) == {"align", "estimate", "score"}
    assert runner.run("small", options).older == {}
    assert set(TABLES) <= set(load(options))


def test_run_up_to_a_stage_says_what_is_older(
    options: Options, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(options, "seed = 14", "seed = 15")
    assert cli.main(command(options, "run", "--until", "validate")) == 0
    assert "score      older: " in capsys.readouterr().out


def test_view_opens_no_older_recording_unless_it_is_asked_to(
    options: Options, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[list[str]] = []
    monkeypatch.setattr("os.execv", lambda _, command: started.append(command))
    monkeypatch.setattr("os.execve", lambda _, command, env: started.append(command))
    edit(options, "[score]", "[score]\nby_hour = false")
    cli.main(command(options, "view"))
    assert (
        "score is left out, because it is older or damaged: score of the case file"
        in capsys.readouterr().err
    )
    assert [Path(name).name for name in started[0][1:4]] == [
        "validate.rrd",
        "align.rrd",
        "estimate.rrd",
    ]
    cli.main(command(options, "view", "--older"))
    assert any(name.endswith("score.rrd") for name in started[1])


def test_every_derived_table_says_where_it_comes_from(options: Options) -> None:
    store = options.data_folder / "processed" / "small" / "manifest.json"
    stages = json.loads(store.read_text())["stages"]
    for name, path in load(options).files.items():
        told = telemetry.read_provenance(path)
        assert told["case"] == "small"
        assert told["fingerprint"] == stages[told["stage"]]["fingerprint"]
        assert told["inputs"] == stages[told["stage"]]["inputs"], name
        assert {"pse_analysis", "numpy", "pyarrow", "python"} <= set(told["versions"])
        assert json.loads(told["parameters"]["study"])["step_s"] == 300
    raw = options.data_folder / "raw" / "small" / "channels.parquet"
    assert telemetry.read_provenance(raw) == {}


def test_table_of_equal_content_and_other_provenance_stops_the_wave(options: Options) -> None:
    validated = load(options)["validated"]
    edit(options, "[validate]", "[validate]\nrules = []")
    before = json.loads((options.data_folder / "processed" / "small" / "manifest.json").read_text())
    result = runner.run("small", options)
    after = load(options)
    assert after["validated"].equals(validated)
    facts = before["stages"]["validate"]["files"]["validated.parquet"]
    assert result.entries["validate"].files["validated.parquet"]["content"] == facts["content"]
    assert result.entries["validate"].files["validated.parquet"]["digest"] != facts["digest"]
    # The summary tells what the checks were asked for.
    assert result.ran == ("validate", "score")


class TestVerify:
    """`pse verify` compares everything and says what was touched."""

    def test_a_fresh_run_is_whole(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert cli.main(command(options, "verify")) == 0
        assert ", 0 damaged" in capsys.readouterr().out

    def test_what_was_touched_is_named(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        results = load(options)
        path = results.files["steps"]
        path.write_bytes(next(flips(path, 1, np.random.default_rng(SEED))))
        results.recordings["align"].unlink()
        (options.data_folder / "raw" / "small" / "truth.parquet").write_bytes(b"?")
        (results.files["scored"].parent / "mine.txt").write_text("mine")
        assert cli.main(command(options, "verify")) == 1
        text = capsys.readouterr().out
        assert "steps.parquet differs from what was written: `pse run small --force`" in text
        assert "align.rrd is gone" in text
        assert "truth.parquet differs from what was written" in text
        assert "mine.txt is not a file of this program" in text
        assert "3 damaged" in text

    def test_older_results_are_named_and_are_no_damage(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        edit(options, "[score]", "[score]\nby_hour = false")
        assert cli.main(command(options, "verify")) == 0
        assert "older: score of the case file has changed" in capsys.readouterr().out

    def test_table_with_another_provenance_is_named(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        manifest = options.data_folder / "processed" / "small" / "manifest.json"
        value = json.loads(manifest.read_text())
        value["stages"]["align"]["inputs"]["raw/truth.parquet"] = "0" * 32
        write_manifest(manifest, value)
        assert cli.main(command(options, "verify")) == 1
        assert "aligned.parquet says inputs" in capsys.readouterr().out

    def test_change_of_raw_data_can_be_accepted(
        self, options: Options, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = (CASES / "small.toml").read_text(encoding="utf-8")
        assert options.cases is not None
        head, rest = text.replace('grid = "ieee14"\n', "").split("[simulate]")
        (options.cases / "small.toml").write_text(head + "[validate]" + rest.split("[validate]")[1])
        raw = options.data_folder / "raw" / "small"
        (raw / "simulated.json").unlink()
        channels = telemetry.read_raw(raw).channels
        telemetry.write_table(
            raw / "channels.parquet", channels.assign(sigma=channels["sigma"] * 2), "channels"
        )
        arguments = command(options, "run", "--until", "validate")
        assert cli.main(arguments) == 1
        assert "pse verify small --accept" in capsys.readouterr().err
        assert cli.main(command(options, "verify", "--accept")) == 0
        assert cli.main(arguments) == 0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signal_ends_a_run_with_one_line_and_leaves_nothing(
    options: Options, number: signal.Signals, code: int
) -> None:
    hang = (
        "import sys, time\n"
        "import pse_analysis.pipeline.stages as stages\n"
        "def hang(*rest):\n    print('here', flush=True)\n    time.sleep(600)\n"
        "stages.write_table = hang\n"
        "from pse_analysis.pipeline.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    edit(options, "[validate]", "[[validate.rules]]\ncriterion = 'fixed'\nquantile = 6.0")
    process = subprocess.Popen(
        [sys.executable, "-c", hang, *command(options, "run", "--workers", "1")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(SOURCE)},
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    assert process.stdout is not None
    next(line for line in process.stdout if line.strip() == "here")
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert errors.strip().splitlines() == [
        f"ended by {number.name}: finished stages are kept, the next run goes on"
    ]
    processed = options.data_folder / "processed" / "small"
    assert not [p for p in processed.rglob("*") if "tmp" in p.name]
