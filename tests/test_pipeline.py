"""Claim: all stages of a small case run to whole, current results, however a run was ended."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pse_analysis import pipeline, telemetry
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.pipeline import runner
from pse_analysis.pipeline.cache import Store
from pse_analysis.pipeline.plan import NAMES, Options
from pse_analysis.vocabulary import KEYS, check

CASES = Path(__file__).parent / "cases"
SOURCE = Path(pipeline.__file__).parents[2]
PROCESSED = ("validated", "aligned", "estimated", "residuals", "steps", "scored")
PATIENCE_S = 60.0
LAXER = "[[validate.rules]]\ncriterion = 'fixed'\nquantile = 6.0"


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
    """A copy of that run, to change."""
    assert whole.data is not None
    shutil.copytree(whole.data.parent, tmp_path, dirs_exist_ok=True)
    return Options(data=tmp_path / "data", cases=tmp_path / "cases", workers=1)


def edit(options: Options, old: str, new: str) -> None:
    assert options.cases is not None
    path = options.cases / "small.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def load(options: Options, *, older: bool = False) -> pipeline.Results:
    assert options.data is not None
    return pipeline.load("small", data=options.data, cases=options.cases, older=older)


def command(options: Options, *more: str, setup: str = "") -> list[str]:
    """A run of the command line in a process of its own, with something patched before."""
    code = (
        f"import sys\n{setup}\nfrom pse_analysis.pipeline.cli import main\n"
        "code = main(sys.argv[1:])\n"
        "print('loaded', *sorted({'pandas', 'numpy', 'rich'} & set(sys.modules)))\n"
        "sys.exit(code)"
    )
    return [
        *(sys.executable, "-c", code, "run", "small", "--workers", "1"),
        *("--data", str(options.data), "--cases", str(options.cases), *more),
    ]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(SOURCE)}


def test_every_table_is_there_and_fits_its_schema(whole: Options) -> None:
    tables = load(whole)
    assert set(PROCESSED) < set(tables)
    for name in tables:
        assert len(check(name, tables[name])) > 0, name
    assert set(tables["steps"]["method"]) == {"wls", "kf_load"}
    assert len(tables["steps"]) == 2 * 12
    assert tables.network.n_bus == 14


def test_every_stage_leaves_a_recording(whole: Options) -> None:
    assert set(load(whole).recordings) == {"validate", "align", "estimate", "score"}


def test_summary_names_every_method_and_the_bad_data(whole: Options) -> None:
    summary = load(whole).summary
    for word in ("wls", "kf_load", "bad data:", "false alarms"):
        assert word in summary


def test_summary_says_first_which_channels_have_no_threshold(whole: Options) -> None:
    # Two hours of history hold eight quarter-hour means of 22 meters.
    told = " ".join(load(whole).summary.split("wls")[0].split())
    assert "attention: no threshold for changes was learnt for 22 of 50 channels" in told
    assert "holds 7 usable samples" in told
    assert "history_s to 27000 or more" in told


def test_samples_are_never_deleted(whole: Options) -> None:
    tables = load(whole)
    key = list(KEYS["telemetry"])
    kept = tables["telemetry"].merge(tables["validated"], on=key, suffixes=("", "_v"))
    assert len(kept) == len(tables["telemetry"]) == len(tables["validated"])
    same = (kept["value"] == kept["value_v"]) | kept["value"].isna()
    assert same.all()


def test_cached_run_is_quick_and_imports_the_standard_library_only(options: Options) -> None:
    done = subprocess.run(
        command(options), capture_output=True, text=True, env=environment(), check=True
    )
    assert done.stdout.count(" cached\n") == len(NAMES)
    assert "bad data:" in done.stdout
    assert done.stdout.splitlines()[-1].strip() == "loaded"


@pytest.mark.parametrize(
    ("old", "new", "ran"),
    [
        ("[score]", "[score]\nby_hour = false", ("score",)),
        ('filter = "wls"', 'filter = "kalman"\nnoise = "scalar"', ("estimate", "score")),
    ],
)
def test_changed_parameter_reruns_what_depends_on_it(
    options: Options, old: str, new: str, ran: tuple[str, ...]
) -> None:
    edit(options, old, new)
    assert runner.run("small", options).ran == ran


def test_simulation_gives_the_same_bytes_again(options: Options, tmp_path: Path) -> None:
    again = Options(data=tmp_path / "again", cases=options.cases, until="simulate")
    runner.run("small", again)

    def files(of: Options) -> dict[str, object]:
        listed = of.data_folder / "raw" / "small" / "checksums.json"
        return dict(json.loads(listed.read_text(encoding="utf-8"))["files"])

    assert files(again) == files(options)


def test_workers_do_not_change_results(options: Options) -> None:
    results = []
    for workers in ("1", "2"):
        arguments = command(options, "--only", "estimate", "--force")
        arguments[arguments.index("--workers") + 1] = workers
        subprocess.run(arguments, stdout=subprocess.PIPE, env=environment(), check=True)
        tables = load(options)
        results.append((tables["estimated"], tables["residuals"]))
    for one, two in zip(*results, strict=True):
        assert one.equals(two)


# Each setup lets the run come to one point of writing the validated table and hang there.
HANG = "import time\ndef hang():\n    print('here', flush=True)\n    time.sleep(600)\n"
MOMENTS = {
    "half a table": HANG
    + """
