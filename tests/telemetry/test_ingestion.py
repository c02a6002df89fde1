"""Claim: tables of one's own come out in this project's names, units, signs and times."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from simulated_case import feeder

from pse_analysis.errors import TableError
from pse_analysis.grid import library, power_flow
from pse_analysis.measurement import SensorLayout
from pse_analysis.telemetry import ingest, read_raw, write_raw

T = pd.Timestamp("2016-06-09T08:00:00Z")


def channels() -> pd.DataFrame:
    """A utility's own description: kV, kW of consumption, ampere."""
    return pd.DataFrame(
        {
            "channel": ["U6", "PV6", "I6"],
            "source": ["scada", "ami", "pmu"],
            "quantity": ["vm_pu", "p_mw", "i_ka"],
            "element": ["bus/6", "bus/6", "branch/6-7"],
            "side": ["", "", "from"],
            "unit": ["kV", "kW", "A"],
            "sigma": [0.05, 0.01, 1],
            "sigma_kind": ["absolute", "relative", "absolute"],
            "lower": [11.0, -10.0, 0.0],
            "upper": [14.0, 300.0, 500.0],
            "period_s": [60, 900, 60],
            "sign": [1, -1, 1],
        }
    )


def frame(**change: object) -> pd.DataFrame:
    times = [T + pd.Timedelta(seconds=s) for s in (0, 60, 0, 900, 0, 60)]
    return pd.DataFrame(
        {
            "channel": ["U6", "U6", "PV6", "PV6", "I6", "I6"],
            "time_utc": times,
            "value": [12.66, 12.5, 60.0, 80.0, 120.0, 125.0],
        }
    ).assign(**change)


def test_units_and_signs_are_those_of_this_project():
    raw = ingest(frame(), channels(), feeder())
    value = raw.telemetry.set_index(["channel", "seq"]).value
    assert value["U6", 0] == pytest.approx(1.0)
    assert value["PV6", 1] == pytest.approx(-0.080)
    assert value["I6", 0] == pytest.approx(0.120)
    c = raw.channels.set_index("channel")
    assert list(c.unit) == ["pu", "mw", "ka"]
    assert set(c.sign) == {1}
    assert c.sigma["U6"] == pytest.approx(0.05 / 12.66)
    assert c.sigma["PV6"] == 0.01
    assert c.sigma["I6"] == pytest.approx(1e-3)
    assert (c.lower["PV6"], c.upper["PV6"]) == pytest.approx((-0.3, 0.01))
    assert c.upper["U6"] == pytest.approx(14.0 / 12.66)
    assert set(c.aggregation) == {"instant"}


def test_per_unit_values_are_the_same_before_and_after():
    given = channels().assign(
        unit=["kv", "kw", "a"], sign=np.array([1, -1, 1], "int8"), aggregation="instant"
    )
    raw = ingest(frame(), channels(), feeder())
    before = SensorLayout.from_channels(given, feeder()).to_per_unit(np.array([12.5, 80.0, 125.0]))
    last = raw.telemetry[raw.telemetry.seq == 1].set_index("channel").value
    after = SensorLayout.from_channels(raw.channels, feeder()).to_per_unit(
        last[["U6", "PV6", "I6"]].to_numpy()
    )
    np.testing.assert_allclose(after, before, rtol=1e-14)


def test_own_names_are_translated():
    own = frame().rename(columns={"time_utc": "TS", "channel": "TAG", "value": "VAL"})
    own["TAG"] = own["TAG"].map({"U6": "K-0006/U", "PV6": "Z77", "I6": "I6"})
    raw = ingest(
        own,
        channels(),
        feeder(),
        columns={"TS": "time_utc", "TAG": "channel", "VAL": "value"},
        tags={"K-0006/U": "U6", "Z77": "PV6"},
    )
    assert set(raw.telemetry.channel) == {"U6", "PV6", "I6"}


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_times_of_any_zone_and_resolution_become_utc_microseconds(unit: str):
    local = frame().time_utc.dt.tz_convert("Europe/Berlin").dt.as_unit(unit)
    for times, zone in ((local, None), (local.dt.tz_localize(None), "Europe/Berlin")):
        raw = ingest(frame(time_utc=times), channels(), feeder(), timezone=zone)
        assert str(raw.telemetry.time_utc.dtype) == "datetime64[us, UTC]"
        assert raw.telemetry.time_utc.min() == T


