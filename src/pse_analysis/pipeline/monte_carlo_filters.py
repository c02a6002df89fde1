"""Filters on the same truth over many draws of noise and gross errors, on several processes.

A case keeps few trials with all tables. These experiments start from known states and keep a few
numbers of each trial, so that a filter is compared over its 30 trials in seconds.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.run_arrays import ArrayRun, run_arrays
from pse_analysis.estimation.filters.composition import Composition, compose, scalar
from pse_analysis.estimation.filters.recursion import GaussianFilter
from pse_analysis.estimation.process.load_noise import LoadStatistics, load_noise
from pse_analysis.estimation.process.sage_husa import of_grid
from pse_analysis.estimation.static.wls import state_columns
from pse_analysis.grid.network import Network
from pse_analysis.measurement import MeasurementModel, SensorLayout
from pse_analysis.pipeline.processes import each
from pse_analysis.vocabulary import Status

LARGE = 6.0
"""√S_ii beyond which a gross error counts as large."""


@dataclass(frozen=True)
class Recipe:
    """A filter that is tried.

    Attributes
    ----------
    composition : Composition
    noise : float or LoadStatistics
        q of Q = q I [p.u.², rad²], or what history tells of the loads.
    kind : {"ukf", "ekf"}
    """

    composition: Composition
    noise: float | LoadStatistics = 1e-4
    kind: Literal["ukf", "ekf"] = "ukf"

    def filter(self, network: Network, layout: SensorLayout) -> GaussianFilter:
        """The filter for a sensor layout."""
        voltages = (
            of_grid(network, load_noise(network, self.noise), state_columns(network, layout))
            if isinstance(self.noise, LoadStatistics)
            else scalar(network, layout, self.noise)
        )
        return compose(self.kind, self.composition, network, layout, voltages)


@dataclass(frozen=True)
class Errors:
    """Which readings are multiplied.

    Attributes
    ----------
    share : float
        Probability by reading.
    factor : float
    instant : int, optional
        The only instant that is spoilt; all after the first if not given.
    channel : str, optional
        The only channel that is spoilt.
    """

    share: float = 0.0
    factor: float = 10.0
    instant: int | None = None
    channel: str | None = None

    def where(
        self, shape: tuple[int, ...], layout: SensorLayout, rng: np.random.Generator
    ) -> BoolArray:
        """Spoilt readings, (T, m)."""
        bad = rng.random(shape) < self.share
        bad[0] = False
        if self.instant is not None:
            bad &= (np.arange(shape[0]) == self.instant)[:, None]
        if self.channel is not None:
            if self.channel not in layout.channel:
                raise ParameterError(
                    f"errors: no channel {self.channel!r} in the layout: take one of "
                    f"{', '.join(layout.channel[:3])}, …"
                )
            bad &= np.array(layout.channel) == self.channel
        return np.asarray(bad)


@dataclass(frozen=True, eq=False)
class Experiment:
    """One truth, its meters, what spoils them and the filters that are tried.

    Attributes
    ----------
    network : Network
    layout : SensorLayout
    truth : (T, 2N) ndarray
        [θ; |V|]; filters start from the first. [rad; p.u.]
    recipes : mapping of str to Recipe
        By a name of their own.
    errors : Errors
    start_variance : float
        P₀ = this · I. [p.u.², rad²]
    """

    network: Network
    layout: SensorLayout
    truth: FloatArray
    recipes: Mapping[str, Recipe]
    errors: Errors = Errors()
    start_variance: float = 1e-4

    def measured(self, seed: int) -> tuple[FloatArray, BoolArray]:
        """Readings of a trial and which of them are spoilt, (T, m)."""
        rng = np.random.default_rng(seed)
        exact = MeasurementModel(self.network, self.layout).h(self.truth.T).T
        z = exact + self.layout.sigma * rng.standard_normal(exact.shape)
        bad = self.errors.where(z.shape, self.layout, rng)
        return np.where(bad, self.errors.factor * z, z), bad

    def run(self, name: str, z: FloatArray) -> ArrayRun:
        """One filter over the readings of a trial."""
        made = self.recipes[name].filter(self.network, self.layout)
        start = self.start_variance * np.eye(len(made.model.columns))
        return run_arrays(made, self.truth[0], start, z, self.layout.sigma)


Task = tuple[str, Experiment, int]


def monte_carlo_filters(
    experiments: Mapping[str, Experiment], seeds: Sequence[int], *, workers: int | None = None
) -> pd.DataFrame:
    """Try every filter of every experiment on every seed.

    Parameters
    ----------
    experiments : mapping of str to Experiment
        All see the same seeds, so that they are compared in pairs.
    seeds : sequence of int
        Of noise and errors, one trial each.
    workers : int, optional
        Processes of one BLAS thread each; as many as the machine has cores if not given. Numbers do
        not depend on it.

    Returns
    -------
    DataFrame
        A row by ``experiment``, ``filter`` and ``seed``: ``vm_rmse`` [p.u.] and ``va_rmse`` [rad]
        after the start, ``va_largest`` [rad], ``bad``, ``named`` and ``right`` (spoilt readings,
        named ones, those of them that are spoilt), ``large`` and ``found`` (spoilt by more than
        `LARGE` √S_ii, those of them that are named), ``restarts``, and ``lost`` where the filter
        had to give up.
    """
    tasks = [(name, own, seed) for seed in seeds for name, own in experiments.items()]
    parts = list(each(run_task, tasks, workers or os.cpu_count() or 1))
    table = pd.DataFrame([row for part in parts for row in part], columns=COLUMNS)
    # They come in the order in which they were done.
    table["experiment"] = pd.Categorical(table["experiment"], list(experiments))
    table = table.sort_values(["experiment", "seed"], kind="stable", ignore_index=True)
    return table.astype({"experiment": str})


COLUMNS = [
    "experiment", "filter", "seed", "vm_rmse", "va_rmse", "va_largest", "bad", "named", "right",
    "large", "found", "restarts", "lost",
]  # fmt: skip


def run_task(task: Task) -> list[tuple[object, ...]]:
    """Rows of one trial, a filter each."""
    name, own, seed = task
    z, bad = own.measured(seed)
    return [(name, each_, seed, *_row(own, own.run(each_, z), bad)) for each_ in own.recipes]


def _row(own: Experiment, done: ArrayRun, bad: BoolArray) -> tuple[object, ...]:
    off = np.abs(done.x - own.truth)[1:, : own.network.n_bus]
    steps = len(done.info)
    named = done.field("inflation").astype(float) > 0
    spoilt = bad[1 : 1 + steps]
    innovation, deviation = (
        done.field(key).astype(float) for key in ("innovation", "sigma_innovation")
    )
    large = spoilt & (np.abs(innovation) > LARGE * deviation)
    return (
        *done.rmse(own.truth),
        float(off.max()),
        int(spoilt.sum()),
        int(named.sum()),
        int((named & spoilt).sum()),
        int(large.sum()),
        int((named & large).sum()),
        done.times(Status.RESTARTED),
        done.times(Status.DIVERGED) > 0,
    )
