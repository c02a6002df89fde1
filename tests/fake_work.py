"""A case whose stages only write down what they read, to test the runner within milliseconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pse_analysis.pipeline import runner
from pse_analysis.pipeline.descent import read_parameters
from pse_analysis.pipeline.plan import STAGES, Job, Options, Stage

CASE = """
title = "A small study"
grid = "ieee14"
[study]
start = 2016-06-09T00:00:00Z
end = 2016-06-09T01:00:00Z
step_s = 300
[simulate]
seed = 3
[validate]
limit = 1.1
[align]
max_age_s = 900
[score]
"""


def fake(stage: Stage) -> Callable[[Job], None]:
    """Work that writes down what it read: the same inputs give the same bytes."""

    def work(job: Job) -> None:
        seen = [repr(read_parameters(job.case, stage))]
        seen += [(job.raw / n).read_text() for n in stage.raw if (job.raw / n).is_file()]
        seen += [(job.inputs[s] / f"{t}.parquet").read_text() for s, t in stage.tables]
        names = {t for s in STAGES for earlier, t in s.tables if earlier == stage.name}
        if stage.name == "simulate":
            names = {"channels"}
        for name in names or {"scored"}:
            (job.output / f"{name}.parquet").write_text("\n".join(seen), encoding="utf-8")
        if stage.name == "score":
            (job.output / "summary.txt").write_text("all is well\n", encoding="utf-8")
        job.progress(1, 1, "done")

    return work


WORK = {stage.name: fake(stage) for stage in STAGES}


def prepare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Options:
    """Write the case into an empty folder; its code counts as unchanged for ever."""
    monkeypatch.setattr(runner, "code", lambda stage: {"module": stage.module})
    (tmp_path / "cases").mkdir()
    (tmp_path / "cases" / "small.toml").write_text(CASE, encoding="utf-8")
    return Options(data=tmp_path / "data", cases=tmp_path / "cases")


def change(options: Options, **values: object) -> Options:
    """Options with other values."""
    return Options(**{**vars(options), **values})


def edit(options: Options, old: str, new: str) -> None:
    """Replace a text in the case file."""
    assert options.cases is not None
    path = options.cases / "small.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
