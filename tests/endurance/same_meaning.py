"""Changes that keep what a table means: storage, order and zones, which change no result."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from decimal import Decimal
from typing import Any

import numpy as np
import pandas as pd
from hypothesis import strategies as st
from tests.endurance import tiny_case
from tests.endurance.odd_frames import INDEXES
from tests.endurance.outcomes import Different

from pse_analysis.grid.network import Network
from pse_analysis.telemetry import ingest

Change = tuple[str, int]

TIME_UNITS = ("s", "ms", "us", "ns")
ZONES = ("Europe/Berlin", "Asia/Kathmandu", "America/St_Johns", "UTC", "Etc/GMT+12")


def _times(frame: pd.DataFrame, change: Callable[[pd.Series], pd.Series]) -> pd.DataFrame:
    return frame.assign(
        **{name: change(frame[name]) for name in ("time_utc", "arrival_utc") if name in frame}
    )


def _shuffled(frame: pd.DataFrame, number: int) -> pd.DataFrame:
    return frame.iloc[np.random.default_rng(number).permutation(len(frame))]


STORAGES: tuple[Callable[[pd.DataFrame], pd.DataFrame], ...] = (
    lambda f: f.assign(channel=f["channel"].astype("category")),
    lambda f: f.assign(channel=f["channel"].astype("string")),
    lambda f: f.assign(channel=f["channel"].astype("string[pyarrow]")),
    lambda f: f.assign(value=f["value"].astype("Float64")),
    lambda f: f.assign(value=f["value"].astype("double[pyarrow]")),
    lambda f: f.assign(value=f["value"].astype("category")),
    lambda f: f.assign(value=f["value"].astype(object)),
    lambda f: f.assign(value=f["value"].map(Decimal)),
    lambda f: f.assign(value=f["value"].astype("Sparse[float64]")),
    lambda f: f.assign(value=f["value"].astype("longdouble")),
    lambda f: f.assign(quality=f["quality"].astype("Int16")),
    lambda f: f.assign(quality=f["quality"].astype("float64")),
    lambda f: f.assign(quality=f["quality"].astype("category")),
    lambda f: f.assign(quality=f["quality"].astype("int64[pyarrow]")),
    lambda f: f.assign(trial=f["trial"].astype("Int8")),
    lambda f: f.assign(trial=f["trial"].astype("float32")),
    lambda f: f.assign(trial=f["trial"].astype("category")),
    lambda f: _times(f, lambda t: t.astype("category")),
    lambda f: _times(f, lambda t: t.astype("timestamp[us, UTC][pyarrow]")),
    lambda f: f.assign(extra=[{"a": 1}] * len(f)),
    lambda f: f[f.columns[::-1]],
    lambda f: f.copy().astype({"channel": "large_string[pyarrow]"}),
)

CHANNEL_STORAGES: tuple[Callable[[pd.DataFrame], pd.DataFrame], ...] = (
    lambda c: c.astype("category"),
    lambda c: c.convert_dtypes(),
    lambda c: c.convert_dtypes(dtype_backend="pyarrow"),
    lambda c: c[c.columns[::-1]],
    lambda c: c.assign(sign=c["sign"].astype(float), remark="x"),
    lambda c: c.assign(unit=c["unit"].str.upper()),
    lambda c: c.assign(unit=c["unit"].replace({"pu": "p.u.", "degree": "°"})),
    lambda c: c.drop(columns=["sign", "aggregation"], errors="ignore"),
    lambda c: c.assign(side=c["side"].replace("", None)),
    lambda c: c.astype(object),
)

GRID_STORAGES: tuple[Callable[[pd.DataFrame], pd.DataFrame], ...] = (
    lambda g: g.astype("category"),
    lambda g: g.convert_dtypes(),
    lambda g: g.convert_dtypes(dtype_backend="pyarrow"),
    lambda g: g[g.columns[::-1]],
    lambda g: g.astype(str),
    lambda g: g.astype(object),
    lambda g: g.assign(remark="x"),
)

_COUNT = {
    "zone": len(ZONES),
    "naive": len(ZONES),
    "unit": len(TIME_UNITS),
    "storage": len(STORAGES),
    "index": len(INDEXES),
    "rows": 5,
    "channels": len(CHANNEL_STORAGES),
    "channel index": len(INDEXES),
    "grid": len(GRID_STORAGES),
    "grid index": len(INDEXES),
    "exact": 3,
}
CHANGES = st.tuples(
    st.lists(
        st.sampled_from(sorted(_COUNT)).flatmap(
            lambda name: st.tuples(st.just(name), st.integers(0, _COUNT[name] - 1))
        ),
        min_size=1,
        max_size=4,
    ),
    st.booleans(),
    st.integers(0, len(tiny_case.METHODS) - 1),
    st.integers(0, 3),
)
"""Changes, whether arrivals are known, a method, and whether it runs: one in four times."""


def _ingested(changes: list[Change], arrivals: bool) -> Any:
    """The raw case of tables that are changed in order."""
    frame, channels = tiny_case.telemetry(), tiny_case.channel_table()
    frame = frame if arrivals else frame.drop(columns="arrival_utc")
    tables = tiny_case.grid_tables()
    arguments: dict[str, Any] = {}
    exact = any(name == "exact" for name, _ in changes)
    if exact:
        # Halves of thousandths are numbers of 24 bits.
        frame = frame.assign(value=np.round(frame["value"] * 64.0) / 64.0)
    for name, number in changes:
        if name == "zone" and _zoned(frame):
            frame = _times(frame, lambda t, zone=ZONES[number]: t.dt.tz_convert(zone))
        elif name == "naive" and _zoned(frame) and not arguments:
            zone = ZONES[number]
            frame = _times(frame, lambda t, zone=zone: t.dt.tz_convert(zone).dt.tz_localize(None))
            arguments["timezone"] = zone
        elif name == "unit" and not _stored_otherwise(frame):
            frame = _times(frame, lambda t, unit=TIME_UNITS[number]: t.dt.as_unit(unit))
        elif name == "storage":
            frame = _kept(STORAGES[number], frame)
        elif name == "index":
            frame = frame.set_axis(INDEXES[number](len(frame)), axis=0)
        elif name == "rows":
            frame = _shuffled(frame, number)
        elif name == "channels":
            channels = _kept(CHANNEL_STORAGES[number], channels)
        elif name == "channel index":
            channels = channels.set_axis(INDEXES[number](len(channels)), axis=0)
        elif name == "grid":
            tables = {key: _kept(GRID_STORAGES[number], table) for key, table in tables.items()}
        elif name == "grid index":
            tables = {
                key: table.set_axis(INDEXES[number](len(table)), axis=0)
                for key, table in tables.items()
            }
        elif name == "exact" and not _stored_otherwise(frame, "value"):
            frame = frame.assign(
                value=frame["value"].astype(("float32", "Float32", "float64")[number])
            )
    return ingest(frame, channels, Network.from_tables(**tables), **arguments)


def _kept(change: Callable[[pd.DataFrame], pd.DataFrame], frame: pd.DataFrame) -> pd.DataFrame:
    """The changed table, or the table itself where pandas cannot store an earlier change so."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return change(frame)
    except (TypeError, ValueError, AttributeError, NotImplementedError):
        return frame