def test_seq_is_the_order_of_arrival():
    late = frame().time_utc + pd.to_timedelta([500, 5, 60, 60, 1, 1], unit="s")
    raw = ingest(frame(arrival_utc=late), channels(), feeder())
    voltage = raw.telemetry[raw.telemetry.channel == "U6"]
    assert list(voltage.seq) == [0, 1]
    assert list(voltage.value * 12.66) == pytest.approx([12.5, 12.66])


def test_without_arrival_seq_is_the_order_of_time_whatever_that_of_the_rows(caplog):
    forward = ingest(frame(), channels(), feeder()).telemetry
    assert not caplog.records
    backward = ingest(frame().iloc[::-1], channels(), feeder()).telemetry
    pd.testing.assert_frame_equal(backward, forward)
    assert backward.arrival_utc.isna().all()
    assert "sorted" in caplog.text


def test_trials_and_quality_codes_are_kept():
    raw = ingest(
        frame(trial=[0, 1, 0, 1, 0, 1], quality=[192, None, 0, 0, 0, 0]), channels(), feeder()
    )
    assert (raw.telemetry.seq == 0).all()
    assert raw.telemetry.quality.isna().sum() == 1


def test_faulty_samples_stay_as_they_are():
    bad = frame(value=[np.nan, np.inf, -np.inf, 1.0, 1.0, 1.0], time_utc=[T] * 6)
    raw = ingest(bad, channels(), feeder())
    assert len(raw.telemetry) == 6
    assert raw.telemetry.value.isna().sum() == 1
    assert np.isinf(raw.telemetry.value).sum() == 2


def test_what_was_taken_in_can_be_written_and_read(tmp_path):
    raw = ingest(frame(), channels(), feeder())
    write_raw(tmp_path / "mine", raw)
    back = read_raw(tmp_path / "mine")
    pd.testing.assert_frame_equal(back.telemetry, raw.telemetry)
    assert back.truth is None


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (frame().drop(columns="value"), r"column 'value' is missing; .*received channel, time_utc"),
        (frame().iloc[:0], "no rows; expected at least one sample"),
        (frame(value=[1, 2, "Bad", 4, 5, 6]), r"numeric, received object, e.g. 'Bad'.*to_numeric"),
        (frame(value=["1,5"] * 6), r"e.g. '1,5'; read decimal commas with .*decimal=','"),
        (frame(channel=["U6", None] * 3), "channel is empty in 3 rows, first row 1"),
        (frame(quality=[0, 0x80000000] * 3), r"-32768 to 32767, received 2147483648.*2\*\*30"),
        (frame(quality=70000), "quality.*received 70000"),
        (frame(trial=2**31), "trial.*received 2147483648"),
        (frame(trial=0.5), "'trial' must hold whole numbers, received float64, e.g. 0.5"),
        (frame(value=[True] * 6), "must be numeric, received bool"),
        (
            frame(time_utc=frame().time_utc.dt.tz_localize(None)),
            r"no time zone \(first: 2016-06-09 08:00:00\).*timezone='UTC'",
        ),
        (frame(time_utc=range(6)), r"'time_utc' must hold times, received int64.*to_datetime"),
        (frame(time_utc=[pd.NaT] + [T] * 5), "time_utc is empty in 1 rows"),
        (frame(channel=["U7"] * 6), "channel 'U7' is not in the channels table .*mean 'U6'"),
        (frame(quality=["good"] * 6), "'quality' must hold whole numbers"),
        (frame(trial=[0, None, 0, 0, 0, 0]), "trial is empty in 1 rows, first row 1; number every"),
        (frame(trial=np.inf), "'trial' must hold whole numbers"),
        (frame(trial=1j), "'trial' must hold whole numbers, received complex128"),
        (frame(value=frame().time_utc), "must be numeric, received datetime64"),
        (frame(value=pd.Series([10**400] * 6, dtype=object)), "must be numeric, received object"),
        (frame(channel=[["U6"]] * 6), r"'channel' must hold names, received e.g. \['U6'\]"),
        (frame(channel=["U6\udcff"] * 6), r"holds damaged bytes or control .*encoding='cp1252'"),
        (frame().set_index("time_utc"), r"'time_utc' is missing.*pass frame.reset_index\(\)"),
        (frame().T.T.set_axis([["a"] * 3, [1, 2, 3]], axis=1), "column names have 2 levels"),
        (frame().to_dict("list"), "telemetry: expected a pandas DataFrame, received dict"),
        (
            pd.concat([frame(), frame()[["value"]]], axis=1),
            "telemetry: 'value' is the name of two columns; expected one: rename or drop the other",
        ),
    ],
)
def test_a_broken_table_is_refused_with_its_remedy(own, message):
    with pytest.raises(TableError, match=message):
        ingest(own, channels(), feeder())


