"""The glossary: names, units, flags and table schemas that every other module speaks.

Conventions, fixed here once:

- Users meet pandapower's names and units (``vm_pu``, ``va_degree``, ``p_mw``, ``q_mvar``,
  ``i_ka``); the mathematics works in per unit and radians. `pse_analysis.measurement` holds the
  only boundary.
- Injection is positive into the grid (generation), branch flow is positive from the metered bus
  into the branch. Shunts and line charging belong to the grid, never to the injection.
- Time is UTC with microseconds. σ is a standard deviation.
- A flag says what is wrong; only `usable` says what is good.

Glossary
--------
case            one study: a TOML file and a folder of raw parquet
channel         one measured quantity of one sensor, e.g. ``pmu:bus/6:vm_pu``
element         ``bus/NAME``, ``branch/NAME`` or ``machine/NAME``, with NAME as the model spells it
instant         a time at which the state is estimated
sample          one value of one channel as it arrived
study window    the instants that are estimated and scored; telemetry before it is *history*
trial           one realisation of load, noise and faults, drawn from its own seed
variant         a named way to run one stage (for example alignment with or without DTW)
innovation      measurement minus its prediction, η
NIS, NEES       normalised squared innovation ηᵀS⁻¹η and state error eᵀP⁻¹e
"""

from __future__ import annotations

import enum
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from pse_analysis.errors import TableError

if TYPE_CHECKING:
    import pandas as pd
    import pandera.errors
    import pandera.pandas as pa


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


# --------------------------------------------------------------------------------------------------
# Table schemas
# --------------------------------------------------------------------------------------------------

KEYS: MappingProxyType[str, tuple[str, ...]] = MappingProxyType(
    {
        "telemetry": ("trial", "channel", "seq"),
        "channels": ("channel",),
        "truth": ("trial", "time_utc", "element", "quantity"),
        "sample_truth": ("trial", "channel", "seq"),
        "faults": ("trial", "channel", "kind", "seq"),
        "validated": ("trial", "channel", "seq"),
        "aligned": ("variant", "trial", "time_utc", "channel"),
        "estimated": ("method", "trial", "time_utc", "element", "quantity"),
        "residuals": ("method", "trial", "time_utc", "channel"),
        "steps": ("method", "trial", "time_utc"),
        "scored": ("method", "trial", "metric", "element"),
    }
)
"""Columns that identify a row of each table."""


@cache
def schema(table: str) -> pa.DataFrameSchema:
    """Pandera schema of a table.

    Pandera is imported here, so that reading a flag does not wait for it.

    Raises
    ------
    KeyError
        If there is no such table.
    """
    import pandera.pandas as pa
    from pandas.api.types import infer_dtype

    def col(
        kind: object, *checks: pa.Check, nullable: bool = False, required: bool = True
    ) -> pa.Column:
        return pa.Column(
            kind, checks=list(checks), nullable=nullable, required=required, coerce=False
        )

    def text(*checks: pa.Check) -> pa.Column:
        # pandas' own look at the values: pandera's calls Python once per row.
        strings = pa.Check(
            lambda values: infer_dtype(values, skipna=False) in ("string", "empty"),
            error="text",
        )
        return col(None, strings, *checks)

    def one_of(values: type[enum.StrEnum]) -> pa.Check:
        names = [str(v) for v in values]
        return pa.Check.isin(names, error=f"one of {', '.join(map(repr, names))}")

    above_0, not_below_0 = pa.Check.gt(0, error="above 0"), pa.Check.ge(0, error="0 or above")
    element = pa.Check.str_matches(
        r"^(bus|branch|machine)/.+", error="bus/NAME, branch/NAME or machine/NAME"
    )
    flags = ", ".join(f"{int(f)} ({f.name.lower()})" for f in Flag)

    utc = "datetime64[us, UTC]"
    key_sample = {"trial": col("int32"), "channel": text(), "seq": col("int64")}
    sample = {
        "time_utc": col(utc),
        "arrival_utc": col(utc, nullable=True),
        "value": col("float64", nullable=True),
        "quality": col("Int16", nullable=True),
    }
    finding = {
        "flag": col("int8", pa.Check.isin([int(f) for f in Flag], error=f"one of {flags}")),
        "reasons": col("int32"),
    }
    step_key = {"method": text(), "trial": col("int32"), "time_utc": col(utc)}
    tables: dict[str, dict[str, pa.Column]] = {
        "telemetry": {**key_sample, **sample},
        "channels": {
            "channel": text(),
            "source": text(one_of(Source)),
            "quantity": text(one_of(Quantity)),
            "element": text(element),
            "side": text(one_of(Side)),
            "unit": text(),
            "sigma": col("float64", above_0),
            "sigma_kind": text(one_of(SigmaKind)),
            "lower": col("float64", nullable=True),
            "upper": col("float64", nullable=True),
            "period_s": col("float64", above_0),
            "sign": col("int8", pa.Check.isin([-1, 1], error="1 or -1")),
            "aggregation": text(one_of(Aggregation)),
        },
        "truth": {
            "trial": col("int32"),
            "time_utc": col(utc),
            "element": text(),
            "quantity": text(one_of(Quantity)),
            "value": col("float64"),
        },
        "sample_truth": {**key_sample, "time_utc": col(utc), "value": col("float64")},
        "faults": {
            "trial": col("int32"),
            "channel": text(),
            "seq": col("Int64", nullable=True),
            "time_utc": col(utc),
            "kind": text(one_of(FaultKind)),
            "size": col("float64"),
        },
        "validated": {
            **key_sample,
            **sample,
            **finding,
            "statistic": col("float64", nullable=True),
            "threshold": col("float64", nullable=True),
            "corrected": col("float64", nullable=True),
        },
        "aligned": {
            "variant": text(),
            "trial": col("int32"),
            "time_utc": col(utc),
            "channel": text(),
            "value_pu": col("float64"),
            "sigma_pu": col("float64", above_0),
            "sigma_age_pu": col("float64", not_below_0),
            "origin": text(one_of(Origin)),
            "sample_utc": col(utc),
            "time_confidence": col("float64", pa.Check.in_range(0, 1, error="0 … 1")),
            "age_s": col("float64", not_below_0),
            **finding,
        },
        "estimated": {
            **step_key,
            "element": text(),
            "quantity": text(one_of(Quantity)),
            "value": col("float64", nullable=True),
            "sigma": col("float64", nullable=True),
        },
        "residuals": {
            **step_key,
            "channel": text(),
            "innovation": col("float64"),
            "sigma_innovation": col("float64", above_0),
            "inflation": col("float64", not_below_0),
            "used": col("bool"),
            "reasons": col("int32"),
        },
        "steps": {
            **step_key,
            "status": text(one_of(Status)),
            "iterations": col("int32"),
            "nis": col("float64", nullable=True),
            "nees": col("float64", nullable=True),
            "dof": col("int32"),
            "rejected": col("int32"),
            "seconds": col("float64"),
            "detail": text(),
        },
        "scored": {
            "method": text(),
            "trial": col("int32"),
            "metric": text(),
            "element": text(),
            "value": col("float64", nullable=True),
            "unit": text(),
            "published": col("float64", nullable=True),
            "source": text(),
        },
    }
    return pa.DataFrameSchema(tables[table], strict="filter", name=table)


