"""Frozen parameters from a case file, with every unknown or ill-typed key refused.

Standard library only: a cached run reads case files without waiting for numpy.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, TypeVar

from pse_analysis.errors import ParameterError

T = TypeVar("T")


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
        try:
            _ = self.history_start
        except OverflowError as error:
            raise ParameterError(
                f"[study] history_s = {self.history_s:g} reaches back beyond the calendar: "
                "expected seconds before start, e.g. 86400 for a day"
            ) from error

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
    """
    if not isinstance(data, Mapping):
        raise _wrong(where, cls, data)
    hints = typing.get_type_hints(cls)
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
    return cls(**values)


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if hint is Any:
        return value
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
        if value not in arguments:
            raise ParameterError(
                f"[{where}] must be one of {', '.join(map(repr, arguments))}, received {value!r}"
            )
        return value
    if dataclasses.is_dataclass(hint):
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
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is float and value != value:
        raise _wrong(where, hint, value, "a number")
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
    return ParameterError(f"[{where}] expected {expected or _named(hint)}, received {value!r}")


def _named(hint: Any) -> str:
    """A type as a user would name it."""
    options = typing.get_args(hint)
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(repr, options))
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(_named(option) for option in options if option is not type(None))
    return hint.__name__ if isinstance(hint, type) else str(hint)
