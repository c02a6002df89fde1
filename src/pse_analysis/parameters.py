"""Frozen parameters from a case file, with every unknown or ill-typed key refused.

Standard library only: a cached run reads case files without waiting for numpy.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Annotated, Any, TypeVar

from pse_analysis.errors import ParameterError

T = TypeVar("T")

Unbounded = Annotated[float, "may be infinite"]
"""A number of a case file that may be ±inf, such as a limit where there is none."""

LARGEST = 1e12
"""Magnitude that no number of a study exceeds, in any unit."""
LEAST = 1e-30
"""Magnitude below which a number of a study is 0, or a mistake."""
MOST_INSTANTS = 10_000_000
"""Instants of one study; what is longer is estimated a part at a time."""
LONGEST_SHOWN = 200
"""Characters of a value that a message shows."""
CALENDAR = (1900, 2200)
"""Years in which telemetry may stand; 64 bits hold nanoseconds of 1678 … 2262."""
_WHOLE = 2**63
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


@dataclass(frozen=True)
class Study:
    """The instants that a case estimates, and how much telemetry before them is history.

    Attributes
    ----------
    start, end : datetime
        First instant, and the time before which the last one lies; with a time zone.
    step_s : float
        Time between instants. [s]
    history_s : float
        Length of the telemetry before ``start`` from which thresholds and noise are learnt. [s]
    """

    start: datetime
    end: datetime
    step_s: float
    history_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            if getattr(self, name).tzinfo is None:
                raise ParameterError(
                    f"[study] {name} has no time zone: expected UTC, received "
                    f"{getattr(self, name).isoformat()}; append 'Z'"
                )
        if self.end <= self.start:
            raise ParameterError(
                f"[study] end must lie after start, received {self.start} … {self.end}"
            )
        # Time stamps count microseconds; negated, so that NaN is refused too.
        if not (1e-6 <= self.step_s < math.inf and 0 <= self.history_s < math.inf):
            raise ParameterError(
                "[study] needs finite step_s > 0 (a microsecond at least) and history_s ≥ 0, "
                f"received step_s = {self.step_s}, history_s = {self.history_s}"
            )
        if (self.end - self.start).total_seconds() / self.step_s > MOST_INSTANTS:
            raise ParameterError(
                f"[study] {self.start} … {self.end} in steps of {self.step_s:g} s are more than "
                f"{MOST_INSTANTS} instants: raise step_s, or study a part at a time"
            )
        if not (CALENDAR[0] <= self.start.year and self.end.year <= CALENDAR[1]):
            raise ParameterError(
                f"[study] expected start and end in the years {CALENDAR[0]} … {CALENDAR[1]}, "
                f"received {self.start} … {self.end}"
            )
        try:
            _ = self.history_start
        except OverflowError as error:
            raise ParameterError(
                f"[study] history_s = {self.history_s:g} reaches back beyond the calendar: "
                "expected seconds before start, e.g. 86400 for a day"
            ) from error
        if self.history_start.year < CALENDAR[0]:
            raise ParameterError(
                f"[study] history_s = {self.history_s:g} reaches back to {self.history_start}: "
                "expected seconds before start, e.g. 86400 for a day"
            )

    @property
    def history_start(self) -> datetime:
        """Time at which the telemetry begins."""
        return self.start - timedelta(seconds=self.history_s)


def build(cls: type[T], data: Mapping[str, Any], where: str) -> T:
    """Build a frozen dataclass from a table of a case file.

    Parameters
    ----------
    cls
        The dataclass; its field types are checked, nested dataclasses and tuples of them are built.
    data
        The TOML table.
    where
        Its name, for messages.

    Raises
    ------
    ParameterError
        On an unknown or missing key or a value of another type; the message names the remedy.

    Notes
    -----
    A class method ``chosen(data, where)`` of ``cls`` may name the subclass that is built instead.
    """
    if not isinstance(data, Mapping):
        raise _wrong(where, cls, data)
    # A class of which there are several kinds finds the one that is meant.
    choose: Callable[..., type[T]] | None = getattr(cls, "chosen", None)
    cls = cls if choose is None else choose(data, where)
    hints = typing.get_type_hints(cls, include_extras=True)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in data:
        if key not in fields:
            close = difflib.get_close_matches(key, fields, n=1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            raise ParameterError(
                f"[{where}] unknown key {key!r}: {hint}expected any of {', '.join(fields)}"
            )
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name in data:
            values[name] = _convert(hints[name], data[name], f"{where}.{name}")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ParameterError(f"[{where}] key {name!r} is missing: add it to the case file")
    wrong = [
        error
        for name, value in values.items()
        if (error := _size_error(value, f"{where}.{name}", Unbounded in _leaves(hints[name])))
    ]
    try:
        built = cls(**values)
    except (ArithmeticError, TypeError) as error:
        raise (
            wrong[0]
            if wrong
            else ParameterError(
                f"[{where}] these values cannot be computed with ({error}): check their sizes and "
                "units"
            )
        ) from error
    # A class's own message says more than that a number is too large.
    if wrong:
        raise wrong[0]
    return built


def _leaves(hint: Any) -> set[Any]:
    """Types that a field's values may have, inside of lists, tables and unions too."""
    if hint == Unbounded or not typing.get_args(hint):
        return {hint} if isinstance(hint, typing.Hashable) else set()
    return set().union(*(_leaves(argument) for argument in typing.get_args(hint)))