# 2016-06-09T08:00:00Z and the minute after it, as other systems count.
EPOCH_S = np.array([1465459200, 1465459260] * 3)


@pytest.mark.parametrize(
    ("times", "advice"),
    [
        (EPOCH_S, "pandas.to_datetime(frame.time_utc, unit='s', utc=True)"),
        (EPOCH_S * 10**3, "pandas.to_datetime(frame.time_utc, unit='ms', utc=True)"),
        (EPOCH_S * 10**6, "pandas.to_datetime(frame.time_utc, unit='us', utc=True)"),
        (EPOCH_S * 10**9, "pandas.to_datetime(frame.time_utc, unit='ns', utc=True)"),
        (EPOCH_S + 0.25, "pandas.to_datetime(frame.time_utc, unit='s', utc=True)"),
        (
            [str(t) for t in EPOCH_S * 1000],
            "pandas.to_datetime(pandas.to_numeric(frame.time_utc), unit='ms', utc=True)",
        ),
        ([42530.333, 42530.334] * 3, "unit='D', origin='1899-12-30'), with timezone= here"),
        ([736490.3, 736490.4] * 3, "are no s, ms, us or ns since 1970"),
        (["2016-06-09 08:00"] * 6, "pandas.to_datetime(frame.time_utc, utc=True), or without utc"),
        (pd.period_range("2016-06-09", periods=6, freq="h"), "frame.time_utc.dt.to_timestamp()"),
    ],
)
def test_the_advice_on_times_fits_the_numbers_that_came(times, advice):
    own = frame(time_utc=times)
    with pytest.raises(TableError) as refused:
        ingest(own, channels(), feeder())
    assert advice in str(refused.value)
    if "utc=True), or" in advice or "=True)" not in advice:
        return
    followed = eval(advice, {"pandas": pd, "frame": own})  # our own advice, word for word
    assert abs(followed.iloc[0] - T) <= pd.Timedelta("1s")
    assert ingest(own.assign(time_utc=followed), channels(), feeder()).telemetry.time_utc.min() >= T


def test_times_of_a_wrong_unit_are_named(caplog):
    ingest(frame(time_utc=pd.to_datetime(EPOCH_S, utc=True)), channels(), feeder())
    assert "6 of 6 times in time_utc lie outside 1980 … 2200, e.g. 1970-01-01" in caplog.text


@pytest.mark.parametrize("column", ["channel", "time_utc", "value", "trial", "quality"])
def test_categories_stand_for_their_values(column: str):
    own = frame(trial=[0, 1, 0, 1, 0, 1], quality=[192, None, 0, 0, 0, 0])
    coded = own.assign(**{column: own[column].astype("category")})
    pd.testing.assert_frame_equal(
        ingest(coded, channels(), feeder()).telemetry, ingest(own, channels(), feeder()).telemetry
    )


