"""The shape that every estimator has.

An estimator is a record of functions built from a model and frozen parameters. ``init`` makes a
state from a snapshot, ``step`` carries it to the next one and says what it did, ``read`` turns it
into an estimate with its covariance: of a grid's voltages, or of a machine's rotor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import PseError
from pse_analysis.vocabulary import Reason, Status

FAILURES = (ArithmeticError, ValueError, RuntimeError, PseError)
"""What the numbers of a snapshot may raise; `numpy.linalg.LinAlgError` is a ValueError."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What is known at one instant; rows follow the sensor layout.

    Attributes
    ----------
    time : datetime64
    z : (m,) ndarray
        Values; 0 where not available. [p.u., rad]
    sigma : (m,) ndarray
        σ with the growth by age. [p.u., rad]
    sigma_age : (m,) ndarray
        The part of σ that age added, for filters that treat age in their model. [p.u., rad]
    available : (m,) ndarray of bool
        Rows that carry a usable value.
    fresh : (m,) ndarray of bool
        Rows whose sample has not been used at an earlier instant.
    age_s : (m,) ndarray
        Time since the sample was taken. [s]
    inputs : ndarray, optional
        Known inputs u of the model.
    """

    time: np.datetime64
    z: FloatArray
    sigma: FloatArray
    sigma_age: FloatArray
    available: BoolArray
    fresh: BoolArray
    age_s: FloatArray
    inputs: FloatArray | None = None

    def silent(self) -> Snapshot:
        """The same instant without any measurement."""
        return replace(self, available=np.zeros_like(self.available))

    @property
    def sigma_own(self) -> FloatArray:
        """σ of the samples themselves, without what age added. (m,) [p.u., rad]"""
        return np.asarray(np.sqrt(np.maximum(self.sigma**2 - self.sigma_age**2, 0.0)))


@dataclass(frozen=True, eq=False)
class Info:
    """What a step did.

    Attributes
    ----------
    status : Status
    iterations : int
    nis : float
        ηᵀS⁻¹η, or the objective of a least-squares estimate; NaN without measurements.
    dof : int
        Its degrees of freedom.
    used : (m,) ndarray of bool
    innovation, sigma_innovation : (m,) ndarray
        η and √S_ii; NaN where not used. [p.u., rad]
    inflation : (m,) ndarray
        Factor φ added to the noise of a row by a robust filter; 0 where none was.
    detail : str
        What went wrong and what would help; "" if nothing did.
    reasons : (m,) ndarray of int, optional
        Bits of `Reason` for what a screening decided; without it an inflated row is
        `Reason.INNOVATION`.
    tested : bool
        The status already says whether ``nis`` is as large as it should be, so that nobody tests it
        again.
    misfit : float
        Largest residual of a measurement that a filter has believed, R S⁻¹η, in units of its σ; NaN
        where it named wrong ones, and where it was not asked.

    Rows with an innovation that were not used were refused.
    """

    status: Status
    iterations: int
    nis: float
    dof: int
    used: BoolArray
    innovation: FloatArray
    sigma_innovation: FloatArray
    inflation: FloatArray
    detail: str = ""
    reasons: npt.NDArray[np.int32] | None = None
    tested: bool = False
    misfit: float = np.nan

    @property
    def judged(self) -> BoolArray:
        """Rows that were used or refused. (m,)"""
        return np.asarray(self.used | np.isfinite(self.innovation))

    @property
    def findings(self) -> npt.NDArray[np.int32]:
        """Bits of `Reason` of every row. (m,)"""
        found = np.where(self.inflation > 0, int(Reason.INNOVATION), 0).astype(np.int32)
        return found if self.reasons is None else self.reasons

    @classmethod
    def nothing(cls, m: int, status: Status, detail: str = "") -> Info:
        """Info of a step that used no measurement."""
        empty = np.full(m, np.nan)
        return cls(status, 0, np.nan, 0, np.zeros(m, dtype=bool), empty, empty, np.zeros(m), detail)


class Estimate(NamedTuple):
    """Estimate x (n,) with its covariance (n, n); what the entries are follows from the model.

    A grid's are [θ; |V|] (2N,) [rad, p.u.], a machine's [θ; ω] (2,) [rad, rad/s]. States that the
    measurements leave open are NaN, in both.
    """

    x: FloatArray
    covariance: FloatArray
    open: BoolArray | None = None


Voltages = Estimate
"""An estimate of a grid in polar form."""


class Transition(NamedTuple):
    """How a filter's state moves to the next instant before anything is measured there.

    Attributes
    ----------
    mean : (N,) ndarray
        s⁻ at the later instant.
    covariance : (N, N) ndarray
        P⁻ of it.
    cross : (N, N) ndarray
        Cov(s, s⁻⁺) = P Fᵀ of the earlier state (rows) and the later one (columns).
    """

    mean: FloatArray
    covariance: FloatArray
    cross: FloatArray


class Dynamics(NamedTuple):
    """What a smoother needs of a filter, whose state it knows as a mean s and a covariance P.

    Attributes
    ----------
    belief : state -> (s (N,), P (N, N))
    predict : (state, snapshot) -> Transition
        To the instant of a snapshot, before its measurements are read.
    read : (state, s, P) -> Estimate
        Estimate of a mean and covariance that stand in the place of the state's own.
    difference : (s, s) -> (N,) ndarray
        s₁ - s₂, angles taken by their shorter way.
    undoubted : state -> state
        The state before a doubtful snapshot was held against it; None where none was.
    """

    belief: Callable[[Any], tuple[FloatArray, FloatArray]]
    predict: Callable[[Any, Snapshot], Transition]
    read: Callable[[Any, FloatArray, FloatArray], Estimate]
    difference: Callable[[FloatArray, FloatArray], FloatArray] = np.subtract
    undoubted: Callable[[Any], Any] = lambda _state: None

    def inside(self, unwrap: Callable[[Any], Any]) -> Dynamics:
        """The same for a state that holds the filter's own among other things."""
        return Dynamics(
            lambda state: self.belief(unwrap(state)),
            lambda state, snapshot: self.predict(unwrap(state), snapshot),
            lambda state, s, P: self.read(unwrap(state), s, P),
            self.difference,
        )


class Estimator(NamedTuple):
    """A method: three functions over an opaque state.

    Where they are given, ``with_covariance`` is a state with another covariance, ``dynamics`` knows
    mean and covariance of a state and lets a smoother look back from later instants, and ``again``
    starts from a snapshot and nothing else.
    """

    name: str
    init: Callable[[Snapshot], tuple[Any, Info]]
    step: Callable[[Any, Snapshot], tuple[Any, Info]]
    read: Callable[[Any], Estimate | None]
    with_covariance: Callable[[Any, FloatArray], Any] | None = None
    dynamics: Dynamics | None = None
    again: Callable[[Snapshot], tuple[Any, Info]] | None = None
