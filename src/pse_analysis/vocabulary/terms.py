"""The words themselves: quantities, units, flags and reasons, with what each of them means."""

from __future__ import annotations

import enum
from types import MappingProxyType

import numpy as np
import numpy.typing as npt


class Source(enum.StrEnum):
    """Where a channel's samples come from."""

    SCADA = "scada"
    PMU = "pmu"
    AMI = "ami"
    PSEUDO = "pseudo"


class Quantity(enum.StrEnum):
    """What a channel measures, spelled with the unit its results are reported in."""

    VM_PU = "vm_pu"
    VA_DEGREE = "va_degree"
    P_MW = "p_mw"
    Q_MVAR = "q_mvar"
    I_KA = "i_ka"
    IA_DEGREE = "ia_degree"
    DELTA_M_PU = "delta_m_pu"
    ROTOR_ANGLE_RAD = "rotor_angle_rad"
    ROTOR_SPEED_RAD_S = "rotor_speed_rad_s"


class Side(enum.StrEnum):
    """Which end of a branch is metered; buses have no side."""

    NONE = ""
    FROM = "from"
    TO = "to"


class Aggregation(enum.StrEnum):
    """Whether a sample is the value at its time stamp or the mean over the period ending there."""

    INSTANT = "instant"
    MEAN = "mean"


class SigmaKind(enum.StrEnum):
    """Whether σ is in the channel's unit or a fraction of the magnitude."""

    ABSOLUTE = "absolute"
    RELATIVE = "relative"


class Origin(enum.StrEnum):
    """How an aligned value came to stand at its instant."""

    MEASURED = "measured"
    HELD = "held"
    PSEUDO = "pseudo"
    REPLACED = "replaced"


class FaultKind(enum.StrEnum):
    """Faults of telemetry that the simulation injects and records."""

    SPIKE = "spike"
    STALE = "stale"
    LOST = "lost"
    DUPLICATED = "duplicated"
    DELAYED = "delayed"
    EMPTY = "empty"


class Status(enum.StrEnum):
    """How an estimation step ended."""

    OK = "ok"
    PREDICTED = "predicted"
    INCONSISTENT = "inconsistent"
    NOT_CONVERGED = "not_converged"
    UNOBSERVABLE = "unobservable"
    PARTLY_OBSERVABLE = "partly_observable"
    DIVERGED = "diverged"
    RESTARTED = "restarted"


class Flag(enum.IntEnum):
    """Severity of what the checks found; the larger value takes precedence."""

    GOOD = 0
    SUSPECT = 1
    BAD = 2
    MISSING = 3


class Reason(enum.IntFlag):
    """Why a sample is flagged; several reasons may hold at once."""

    NONE = 0
    NOT_FINITE = 1
    DUPLICATE = 2
    BACKWARD = 4
    LATE = 8
    LIMIT = 16
    INCREMENT = 32
    EXTRAPOLATION = 64
    STUCK = 128
    GAP = 256
    QUALITY = 512
    STEP_ACCEPTED = 1024
    INNOVATION = 2048
    AHEAD = 4096


SEVERITY: MappingProxyType[Reason, Flag] = MappingProxyType(
    {
        Reason.NOT_FINITE: Flag.MISSING,
        Reason.DUPLICATE: Flag.BAD,
        Reason.BACKWARD: Flag.SUSPECT,
        Reason.LATE: Flag.SUSPECT,
        Reason.LIMIT: Flag.BAD,
        Reason.INCREMENT: Flag.BAD,
        Reason.EXTRAPOLATION: Flag.BAD,
        Reason.STUCK: Flag.BAD,
        Reason.GAP: Flag.GOOD,
        Reason.QUALITY: Flag.BAD,
        Reason.STEP_ACCEPTED: Flag.GOOD,
        Reason.INNOVATION: Flag.BAD,
        Reason.AHEAD: Flag.BAD,
    }
)
"""Severity that each reason carries on its own; a sample gets the largest of its reasons."""


UNITS: MappingProxyType[Quantity, tuple[str, ...]] = MappingProxyType(
    {
        Quantity.VM_PU: ("pu", "kv"),
        Quantity.VA_DEGREE: ("degree", "rad"),
        Quantity.P_MW: ("mw", "kw", "pu"),
        Quantity.Q_MVAR: ("mvar", "kvar", "pu"),
        Quantity.I_KA: ("ka", "a", "pu"),
        Quantity.IA_DEGREE: ("degree", "rad"),
        Quantity.DELTA_M_PU: ("pu",),
        Quantity.ROTOR_ANGLE_RAD: ("rad",),
        Quantity.ROTOR_SPEED_RAD_S: ("rad/s",),
    }
)
"""Units a channel of each quantity may be given in; the first is the one its name carries."""

_UNIT_NAMES: MappingProxyType[str, str] = MappingProxyType(
    {
        "p.u.": "pu",
        "p.u": "pu",
        "deg": "degree",
        "degrees": "degree",
        "°": "degree",
        "radian": "rad",
        "radians": "rad",
    }
)


def plain_unit(text: str) -> str:
    """A unit as `UNITS` spells it, from the ways in which people do."""
    unit = text.strip().lower()
    return _UNIT_NAMES.get(unit, unit)


def severity(reasons: npt.ArrayLike) -> npt.NDArray[np.int8]:
    """Largest severity among the reasons of each sample.

    Parameters
    ----------
    reasons : (n,) array_like of int
        Bits of `Reason`.

    Returns
    -------
    (n,) ndarray of int8
        Values of `Flag`.
    """
    bits = np.asarray(reasons, dtype=np.int64)
    flag = np.zeros(bits.shape, dtype=np.int8)
    for reason, level in SEVERITY.items():
        np.maximum(flag, np.where(bits & reason, np.int8(level), np.int8(0)), out=flag)
    return flag


def usable(flag: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Whether samples of the given severity may enter an estimate (good or suspect)."""
    return np.asarray(np.asarray(flag) < Flag.BAD)
