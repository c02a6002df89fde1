"""The maximum allowed power flow of a section: six criteria, outages, loading vectors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.grid.continuation import Loading
from pse_analysis.grid.continuation.base import BaseState
from pse_analysis.grid.network import Network
from pse_analysis.scoring.transfer_limit.intact import IntactGrid
from pse_analysis.scoring.transfer_limit.outages import Outage, Setting, Task, study_outage
from pse_analysis.scoring.transfer_limit.params import Contingency, TransferLimitParams
from pse_analysis.scoring.transfer_limit.result import Row, TransferLimit, result
from pse_analysis.scoring.transfer_limit.sections import Section

Run = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]
"""Calls a function with each of several tasks, such as the built-in ``map``, in any order."""


def transfer_limit(
    network: Network,
    section: Section,
    loadings: Sequence[Loading],
    params: TransferLimitParams | None = None,
    *,
    contingencies: Sequence[Contingency | str] = (),
    state: FloatArray | None = None,
    covariance: FloatArray | None = None,
    run: Run = map,
    progress: Callable[[int, int], None] | None = None,
) -> TransferLimit:
    """Find the maximum allowed power flow (MAPF) of a section.

    Parameters
    ----------
    network : Network
    section : Section
    loadings : sequence of Loading
        The lowest result counts.
    params : TransferLimitParams, optional
    contingencies : sequence of Contingency or str
        Outages; a string is the branch that trips.
    state : (2N,) ndarray, optional
        [θ; |V|] of the base state, such as an estimate; by default the solution of the grid's own
        tables. [rad, p.u.]
    covariance : (2N, 2N) ndarray, optional
        Of that state.
    run : callable
        ``map``, or what spreads tasks over processes:
        ``functools.partial(pse_analysis.pipeline.processes.each, workers=2)``.
    progress : callable, optional
        Called with the number of outages done and that of all.

    Returns
    -------
    TransferLimit

    Raises
    ------
    GridError
        If the section is no cut, a loading vector sums to nothing or does not raise the section's
        power, or an element is not in the grid.
    NotConverged
        If the base case has no solution, or the grid no limit along a loading vector.
    ParameterError, TableError
        On arguments that contradict each other.

    Notes
    -----
    Criteria 1-6 and irregular oscillations as in Batseva and Foos (2023), section on MAPF: shares
    of the largest power and of critical voltages before and after outages, and current limits.
    Power after an outage counts as what flows before it at the same loading.
    """
    params = params or TransferLimitParams()
    sending = section.sending(network)
    outages = _outages(network, section, contingencies)
    _check_loadings(loadings)
    covariance = _checked(network, state, covariance)
    enforce = params.continuation.enforce_q_limits
    base = (
        BaseState.solved(network, enforce_q_limits=enforce)
        if state is None
        else BaseState.of_estimate(network, state, enforce_q_limits=enforce)
    )
    settings = [
        Setting(
            network=network,
            base=base,
            loading=loading.name,
            direction=loading.direction(network),
            section=section,
            params=params,
            gradients=covariance is not None,
        )
        for loading in loadings
    ]
    studies = [IntactGrid(setting) for setting in settings]
    tasks = [
        Task(study.setting, outage, study.curve.limit) for study in studies for outage in outages
    ]
    done: dict[tuple[str, str], Outage] = {}
    for number, found in enumerate(run(study_outage, tasks), start=1):
        done[found.loading, found.contingency] = found
        if progress is not None:
            progress(number, len(tasks))
    rows: list[Row] = []
    points = []
    for study in studies:
        # In the order in which they were asked for, whichever came first.
        for outage in outages:
            study.add(done[study.setting.loading, outage.name])
        rows += [(study.setting.loading, name, reached) for name, reached in study.rows]
        points += study.points
    curves = pd.concat(points, ignore_index=True)
    irregular = _irregular(network, sending, params)
    return result(network, section, base, irregular, rows, curves, covariance)


def _irregular(network: Network, sending: BoolArray, params: TransferLimitParams) -> float:
    """Returns the irregular oscillations of the exchange of two areas. [MW]"""
    if params.irregular_mw is not None:
        return float(params.irregular_mw)
    load = network.buses.p_load_mw
    one, other = float(load[sending].sum()), float(load[~sending].sum())
    if one <= 0 or other <= 0:
        return 0.0
    return float(params.irregular_factor * np.sqrt(one * other / (one + other)))


def _outages(
    network: Network, section: Section, contingencies: Sequence[Contingency | str]
) -> list[Contingency]:
    found = [c if isinstance(c, Contingency) else Contingency(c, (c,)) for c in contingencies]
    names = [c.name for c in found]
    if len(set(names)) < len(names):
        again = next(n for n in names if names.count(n) > 1)
        raise ParameterError(f"contingencies must have distinct names, {again!r} repeats")
    closed = {
        end.branch
        for end in section.ends
        if network.branches.in_service[network.branch(end.branch)]
    }
    for outage in found:
        for branch in outage.branches:
            network.branch(branch)
        if closed <= set(outage.branches):
            raise ParameterError(
                f"contingency {outage.name!r} opens every branch of section {section.name!r} that "
                "is in service, so nothing is left to flow through it: leave it out"
            )
    return found


def _check_loadings(loadings: Sequence[Loading]) -> None:
    names = [loading.name for loading in loadings]
    if not names:
        raise ParameterError(
            "a transfer limit needs one loading vector at least: give Loading.transfer between the "
            "section's two areas"
        )
    if len(set(names)) < len(names):
        again = next(n for n in names if names.count(n) > 1)
        raise ParameterError(f"loading vectors must have distinct names, {again!r} repeats")


def _checked(
    network: Network, state: FloatArray | None, covariance: FloatArray | None
) -> FloatArray | None:
    """Returns the covariance of the base state, refused where it cannot be one."""
    if covariance is None:
        return None
    if state is None:
        raise ParameterError(
            "a covariance belongs to the state of an estimate: give state=[θ; |V|] with it"
        )
    covariance, n2 = np.asarray(covariance, dtype=float), 2 * network.n_bus
    if covariance.shape != (n2, n2):
        raise TableError(
            f"the covariance of the state must be ({n2}, {n2}), of [θ; |V|], received "
            f"{covariance.shape}"
        )
    if not np.isfinite(covariance).all():
        raise TableError(
            "the covariance of the state must be finite: leave out instants at which the estimate "
            "does not cover the whole grid"
        )
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-14):
        raise TableError("the covariance of the state must be symmetric")
    return covariance