def _zoned(frame: pd.DataFrame) -> bool:
    return isinstance(frame["time_utc"].dtype, pd.DatetimeTZDtype)


def _stored_otherwise(frame: pd.DataFrame, column: str = "time_utc") -> bool:
    return not isinstance(frame[column].dtype, pd.DatetimeTZDtype | np.dtype)


def compare(drawn: tuple[list[Change], bool, int, int]) -> None:
    """See that changed tables give what the unchanged give, to the last bit.

    Raises
    ------
    Different
        With the table and where it differs.
    """
    changes, arrivals, method, run = drawn
    exact = [("exact", 2)] if any(name == "exact" for name, _ in changes) else []
    plain, changed = _ingested(exact, arrivals), _ingested(changes, arrivals)
    _same("telemetry", changed.telemetry, plain.telemetry)
    _same("channels", changed.channels, plain.channels)
    for name, table in changed.model.to_tables().items():
        _same(name, table, plain.model.to_tables()[name])
    if run:
        return
    before, after = (
        tiny_case.estimate_raw(raw, (tiny_case.METHODS[method],)) for raw in (plain, changed)
    )
    _same("validated", after.validated, before.validated)
    _same("aligned", after.aligned, before.aligned)
    _same("estimated", after.estimated[0].estimated, before.estimated[0].estimated)


def _same(name: str, changed: pd.DataFrame, plain: pd.DataFrame) -> None:
    try:
        pd.testing.assert_frame_equal(changed, plain, rtol=0.0, atol=0.0)
    except AssertionError as error:
        raise Different(f"{name}: {error}") from None