def test_all_storages_of_the_same_values_are_taken_alike():
    expected = ingest(frame(value=[12.5, 12.25, 60.0, 80.0, 120.0, 125.0]), channels(), feeder())
    whole = pd.Series([12.5, 12.25, 60.0, 80.0, 120.0, 125.0])
    for value in (
        whole.astype("float32"),
        whole.astype("Float64"),
        whole.astype("double[pyarrow]"),
        whole.astype(pd.SparseDtype("float64", np.nan)),
        whole.map(Decimal),
        whole.astype(object),
        whole.astype("complex128"),
    ):
        raw = ingest(frame(value=value), channels(), feeder())
        pd.testing.assert_frame_equal(raw.telemetry, expected.telemetry)
    stored = frame(value=whole).astype(
        {"channel": "string[pyarrow]", "time_utc": pd.ArrowDtype(pa.timestamp("ms", "UTC"))}
    )
    pd.testing.assert_frame_equal(
        ingest(stored, channels(), feeder()).telemetry, expected.telemetry
    )


def test_an_index_of_any_kind_says_nothing():
    expected = ingest(frame(), channels(), feeder()).telemetry
    for index in ([7] * 6, pd.MultiIndex.from_product([[1, 2], list("abc")]), list("fedcba")):
        own = frame().set_axis(index, axis=0)
        pd.testing.assert_frame_equal(ingest(own, channels(), feeder()).telemetry, expected)


def test_values_beyond_all_numbers_are_kept_for_validation():
    raw = ingest(frame(value=[12.66, 12.5, 1e300, -1e300, 1e308, 125.0]), channels(), feeder())
    assert raw.telemetry.value.abs().max() == pytest.approx(1e305)


def test_a_choice_that_does_not_exist_is_refused():
    with pytest.raises(TableError, match="shunts must be 'refuse' or 'accept', received 'ignore'"):
        ingest(frame(), channels(), feeder(), shunts="ignore")


def test_an_hour_that_occurs_twice_needs_utc():
    times = pd.to_datetime(["2016-10-30 02:30"] * 6)
    with pytest.raises(TableError, match="summer time only the source's UTC offset tells"):
        ingest(frame(time_utc=times), channels(), feeder(), timezone="Europe/Berlin")


def test_an_unknown_zone_is_no_matter_of_summer_time():
    times = frame().time_utc.dt.tz_localize(None)
    with pytest.raises(TableError, match="no time zone 'Europe/Berln': did you mean 'Europe/Berl"):
        ingest(frame(time_utc=times), channels(), feeder(), timezone="Europe/Berln")


def test_two_columns_of_one_name_are_refused():
    with pytest.raises(TableError, match="'value' names two columns once columns= is applied"):
        ingest(frame(reading=1.0), channels(), feeder(), columns={"reading": "value"})


def test_blank_cells_of_a_csv_file_take_their_defaults(tmp_path):
    full = ingest(frame(), channels(), feeder())
    for kept in (slice(None), slice(2)):
        blank = channels().iloc[kept].assign(aggregation=np.nan, lower=np.nan)
        blank["sign"] = blank["sign"].where(blank["sign"] == -1)
        blank.to_csv(tmp_path / "channels.csv", index=False)
        own = frame()[frame().channel.isin(blank.channel)]
        raw = ingest(own, pd.read_csv(tmp_path / "channels.csv"), feeder())
        expected = full.channels.iloc[kept].assign(
            lower=raw.channels.lower, upper=raw.channels.upper
        )
        pd.testing.assert_frame_equal(raw.channels, expected)


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        (("element", "bus/66"), "has no bus '66'"),
        (("unit", "MW"), "does not fit vm_pu"),
        (("sigma", -1.0), "must be a finite standard deviation above 0, received -1.0"),
        (("sign", 257), "sign of 'U6' must be 1, or -1 .*; received 257"),
        (("sigma", 1e-13), "sigma of 'U6' is 1e-13, expected 1e-12 … 1e.12"),
        (("period_s", np.inf), "'period_s' of channel 'U6': expected 1e-06 … 1e.09 seconds"),
        (("channel", "U\udcff6"), "damaged bytes or control characters"),
        (("sign", 1.5), "sign of 'U6' must be 1, or -1 .*; received 1.5"),
    ],
)
def test_broken_channels_are_refused(cell, message):
    broken = channels()
    broken[cell[0]] = broken[cell[0]].astype(object)
    broken.loc[0, cell[0]] = cell[1]
    with pytest.raises(TableError, match=message):
        ingest(frame(), broken, feeder())


