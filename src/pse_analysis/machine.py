"""Synchronous machine as a linear model: nameplate data, its two states, exact sampling.

Conventions:

- State x = [θ; ω]: rotor angle in the frame that turns at nominal speed, not folded [electrical
  rad], and deviation from nominal speed [electrical rad/s].
- Input u = ΔM = M_mech - M_el, accelerating torque in per unit of the machine's rating.
- Output y = θ.
- The densities of white noise are two-sided, as in Simulink's *Band-Limited White Noise*: a
  sequence held for Δt has the variance density/Δt.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import linalg

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.vocabulary import as_number, plain_columns, shown, unwritable

ELEMENT = "machine"
"""Kind of element in tables: channels and states stand at ``machine/NAME``."""
STATES = ("rotor_angle_rad", "rotor_speed_rad_s")
INPUT = "delta_m_pu"
PLATE: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"s_mva": (1e-6, 1e6), "t_j_s": (1e-3, 1e4), "f_hz": (1.0, 1e4)}
)
"""What a nameplate may say, from a toy to far above the largest. [MVA, s, Hz]"""
LARGEST_DAMPING_PU = 1e4


@dataclass(frozen=True)
class Machine:
    """Rotor of a synchronous machine, eqs. (1)–(2) of [frolov2025].

    Attributes
    ----------
    s_mva : float
        Rated apparent power, the base of torques. [MVA]
    t_j_s : float
        Starting time T_j = 2H: the time in which rated torque brings the rotor to nominal speed.
        [s]
    k_d_pu : float
        Damping: torque per unit of speed deviation, both per unit.
    f_hz : float
        Nominal frequency. [Hz]
    u_kv : float
        Rated voltage; named on the plate, not used by the rotor's model. [kV]
    name : str
        Of the element ``machine/NAME``.

    Notes
    -----
    T_j dω/dt + K_d ω = ω₀ ΔM with ω in rad/s and ΔM in per unit. The paper prints the input gain
    1/T_j; with the units that it states, rad/s and per unit, the gain is ω₀/T_j.
    """

    s_mva: float
    t_j_s: float
    k_d_pu: float = 0.0
    f_hz: float = 50.0
    u_kv: float = float("nan")
    name: str = "1"

    def __post_init__(self) -> None:
        for key, (low, high) in PLATE.items():
            value = getattr(self, key)
            if not (value > 0 and low <= value <= high):
                raise ParameterError(
                    f"[machine] {key} must be above 0, {low:g} … {high:g}, received {value!r}; it "
                    "stands on the nameplate (T_j = 2H)"
                )
        if not abs(self.k_d_pu) <= LARGEST_DAMPING_PU:
            raise ParameterError(
                f"[machine] k_d_pu must be a number, at most {LARGEST_DAMPING_PU:g} in size, "
                f"received {self.k_d_pu!r}: torque per unit of speed deviation, both per unit"
            )
        if not self.name or unwritable([self.name]):
            raise ParameterError(
                f"[machine] name must be a text of printable characters, received {self.name!r}"
            )

    @property
    def omega0(self) -> float:
        """Nominal speed ω₀ = 2πf. [rad/s]"""
        return 2.0 * np.pi * self.f_hz

    @property
    def element(self) -> str:
        """Name in tables."""
        return f"{ELEMENT}/{self.name}"

    @property
    def A(self) -> FloatArray:
        """(2, 2) state matrix. [1/s]"""
        return np.array([[0.0, 1.0], [0.0, -self.k_d_pu / self.t_j_s]])

    @property
    def B(self) -> FloatArray:
        """(2, 1) input matrix; the second entry is ω₀/T_j. [rad/s² per p.u.]"""
        return np.array([[0.0], [self.omega0 / self.t_j_s]])

    @property
    def C(self) -> FloatArray:
        """(1, 2) output matrix, θ alone. The paper's "2×1" is a slip."""
        return np.array([[1.0, 0.0]])

    def to_table(self) -> pd.DataFrame:
        """One row that `from_table` reads."""
        return pd.DataFrame(
            {
                "name": [self.name],
                "s_mva": [float(self.s_mva)],
                "u_kv": [float(self.u_kv)],
                "f_hz": [float(self.f_hz)],
                "t_j_s": [float(self.t_j_s)],
                "k_d_pu": [float(self.k_d_pu)],
            }
        )

    @classmethod
    def from_table(cls, table: pd.DataFrame) -> Machine:
        """The machine of a one-row table.

        Raises
        ------
        TableError
            If a column is missing, a value is no number, or there is not exactly one row.
        ParameterError
            If a number cannot stand on a nameplate.
        """
        names = ("name", "s_mva", "u_kv", "f_hz", "t_j_s", "k_d_pu")
        table = plain_columns("machine", table, names)
        missing = [n for n in names if n not in table.columns]
        if missing or len(table) != 1:
            raise TableError(
                f"machine: expected one row with columns {', '.join(names)}; received "
                f"{len(table)} rows with {', '.join(map(str, table.columns))}"
            )
        row = table.iloc[0]
        numbers = {}
        for name in names[1:]:
            try:
                numbers[name] = as_number(row[name])
            except (TypeError, ValueError, OverflowError) as error:
                raise TableError(
                    f"machine: {name} must be a number, received {shown(row[name])}"
                ) from error
        return cls(name=str(row["name"]), **numbers)