import pse_analysis.pipeline.stages as stages
real = stages.write_table
def write(path, *rest):
    real(path, *rest)
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)
    hang()
stages.write_table = write
""",
    "before the rename": HANG
    + """
import os
real = os.rename
def rename(a, b):
    hang() if "tmp" in str(a) else real(a, b)
os.rename = rename
""",
    "between rename and manifest": HANG
    + """
import pse_analysis.pipeline.cache as cache
real = cache.write_json
def write(path, value):
    hang() if path.name == "manifest.json" else real(path, value)
cache.write_json = write
""",
    "half a manifest": HANG
    + """
import os
real = os.replace
def replace(a, b):
    if str(b).endswith("manifest.json"):
        with open(a, "r+b") as file:
            file.truncate(40)
        hang()
    real(a, b)
os.replace = replace
""",
    "before the old folder is pruned": HANG
    + """
import pse_analysis.pipeline.cache as cache
real = cache.Store.prune
calls = []
def prune(self):
    calls.append(1)
    hang() if len(calls) > 1 else real(self)
cache.Store.prune = prune
""",
}


def kill_at(options: Options, moment: str) -> None:
    """Run until the moment, then SIGKILL."""
    process = subprocess.Popen(
        command(options, setup=MOMENTS[moment]),
        stdout=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip() == "here":
                break
        else:
            pytest.fail(f"the run ended before {moment}")
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE_S)
        process.stdout.close()


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_run_leaves_the_old_result_or_the_new_one(options: Options, moment: str) -> None:
    only = Options(**{**vars(options), "until": "validate"})
    old = load(options)["validated"]
    edit(options, "[validate]", LAXER)
    kill_at(options, moment)
    between = load(options, older=True)["validated"]
    if moment == "before the old folder is pruned":
        assert not between.equals(old)
        assert "validate" in runner.run("small", only).cached
    else:
        assert between.equals(old)
        assert runner.run("small", only).ran == ("validate",)
    assert not load(options)["validated"].equals(old)
    tables = load(options, older=True)
    for name in PROCESSED:
        assert len(check(name, tables[name])) > 0
    processed = options.data_folder / "processed" / "small"
    assert {path.name for path in processed.iterdir()} == {".lock", "manifest.json", *NAMES[1:]}
    for stage in NAMES[1:]:
        assert len(list((processed / stage).iterdir())) == 1


def test_killed_simulation_leaves_the_old_raw_folder(options: Options) -> None:
    assert options.data is not None
    before = (options.data / "raw" / "small" / "simulated.json").read_text(encoding="utf-8")
    edit(options, "seed = 14", "seed = 15")
    kill_at(options, "before the rename")
    assert (options.data / "raw" / "small" / "simulated.json").read_text(encoding="utf-8") == before
    only = Options(**{**vars(options), "until": "simulate"})
    assert runner.run("small", only).ran == ("simulate",)
    assert [p.name for p in (options.data / "raw").iterdir()] == ["small"]


def test_second_runner_of_a_case_is_refused(options: Options) -> None:
    edit(options, "[validate]", LAXER)
    first = subprocess.Popen(
        command(options, setup=MOMENTS["before the rename"]),
        stdout=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    try:
        assert first.stdout is not None
        next(line for line in first.stdout if line.strip() == "here")
        second = subprocess.run(
            command(options),
            capture_output=True,
            text=True,
            env=environment(),
            check=False,
            timeout=PATIENCE_S,
        )
    finally:
        first.kill()
        first.wait(PATIENCE_S)
        first.stdout.close()
    assert second.returncode == 1
    assert f"another process (pid {first.pid})" in second.stderr
    assert "Traceback" not in second.stderr


def test_interrupted_run_ends_with_130_and_its_workers_with_it(options: Options) -> None:
    setup = """