@pytest.mark.parametrize("sigma", [200.0, 2.0, 1.01])
def test_a_relative_sigma_is_a_fraction(sigma: float):
    per_cent = channels().assign(sigma=[0.05, sigma, 1.0])
    with pytest.raises(TableError, match=r"sigma of 'PV6' is relative.*at most 1, received"):
        ingest(frame(), per_cent, feeder())


def test_columns_of_channels_stand_once_and_may_be_categories():
    expected = ingest(frame(), channels(), feeder()).channels
    coded = channels().astype("category")
    pd.testing.assert_frame_equal(ingest(frame(), coded, feeder()).channels, expected)
    with pytest.raises(TableError, match="channels: 'sigma' is the name of two columns"):
        ingest(frame(), pd.concat([channels(), channels()[["sigma"]]], axis=1), feeder())


def test_bus_results_of_another_tool_with_their_shunts_are_refused():
    network = library.load("ieee30")
    flow = power_flow.solve(network)
    bus = int(np.flatnonzero(network.buses.b_shunt_pu)[-1])
    name = network.buses.name[bus]
    shunt = network.buses.b_shunt_pu[bus] * flow.vm[bus] ** 2
    about = pd.DataFrame(
        {
            "channel": ["v", "p", "q"],
            "source": "scada",
            "quantity": ["vm_pu", "p_mw", "q_mvar"],
            "element": f"bus/{name}",
            "unit": ["pu", "MW", "MVar"],
            "sigma": 0.01,
            "sigma_kind": "absolute",
            "period_s": 60.0,
            "sign": [1, -1, -1],
        }
    )
    p, q = flow.p_pu[bus] * network.base_mva, flow.q_pu[bus] * network.base_mva
    copied = pd.DataFrame(
        {
            "channel": ["v", "p", "q"],
            "time_utc": [T, T, T],
            "value": [flow.vm[bus], -p, -(q + shunt * network.base_mva)],
        }
    )
    with pytest.raises(TableError, match=rf"q_mvar at bus/{name} .* plus the bus's own shunt"):
        ingest(copied, about, network)
    assert len(ingest(copied, about, network, shunts="accept").telemetry) == 3
    right = copied.assign(value=[flow.vm[bus], -p, -q])
    assert len(ingest(right, about, network).telemetry) == 3


def test_a_cell_with_several_numbers_is_refused() -> None:
    frame = pd.DataFrame(
        {"channel": "U6", "time_utc": [T, T], "value": [[12.6, 12.7], [12.5, 12.6]]}
    )
    with pytest.raises(
        TableError, match=r"holds lists or arrays, e\.g\. \[12\.6, 12\.7\].*explode"
    ):
        ingest(frame, channels(), feeder())


@pytest.mark.parametrize("kind", [complex, object])
def test_a_complex_sign_is_refused(kind: type) -> None:
    frame = pd.DataFrame({"channel": "PV6", "time_utc": [T], "value": [50.0]})
    signs = np.array([np.complex128(1), np.complex128(-1), np.complex128(1)], dtype=kind)
    with pytest.raises(TableError, match=r"sign of 'U6' must be 1, or -1"):
        ingest(frame, channels().assign(sign=signs), feeder())
