"""The stages of a simulated case over many seeds, in memory, on several processes.

A case keeps one realisation, or a few trials, with all tables and recordings. To compare methods
one needs many realisations and of each a few numbers only.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

import pandas as pd

from pse_analysis.alignment import align
from pse_analysis.errors import ParameterError
from pse_analysis.estimation import estimate
from pse_analysis.grid import library
from pse_analysis.pipeline.case import project_root
from pse_analysis.pipeline.processes import each
from pse_analysis.pipeline.stages import Parameters
from pse_analysis.scoring import ScoreParams, score
from pse_analysis.simulation import SimulateParams, profiles, simulate
from pse_analysis.validation import validate

PROFILES = Path("data/raw/load_profiles")


@dataclasses.dataclass(frozen=True)
class Task:
    """One realisation, on which all methods are tried."""

    world: str
    seed: int
    grid: str
    curves: Path
    parameters: Parameters


def monte_carlo(
    grid: str,
    worlds: Mapping[str, Parameters],
    seeds: Sequence[int],
    *,
    workers: int | None = None,
    curves: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> pd.DataFrame:
    """Simulate, validate, align, estimate and score, once for every world and seed.

    Parameters
    ----------
    grid : str
        Name in `pse_analysis.grid.library`.
    worlds : mapping of str to Parameters
        What is simulated and which methods are tried, by a name of its own; usually the parameters
        of a case with something replaced. All worlds see the same seeds, so that a world, a variant
        and a method are compared in pairs.
    seeds : sequence of int
        Take the place of ``simulate.seed``.
    workers : int, optional
        Processes; as many as the machine has cores if not given. Numbers do not depend on it.
    curves : Path, optional
        Folder of load profiles; that of the project if not given.
    progress : callable, optional
        Told how many realisations of how many are done.

    Returns
    -------
    DataFrame
        ``world``, ``seed``, ``method``, ``metric``, ``value``: scores of the whole grid and study,
        as table ``scored`` has them.

    Raises
    ------
    ParameterError
        If a world is not simulated, or is about a machine or metered loads alone.
    """
    for name, parameters in worlds.items():
        if not isinstance(parameters.simulate, SimulateParams):
            raise ParameterError(
                f"monte_carlo: expected worlds with [simulate] of a grid, received {name!r} "
                "without one: take the parameters of a simulated case"
            )
    folder = project_root() / PROFILES if curves is None else curves
    tasks = [
        Task(name, seed, grid, folder, parameters)
        for seed in seeds
        for name, parameters in worlds.items()
    ]
    parts = []
    for done, part in enumerate(each(run_task, tasks, workers or os.cpu_count() or 1), 1):
        parts.append(part)
        if progress is not None:
            progress(done, len(tasks))
    order = ["world", "seed", "method", "metric"]
    return pd.concat(parts, ignore_index=True).sort_values(order, ignore_index=True)


def run_task(task: Task) -> pd.DataFrame:
    """Scores of one realisation."""
    own, study = task.parameters, task.parameters.study
    assert isinstance(own.simulate, SimulateParams)
    network = library.load(task.grid)
    drawn = simulate(
        network, _curves(task.curves), study, dataclasses.replace(own.simulate, seed=task.seed)
    )
    checked = validate(
        drawn.telemetry, drawn.channels, own.validate, history_end=study.start, model=network
    )
    wanted = {method.variant for method in own.estimate.methods}
    variants = tuple(v for v in own.align.variants if v.name in wanted)
    aligned = align(
        checked, drawn.channels, network, study, dataclasses.replace(own.align, variants=variants)
    )
    by_variant = dict(tuple(aligned.groupby("variant")))
    done = [
        estimate(
            by_variant.get(method.variant, aligned),
            drawn.channels,
            network,
            study,
            method,
            truth=drawn.truth,
        )
        for method in own.estimate.methods
    ]
    scored = score(
        pd.concat([d.estimated for d in done], ignore_index=True),
        pd.concat([d.steps for d in done], ignore_index=True),
        checked,
        drawn.truth,
        params=ScoreParams(by_hour=False, by_element=False),
    )
    # How long it took is no property of a seed.
    whole = scored[(scored["element"] == "") & (scored["metric"] != "seconds")]
    return pd.DataFrame(
        {
            "world": task.world,
            "seed": task.seed,
            "method": whole["method"].to_numpy(),
            "metric": whole["metric"].to_numpy(),
            "value": whole["value"].to_numpy(),
        }
    )


@cache
def _curves(folder: Path) -> pd.DataFrame:
    return profiles.load(folder)
