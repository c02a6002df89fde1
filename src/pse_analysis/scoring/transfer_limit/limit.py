"""The maximum allowed power flow of a section: six criteria, outages, loading vectors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import GridError, NotConverged, ParameterError, TableError
from pse_analysis.grid.continuation import Curve, LoadedGrid, Loading, trace
from pse_analysis.grid.continuation.base import BaseState
from pse_analysis.grid.network import Network
from pse_analysis.scoring.transfer_limit.constraints import Constraint, HighCurrent
from pse_analysis.scoring.transfer_limit.outages import (
    Outage,
    Reached,
    Setting,
    Task,
    curve_points,
    described,
    largest_power,
    safely_traced,
    study_outage,
    where,
)
from pse_analysis.scoring.transfer_limit.params import (
    Contingency,
    Criterion,
    TransferLimitParams,
)
from pse_analysis.scoring.transfer_limit.sections import Section, SectionPower

Run = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]
"""Calls a function with each of several tasks, such as the built-in ``map``, in any order."""


@dataclass(frozen=True, eq=False)
class TransferLimit:
    """The maximum allowed power flow of a section, and what it rests on.

    Attributes
    ----------
    section : str
    mapf_mw : float
        The lowest value of all criteria, outages and loading vectors; NaN where one of them could
        not be determined. [MW]
    sigma_mw : float
        Its standard error from the covariance of the base state, by the delta method; NaN without
        one. [MW]
    criterion, contingency, loading, element : str
        Which of them binds, and what meets it first; the contingency is "" without outage.
    base_mw : float
        Power in the base state. [MW]
    irregular_mw : float
        Irregular oscillations ΔP. [MW]
    table : DataFrame
        One row per loading vector, contingency and criterion: ``state`` (found, not_reached,
        unresolved), ``power_mw`` before and ``value_mw`` after margins, ``sigma_mw``,
        ``loading_factor`` λ, ``element``, ``binding``, ``detail``.
    curves : DataFrame
        Nose curves, one row per point.
    gradient : (2N,) ndarray
        Derivative of the limit by the base state [θ; |V|]; zeros without a covariance.
        [MW/rad, MW/p.u.]
    findings : tuple of str
        What a reader should know of, in sentences.
    """

    section: str
    mapf_mw: float
    sigma_mw: float
    criterion: str
    contingency: str
    loading: str
    element: str
    base_mw: float
    irregular_mw: float
    table: pd.DataFrame
    curves: pd.DataFrame
    gradient: FloatArray
    findings: tuple[str, ...]


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
    studies = {setting.loading: _Intact(setting) for setting in settings}
    tasks = [
        Task(study.setting, outage, study.curve.limit)
        for study in studies.values()
        for outage in outages
    ]
    for number, found in enumerate(run(study_outage, tasks), start=1):
        studies[found.loading].add(found)
        if progress is not None:
            progress(number, len(tasks))
    irregular = _irregular(network, sending, params)
    return _result(network, section, studies, base, irregular, covariance)


class _Intact:
    """The grid without outage under one loading vector, and what its outages allow."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        network, params = setting.network, setting.params
        self.power = SectionPower(network, setting.section)
        self.grid = LoadedGrid(network, setting.base, setting.direction)
        self.curve = trace(self.grid, params.continuation)
        self._check_rise()
        self.scale = self.curve.limit
        self.curve, constraints = safely_traced(
            self.grid, params.continuation, self._constraints, self.scale, self.curve
        )
        largest = largest_power(self.curve, self.power, gradients=setting.gradients)
        if largest.power_mw <= 0:
            raise GridError(
                f"section {setting.section.name!r} carries {largest.power_mw:.4g} MW at the limit "
                f"of loading {setting.loading!r}, against its direction: turn its signs, and the "
                "loading with them"
            )
        self.rows = [("", _scaled(largest, params.power_share))]
        for criterion, constraint in constraints.items():
            met = where(self.curve, self.power, criterion, constraint, gradients=setting.gradients)
            self.rows.append(("", met))
        self.points = [curve_points(self.curve, self.power, setting, "")]

    def _constraints(self, curve: Curve) -> dict[Criterion, Constraint]:
        params = self.setting.params
        found: dict[Criterion, Constraint] = {
            Criterion.VOLTAGE: self.setting.low_voltage(curve.grid, params.voltage_share)
        }
        if params.continuous_ka:
            found[Criterion.CURRENT] = HighCurrent(self.setting.network, params.continuous_ka)
        return found

    def _check_rise(self) -> None:
        """Refuse a loading vector along which the section's power does not rise."""
        curve, setting = self.curve, self.setting
        power = self.power.power_mw(curve.x[:, : curve.nose + 1])
        if power.max() - power[0] <= 1e-6 * self.power_scale:
            raise GridError(
                f"loading {setting.loading!r} does not raise the power of section "
                f"{setting.section.name!r} ({power[0]:.4g} MW at first, {power[-1]:.4g} MW at the "
                "limit): raise generation in the sending area and lower it, or raise load, in the "
                "receiving one (Loading.transfer), or turn the section's signs"
            )

    @property
    def power_scale(self) -> float:
        """Base power. [MW]"""
        return self.setting.network.base_mva

    def add(self, outage: Outage) -> None:
        """Take the criteria of an outage, as what flows in the grid without it."""
        self.points.append(outage.points)
        for reached in outage.reached:
            self.rows.append((outage.contingency, self._before(reached)))

    def _before(self, reached: Reached) -> Reached:
        if reached.state != "found":
            return reached
        if reached.loading < self.curve.loading[0]:
            start = reached.loading - 1e-6 * abs(self.scale)
            try:
                self.curve = trace(self.grid, self.setting.params.continuation, start=start)
            except NotConverged as error:
                return replace(reached, state="unresolved", detail=str(error), power_mw=np.nan)
        located = self.curve.at(reached.loading)
        if located is None:
            detail = "the grid without outage reaches its limit first"
            return replace(reached, state="not_reached", detail=detail, power_mw=np.nan)
        if reached.loading_gradient is not None:
            located = located.with_base_gradient(-reached.loading_gradient)
        return described(
            located,
            self.power,
            reached.criterion,
            reached.element,
            gradients=self.setting.gradients,
        )


