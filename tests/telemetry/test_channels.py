"""Claim: a channel that does not fit the grid or its unit is refused, with the remedy."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from simulated_case import case, feeder

from pse_analysis.errors import TableError
from pse_analysis.grid import library, power_flow
from pse_analysis.telemetry import check_channels, check_shunts


def changed(**cells: object) -> pd.DataFrame:
    """Channels with cells of the first row changed."""
    channels = case().channels.copy()
    for name, value in cells.items():
        channels.loc[0, name] = value
    return channels


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (
            {"element": "bus/33x"},
            r"'pmu:bus/2:vm_pu' stands at 'bus/33x', but ieee33 has no bus '33x'.*mean '33'",
        ),
        (
            {"element": "branch/67", "quantity": "p_mw", "unit": "mw", "side": "to"},
            r"no branch '67': did you mean '6-7'",
        ),
        ({"unit": "mw"}, r"does not fit vm_pu: expected 'pu' or 'kv', received 'mw'"),
        ({"sigma": 0.0}, r"sigma of 'pmu:bus/2:vm_pu' must be .* above 0, received 0.0"),
        ({"sigma": np.nan}, r"sigma of .* received nan"),
        ({"sigma": np.inf}, r"sigma of .* received inf"),
        ({"lower": 1.2, "upper": 0.8}, r"lower = 1.2 of 'pmu:bus/2:vm_pu' lies above upper = 0.8"),
        ({"side": "from"}, r"side of .* at 'bus/2': expected '', received 'from'"),
        ({"element": "branch/6-7", "side": "from"}, "a voltage belongs to a bus"),
        (
            {"element": "node/2"},
            "'element' of channel 'pmu:bus/2:vm_pu': expected bus/NAME, .*'node/2'",
        ),
        ({"quantity": "vm"}, "'quantity' of channel .*: expected one of 'vm_pu', .*received 'vm'"),
    ],
)
def test_a_channel_that_does_not_fit_is_refused(cells, message):
    with pytest.raises(TableError, match=message):
        check_channels(changed(**cells), feeder())


def test_a_missing_column_is_named():
    with pytest.raises(TableError, match="channels: column 'period_s' is missing"):
        check_channels(case().channels.drop(columns="period_s"), feeder())


def test_sound_channels_pass():
    pd.testing.assert_frame_equal(check_channels(case().channels, feeder()), case().channels)


# --------------------------------------------------------------------------------------------------
# Shunts counted twice
# --------------------------------------------------------------------------------------------------


def snapshots(grid: str, level: float, with_shunt: bool) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Voltage and injections of every bus, with the shunt in the injection or not."""
    network = library.load(grid)
    flow = power_flow.solve(network, level * network.p_nominal_pu, level * network.q_nominal_pu)
    square = flow.vm**2 if with_shunt else 0.0
    values = {
        "vm_pu": flow.vm,
        "p_mw": (flow.p_pu - network.buses.g_shunt_pu * square) * network.base_mva,
        "q_mvar": (flow.q_pu + network.buses.b_shunt_pu * square) * network.base_mva,
    }
    rows = [
        {"channel": f"scada:bus/{b}:{q}", "element": f"bus/{b}", "quantity": q, "value": v[i]}
        for q, v in values.items()
        for i, b in enumerate(network.buses.name)
    ]
    frame = pd.DataFrame(rows)
    return frame[["channel", "value"]], frame[["channel", "element", "quantity"]]


@pytest.mark.parametrize("grid", ["ieee14", "ieee30", "ieee118"])
@pytest.mark.parametrize("level", [0.6, 1.0])
def test_injections_that_contain_the_shunt_are_refused(grid: str, level: float):
    network = library.load(grid)
    check_shunts(*snapshots(grid, level, with_shunt=False), network)
    with pytest.raises(TableError, match=r"looks like the load .* plus the bus's own shunt"):
        check_shunts(*snapshots(grid, level, with_shunt=True), network)


def test_without_a_voltage_at_the_bus_nothing_is_said():
    samples, channels = snapshots("ieee30", 1.0, with_shunt=True)
    without = channels[channels.quantity != "vm_pu"]
    with pytest.raises(TableError):
        check_shunts(samples, channels, library.load("ieee30"))
    assert check_shunts(samples, without, library.load("ieee30")) is None
