"""Which checks a channel gets and with what numbers: rules of the case file, later ones winning."""

from __future__ import annotations

import dataclasses
import fnmatch
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pandas as pd

from pse_analysis.errors import ParameterError
from pse_analysis.measurement import Model, SensorLayout
from pse_analysis.parameters import Unbounded
from pse_analysis.validation.default_limits import DefaultLimits, physical_limits
from pse_analysis.validation.thresholds import DEFAULT_AMPLITUDE
from pse_analysis.vocabulary import UNITS, Quantity, plain_unit

CHECKS = ("limits", "increment", "extrapolation", "stuck", "time")

SCALES: Mapping[tuple[str, str], float] = {
    ("mw", "kw"): 1e3,
    ("kw", "mw"): 1e-3,
    ("mvar", "kvar"): 1e3,
    ("kvar", "mvar"): 1e-3,
    ("ka", "a"): 1e3,
    ("a", "ka"): 1e-3,
    ("degree", "rad"): 0.017453292519943295,
    ("rad", "degree"): 57.29577951308232,
}

LEAST_VOLTAGE = 5e-324
"""Least magnitude of a voltage, in any unit: a bus at zero has no state to be estimated."""


MOST_IN_A_ROW = 1_000_000
"""Samples that a check may count before it decides."""
MOST_BINS = 1440
"""Parts of a day: a minute each."""