def _scaled(reached: Reached, share: float) -> Reached:
    by_power = reached.power_gradient
    return replace(
        reached,
        power_mw=share * reached.power_mw,
        power_gradient=None if by_power is None else share * by_power,
    )


def _result(
    network: Network,
    section: Section,
    studies: dict[str, _Intact],
    base: BaseState,
    irregular: float,
    covariance: FloatArray | None,
) -> TransferLimit:
    rows, gradients = [], []
    for name, study in studies.items():
        for contingency, reached in study.rows:
            gradient = reached.power_gradient
            variance = np.nan
            if covariance is not None and gradient is not None:
                variance = float(gradient @ covariance @ gradient)
            gradients.append(gradient)
            rows.append(
                {
                    "loading": name,
                    "contingency": contingency,
                    "criterion": str(reached.criterion),
                    "state": reached.state,
                    "value_mw": reached.power_mw - irregular,
                    "sigma_mw": np.sqrt(max(variance, 0.0)) if variance == variance else np.nan,
                    "power_mw": reached.power_mw,
                    "loading_factor": reached.loading,
                    "element": reached.element,
                    "detail": reached.detail,
                }
            )
    table = pd.DataFrame(rows)
    found, open_ = table["state"] == "found", table["state"] == "unresolved"
    best = int(table["value_mw"].where(found).idxmin())
    table.insert(3, "binding", (table.index == best) & ~open_.any())
    determined = not open_.any()
    chosen = table.loc[best] if determined else None
    gradient = gradients[best] if determined else None
    power = SectionPower(network, section)
    return TransferLimit(
        section=section.name,
        mapf_mw=float(chosen["value_mw"]) if chosen is not None else np.nan,
        sigma_mw=float(chosen["sigma_mw"]) if chosen is not None else np.nan,
        criterion=str(chosen["criterion"]) if chosen is not None else "",
        contingency=str(chosen["contingency"]) if chosen is not None else "",
        loading=str(chosen["loading"]) if chosen is not None else "",
        element=str(chosen["element"]) if chosen is not None else "",
        base_mw=float(power.power_mw(base.x)),
        irregular_mw=irregular,
        table=table.sort_values("value_mw", kind="stable", ignore_index=True),
        curves=pd.concat([p for s in studies.values() for p in s.points], ignore_index=True),
        gradient=np.zeros(2 * network.n_bus) if gradient is None else gradient,
        findings=_findings(network, base, table),
    )


def _findings(network: Network, base: BaseState, table: pd.DataFrame) -> tuple[str, ...]:
    out = []
    open_ = table[table["state"] == "unresolved"]
    for row in open_.itertuples():
        after = f" after {row.contingency}" if row.contingency else ""
        at = f" ({row.element})" if row.element else ""
        out.append(
            f"no limit is given, because {row.criterion}{after} along {row.loading}{at} is "
            f"undetermined: {row.detail}"
        )
    beyond = np.flatnonzero(base.upper_is_base | base.lower_is_base)
    if len(beyond):
        names = ", ".join(network.buses.name[bus] for bus in beyond[:5])
        out.append(
            f"in the base state {len(beyond)} generators lie beyond their reactive limits and are "
            f"held at what they give: buses {names}{', …' if len(beyond) > 5 else ''}"
        )
    return tuple(out)


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