import pse_analysis.pipeline.processes as processes
real = processes.as_completed
def wait(futures):
    print('here', flush=True)
    import time
    time.sleep(600)
processes.as_completed = wait
"""
    edit(options, 'filter = "wls"', 'filter = "kalman"\nnoise = "scalar"')
    arguments = command(options, setup=setup)
    arguments[arguments.index("--workers") + 1] = "2"
    process = subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        # A shell that starts the tests in the background lets them ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    next(line for line in process.stdout if line.strip() == "here")
    begun = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert time.monotonic() - begun < PATIENCE_S
    assert options.data is not None
    assert Store(options.data / "processed" / "small").entries()["align"].damaged() == ()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[score]", "[score]\nby_our = true", "unknown key 'by_our': did you mean 'by_hour'"),
        ('filter = "wls"', 'filter = "wsl"', "filter"),
        ('name = "kf_load"', 'name = "wls"', "'wls' stands twice"),
        ('filter = "wls"', 'filter = "wls"\nvariant = "fused"', "'fused', .* one of 'last'"),
        (
            'filter = "wls"',
            'filter = "observer"\nobserver = { q = [1.0, 1.0], r = 1.0 }',
            "about a grid: use wls, kalman, ukf or ekf",
        ),
        ("seed = 14", "seed = 14\nsede = 1", "unknown key 'sede': did you mean 'seed'"),
    ],
)
def test_mistake_in_the_case_file_shows_before_anything_runs(
    options: Options, old: str, new: str, message: str
) -> None:
    edit(options, old, new)
    with pytest.raises(ParameterError, match=message) as caught:
        runner.run("small", Options(**{**vars(options), "force": True}))
    assert "small.toml" in str(caught.value)


def test_truncated_raw_table_is_refused_with_its_name(options: Options) -> None:
    text = (CASES / "small.toml").read_text(encoding="utf-8")
    assert options.cases is not None
    head, rest = text.replace('grid = "ieee14"\n', "").split("[simulate]")
    (options.cases / "small.toml").write_text(head + "[validate]" + rest.split("[validate]")[1])
    raw = options.data_folder / "raw" / "small"
    (raw / "simulated.json").unlink()
    path = raw / "channels.parquet"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(TableError, match=r"channels\.parquet is not as it was written"):
        runner.run("small", options)
    with pytest.raises(TableError, match=r"channels\.parquet is not a whole parquet file"):
        telemetry.accept(raw)
    (raw / "checksums.json").unlink()
    with pytest.raises(TableError, match=r"channels\.parquet is not a whole parquet file"):
        runner.run("small", options)


def test_load_before_a_run_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="pse run small"):
        pipeline.load("small", data=tmp_path, cases=CASES)


def test_tables_that_a_later_run_replaced_say_so(options: Options) -> None:
    stale = load(options)
    edit(options, "[score]", "[score]\nby_hour = false")
    runner.run("small", options)
    with pytest.raises(TableError, match="load the case again"):
        stale["scored"]
    with pytest.raises(KeyError, match="expected any of"):
        stale["scord"]