@dataclass(frozen=True)
class Densities:
    """Spectral densities of white noise: Q = diag(theta, omega) on the states, R on the angle.

    Attributes
    ----------
    theta : float
        Of the disturbance of θ′ = ω. [rad²/s]
    omega : float
        Of the disturbance of ω′. [rad²/s³]
    angle : float
        Of the measured angle. [rad²·s]
    """

    theta: float
    omega: float
    angle: float

    @property
    def Q(self) -> FloatArray:
        """(2, 2) density of the disturbances."""
        return np.diag([self.theta, self.omega])

    @property
    def R(self) -> FloatArray:
        """(1, 1) density of the measurement noise."""
        return np.array([[self.angle]])


class Sampled(NamedTuple):
    """The machine between two samples: x⁺ = F x + G₀ u + G₁ u⁺ + w.

    Attributes
    ----------
    F : (2, 2) ndarray
    G0, G1 : (2, 1) ndarray
        Gains of the input at the begin and the end of the step, for an input that runs straight
        between its samples. [rad, rad/s per p.u.]
    Q : (2, 2) ndarray
        Covariance of w.
    R : (1, 1) ndarray
        Variance of a sample's noise, density/h. [rad²]
    """

    F: FloatArray
    G0: FloatArray
    G1: FloatArray
    Q: FloatArray
    R: FloatArray


@lru_cache(maxsize=1024)
def sample(machine: Machine, densities: Densities, step_s: float) -> Sampled:
    """Discrete equivalent of the machine over a step.

    Parameters
    ----------
    machine : Machine
    densities : Densities
    step_s : float
        [s]

    Returns
    -------
    Sampled
        Its arrays are read-only.

    Raises
    ------
    ParameterError
        If the step is not above 0, or so long that the machine has left the range of numbers.

    Notes
    -----
    Both integrals come from one matrix exponential each [vanloan1978]_.

    .. [vanloan1978] C. Van Loan, "Computing integrals involving the matrix exponential," IEEE
       Trans. Autom. Control 23(3), 395–404, 1978.
    """
    if not step_s > 0:
        raise ParameterError(
            f"the step must be above 0 s, received {step_s}: order the samples by time"
        )
    with np.errstate(all="ignore"):
        out = _sampled(machine, densities, step_s)
    if not all(np.isfinite(array).all() for array in out):
        raise ParameterError(
            f"a step of {step_s:g} s is {abs(machine.k_d_pu) / machine.t_j_s * step_s:.3g} times "
            "T_j/K_d, over which the machine leaves the range of numbers: sample it more often, or "
            "check t_j_s, k_d_pu and the densities"
        )
    for array in out:
        array.setflags(write=False)
    return out


def _sampled(machine: Machine, densities: Densities, step_s: float) -> Sampled:
    A, B, n, h = machine.A, machine.B, 2, step_s
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -A, densities.Q, A.T
    power = linalg.expm(block * h)
    F = power[n:, n:].T
    Q = F @ power[:n, n:]
    # d/ds [x; u; u'] with u' constant: the exponential holds ∫e^{As}B ds and its ramp integral.
    chain = np.zeros((n + 2, n + 2))
    chain[:n, :n], chain[:n, n : n + 1], chain[n, n + 1] = A, B, 1.0
    integrals = linalg.expm(chain * h)
    hold, ramp = integrals[:n, n : n + 1], integrals[:n, n + 1 :] / h
    return Sampled(F, hold - ramp, ramp, 0.5 * (Q + Q.T), densities.R / h)
