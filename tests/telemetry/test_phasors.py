"""Claim: of a complex value each channel takes the part that it measures, in its own unit."""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_case import feeder

from pse_analysis.errors import TableError
from pse_analysis.machine import Machine
from pse_analysis.telemetry import RawCase, ingest

T = pd.Timestamp("2016-06-09T08:00:00Z")
PHASOR = 0.5 + 0.87j  # |z|² = 0.25 + 0.7569, arg z = atan 1.74


def channels(*rows: tuple[str, str, str, str]) -> pd.DataFrame:
    """Channels of (name, quantity, element, unit)."""
    return pd.DataFrame(
        {
            "channel": [r[0] for r in rows],
            "source": "pmu",
            "quantity": [r[1] for r in rows],
            "element": [r[2] for r in rows],
            "side": ["from" if r[2].startswith("branch") else "" for r in rows],
            "unit": [r[3] for r in rows],
            "sigma": 0.01,
            "sigma_kind": "absolute",
            "period_s": 60.0,
        }
    )


BUS = channels(("vm", "vm_pu", "bus/6", "pu"), ("va", "va_degree", "bus/6", "degree"))


def taken(values: object, about: pd.DataFrame, tag: str = "PMU7", **how: object) -> pd.DataFrame:
    """Values of one tag that feeds all channels, a column per channel."""
    column = pd.Series(values)
    frame = pd.DataFrame(
        {
            "channel": tag,
            "time_utc": T + pd.to_timedelta(60 * np.arange(len(column)), unit="s"),
            "value": column,
        }
    )
    raw: RawCase = ingest(frame, about, feeder(), tags={tag: tuple(about["channel"])}, **how)
    return raw.telemetry.pivot(index="seq", columns="channel", values="value")


def test_one_column_of_phasors_feeds_magnitude_and_angle():
    read = taken([PHASOR, 1j, -1 + 0j], BUS)
    assert list(read["vm"]) == pytest.approx([np.sqrt(1.0069), 1.0, 1.0])
    assert list(read["va"]) == pytest.approx([60.11347, 90.0, 180.0], abs=1e-4)


@pytest.mark.parametrize("kind", ["complex64", "complex128", "object"])
def test_every_type_of_complex_numbers_is_read(kind: str):
    read = taken(np.array([PHASOR], dtype=kind), BUS)
    assert read.loc[0, "vm"] == pytest.approx(1.00344, rel=1e-5)
    assert read.loc[0, "va"] == pytest.approx(60.11347, rel=1e-5)


def test_units_are_those_of_the_channel():
    about = channels(
        ("kv", "vm_pu", "bus/6", "kV"),
        ("rad", "va_degree", "bus/6", "rad"),
        ("i", "i_ka", "branch/6-7", "A"),
        ("ia", "ia_degree", "branch/6-7", "degree"),
    )
    read = taken([12.66 * (0.6 + 0.8j)], about, units="accept")
    assert read.loc[0, "kv"] == pytest.approx(1.0)
    assert read.loc[0, "rad"] == pytest.approx(np.degrees(np.arctan2(0.8, 0.6)))
    assert read.loc[0, "i"] == pytest.approx(12.66e-3)
    assert read.loc[0, "ia"] == pytest.approx(53.1301, abs=1e-4)


def test_complex_power_is_active_and_reactive_power():
    about = channels(("p", "p_mw", "bus/6", "kW"), ("q", "q_mvar", "bus/6", "kvar"))
    read = taken([60 + 20j, 80 - 10j], about.assign(sign=-1))
    assert list(read["p"]) == pytest.approx([-0.06, -0.08])
    assert list(read["q"]) == pytest.approx([-0.02, 0.01])


def test_a_current_counted_in_the_other_direction_turns_by_half():
    about = channels(("i", "i_ka", "branch/6-7", "ka"), ("ia", "ia_degree", "branch/6-7", "degree"))
    read = taken([0.1 * np.exp(1j * np.radians(30.0))], about.assign(sign=-1, lower=0.0))
    assert read.loc[0, "i"] == pytest.approx(0.1)
    assert read.loc[0, "ia"] == pytest.approx(-150.0)


@pytest.mark.parametrize(
    "lost", [complex("nan"), complex("nan+1j"), complex("inf"), complex(1, np.inf), 0j]
)
def test_what_is_no_phasor_has_no_angle(lost: complex):
    read = taken([PHASOR, lost], BUS)
    assert np.isnan(read.loc[1, "va"])
    assert read.loc[1, "vm"] == 0.0 or not np.isfinite(read.loc[1, "vm"])


def test_gaps_among_phasors_are_missing_values():
    read = taken(pd.Series([PHASOR, None, PHASOR], dtype=object), BUS)
    assert read["vm"].isna().tolist() == read["va"].isna().tolist() == [False, True, False]


def test_plain_numbers_among_phasors_stay_what_they_are():
    frame = pd.DataFrame(
        {"channel": ["vm", "va"], "time_utc": T, "value": pd.Series([PHASOR, -12.5], dtype=object)}
    )
    value = ingest(frame, BUS, feeder()).telemetry.set_index("channel")["value"]
    assert value["vm"] == pytest.approx(1.00344, rel=1e-5)
    assert value["va"] == -12.5


def test_angles_without_any_imaginary_part_are_named(caplog):
    with caplog.at_level(logging.WARNING):
        taken([-12.5 + 0j, -12.6 + 0j], BUS[BUS["channel"] == "va"])
    assert "no value of va has an imaginary part" in caplog.text


def test_a_machine_has_no_phasor():
    machine = Machine(s_mva=200.0, t_j_s=6.4)
    about = channels(("w", "rotor_speed_rad_s", "machine/1", "rad/s"))
    frame = pd.DataFrame({"channel": "w", "time_utc": [T], "value": [PHASOR]})
    with pytest.raises(TableError, match=r"'w' are complex.*rotor_speed_rad_s has no phasor.*pass"):
        ingest(frame, about, machine)


@pytest.mark.parametrize("named", [(), ("vm", 7), 7, None])
def test_a_tag_names_a_channel_or_several(named: object):
    frame = pd.DataFrame({"channel": "PMU7", "time_utc": [T], "value": [PHASOR]})
    with pytest.raises(TableError, match=r"tags\['PMU7'\] must be a channel or several, received"):
        ingest(frame, BUS, feeder(), tags={"PMU7": named})


def test_a_tag_may_feed_several_channels_with_real_values_too():
    about = channels(("a", "vm_pu", "bus/6", "pu"), ("b", "vm_pu", "bus/7", "pu"))
    read = taken([1.01, 1.02], about)
    assert list(read["a"]) == list(read["b"]) == [1.01, 1.02]


@given(st.lists(st.tuples(st.floats(0.75, 1.45), st.floats(-179.9, 179.9)), min_size=1, max_size=8))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_magnitude_and_angle_are_those_that_made_the_phasor(polar: list[tuple[float, float]]):
    size, angle = np.array(polar).T
    read = taken(size * np.exp(1j * np.radians(angle)), BUS)
    np.testing.assert_allclose(read["vm"], size, rtol=1e-12)
    np.testing.assert_allclose(read["va"], angle, atol=1e-10)
