"""Claim: default limits keep out what no plant can have had, and nothing that a plant can have."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pse_analysis.errors import ParameterError
from pse_analysis.grid import Network, library
from pse_analysis.machine import Machine
from pse_analysis.parameters import build
from pse_analysis.validation import DefaultLimits, Rule, ValidateParams, validate
from pse_analysis.validation.default_limits import nominal_mva, physical_limits
from pse_analysis.vocabulary import Quantity, Reason

MACHINE = Machine(s_mva=200.0, t_j_s=6.4, f_hz=50.0)
UNITS = {
    "vm_pu": ("pu", "kv"),
    "va_degree": ("degree", "rad"),
    "p_mw": ("mw", "kw", "pu"),
    "q_mvar": ("mvar", "kvar", "pu"),
    "i_ka": ("ka", "a", "pu"),
    "ia_degree": ("degree", "rad"),
}


def grid(base_mva: float = 10.0, load_mw: float = 4.0, vn_kv: float = 20.0) -> Network:
    """Two buses and the line between them; its impedance in ohms does not depend on the base."""
    ohm = vn_kv**2 / base_mva
    return Network.from_tables(
        pd.DataFrame({"name": ["pair"], "base_mva": [base_mva]}),
        pd.DataFrame(
            {"name": ["A", "B"], "kind": [3, 1], "vn_kv": vn_kv, "p_load_mw": [0.0, load_mw]}
        ),
        pd.DataFrame(
            {"from_bus": ["A"], "to_bus": ["B"], "r_pu": [0.4 / ohm], "x_pu": [0.8 / ohm]}
        ),
    )


def channel(quantity: str, unit: str, element: str = "bus/B", **changes: object) -> pd.DataFrame:
    row = {
        "channel": f"scada:{element}:{quantity}", "source": "scada", "quantity": quantity,
        "element": element, "side": "from" if element.startswith("branch") else "", "unit": unit,
        "sigma": 0.01, "sigma_kind": "absolute", "lower": np.nan, "upper": np.nan,
        "period_s": 60.0, "sign": np.int8(1), "aggregation": "instant",
    }  # fmt: skip
    return pd.DataFrame([row | changes])


def out_of_limits(
    channels: pd.DataFrame,
    values: list[float],
    model: Network | Machine | None,
    params: ValidateParams | None = None,
) -> list[bool]:
    """Which of a few samples of every channel, without history, are flagged for a limit."""
    n, m = len(values), len(channels)
    time = pd.Series(pd.date_range("2024-05-14", periods=n, freq="60s", tz="UTC", unit="us"))
    time = pd.concat([time] * m, ignore_index=True)
    telemetry = pd.DataFrame(
        {
            "trial": np.zeros(n * m, dtype=np.int32),
            "channel": np.repeat(channels["channel"].to_numpy(), n),
            "seq": np.tile(np.arange(n), m),
            "time_utc": time,
            "arrival_utc": time,
            "value": np.tile(np.asarray(values, dtype=float), m),
            "quality": pd.array([pd.NA] * (n * m), dtype="Int16"),
        }
    )
    found = validate(telemetry, channels, params, model=model)
    return ((found["reasons"] & int(Reason.LIMIT)) != 0).tolist()


@pytest.mark.parametrize("base_mva", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("load_mw", [4.0, 0.0])
def test_a_million_per_unit_is_out_in_every_unit_of_every_quantity(
    base_mva: float, load_mw: float
) -> None:
    network = grid(base_mva, load_mw)
    base_ka = base_mva / (np.sqrt(3.0) * 20.0)
    per_unit = {
        "kv": 20.0, "mw": base_mva, "kw": 1e3 * base_mva, "mvar": base_mva, "kvar": 1e3 * base_mva,
        "ka": base_ka, "a": 1e3 * base_ka,
    }  # fmt: skip
    off = ValidateParams(default_limits=DefaultLimits(apply=False))
    for unit in {u for units in UNITS.values() for u in units}:
        value = 1e6 * per_unit.get(unit, 1.0)
        own = pd.concat(
            [
                channel(q, unit, "branch/A-B" if q[0] == "i" else "bus/B", sign=np.int8(sign))
                for q in UNITS
                for sign in (1, -1)
                if unit in UNITS[q]
            ],
            ignore_index=True,
        )
        own["channel"] += own["sign"].astype(str)
        assert out_of_limits(own, [value, -value], network) == [True, True] * len(own)
        # The same turned off lets all but a negative magnitude of a voltage pass.
        passed = [flag for q in own["quantity"] for flag in (False, q == "vm_pu")]
        assert out_of_limits(own, [value, -value], network, off) == passed


@pytest.mark.parametrize(
    ("quantity", "unit", "element", "values"),
    [
        # 20 kV in a p.u. channel; 20,000 V in kV; the load of 4 MW in W, reactive power in var.
        ("vm_pu", "pu", "bus/B", [20.0]),
        ("vm_pu", "kv", "bus/B", [20_000.0]),
        ("p_mw", "mw", "bus/B", [-4e6]),
        ("p_mw", "mw", "branch/A-B", [4e6, -4e3 * 1e3]),
        ("q_mvar", "mvar", "bus/B", [-1.2e6]),
        ("i_ka", "ka", "branch/A-B", [115.0]),
        ("va_degree", "degree", "bus/B", [9999.0, -32768.0]),
        ("ia_degree", "rad", "branch/A-B", [65_535.0]),
    ],
)
def test_wrong_units_and_numbers_that_stand_for_no_value_are_out(
    quantity: str, unit: str, element: str, values: list[float]
) -> None:
    assert all(out_of_limits(channel(quantity, unit, element), values, grid()))


@pytest.mark.parametrize(
    ("quantity", "unit", "element", "values"),
    [
        # Almost broken down, in an earth fault, as a voltage transformer still transforms it.
        ("vm_pu", "pu", "bus/B", [1e-3, 0.3, 1.0, 1.73, 1.9]),
        # Overload, reverse flow, a plant of twenty times the load, a transit of 100 times.
        ("p_mw", "mw", "bus/B", [-12.0, 0.0, 12.0, 80.0, 400.0]),
        ("q_mvar", "mvar", "bus/B", [-80.0, 80.0]),
        ("p_mw", "kw", "branch/A-B", [-400e3, 400e3]),
        # Idle, loaded, with a direction, in a short circuit of the largest usual switchgear.
        ("i_ka", "ka", "branch/A-B", [0.0, 0.115, -0.115, 40.0, 80.0]),
        # Both conventions, and a vector group of 330 degrees on top.
        ("va_degree", "degree", "bus/B", [-180.0, 180.0, 359.9, 690.0]),
        ("ia_degree", "rad", "branch/A-B", [-np.pi, 2 * np.pi]),
    ],
)
@pytest.mark.parametrize("load_mw", [4.0, 0.0])
def test_whatever_a_plant_can_have_is_in(
    quantity: str, unit: str, element: str, values: list[float], load_mw: float
) -> None:
    own = channel(quantity, unit, element)
    assert not any(out_of_limits(own, values, grid(load_mw=load_mw)))


@pytest.mark.parametrize("name", library.GRIDS)
def test_ten_times_the_load_or_generation_of_a_bus_is_in_on_every_library_grid(name: str) -> None:
    network = library.load(name)
    buses = network.buses
    channels = pd.concat(
        [channel(q, "pu", f"bus/{b}") for b in buses.name for q in ("p_mw", "q_mvar")],
        ignore_index=True,
    )
    upper = physical_limits(channels, network, DefaultLimits()).upper.reshape(-1, 2)
    largest = np.maximum(np.abs(buses.p_gen_mw), np.hypot(buses.p_load_mw, buses.q_load_mvar))
    assert (upper * network.base_mva >= 10.0 * largest[:, None]).all()
    # Any of their loads in W is out all the same.
    load = np.abs(buses.p_load_mw)
    assert (upper[load > 0, 0] * network.base_mva < 1e6 * load[load > 0]).all()


def test_the_limits_of_a_small_grid_follow_by_hand() -> None:
    network = grid()
    # √3 · 20 kV · 4 kA = 138.6 MVA, times ten for powers; 4 MW of load are less than that.
    rows = [("p_mw", "mw"), ("p_mw", "kw"), ("i_ka", "ka"), ("i_ka", "pu"), ("vm_pu", "kv")]
    own = pd.concat([channel(q, u) for q, u in rows], ignore_index=True)
    limits = physical_limits(own, network, DefaultLimits())
    base_ka = 10.0 / (np.sqrt(3.0) * 20.0)
    expected = [1385.6406, 1385640.6, 80.0, 80.0 / base_ka, 40.0]
    np.testing.assert_allclose(limits.upper, expected, rtol=1e-6)
    np.testing.assert_allclose(limits.lower[:4], -limits.upper[:4])
    assert np.isnan(limits.lower[4])
    assert limits.origin[0] == "10 × 4 kA at rated voltage"
    # 400 MW at a bus are more; they count beside the shunt of 0.5 p.u. of 10 MVA.
    large = grid(load_mw=400.0)
    shunted = dataclasses.replace(
        large, buses=dataclasses.replace(large.buses, b_shunt_pu=np.array([0.0, -0.5]))
    )
    assert nominal_mva(shunted) == pytest.approx(405.0)
    limits = physical_limits(own, shunted, DefaultLimits(power=3.0))
    assert limits.upper[0] == pytest.approx(1215.0)
    assert limits.origin[0] == "3 × 405 MVA, the nominal power of the whole grid"


@settings(max_examples=50, deadline=None)
@given(st.floats(0.1, 1e4), st.floats(0.1, 1e4), st.floats(0.0, 1e4), st.floats(0.2, 1000.0))
def test_limits_in_physical_units_do_not_depend_on_the_base(
    one: float, other: float, load_mw: float, vn_kv: float
) -> None:
    rows = [("p_mw", "kw"), ("q_mvar", "mvar"), ("i_ka", "a"), ("vm_pu", "kv")]
    own = pd.concat([channel(q, u) for q, u in rows], ignore_index=True)
    both = [
        physical_limits(own, grid(base, load_mw, vn_kv), DefaultLimits()).upper
        for base in (one, other)
    ]
    np.testing.assert_allclose(*both, rtol=1e-9)


def test_a_rotor_is_limited_by_its_nameplate() -> None:
    for quantity, unit, bad, good in (
        # Over 20 p.u.; three times nominal speed, 942 rad/s; 30 min of it, 565,487 rad.
        ("delta_m_pu", "pu", [1e6, -25.0], [0.0, 1.0, -10.0]),
        ("rotor_speed_rad_s", "rad/s", [1e6, 1000.0], [-314.2, 0.0, 628.3]),
        ("rotor_angle_rad", "rad", [1e6, -6e5], [-200.0, 5e5]),
    ):
        own = channel(quantity, unit, MACHINE.element)
        assert all(out_of_limits(own, bad, MACHINE))
        assert not any(out_of_limits(own, good, MACHINE))


def test_stated_limits_always_hold_and_only_what_is_absent_is_filled() -> None:
    network = grid()

    def limits(*rules: Rule, **stated: float) -> list[bool]:
        own = channel("p_mw", "mw", **stated)
        return out_of_limits(own, [-1e9, -1e4, 5.0, 1e4, 1e9], network, ValidateParams(rules))

    assert limits() == [True, True, False, True, True]
    assert limits(lower=-np.inf, upper=np.inf) == [False] * 5
    assert limits(lower=-1e5, upper=1e5) == [True, False, False, False, True]
    assert limits(upper=1e5) == [True, True, False, False, True]
    assert limits(Rule(upper=4.0)) == [True, True, True, True, True]
    assert limits(Rule(checks=("time",))) == [False] * 5
    # 5,000 MW or more: what the default knows nothing of, so that side is left to the user.
    assert limits(lower=5e3) == [True, True, True, False, False]
    assert limits(upper=-5e3) == [False, False, True, True, True]


def test_without_a_model_only_what_needs_none_is_limited() -> None:
    assert out_of_limits(channel("vm_pu", "pu"), [1e6, 1.0], None) == [True, False]
    assert out_of_limits(channel("vm_pu", "kv"), [1e6, 20.0], None) == [False, False]
    assert out_of_limits(channel("p_mw", "pu"), [1e6, 1.0], None) == [False, False]
    assert out_of_limits(channel("va_degree", "rad"), [1e6, 1.0], None) == [True, False]


def test_a_channel_that_is_out_as_a_whole_says_which_limits_are_meant(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        assert all(out_of_limits(channel("p_mw", "mw"), [4e6, 4.1e6], grid()))
    assert "mw (default: 10 × 4 kA at rated voltage), e.g. 4e+06" in caplog.text
    assert "validated" not in caplog.text


def test_a_case_file_sets_the_widths_and_turns_them_off() -> None:
    section = {"default_limits": {"voltage_pu": 1.5, "power": 5, "current": float("inf")}}
    params = build(ValidateParams, section, "validate")
    assert params.default_limits == DefaultLimits(voltage_pu=1.5, power=5.0, current=np.inf)
    assert out_of_limits(channel("vm_pu", "pu"), [1.6, 1.4], grid(), params) == [True, False]
    assert out_of_limits(channel("i_ka", "ka"), [1e9], grid(), params) == [False]
    off = build(ValidateParams, {"default_limits": {"apply": False}}, "validate")
    assert out_of_limits(channel("vm_pu", "pu"), [1e6], grid(), off) == [False]
    with pytest.raises(ParameterError, match="unknown key 'voltage': did you mean 'voltage_pu'"):
        build(ValidateParams, {"default_limits": {"voltage": 1.5}}, "validate")
    for width in (0.0, -1.0):
        with pytest.raises(ParameterError, match=r"power must be above 0, received"):
            DefaultLimits(power=width)


def test_every_quantity_has_default_limits() -> None:
    assert {*UNITS, "delta_m_pu", "rotor_angle_rad", "rotor_speed_rad_s"} == set(Quantity)