@dataclass(frozen=True)
class Rule:
    """What to check in the channels that match; an absent field leaves earlier rules in force.

    Attributes
    ----------
    source, quantity, channel : str
        Patterns of names (``*``, ``?``, ``[…]``); a channel must match all three.
    checks : tuple of str
        Any of limits, increment, extrapolation, stuck, time (late samples and gaps; duplicates
        and backward stamps are always flagged). Default: all but ``increment``; the extrapolation
        check is the first-increment check, and called so, where the history shows no sure gain.
    unit : str
        Unit of ``lower``, ``upper`` and ``increment``, any that the quantity has. Default: each
        channel's own, which after `pse_analysis.telemetry.ingest` is that of its quantity's name.
    lower, upper : float
        Limits in place of those in the table of channels; ``inf`` for none. Where neither states
        one, `DefaultLimits` do. A voltage magnitude must be above 0 whatever they say.
    increment : float
        Given threshold γ of the first increment over one sampling period, in place of a learnt
        one; √m times as large over m periods.
    criterion : str
        ``bayes``, ``minimax`` or ``fixed``: how k = γ/σ is chosen.
    amplitude : float
        A, largest gross error over σ of the good increment.
    q : float
        Prior probability of a gross error (bayes).
    q_max : float
        Largest credible one (minimax).
    cost_false_alarm, cost_miss : float
        Only their ratio matters.
    quantile : float
        k = γ/σ where the criterion is ``fixed``.
    k : "optimal", "scan" or float
        Coefficient of the extrapolation, −1 … 2.
    confirm : int
        Samples that must agree with a flagged one before a step is accepted.
    stuck : int
        Equal values in a row that mean a stuck source. Default: from the history.
    stuck_at_zero : bool
        Whether a run of exact zeros counts. Default: of voltage magnitudes only; plant at rest
        reads zero power.
    late_s : float
        Delay of arrival that is flagged. Default: a period above the usual delay. [s]
    bad_quality : tuple of int
        The source's own codes that mean a bad sample.
    time_of_day_bins : int
        Parts of the day with their own σ; 0 takes one σ.
    """

    source: str = "*"
    quantity: str = "*"
    channel: str = "*"
    checks: tuple[str, ...] | None = None
    unit: str | None = None
    lower: Unbounded | None = None
    upper: Unbounded | None = None
    increment: float | None = None
    criterion: Literal["bayes", "minimax", "fixed"] | None = None
    amplitude: float | None = None
    q: float | None = None
    q_max: float | None = None
    cost_false_alarm: float | None = None
    cost_miss: float | None = None
    quantile: float | None = None
    k: Literal["optimal", "scan"] | float | None = None
    confirm: int | None = None
    stuck: int | None = None
    stuck_at_zero: bool | None = None
    late_s: Unbounded | None = None
    bad_quality: tuple[int, ...] | None = None
    time_of_day_bins: int | None = None

    def __post_init__(self) -> None:
        for name in self.checks or ():
            if name not in CHECKS:
                raise ParameterError(
                    f"[validate.rules] checks: unknown check {name!r}; expected any of "
                    f"{', '.join(CHECKS)}"
                )
        for name, low in (
            ("increment", 0.0), ("amplitude", 0.0), ("cost_false_alarm", 0.0),
            ("cost_miss", 0.0), ("quantile", 0.0),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not low < value < math.inf:
                raise ParameterError(
                    f"[validate.rules] {name} must be finite and > 0, received {value}"
                )
        for name in ("q", "q_max"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value <= 1.0:
                raise ParameterError(
                    f"[validate.rules] {name} is a probability: expected 0 … 1, received {value}"
                )
        for name, low, high in (
            ("confirm", 1, MOST_IN_A_ROW), ("stuck", 0, MOST_IN_A_ROW), ("late_s", 0, math.inf),
            ("time_of_day_bins", 0, MOST_BINS),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ParameterError(
                    f"[validate.rules] {name} must be ≥ {low}, received {value}"
                    f"{f'; at most {high}' if value > high else ''}"
                )
        if isinstance(self.k, float | int) and not -1.0 <= self.k <= 2.0:
            raise ParameterError(
                f"[validate.rules] k is the share of the last increment that is expected again: "
                f"expected -1 … 2, received {self.k}"
            )
        if self.stuck == 1:
            raise ParameterError(
                "[validate.rules] stuck = 1 would flag every sample: "
                "give 0 (off) or the number ≥ 2 of equal values in a row"
            )
        if self.lower is not None and self.upper is not None and not self.lower <= self.upper:
            raise ParameterError(
                f"[validate.rules] lower = {self.lower} lies above upper = {self.upper}: swap them"
            )

    def matches(self, source: str, quantity: str, channel: str) -> bool:
        """Whether the rule speaks of this channel."""
        return (
            fnmatch.fnmatchcase(source, self.source)
            and fnmatch.fnmatchcase(quantity, self.quantity)
            and fnmatch.fnmatchcase(channel, self.channel)
        )


DEFAULTS = Rule(
    checks=("limits", "extrapolation", "stuck", "time"),
    criterion="bayes",
    amplitude=DEFAULT_AMPLITUDE,
    q=0.01,
    q_max=1.0,
    cost_false_alarm=1.0,
    cost_miss=1.0,
    quantile=3.0,
    k="optimal",
    confirm=2,
    bad_quality=(),
    time_of_day_bins=0,
)
"""What holds where no rule says otherwise."""

_PATTERNS = ("source", "quantity", "channel")
_IN_UNIT = ("lower", "upper", "increment")


@dataclass(frozen=True)
class ValidateParams:
    """Parameters of the validate stage.

    Attributes
    ----------
    rules : tuple of Rule
        Applied in order; a later rule overrides an earlier one field by field.
    default_limits : DefaultLimits
        Limits of channels for which neither the table of channels nor a rule states one.
    """

    rules: tuple[Rule, ...] = ()
    default_limits: DefaultLimits = field(default_factory=DefaultLimits)


def resolve(
    channels: pd.DataFrame, params: ValidateParams, model: Model | None = None
) -> list[Rule]:
    """The rule in force for each channel, limits and increments in the channel's own unit.

    A limit that nobody states is the default one, `physical_limits`.

    Parameters
    ----------
    channels : DataFrame
        Of schema ``channels``.
    params : ValidateParams
    model : Network or Machine, optional
        What turns kV or A into p.u., and what default limits follow from.

    Returns
    -------
    list of Rule
        One for each row of ``channels``, patterns replaced by the channel's own names.

    Raises
    ------
    ParameterError
        If a rule matches no channel, or its unit does not convert to a channel's.
    """
    used = [False] * len(params.rules)
    resolved = []
    default = physical_limits(channels, model, params.default_limits)
    for at, row in enumerate(channels.itertuples(index=False)):
        source, quantity, channel = str(row.source), str(row.quantity), str(row.channel)
        values: dict[str, Any] = {
            f.name: getattr(DEFAULTS, f.name) for f in dataclasses.fields(Rule)
        }
        voltage = quantity == Quantity.VM_PU
        values |= {"lower": _number(row.lower), "upper": _number(row.upper)}
        values["stuck_at_zero"] = voltage
        for index, rule in enumerate(params.rules):
            if not rule.matches(source, quantity, channel):
                continue
            used[index] = True
            for f in dataclasses.fields(Rule):
                value = getattr(rule, f.name)
                if f.name in _PATTERNS or f.name == "unit" or value is None:
                    continue
                if f.name in _IN_UNIT:
                    value = value * _scale(rule.unit, row._asdict(), model)
                values[f.name] = value
        values["lower"], values["upper"] = default.beside(at, values["lower"], values["upper"])
        if voltage and not (values["lower"] or 0.0) > 0.0:
            values["lower"] = LEAST_VOLTAGE
        values |= {"source": source, "quantity": quantity, "channel": channel}
        resolved.append(Rule(**values))
    for rule, hit in zip(params.rules, used, strict=True):
        if not hit:
            names = ", ".join(f"{n} = {getattr(rule, n)!r}" for n in _PATTERNS)
            known = ", ".join(sorted({f"{s}:*:{q}" for s, q in _pairs(channels)})[:8])
            raise ParameterError(
                f"[validate.rules] the rule with {names} matches no channel; there are {known}"
            )
    return resolved


def _pairs(channels: pd.DataFrame) -> list[tuple[str, str]]:
    return list(zip(channels["source"].astype(str), channels["quantity"].astype(str), strict=True))


def _number(value: Any) -> float | None:
    return None if pd.isna(value) else float(value)


def _scale(unit: str | None, row: Mapping[str, Any], model: Model | None) -> float:
    """What a number in a rule's unit is multiplied by to be in the channel's own."""
    own = str(row["unit"])
    given = own if unit is None else plain_unit(unit)
    if given == own:
        return 1.0
    if (given, own) in SCALES:
        return SCALES[given, own]
    if given not in UNITS[Quantity(row["quantity"])] or model is None:
        raise ParameterError(
            f"[validate.rules] unit {unit!r} does not convert to {own!r}, the unit of "
            f"{row['channel']}{'' if model else ', without the grid'}: state the rule in {own!r}"
            f"{'' if model else ', or pass model='}"
        )
    both = pd.DataFrame([row, row]).assign(unit=[given, own])
    scale = SensorLayout.from_channels(both, model).scale
    return float(scale[0] / scale[1])
