"""Claim: values in another unit than their channel states are refused or named, with the unit."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from simulated_case import feeder

from pse_analysis.errors import TableError
from pse_analysis.telemetry import ingest

T = pd.Timestamp("2016-06-09T08:00:00Z")


def about() -> pd.DataFrame:
    """A voltage, a load and a current of the feeder."""
    return pd.DataFrame(
        {
            "channel": ["U6", "PV6", "I6"],
            "source": ["scada", "ami", "pmu"],
            "quantity": ["vm_pu", "p_mw", "i_ka"],
            "element": ["bus/6", "bus/6", "branch/6-7"],
            "side": ["", "", "from"],
            "unit": ["kV", "kW", "A"],
            "sigma": [0.05, 0.01, 1.0],
            "sigma_kind": ["absolute", "relative", "absolute"],
            "period_s": 60.0,
            "sign": [1, -1, 1],
        }
    )


def frame(value: list[float]) -> pd.DataFrame:
    """Two samples of each."""
    times = [T + pd.Timedelta(seconds=s) for s in (0, 60)] * 3
    return pd.DataFrame(
        {"channel": np.repeat(["U6", "PV6", "I6"], 2), "time_utc": times, "value": value}
    )


# The bus is rated 12.66 kV.
@pytest.mark.parametrize(
    ("unit", "value", "remedy"),
    [
        ("pu", 12.66, "look like kV: write unit = 'kv'"),
        ("pu", 12500.0, "look like V: divide values, sigma and limits by 1000"),
        ("pu", 98.0, "look like per cent: divide values, sigma and limits by 100"),
        ("pu", 7.31, "look like kV from phase to ground: multiply values, sigma and limits by √3"),
        ("kv", 1.02, "look like p.u.: write unit = 'pu'"),
        ("kv", 12660.0, "look like V: divide values"),
    ],
)
def test_voltages_of_another_unit_are_refused_with_the_unit_to_write(unit, value, remedy):
    stated = about().assign(unit=[unit, "kW", "A"])
    own = frame([value, value, 60.0, 80.0, 120.0, 125.0])
    with pytest.raises(TableError) as refused:
        ingest(own, stated, feeder())
    assert remedy in str(refused.value)
    assert "rated 12.66 kV" in str(refused.value)
    ingest(own, stated, feeder(), units="accept")


def test_one_broken_voltage_meter_is_named_and_stops_nothing(caplog):
    ingest(frame([400.0, 410.0, 60.0, 80.0, 120.0, 125.0]), about(), feeder())
    assert "'U6' has a median of 405 kv = 31.99 p.u. at bus/6" in caplog.text


def test_flows_that_dwarf_the_grid_are_named(caplog):
    stated = about().assign(unit=["kV", "MW", "kA"])
    ingest(frame([12.66, 12.5, 600.0, 800.0, 120.0, 125.0]), stated, feeder())
    assert "if these values are in kw, write unit = 'kw'" in caplog.text
    assert "if these values are in a, write unit = 'a'" in caplog.text
