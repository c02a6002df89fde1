"""Claim: every command of the README exists, and its way to one's own grid and telemetry works."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pse_analysis import pipeline
from pse_analysis.alignment import AlignParams
from pse_analysis.grid import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.parameters import build
from pse_analysis.pipeline.case import list_cases
from pse_analysis.pipeline.cli import parser
from pse_analysis.pipeline.plan import NAMES
from pse_analysis.vocabulary import Flag

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r"^```(?:bash|sh|shell|console)\n(.*?)^```", re.MULTILINE | re.DOTALL)
SEED = 20240514


def commands() -> list[str]:
    """Lines of the README's shell blocks, without prompts and comments."""
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8") if readme.is_file() else ""
    lines = [line for block in FENCE.findall(text) for line in block.splitlines()]
    bare = [line.strip().removeprefix("$ ").split(" #")[0].strip() for line in lines]
    return [line for line in bare if line and not line.startswith("#")]


def arguments_of(words: list[str]) -> list[str] | None:
    """Arguments for ``pse`` if the line starts this program in one of its ways."""
    name = Path(words[0]).name
    if name == "pse":
        return words[1:]
    if name.startswith("python") and words[1:2] and words[1].startswith("pipelines/"):
        stage = Path(words[1]).stem
        assert (ROOT / words[1]).is_file(), words[1]
        return ["run", *words[2:], *([] if stage == "run" else ["--only", stage])]
    return None


@pytest.mark.parametrize("line", commands())
def test_command_exists(line: str) -> None:
    words = shlex.split(line)
    if words[0] == "make":
        targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
        assert {word for word in words[1:] if "=" not in word} <= targets
        return
    arguments = arguments_of(words)
    if arguments is None:
        return
    options = parser().parse_args(arguments)
    named = getattr(options, "case", [])
    known = {*list_cases(ROOT / "pipelines" / "cases"), "all", "CASE", "my_case"}
    assert set([named] if isinstance(named, str) else named) <= known
    assert getattr(options, "until", None) in {None, *NAMES}


def block(language: str, word: str) -> str:
    """The README's one block in a language that has a word in it."""
    found = re.findall(rf"^```{language}\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    found = [text for text in found if word in text]
    assert len(found) == 1, f"{len(found)} {language} blocks with {word!r}"
    return str(found[0])


def export(folder: Path) -> None:
    """What a user has: a grid of four buses and ten hours of readings in local time, some bad."""
    (folder / "buses.csv").write_text("name,kind,vn_kv\nA,3,20\nB,1,20\nC,1,20\nD,1,20\n")
    (folder / "branches.csv").write_text(
        "from_bus,to_bus,r_pu,x_pu\nA,B,0.01,0.02\nB,C,0.02,0.03\nB,D,0.015,0.02\n"
    )
    rng = np.random.default_rng(SEED)
    steps = 120
    load = 1.5 + np.cumsum(rng.normal(0.0, 0.02, (4, steps)), axis=1)
    load[0] = 0.0
    grid = Network.from_tables(
        pd.DataFrame({"name": ["my_grid"], "base_mva": [10.0]}),
        pd.read_csv(folder / "buses.csv"),
        pd.read_csv(folder / "branches.csv"),
    )
    flow = solve(grid, -load / 10.0, -0.3 * load / 10.0)
    stamp = pd.date_range("2024-05-14 08:00", periods=steps, freq="5min")  # 06:00 UTC
    readings, channels = [], []
    for i, bus in enumerate("BCD", start=1):
        for tag, quantity, unit, value, sigma, sign in (
            (f"{bus}.P", "p_mw", "kw", 1e3 * load[i], 10.0, -1),
            (f"{bus}.Q", "q_mvar", "kvar", 300 * load[i], 5.0, -1),
            (f"{bus}.U", "vm_pu", "kv", 20.0 * flow.vm[i], 0.06, 1),
        ):
            noisy = value + rng.normal(0.0, sigma, steps)
            noisy[40] *= 3.0  # a wrong digit
            noisy[60] = np.nan
            readings.append(pd.DataFrame({"tag": tag, "stamp": stamp, "reading": noisy}))
            channels.append(
                (tag, "scada", quantity, f"bus/{bus}", unit, sigma, "absolute", 300, sign)
            )
    pd.concat(readings).to_csv(folder / "export.csv", index=False)
    names = "channel source quantity element unit sigma sigma_kind period_s sign"
    pd.DataFrame(channels, columns=names.split()).to_csv(folder / "channels.csv", index=False)


def test_own_grid_and_telemetry_run_as_the_readme_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export(tmp_path)
    cases = tmp_path / "pipelines" / "cases"
    cases.mkdir(parents=True)
    (cases / "my_case.toml").write_text(block("toml", "[study]"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(compile(block("python", "ingest"), "README.md", "exec"), {})
    results = pipeline.run("my_case", data=tmp_path / "data", cases=cases)
    assert set(results["steps"]["method"]) == {"wls", "kf_load"}
    steps = results["steps"]
    assert (steps.groupby("method").size() == 48).all()
    assert (steps["status"].isin(["ok", "inconsistent", "predicted"])).all()
    flags = results["validated"].groupby("seq")["flag"].min()
    assert flags.loc[40] == Flag.BAD
    assert flags.loc[60] == Flag.MISSING
    level = results["estimated"].query("quantity == 'vm_pu'")["value"]
    assert level.between(0.9, 1.1).all()


def test_late_sources_are_brought_together_as_the_readme_says() -> None:
    section = tomllib.loads(block("toml", "latency_s"))["align"]
    params = build(AlignParams, section, "align")
    assert params.latency_s == 300
    assert params.variants[0].time == "dtw"


def test_seeds_are_compared_as_the_readme_says() -> None:
    """The README's own lines, with two seeds in this process for its thirty on all cores."""
    text = block("python", "monte_carlo").replace("seeds=range(30)", "seeds=range(2), workers=1")
    names: dict[str, Any] = {}
    exec(compile(text, "README.md", "exec"), names)
    assert set(names["scores"]["seed"]) == {0, 1}
    assert set(names["scores"]["method"]) == {"wls", "kf_scalar", "kf_load"}
