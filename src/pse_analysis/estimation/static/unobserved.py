"""What the measurements leave open, and nominal values that let the rest be estimated."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.errors import Unobservable
from pse_analysis.estimation.core.normal import Pins, with_held
from pse_analysis.estimation.static.cold_start import ColdStart
from pse_analysis.estimation.static.gauss_newton import Descent, GaussNewton, Problem, Singular
from pse_analysis.estimation.static.observability import closing_rows, influence, named, open_states
from pse_analysis.measurement import BUS, VM, MeasurementModel, P, Q, SensorLayout

NOMINAL_SIGMA = 0.05
"""σ of |V| about its nominal value where nothing is measured. [p.u.]"""
MOVED = 1e-5
"""How far a state may follow a nominal value, beside the one that follows most, if it is known."""
SAY = 1e-6
"""Influence on a known state, where rows and columns have norm one, that counts as none."""


class Gap(NamedTuple):
    """What to do where available measurements leave states open.

    Attributes
    ----------
    kept : (m,) ndarray of bool
        Available rows that have a say in a state that is not open.
    closing : (k,) ndarray of int
        Nominal values that stand for what is not measured.
    """

    kept: BoolArray
    closing: IntArray


class Unobserved:
    """Least squares beside nominal injections and voltages, as many as a gap has dimensions.

    As they are no more than what is missing, no measurement is contradicted and no known state is
    moved by them.

    Parameters
    ----------
    model : MeasurementModel
    cold : ColdStart
    tolerance : float
        Largest step of a converged state. [rad, p.u.]
    max_iterations : int
    """

    def __init__(
        self, model: MeasurementModel, cold: ColdStart, tolerance: float, max_iterations: int
    ) -> None:
        self.model, self._cold = model, cold
        self._limits = tolerance, max_iterations

    @cached_property
    def steps(self) -> GaussNewton:
        """Steps with the layout's own rows and, after them, P, Q and |V| of every bus."""
        network, bus = self.model.network, np.arange(self.model.network.n_bus)
        rows = SensorLayout.of(network, *[(q, bus, BUS) for q in (P, Q, VM)])
        both = MeasurementModel(network, self.model.layout.joined(rows), self.model.columns)
        return GaussNewton(both, *self._limits)

    @cached_property
    def _nominal(self) -> tuple[FloatArray, FloatArray]:
        """Nominal values of P, Q and |V| of every bus, and their σ. (3N,), (3N,) [p.u.]"""
        m = self.model.shape[0]
        z = self.steps.model.h(self._cold.nominal)[m:]
        power = self.steps.model.layout.quantity[m:] != VM
        usual = np.abs(z[power]).mean()
        return z, np.where(power, np.maximum(np.abs(z), usual), NOMINAL_SIGMA)

    def gap(self, error: Singular, held: Pins) -> Gap:
        """Returns what closes the gap that measurements leave at a state, and what lies inside.

        What has no say in any state that is known lies inside: it would fix open states in terms
        of others, with errors that grow from bus to bus, and is left out.
        """
        every, m = self.steps.jacobian(error.x), self.model.shape[0]
        rows, offered = every[:m], every[m:]
        fixed = np.ones(len(held.columns))
        available = np.flatnonzero(error.rows)
        present = with_held(rows[available], held.columns, fixed)
        open_ = open_states(present)
        inside = available[(abs(rows[available]) @ open_) > 0]
        kept = error.rows.copy()
        closing = closing_rows(present, offered)
        if not open_.all() and len(inside):
            closed = sparse.csr_array(sparse.vstack([rows[available], offered[closing]]))
            say = influence(with_held(closed, held.columns, fixed), ~open_)
            kept[inside[say[np.searchsorted(available, inside)] < SAY]] = False
            left = with_held(rows[np.flatnonzero(kept)], held.columns, fixed)
            closing = closing_rows(left, offered)
        return Gap(kept, closing)

    def descend(self, x: FloatArray, problem: Problem, held: Pins, gap: Gap) -> Descent:
        """Descend from a state beside the nominal values that close a gap.

        Raises
        ------
        Singular
            If the way leads to where they do not close it.
        """
        z, sigma = self._nominal
        used = np.zeros(len(z), dtype=bool)
        used[gap.closing] = True
        weight = np.where(gap.kept, problem.weight, 0.0)
        beside = Problem(
            np.concatenate([problem.z, np.where(used, z, 0.0)]),
            np.concatenate([weight, np.where(used, 1.0 / sigma, 0.0)]),
            np.concatenate([problem.rows & gap.kept, used]),
            problem.huber,
        )
        return self.steps.descend(x, beside, held)

    def following(self, found: Descent, gap: Gap) -> BoolArray:
        """Returns which states follow the nominal values, because they are open. (n,)"""
        J = self.steps.model.jacobian(found.x)[self.model.shape[0] + gap.closing]
        moved = np.abs(found.factor.solve(J.T.toarray()))
        return np.asarray((moved > MOVED * moved.max(axis=0)).any(axis=1))

    def explained(self, x: FloatArray, rows: BoolArray, held: Pins) -> Unobservable:
        """Returns the error that names what some rows leave open, and what would help."""
        every, (m, n) = self.steps.jacobian(x), self.model.shape
        present = with_held(every[np.flatnonzero(rows)], held.columns, np.ones(len(held.columns)))
        network = self.model.network
        names = named(network.buses.name, self.model.columns[np.flatnonzero(open_states(present))])
        return Unobservable(
            f"{network.name} is not observable: {int(rows.sum())} measurements leave "
            f"{len(closing_rows(present, every[m:]))} of {n} states open, among them {names}: add "
            "a P and Q injection, a flow on a branch that ends there, or a voltage phasor"
        )
