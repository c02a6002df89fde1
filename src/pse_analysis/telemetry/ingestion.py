"""The door for tables of one's own: names, units, signs and times are translated here only."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, Literal
from zoneinfo import available_timezones

import numpy as np
import pandas as pd

from pse_analysis.errors import TableError
from pse_analysis.grid.network import Network
from pse_analysis.measurement import Model, SensorLayout
from pse_analysis.telemetry.channels import check_channels, check_known, check_shunts, suggest
from pse_analysis.telemetry.tables import RawCase
from pse_analysis.vocabulary import UNITS, Quantity, check, plain_unit, shown

log = logging.getLogger(__name__)

_CHANNEL_DEFAULTS: Mapping[str, object] = {
    "side": "",
    "lower": np.nan,
    "upper": np.nan,
    "sign": 1,
    "aggregation": "instant",
}


def ingest(
    frame: pd.DataFrame,
    channels: pd.DataFrame,
    model: Model,
    *,
    timezone: str | None = None,
    columns: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
    shunts: Literal["refuse", "accept"] = "refuse",
) -> RawCase:
    """Turn tables of one's own into a raw case.

    Nothing is dropped or repaired: NaN, infinities, duplicates and backward stamps stay, for
    `validate` to flag.

    Parameters
    ----------
    frame
        One row per sample: ``channel``, ``time_utc``, ``value``; where known ``arrival_utc``,
        ``quality`` (the source's own code) and ``trial``.
    channels
        Table ``channels``; ``side``, ``lower``, ``upper``, ``sign`` and ``aggregation`` may be
        absent. ``unit``, ``sigma``, limits and ``sign`` describe the values as they are in
        ``frame``; sign −1 says that the source counts consumption, or flow out of the branch, as
        positive.
    model
        The grid, or the machine.
    timezone
        Zone of times that carry none, e.g. ``Europe/Berlin``; without it such times are refused.
    columns
        Own column name → the name above.
    tags
        Own channel name → channel.
    shunts
        What to do when an injection looks as if it contained the bus's shunt
        (`pse_analysis.telemetry.check_shunts`).

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
    given = _channels(channels, model)
    frame = frame.rename(columns=dict(columns or {}))
    if not frame.columns.is_unique:
        raise TableError(
            f"telemetry: {frame.columns[frame.columns.duplicated()][0]!r} names two columns once "
            f"columns= is applied; expected one: drop the other, or leave it out of columns="
        )
    for name in ("channel", "time_utc", "value"):
        if name not in frame.columns:
            raise TableError(
                f"telemetry: column {name!r} is missing; expected channel, time_utc and value; "
                f"received {', '.join(map(str, frame.columns))}; say columns={{'YOURS': {name!r}}}"
            )
    if frame.empty:
        raise TableError("telemetry: no rows; expected at least one sample: check the export")
    channel = frame["channel"].astype(object)
    if channel.isna().any():
        raise TableError(
            f"telemetry: channel is empty in {int(channel.isna().sum())} rows, first row "
            f"{int(np.argmax(channel.isna()))}; name it, or leave those rows out"
        )
    if tags is not None:
        channel = channel.map(lambda tag: tags.get(tag, tag))
    channel = channel.astype(str)
    check_known(pd.DataFrame({"channel": channel}), given)

    value = frame["value"]
    if not pd.api.types.is_numeric_dtype(value.dtype) or pd.api.types.is_bool_dtype(value.dtype):
        texts = value[pd.to_numeric(value, errors="coerce").isna() & value.notna()]
        raise TableError(
            f"telemetry: column 'value' must be numeric, received {value.dtype}, e.g. "
            f"{shown((texts if len(texts) else value).iloc[0])}; read decimal commas with "
            "pandas.read_csv(decimal=','); pandas.to_numeric(frame.value, errors='coerce') turns "
            "what is no number into NaN, which is flagged as missing"
        )
    standard = given.assign(
        unit=[UNITS[Quantity(q)][0] for q in given["quantity"]],
        sign=np.ones(len(given), dtype=np.int8),
    )
    ratio = (
        SensorLayout.from_channels(given, model).scale
        / SensorLayout.from_channels(standard, model).scale
    )
    row = pd.Index(given["channel"]).get_indexer(pd.Index(channel))
    time = _utc(frame["time_utc"], "time_utc", timezone)
    if time.isna().any():
        raise TableError(
            f"telemetry: time_utc is empty in {int(time.isna().sum())} rows, first row "
            f"{int(np.flatnonzero(time.isna())[0])}; a sample without a time cannot be placed: "
            "use its arrival, or leave it out"
        )
    known = "arrival_utc" in frame.columns
    arrival = (
        _utc(frame["arrival_utc"], "arrival_utc", timezone)
        if known
        else pd.Series(pd.NaT, index=time.index, dtype=time.dtype)
    )
    telemetry = pd.DataFrame(
        {
            "trial": _integers(frame, "trial", 0, np.int32).astype(np.int32),
            "channel": channel.to_numpy(dtype=object),
            "time_utc": time.array,
            "arrival_utc": arrival.array,
            "value": value.to_numpy(dtype=np.float64, na_value=np.nan) * ratio[row],
            "quality": pd.array(_integers(frame, "quality", None, np.int16), dtype="Int16"),
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


def _channels(channels: pd.DataFrame, model: Model) -> pd.DataFrame:
    """The channels as given, with defaults, plain spellings of units and the schema's types."""
    filled = channels.copy()
    for name, default in _CHANNEL_DEFAULTS.items():
        # A CSV file spells an absent cell NaN.
        given = filled[name] if name in filled.columns else pd.Series(np.nan, filled.index)
        filled[name] = given.where(given.notna(), default) if given.notna().any() else default
    if "unit" in filled.columns:
        filled["unit"] = filled["unit"].astype(str).map(plain_unit).astype(object)
    for name in ("sigma", "lower", "upper", "period_s"):
        if name in filled.columns and pd.api.types.is_numeric_dtype(filled[name].dtype):
            filled[name] = filled[name].astype(np.float64)
    wrong = ~filled["sign"].isin([-1, 1])
    if wrong.any() and "channel" in filled.columns:
        row = filled.loc[wrong].iloc[0]
        raise TableError(
            f"channels: sign of {row['channel']!r} must be 1, or -1 where the source counts "
            f"consumption as positive; received {shown(row['sign'])}"
        )
    filled["sign"] = filled["sign"].astype(np.int8)
    return check_channels(filled.reset_index(drop=True), model)


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


def _utc(times: pd.Series, name: str, timezone: str | None) -> pd.Series:
    """Times in UTC and microseconds."""
    if not pd.api.types.is_datetime64_any_dtype(times.dtype):
        raise TableError(
            f"telemetry: column {name!r} must hold times, received {times.dtype}, e.g. "
            f"{times.iloc[0]!r}; use pandas.to_datetime(frame.{name}, utc=True), or without utc "
            "and with timezone= here if they are local times"
        )
    times = times.reset_index(drop=True)
    if times.dt.tz is None:
        if timezone is None:
            raise TableError(
                f"telemetry: column {name!r} has no time zone (first: {times.iloc[0]}); expected "
                "UTC or any other zone: pass timezone='UTC' or e.g. timezone='Europe/Berlin'"
            )
        try:
            pd.Timestamp(0).tz_localize(timezone)
        except Exception as error:
            raise TableError(
                f"telemetry: no time zone {timezone!r}: {suggest(timezone, available_timezones())}"
            ) from error
        try:
            times = times.dt.tz_localize(timezone)
        except Exception as error:
            raise TableError(
                f"telemetry: column {name!r} cannot be read as times in {timezone!r} ({error}); "
                "around a change of summer time only the source's UTC offset tells: export UTC, "
                f"or offsets, and read them with pandas.to_datetime(frame.{name}, utc=True)"
            ) from error
    return times.dt.tz_convert("UTC").dt.as_unit("us")


def _integers(
    frame: pd.DataFrame, name: str, default: int | None, kind: type[np.signedinteger[Any]]
) -> pd.api.extensions.ExtensionArray:
    if name not in frame.columns:
        return pd.array([default] * len(frame), dtype="Int64")
    try:
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