def _size_error(value: Any, where: str, unbounded: bool) -> ParameterError | None:
    """What is wrong with the size of a number, or of the first wrong one in a list or table."""
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple):
        found = (_size_error(one, where, unbounded) for one in value)
        return next((error for error in found if error is not None), None)
    if not isinstance(value, float) or (unbounded and math.isinf(value)):
        return None
    if value == 0 or LEAST <= abs(value) <= LARGEST:
        return None
    return ParameterError(
        f"[{where}] expected a finite number, 0 or {LEAST:g} … {LARGEST:g} in size, received "
        f"{value!r}: check its unit"
    )


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if hint is Any:
        return value
    if hint == Unbounded:
        hint = float
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        options = [option for option in arguments if option is not type(None)]
        if len(options) == 1:  # its own message says more than that of the union
            return _convert(options[0], value, where)
        for option in options:
            try:
                return _convert(option, value, where)
            except ParameterError:
                continue
        raise _wrong(where, hint, value)
    if origin is typing.Literal:
        # True equals 1, and 1.0 does.
        if not any(type(value) is type(option) and value == option for option in arguments):
            raise ParameterError(
                f"[{where}] must be one of {', '.join(map(repr, arguments))}, received {value!r}"
            )
        return value
    if dataclasses.is_dataclass(hint):
        if isinstance(hint, type) and isinstance(value, hint):
            return value
        if not isinstance(value, Mapping):
            raise _wrong(where, hint, value)
        return build(typing.cast(type[Any], hint), value, where)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise _wrong(where, hint, value)
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_convert(arguments[0], v, f"{where}[{i}]") for i, v in enumerate(value))
        if len(arguments) != len(value):
            raise _wrong(where, hint, value, f"a list of {len(arguments)}")
        return tuple(
            _convert(a, v, f"{where}[{i}]")
            for i, (a, v) in enumerate(zip(arguments, value, strict=True))
        )
    if origin in (dict, Mapping) or hint is dict or str(origin).endswith("Mapping'>"):
        if not isinstance(value, Mapping):
            raise _wrong(where, hint, value)
        element = arguments[1] if arguments else Any
        return {str(k): _convert(element, v, f"{where}.{k}") for k, v in value.items()}
    if hint is datetime and not isinstance(value, datetime):
        raise ParameterError(
            f"[{where}] expected datetime, received {brief(value)}: write it with its zone and "
            "without quotes, e.g. 2016-06-09T00:00:00Z"
        )
    if hint in (int, float) and isinstance(value, int) and not -_WHOLE <= value < _WHOLE:
        raise ParameterError(
            f"[{where}] expected a whole number of 64 bits, received one of {value.bit_length()}"
        )
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is float and value != value:
        raise _wrong(where, hint, value, "a number")
    if hint is str and isinstance(value, str) and _CONTROL.search(value):
        raise _wrong(where, hint, value, "a text of one line without control characters")
    if (
        isinstance(hint, type)
        and isinstance(value, hint)
        and not (hint is int and isinstance(value, bool))
    ):
        return value
    raise _wrong(where, hint, value)


def _wrong(where: str, hint: Any, value: Any, expected: str = "") -> ParameterError:
    kind = typing.get_origin(hint) or hint
    if not expected and isinstance(kind, type) and kind is not types.UnionType:
        if dataclasses.is_dataclass(kind) or issubclass(kind, Mapping):
            expected = "a table"
        elif issubclass(kind, tuple):
            expected = "a list"
        else:
            expected = kind.__name__
    return ParameterError(f"[{where}] expected {expected or _named(hint)}, received {brief(value)}")


def brief(value: Any) -> str:
    """A value as a message shows it, cut where it is long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # whole numbers of more digits than Python spells
        return f"a {type(value).__name__} too long to show"
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"


def _named(hint: Any) -> str:
    """A type as a user would name it."""
    if hint == Unbounded:
        return "float"
    options = typing.get_args(hint)
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(repr, options))
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(_named(option) for option in options if option is not type(None))
    return hint.__name__ if isinstance(hint, type) else str(hint)
