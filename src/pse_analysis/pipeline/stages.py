"""The work of each stage: read tables, call the stage's function, write tables and a recording.

Imported by the runner when a stage has to run, because it imports everything.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from pse_analysis import recording
from pse_analysis.alignment import AlignParams, align
from pse_analysis.errors import ParameterError, PseError
from pse_analysis.estimation import EstimateParams, Method, estimate
from pse_analysis.files import Facts, check, describe
from pse_analysis.grid import library
from pse_analysis.machine import Machine
from pse_analysis.parameters import Study, build
from pse_analysis.pipeline import account
from pse_analysis.pipeline.cache import SUMMARY
from pse_analysis.pipeline.case import Case
from pse_analysis.pipeline.plan import Job, Work
from pse_analysis.pipeline.processes import each
from pse_analysis.pipeline.summary import markdown, text
from pse_analysis.pipeline.tables import find_raw_table
from pse_analysis.recording import Take
from pse_analysis.scoring import ScoreParams, observers, score
from pse_analysis.simulation import (
    MachineSimulateParams,
    SeriesSimulateParams,
    SimulateParams,
    profiles,
    simulate,
    simulate_machine,
    simulate_series,
)
from pse_analysis.telemetry import (
    read_model,
    read_raw,
    read_raw_table,
    read_table,
    write_table,
)
from pse_analysis.telemetry.parquet import merge_files, read_rows, read_trials
from pse_analysis.telemetry.tables import write_files
from pse_analysis.validation import ValidateParams, validate

PARTS = ("estimated", "residuals", "steps")


@dataclass(frozen=True)
class Parameters:
    """What a case file says, as frozen parameters of each stage."""

    study: Study
    machine: Machine | None
    simulate: SimulateParams | MachineSimulateParams | SeriesSimulateParams | None
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

    about_machine = "machine" in sections
    simulation: type[Any] = SimulateParams
    if about_machine:
        simulation = MachineSimulateParams
    elif case.of_series:
        simulation = SeriesSimulateParams
    try:
        parameters = Parameters(
            study=case.study,
            machine=part(Machine, "machine") if about_machine else None,
            simulate=part(simulation, "simulate") if case.simulated else None,
            validate=part(ValidateParams, "validate"),
            align=part(AlignParams, "align"),
            estimate=part(EstimateParams, "estimate"),
            score=part(ScoreParams, "score"),
        )
        names = [name for method in parameters.estimate.methods for name in method.names]
        for name in names:
            if names.count(name) > 1:
                raise ParameterError(
                    f"[estimate.methods] the name {name!r} stands twice: give each method its own"
                )
        made = parameters.align.variants
        variants = [variant.name for variant in made] or [parameters.align.variant]
        for method in parameters.estimate.methods:
            if method.variant not in variants:
                raise ParameterError(
                    f"[estimate.methods] {method.name!r} reads variant {method.variant!r}, which "
                    f"[align] does not make: expected one of {', '.join(map(repr, variants))}"
                )
        if about_machine or case.simulated:
            _check_filters(parameters.estimate, about_machine)
    except ParameterError as error:
        raise ParameterError(f"{case.path}: {error}") from error
    return parameters


def _check_filters(estimate: EstimateParams, about_machine: bool) -> None:
    """Refuse a machine's method for a grid, and the reverse."""
    for method in estimate.methods:
        if (method.about == "machine") != about_machine:
            right = '"observer"' if about_machine else "wls, kalman, ukf or ekf"
            raise ParameterError(
                f"[estimate.methods] {method.name!r}: filter = {method.filter!r}, but the case is "
                f"about a {'machine' if about_machine else 'grid'}: use {right}"
            )


def _simulate(job: Job) -> None:
    params = check_case(job.case)
    if isinstance(params.simulate, MachineSimulateParams):
        assert params.machine is not None
        job.progress(0, 2, "moving the machine")
        raw = simulate_machine(params.machine, params.study, params.simulate)
        job.progress(1, 2, "writing")
        write_files(job.output, raw)
        return
    if isinstance(params.simulate, SeriesSimulateParams):
        job.progress(0, 2, "drawing loads and faults")
        raw = simulate_series(profiles.load(job.profiles), params.study, params.simulate)
        job.progress(1, 2, "writing")
        write_files(job.output, raw)
        return
    assert params.simulate is not None
    assert job.case.grid is not None
    job.progress(0, 3, "reading load profiles")
    network = library.load(job.case.grid)
    curves = profiles.load(job.profiles)
    job.progress(1, 3, "drawing truth, samples and faults")
    raw = simulate(network, curves, params.study, params.simulate)
    job.progress(2, 3, "writing")
    write_files(job.output, raw)


def _validate(job: Job) -> None:
    params = check_case(job.case)
    job.progress(0, 4, "reading")
    raw = read_raw(job.raw)
    _check_filters(params.estimate, isinstance(raw.model, Machine))
    job.progress(1, 4, "checking samples")
    validated = validate(
        raw.telemetry,
        raw.channels,
        params.validate,
        history_end=params.study.start,
        model=raw.model,
    )
    job.progress(2, 4, "writing")
    write_table(job.output / "validated.parquet", validated, "validated", job.provenance)
    job.progress(3, 4, "recording")
    recording.validated(
        Take(job.output / "validate.rrd", job.case.name, params.study),
        validated,
        raw.channels,
        sample_truth=raw.sample_truth,
        faults=raw.faults,
    )