def check(table: str, frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with its columns checked against the schema, in the schema's order.

    Raises
    ------
    TableError
        With the table, the column, what was expected and what came.
    """
    import pandera.errors

    expected = schema(table)
    missing = [name for name in expected.columns if name not in frame.columns]
    if missing:
        raise TableError(
            f"{table}: column {missing[0]!r} is missing; expected columns "
            f"{', '.join(expected.columns)}; received {', '.join(map(str, frame.columns))}"
        )
    try:
        checked = expected.validate(frame[list(expected.columns)], lazy=False)
    except pandera.errors.SchemaError as error:
        raise TableError(_broken(table, frame, error)) from error
    if table != "faults":
        repeated = checked.duplicated(list(KEYS[table]))
        if repeated.any():
            row = ", ".join(
                f"{key} {shown(checked.loc[repeated, key].iloc[0])}" for key in KEYS[table]
            )
            raise TableError(
                f"{table}: {int(repeated.sum())} rows repeat the key of another, the first has "
                f"{row}; expected one row each: leave one out, or give it a key of its own"
            )
    return cast("pd.DataFrame", checked)


def shown(value: object) -> str:
    """A value as a message shows it, without numpy's or pandas' type around it."""
    if hasattr(value, "isoformat"):
        return str(value)
    return repr(value.item() if isinstance(value, np.generic) else value)


def _broken(table: str, frame: pd.DataFrame, error: pandera.errors.SchemaError) -> str:
    """The row that breaks its schema, what was expected there and what came."""
    column = str(getattr(error.schema, "name", None) or "?")
    series, where = frame[column], f"{table}: column {column!r}"
    if str(error.check) == "not_nullable":
        wanted, bad = "a value in every row", series.isna()
    elif getattr(error.check, "error", None) == "text":
        wanted, bad = "text", ~series.map(lambda value: isinstance(value, str))
    elif getattr(error.check, "error", None):
        wanted, bad = error.check.error, series.index.isin(error.failure_cases["index"])
    else:
        kind = schema(table).columns[column].dtype
        first = f", e.g. {shown(series.iloc[0])}" if len(series) else ""
        return f"{where}: expected type {kind}, received {series.dtype}{first}; convert the column"
    row = int(np.argmax(np.asarray(bad)))
    keys = [f"{key} {shown(frame[key].iloc[row])}" for key in KEYS[table] if key != column]
    return (
        f"{where}{' of ' if keys else ''}{', '.join(keys)}: expected {wanted}, received "
        f"{shown(series.iloc[row])}; mend that row, or leave it out"
    )
