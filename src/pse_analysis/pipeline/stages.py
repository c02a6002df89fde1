"""The work of each stage: read tables, call the stage's function, write tables and a recording.

Imported by the runner when a stage has to run, because it imports everything.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from pse_analysis import recording
from pse_analysis.alignment import AlignParams, align
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.estimation import EstimateParams, Method, estimate
from pse_analysis.grid import library
from pse_analysis.parameters import Study, build
from pse_analysis.pipeline.case import Case
from pse_analysis.pipeline.plan import SUMMARY, Job, Work
from pse_analysis.pipeline.processes import each
from pse_analysis.pipeline.summary import render
from pse_analysis.scoring import ScoreParams, score
from pse_analysis.simulation import SimulateParams, profiles, simulate
from pse_analysis.telemetry import read_raw, write_raw
from pse_analysis.validation import ValidateParams, validate
from pse_analysis.vocabulary import KEYS, check

PARTS = ("estimated", "residuals", "steps")


# --------------------------------------------------------------------------------------------------
# Parameters and tables
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Parameters:
    """What a case file says, as frozen parameters of each stage."""

    study: Study
    simulate: SimulateParams | None
    validate: ValidateParams
    align: AlignParams
    estimate: EstimateParams
    score: ScoreParams


def check_case(case: Case) -> Parameters:
    """Build the parameters of every stage, so that a mistake shows before the first one runs.

    Raises
    ------
    ParameterError
        With the case file, the key and what was expected.
    """
    sections = case.sections

    def part(cls: type[Any], name: str) -> Any:
        return build(cls, sections.get(name, {}), name)

    try:
        parameters = Parameters(
            study=case.study,
            simulate=part(SimulateParams, "simulate") if case.simulated else None,
            validate=part(ValidateParams, "validate"),
            align=part(AlignParams, "align"),
            estimate=part(EstimateParams, "estimate"),
            score=part(ScoreParams, "score"),
        )
        names = [method.name for method in parameters.estimate.methods]
        for name in names:
            if names.count(name) > 1:
                raise ParameterError(
                    f"[estimate.methods] the name {name!r} stands twice: give each method its own"
                )
    except ParameterError as error:
        raise ParameterError(f"{case.path}: {error}") from error
    return parameters


def read_table(
    table: str, path: Path, filters: list[tuple[str, str, Any]] | None = None
) -> pd.DataFrame:
    """Read a parquet file and check it against the schema of its table.

    Parameters
    ----------
    table
        Name of the schema.
    path
        The file.
    filters
        Rows to keep, as `pyarrow.parquet.read_table` takes them.

    Raises
    ------
    TableError
        If it is not whole, or breaks the schema.
    FileNotFoundError
        If it is not there.
    """
    if not path.is_file():
        raise FileNotFoundError(2, "no such table", str(path))
    try:
        frame = pq.read_table(path, filters=filters, partitioning=None).to_pandas()
    except (pa.ArrowInvalid, OSError) as error:
        raise TableError(
            f"{path}: not a whole parquet file ({error}): delete it and run the stage again"
        ) from error
    return check(table, frame)


def write_table(table: str, path: Path, frame: pd.DataFrame) -> None:
    """Check a table against its schema, sort it by its key, and write it as parquet.

    The order and the settings are fixed, so that equal tables are equal files and the stages after
    this one need not run again.
    """
    checked = check(table, frame)
    ordered = checked.sort_values(list(KEYS[table]), kind="stable", ignore_index=True)
    pq.write_table(pa.Table.from_pandas(ordered, preserve_index=False), path, compression="zstd")


def merge_tables(paths: list[Path], target: Path) -> None:
    """Join parquet files of one schema, one row group after another, and remove them."""
    schema = pq.read_schema(paths[0])
    with pq.ParquetWriter(target, schema, compression="zstd") as writer:
        for path in paths:
            writer.write_table(pq.read_table(path, partitioning=None).cast(schema))
    for path in paths:
        path.unlink()


# --------------------------------------------------------------------------------------------------
# Stages
# --------------------------------------------------------------------------------------------------


def _simulate(job: Job) -> None:
    params = check_case(job.case)
    assert params.simulate is not None
    assert job.case.grid is not None
    job.progress(0, 3, "reading load profiles")
    network = library.load(job.case.grid)
    curves = profiles.load(job.profiles)
    job.progress(1, 3, "drawing truth, samples and faults")
    raw = simulate(network, curves, params.study, params.simulate)
    job.progress(2, 3, "writing")
    write_raw(job.output, raw)


def _validate(job: Job) -> None:
    params = check_case(job.case)
    job.progress(0, 4, "reading")
    raw = read_raw(job.raw)
    job.progress(1, 4, "checking samples")
    validated = validate(
        raw.telemetry, raw.channels, params.validate, history_end=params.study.start
    )
    job.progress(2, 4, "writing")
    write_table("validated", job.output / "validated.parquet", validated)
    job.progress(3, 4, "recording")
    recording.validated(
        job.output / "validate.rrd",
        job.case.name,
        validated,
        raw.channels,
        sample_truth=raw.sample_truth,
        faults=raw.faults,
        study=params.study,
    )


def _align(job: Job) -> None:
    params = check_case(job.case)
    job.progress(0, 4, "reading")
    raw = read_raw(job.raw)
    validated = read_table("validated", job.inputs["validate"] / "validated.parquet")
    job.progress(1, 4, "bringing samples to instants")
    aligned = align(validated, raw.channels, raw.network, params.study, params.align)
    job.progress(2, 4, "writing")
    write_table("aligned", job.output / "aligned.parquet", aligned)
    job.progress(3, 4, "recording")
    recording.aligned(
        job.output / "align.rrd",
        job.case.name,
        aligned,
        raw.channels,
        truth=raw.truth,
        study=params.study,
    )


@dataclass(frozen=True)
class EstimateTask:
    """One method on one trial; paths in, paths out, so that it may run anywhere."""

    study: Study
    method: Method
    number: int
    trial: int
    raw: Path
    aligned: Path
    output: Path

    def part(self, table: str) -> Path:
        """Where this task writes its part of a table."""
        return self.output / f"{table}-{self.number:03d}-{self.trial:05d}.parquet"


def run_estimate_task(task: EstimateTask) -> dict[str, Path]:
    """Run one method on one trial; returns the file of each table."""
    raw = read_raw(task.raw)
    # Other trials are left on the disk; which variant to take is the method's business.
    aligned = read_table("aligned", task.aligned, [("trial", "==", task.trial)])
    done = estimate(
        aligned,
        raw.channels,
        raw.network,
        task.study,
        task.method,
        trial=task.trial,
        truth=raw.truth,
    )
    for table in PARTS:
        write_table(table, task.part(table), getattr(done, table))
    return {table: task.part(table) for table in PARTS}


def _estimate(job: Job) -> None:
    params = check_case(job.case)
    aligned = job.inputs["align"] / "aligned.parquet"
    trials = np.unique(pq.read_table(aligned, columns=["trial"])["trial"].to_numpy())
    tasks = [
        EstimateTask(params.study, method, number, int(trial), job.raw, aligned, job.output)
        for number, method in enumerate(params.estimate.methods)
        for trial in trials
    ]
    total = len(tasks) + 1
    job.progress(0, total, f"0 of {len(tasks)} estimates")
    for done, _ in enumerate(each(run_estimate_task, tasks, job.workers), 1):
        job.progress(done, total, f"{done} of {len(tasks)} estimates")
    for table in PARTS:
        merge_tables([task.part(table) for task in tasks], job.output / f"{table}.parquet")
    job.progress(len(tasks), total, "recording")


def _score(job: Job) -> None:
    params = check_case(job.case)
    job.progress(0, 3, "reading")
    raw = read_raw(job.raw)
    validated = read_table("validated", job.inputs["validate"] / "validated.parquet")
    tables = {name: read_table(name, job.inputs["estimate"] / f"{name}.parquet") for name in PARTS}
    job.progress(1, 3, "comparing with the truth")
    scored = score(
        tables["estimated"],
        tables["steps"],
        tables["residuals"],
        validated,
        raw.truth,
        raw.faults,
        raw.channels,
    )
    write_table("scored", job.output / "scored.parquet", scored)
    (job.output / SUMMARY).write_text(render(job.case.title, scored), encoding="utf-8")
    job.progress(2, 3, "recording")


WORK: Work = MappingProxyType(
    {
        "simulate": _simulate,
        "validate": _validate,
        "align": _align,
        "estimate": _estimate,
        "score": _score,
    }
)
"""Function of each stage by its name."""