def _align(job: Job) -> None:
    params = check_case(job.case)
    job.progress(0, 4, "reading")
    model, channels = read_model(job.raw), _channels(job.raw)
    validated = read_table(job.inputs["validate"] / "validated.parquet", "validated")
    job.progress(1, 4, "bringing samples to instants")
    aligned = align(validated, channels, model, params.study, params.align)
    job.progress(2, 4, "writing")
    write_table(job.output / "aligned.parquet", aligned, "aligned", job.provenance)
    job.progress(3, 4, "recording")
    recording.aligned(
        Take(job.output / "align.rrd", job.case.name, params.study),
        aligned,
        channels,
        truth=find_raw_table(job.raw, "truth"),
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


def run_estimate_task(task: EstimateTask) -> dict[Path, Facts]:
    """Run one method on one trial; returns what was written, as `pse_analysis.files.describe`."""
    # Other trials stay on the disk; which variant to take is the method's business.
    aligned = read_rows(task.aligned, "aligned", trial=task.trial)
    try:
        done = estimate(
            aligned,
            _channels(task.raw),
            read_model(task.raw),
            task.study,
            task.method,
            trial=task.trial,
            truth=find_raw_table(task.raw, "truth"),
        )
    except PseError as error:
        raise type(error)(f"method {task.method.name!r}: {error}") from error
    for table in PARTS:
        write_table(task.part(table), getattr(done, table), table)
    return {task.part(table): describe(task.part(table)) for table in PARTS}


def _estimate(job: Job) -> None:
    params = check_case(job.case)
    if not params.estimate.methods:
        for table in PARTS:
            merge_files([], job.output / f"{table}.parquet", table, job.provenance)
        return
    aligned = job.inputs["align"] / "aligned.parquet"
    trials = read_trials(aligned)
    tasks = [
        EstimateTask(params.study, method, number, trial, job.raw, aligned, job.output)
        for number, method in enumerate(params.estimate.methods)
        for trial in trials
    ]
    total = len(tasks) + 1
    job.progress(0, total, f"0 of {len(tasks)} estimates")
    written: dict[Path, Facts] = {}
    for done, files in enumerate(each(run_estimate_task, tasks, job.workers), 1):
        written.update(files)
        job.progress(done, total, f"{done} of {len(tasks)} estimates")
    for table in PARTS:
        parts = [task.part(table) for task in tasks]
        for part in parts:
            check(part, written[part], f"`pse run {job.case.name}` makes it again")
        merge_files(parts, job.output / f"{table}.parquet", table, job.provenance)
    job.progress(len(tasks), total, "recording")
    tables = {name: read_table(job.output / f"{name}.parquet", name) for name in PARTS}
    model = read_model(job.raw)
    if isinstance(model, Machine):
        recording.machine_estimated(
            Take(job.output / "estimate.rrd", job.case.name, params.study),
            tables["estimated"],
            tables["steps"],
            aligned=read_table(aligned, "aligned"),
            channels=_channels(job.raw),
            truth=find_raw_table(job.raw, "truth"),
        )
        return
    recording.estimated(
        Take(job.output / "estimate.rrd", job.case.name, params.study),
        tables["estimated"],
        tables["steps"],
        tables["residuals"],
        aligned=read_table(aligned, "aligned"),
        channels=_channels(job.raw),
        network=model,
        truth=find_raw_table(job.raw, "truth"),
    )


def _score(job: Job) -> None:
    params = check_case(job.case)
    job.progress(0, 3, "reading")
    truth, faults = find_raw_table(job.raw, "truth"), find_raw_table(job.raw, "faults")
    validated = read_table(job.inputs["validate"] / "validated.parquet", "validated")
    tables = {name: read_table(job.inputs["estimate"] / f"{name}.parquet", name) for name in PARTS}
    job.progress(1, 3, "comparing with the truth")
    model = read_model(job.raw)
    expected = (
        observers.expect(
            model, params.estimate.methods, params.simulate.densities, params.study.step_s
        )
        if isinstance(model, Machine) and isinstance(params.simulate, MachineSimulateParams)
        else None
    )
    scored = score(
        tables["estimated"],
        tables["steps"],
        validated,
        truth,
        faults,
        params.score,
        expected=expected,
    )
    write_table(job.output / "scored.parquet", scored, "scored", job.provenance)
    told = account.of_run(
        _channels(job.raw),
        validated,
        tables["steps"],
        tables["residuals"],
        study=params.study,
        params=params.validate,
        model=model,
    )
    methods = [name for m in params.estimate.methods for name in m.names]
    shown = job.case.title, scored, told.findings, methods, told.notices
    (job.output / SUMMARY).write_text(text(*shown), encoding="utf-8")
    job.progress(2, 3, "recording")
    if not params.estimate.methods:
        recording.detected(
            Take(job.output / "score.rrd", job.case.name, params.study),
            validated,
            _channels(job.raw),
            faults,
            summary_markdown=markdown(*shown),
        )
        return
    if isinstance(model, Machine):
        recording.machine_scored(
            Take(job.output / "score.rrd", job.case.name, params.study),
            tables["estimated"],
            truth,
            summary_markdown=markdown(*shown),
        )
        return
    recording.scored(
        Take(job.output / "score.rrd", job.case.name, params.study),
        scored,
        tables["estimated"],
        truth,
        model,
        summary_markdown=markdown(*shown),
    )


def _channels(raw: Path) -> pd.DataFrame:
    return read_raw_table(raw, "channels")


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
