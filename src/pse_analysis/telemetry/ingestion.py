"""The door for tables of one's own: names, units, signs and times are translated here only."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.measurement import Model, SensorLayout
from pse_analysis.telemetry.channels import check_channels, check_known, check_shunts
from pse_analysis.telemetry.phasors import MAGNITUDES, measured_part
from pse_analysis.telemetry.tables import RawCase
from pse_analysis.telemetry.times import to_utc
from pse_analysis.telemetry.units import check_units
from pse_analysis.vocabulary import (
    UNITS,
    Quantity,
    as_number,
    check,
    plain_columns,
    plain_unit,
    schema,
    shown,
    unwritable,
)

log = logging.getLogger(__name__)


_CHANNEL_DEFAULTS: Mapping[str, object] = {
    "side": "",
    "lower": np.nan,
    "upper": np.nan,
    "sign": 1,
    "aggregation": "instant",
}
_NEEDED = ("channel", "time_utc", "value")
_KNOWN = (*_NEEDED, "arrival_utc", "quality", "trial")


def ingest(
    frame: pd.DataFrame,
    channels: pd.DataFrame,
    model: Model,
    *,
    timezone: str | None = None,
    columns: Mapping[str, str] | None = None,
    tags: Mapping[Any, str | Sequence[str]] | None = None,
    shunts: Literal["refuse", "accept"] = "refuse",
    units: Literal["refuse", "accept"] = "refuse",
) -> RawCase:
    """Turn tables of one's own into a raw case.

    Nothing is dropped or repaired: NaN, infinities, duplicates and backward stamps stay, for
    `validate` to flag.

    Parameters
    ----------
    frame
        One row per sample: ``channel``, ``time_utc``, ``value``; where known ``arrival_utc``,
        ``quality`` (the source's own code) and ``trial``. Values may be complex: of a phasor a
        magnitude channel takes the magnitude and an angle channel the angle, of complex power
        S = P + jQ a channel of P takes the real and one of Q the imaginary part.
    channels
        Table ``channels``; ``side``, ``lower``, ``upper``, ``sign`` and ``aggregation`` may be
        absent. ``unit``, ``sigma``, limits and ``sign`` describe the values as they are in
        ``frame``; sign −1 says that the source counts consumption, or flow out of the branch, as
        positive. Magnitudes have no direction: a sign changes nothing there.
    model
        The grid, or the machine.
    timezone
        Zone of times that carry none, e.g. ``Europe/Berlin``; without it such times are refused.
    columns
        Own column name → the name above.
    tags
        Own channel name → channel, or several channels that take their part of one complex value:
        ``tags={"PMU7": ("pmu7_vm", "pmu7_va")}``.
    shunts
        What to do when an injection looks as if it contained the bus's shunt
        (`pse_analysis.telemetry.check_shunts`).
    units
        What to do when voltages look as if they were in another unit than the channel's
        (`pse_analysis.telemetry.check_units`).

    Returns
    -------
    RawCase
        Telemetry and channels in this project's convention: every value in the first unit of its
        quantity, every sign 1, times in UTC and microseconds, ``seq`` by order of arrival (of
        time, where no arrival is known).

    Raises
    ------
    TableError
        With what was expected, what came and what to do.
    """
    for name, choice in (("shunts", shunts), ("units", units)):
        if choice not in ("refuse", "accept"):
            raise TableError(f"{name} must be 'refuse' or 'accept', received {choice!r}")
    given = _channels(channels, model)
    frame = _samples(frame, columns)
    channel, source = _tagged(frame["channel"], tags)
    frame = frame.take(source).reset_index(drop=True)
    check_known(pd.DataFrame({"channel": channel}), given)
    row = pd.Index(given["channel"]).get_indexer(pd.Index(channel))
    value = _values(frame["value"], row, given)
    if units == "refuse" and isinstance(model, Network):
        check_units(pd.DataFrame({"channel": channel, "value": value}), given, model)

    standard = given.assign(
        unit=[UNITS[Quantity(q)][0] for q in given["quantity"]],
        sign=np.ones(len(given), dtype=np.int8),
    )
    ratio = (
        SensorLayout.from_channels(given, model).scale
        / SensorLayout.from_channels(standard, model).scale
    )
    time = to_utc(frame["time_utc"], "time_utc", timezone)
    if time.isna().any():
        raise TableError(
            f"telemetry: time_utc is empty in {int(time.isna().sum())} rows, first row "
            f"{int(source[np.argmax(time.isna())])}; a sample without a time cannot be placed: "
            "use its arrival, or leave it out"
        )
    known = "arrival_utc" in frame.columns
    arrival = (
        to_utc(frame["arrival_utc"], "arrival_utc", timezone)
        if known
        else pd.Series(pd.NaT, index=time.index, dtype=time.dtype)
    )
    with np.errstate(over="ignore"):  # what leaves the range of numbers is flagged as not finite
        converted = value * ratio[row]
    telemetry = pd.DataFrame(
        {
            "trial": _trials(frame),
            "channel": channel,
            "time_utc": time.array,
            "arrival_utc": arrival.array,
            "value": converted,
            "quality": pd.array(_integers(frame, "quality", np.int16), dtype="Int16"),
        }
    )
    # Rows of an export stand in any order; without arrivals only the stamps tell which came first.
    by_channel = telemetry.groupby(["trial", "channel"])["time_utc"]
    if not known and not by_channel.is_monotonic_increasing.all():
        log.warning("telemetry: rows are not in order of time and no arrival_utc is known: sorted")
    telemetry = telemetry.take(arrival.fillna(time).argsort(kind="stable").to_numpy())
    telemetry["seq"] = telemetry.groupby(["trial", "channel"]).cumcount().astype(np.int64)
    translated = _translated(standard, ratio)
    if shunts == "refuse" and isinstance(model, Network):
        check_shunts(telemetry, translated, model)
    telemetry = telemetry.sort_values(["trial", "channel", "seq"], ignore_index=True)
    return RawCase(model, translated, check("telemetry", telemetry))


def _samples(frame: pd.DataFrame, columns: Mapping[str, str] | None) -> pd.DataFrame:
    """The user's table under this project's names, with plain columns and a plain index."""
    plain_columns("telemetry", frame, ())
    if columns:
        renamed = frame.rename(columns=dict(columns))
        twice = renamed.columns[renamed.columns.duplicated()].intersection(_KNOWN)
        if len(twice) and frame.columns.is_unique:
            raise TableError(
                f"telemetry: {twice[0]!r} names two columns once columns= is applied; expected "
                "one: drop the other, or leave it out of columns="
            )
        frame = renamed
    frame = plain_columns("telemetry", frame, _KNOWN)
    for name in _NEEDED:
        if name not in frame.columns:
            remedy = (
                "it is the index: pass frame.reset_index()"
                if name in frame.index.names
                else f"say columns={{'YOURS': {name!r}}}"
            )
            raise TableError(
                f"telemetry: column {name!r} is missing; expected channel, time_utc and value; "
                f"received {', '.join(map(str, frame.columns))}; {remedy}"
            )
    if frame.empty:
        raise TableError("telemetry: no rows; expected at least one sample: check the export")
    return frame[[name for name in _KNOWN if name in frame.columns]].reset_index(drop=True)


def _tagged(
    own: pd.Series, tags: Mapping[Any, str | Sequence[str]] | None
) -> tuple[npt.NDArray[np.object_], npt.NDArray[np.intp]]:
    """Channel of each sample, and the row of the table that it stands in."""
    if own.isna().any():
        raise TableError(
            f"telemetry: channel is empty in {int(own.isna().sum())} rows, first row "
            f"{int(np.argmax(own.isna()))}; name it, or leave those rows out"
        )
    try:
        code, names = pd.factorize(own)
        given = {} if tags is None else {name: tags[name] for name in names if name in tags}
    except TypeError as error:
        raise TableError(
            f"telemetry: column 'channel' must hold names, received e.g. {own.iloc[0]!r}"
        ) from error
    channels = []
    for name in names:
        named = given.get(name, str(name))
        several = (named,) if isinstance(named, str) or not np.iterable(named) else tuple(named)
        if not several or not all(isinstance(one, str) for one in several):
            raise TableError(
                f"telemetry: tags[{name!r}] must be a channel or several, received {named!r}: "
                'write e.g. tags={"PMU7": ("pmu7_vm", "pmu7_va")}'
            )
        channels.append(several)
    damaged = unwritable([one for several in channels for one in several])
    if damaged:
        raise TableError(
            f"telemetry: channel {damaged[0]!r} holds damaged bytes or control characters: read "
            "the source with its own encoding, e.g. encoding='cp1252', or clean the name"
        )
    count = np.array([len(several) for several in channels], dtype=np.intp)[code]
    source = np.repeat(np.arange(len(own)), count)
    flat = np.array([one for several in channels for one in several], dtype=object)
    first = np.concatenate([[0], np.cumsum([len(several) for several in channels])])[:-1]
    place = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    return flat[first[code[source]] + place], source


def _values(value: pd.Series, row: npt.NDArray[np.intp], channels: pd.DataFrame) -> FloatArray:
    """Values as real numbers in the unit of their channel."""
    kind = value.dtype
    foreign = (str, bytes, bool, np.bool_)
    if pd.api.types.is_object_dtype(kind) and not value.map(lambda v: isinstance(v, foreign)).any():
        # Decimals of a data base, phasors with gaps, and whole numbers with None among them.
        try:
            array = np.array(
                [np.nan if v is None or v is pd.NA else v for v in value], dtype=np.complex128
            )
        except (TypeError, ValueError, OverflowError):
            array = None  # No numbers: refused below, with an example.
        if array is not None:
            if array.ndim != 1:
                raise TableError(
                    "telemetry: column 'value' holds lists or arrays, e.g. "
                    f"{shown(value.iloc[0])}: expected one number per row; spread them over rows "
                    "with pandas.DataFrame.explode, each with a time of its own"
                )
            phasor = value.map(lambda v: isinstance(v, complex | np.complexfloating)).to_numpy()
            real = np.asarray(array.real)
            if phasor.any():
                # Real numbers in such a column are plain readings, whatever they measure.
                real = real.copy()
                real[phasor] = measured_part(array[phasor], row[phasor], channels)
            return real
    if not pd.api.types.is_numeric_dtype(kind) or pd.api.types.is_bool_dtype(kind):
        texts = value[value.map(lambda v: isinstance(v, str) and not _reads_as_number(v))]
        raise TableError(
            f"telemetry: column 'value' must be numeric, received {kind}, e.g. "
            f"{shown((texts if len(texts) else value).iloc[0])}; read decimal commas with "
            "pandas.read_csv(decimal=','); pandas.to_numeric(frame.value, errors='coerce') turns "
            "what is no number into NaN, which is flagged as missing"
        )
    if pd.api.types.is_complex_dtype(kind):
        return measured_part(value.to_numpy(dtype=np.complex128), row, channels)
    with np.errstate(over="ignore"):
        return np.asarray(value.to_numpy(dtype=np.float64, na_value=np.nan))


def _channels(channels: pd.DataFrame, model: Model) -> pd.DataFrame:
    """The channels as given, with defaults, plain spellings of units and the schema's types."""
    filled = plain_columns("channels", channels, list(schema("channels").columns)).copy()
    for name, default in _CHANNEL_DEFAULTS.items():
        # A CSV file spells an absent cell NaN.
        given = filled[name] if name in filled.columns else pd.Series(np.nan, filled.index)
        filled[name] = given.where(given.notna(), default) if given.notna().any() else default
    if "unit" in filled.columns:
        filled["unit"] = filled["unit"].astype(str).map(plain_unit).astype(object)
    if "quantity" in filled.columns:
        magnitude = [isinstance(q, str) and q in MAGNITUDES for q in filled["quantity"]]
        filled["sign"] = [
            1 if undirected and _is(sign, -1) else sign
            for undirected, sign in zip(magnitude, filled["sign"], strict=True)
        ]
    for name in ("sigma", "lower", "upper", "period_s"):
        if name in filled.columns:
            filled[name] = _floats(filled[name])
    wrong = np.array([not (_is(sign, 1) or _is(sign, -1)) for sign in filled["sign"]], dtype=bool)
    if wrong.any() and "channel" in filled.columns:
        row = filled.loc[wrong].iloc[0]
        raise TableError(
            f"channels: sign of {row['channel']!r} must be 1, or -1 where the source counts "
            f"consumption as positive; received {shown(row['sign'])}"
        )
    # Signs of no channel are not looked at above; the schema refuses such a table.
    filled["sign"] = np.where([_is(sign, -1) for sign in filled["sign"]], -1, 1).astype(np.int8)
    return check_channels(filled.reset_index(drop=True), model)


def _floats(column: pd.Series) -> pd.Series:
    """Numbers of any type as floats; anything else as it is, for the schema to refuse."""
    if pd.api.types.is_object_dtype(column.dtype):
        absent = column.isna().to_numpy()
        cells = [np.nan if empty else cell for cell, empty in zip(column, absent, strict=True)]
        if any(isinstance(cell, str | bytes | bool | np.bool_) for cell in cells):
            return column
        try:
            return pd.Series([as_number(cell) for cell in cells], column.index, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            return column
    kind = column.dtype
    if pd.api.types.is_float_dtype(kind) or pd.api.types.is_integer_dtype(kind):
        with np.errstate(over="ignore"):
            return column.astype(np.float64)
    return column


def _is(cell: object, number: int) -> bool:
    """Whether a cell of any kind is that number."""
    return isinstance(cell, int | float | np.integer | np.floating) and bool(cell == number)


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _translated(
    standard: pd.DataFrame, ratio: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> pd.DataFrame:
    """Channels in standard units and signs, with σ and limits converted."""
    lower, upper = (standard[n].to_numpy(dtype=float) * ratio for n in ("lower", "upper"))
    turned = ratio < 0
    absolute = (standard["sigma_kind"] == "absolute").to_numpy()
    return standard.assign(
        sigma=standard["sigma"].to_numpy(dtype=float) * np.where(absolute, np.abs(ratio), 1.0),
        lower=np.where(turned, upper, lower),
        upper=np.where(turned, lower, upper),
    )


def _trials(frame: pd.DataFrame) -> npt.NDArray[np.int32]:
    """Trial of each sample, 0 where the table does not say."""
    if "trial" not in frame.columns:
        return np.zeros(len(frame), dtype=np.int32)
    trials = _integers(frame, "trial", np.int32)
    empty = pd.isna(trials)
    if empty.any():
        raise TableError(
            f"telemetry: trial is empty in {int(empty.sum())} rows, first row "
            f"{int(np.argmax(empty))}; number every row, or leave the column out"
        )
    return np.asarray(trials, dtype=np.int32)


def _integers(
    frame: pd.DataFrame, name: str, kind: type[np.signedinteger[Any]]
) -> pd.api.extensions.ExtensionArray:
    """A column of whole numbers within a type's range; empty where the column is absent."""
    if name not in frame.columns:
        return pd.array([None] * len(frame), dtype="Int64")
    try:
        with np.errstate(
            invalid="ignore"
        ):  # infinity becomes no whole number, which pandas refuses
            whole = frame[name].astype("Int64")
    except (TypeError, ValueError, OverflowError) as error:
        raise TableError(
            f"telemetry: column {name!r} must hold whole numbers, received {frame[name].dtype}, "
            f"e.g. {shown(frame[name].iloc[0])}: map the source's codes to numbers"
        ) from error
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    wide = whole[~whole.between(low, high).fillna(True)]
    if len(wide):
        raise TableError(
            f"telemetry: column {name!r} must hold whole numbers from {low} to {high}, received "
            f"{wide.iloc[0]}: map the source's codes to smaller ones (of a status code of OPC UA, "
            "quality // 2**30 is the severity)"
        )
    return whole.array
