"""Claim: a network is immutable, names its elements, and refuses what it cannot mean."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest
from reference import GRIDS

from pse_analysis.errors import GridError
from pse_analysis.grid import BusKind, library
from pse_analysis.grid.network import Network


def changed(network: Network, table: str, **columns: object) -> Network:
    """The network with columns of a table replaced."""
    part = dataclasses.replace(getattr(network, table), **columns)
    return dataclasses.replace(network, **{table: part})


@pytest.mark.parametrize(
    ("grid", "buses", "branches", "closed"),
    [
        ("ieee14", 14, 20, 20),
        ("ieee30", 30, 41, 41),
        ("ieee33", 33, 37, 32),
        ("ieee118", 118, 186, 186),
    ],
)
def test_library_has_the_literatures_counts(
    grid: str, buses: int, branches: int, closed: int
) -> None:
    network = library.load(grid)
    assert (network.n_bus, network.n_branch) == (buses, branches)
    assert int(network.branches.in_service.sum()) == closed
    assert network.buses.name == tuple(str(i + 1) for i in range(buses))


def test_feeder_carries_baran_and_wus_load() -> None:
    buses = library.load("ieee33").buses
    assert buses.p_load_mw.sum() == pytest.approx(3.715)
    assert buses.q_load_mvar.sum() == pytest.approx(2.3)


def test_parallel_circuits_have_names_of_their_own() -> None:
    names = library.load("ieee118").branches.name
    assert {"42-49", "42-49#2", "49-54", "49-54#2"} <= set(names)


@pytest.mark.parametrize("grid", GRIDS)
def test_tables_give_the_same_network_back(grid: str) -> None:
    network = library.load(grid)
    again = Network.from_tables(**network.to_tables())
    for table in ("buses", "branches"):
        for column in dataclasses.fields(getattr(network, table)):
            np.testing.assert_array_equal(
                getattr(getattr(again, table), column.name),
                getattr(getattr(network, table), column.name),
            )
    assert (again.name, again.base_mva) == (network.name, network.base_mva)


def test_columns_cannot_be_written_to() -> None:
    network = library.load("ieee14")
    with pytest.raises(ValueError, match="read-only"):
        network.branches.in_service[0] = False
    with pytest.raises(dataclasses.FrozenInstanceError):
        network.base_mva = 1.0  # type: ignore[misc]


def test_caller_keeps_the_array_it_handed_in() -> None:
    network = library.load("ieee14")
    ratio = network.branches.tap.copy()
    other = changed(network, "branches", tap=ratio)
    ratio[0] = 3.0
    assert other.branches.tap[0] == network.branches.tap[0]


def test_opening_a_branch_returns_another_network() -> None:
    network = library.load("ieee14")
    opened = network.open_branch("1-2")
    k = network.branch("1-2")
    assert network.branches.in_service[k]
    assert not opened.branches.in_service[k]
    assert abs(opened.y_from[[k]]).sum() == abs(opened.y_to[[k]]).sum() == 0
    series = 1 / (network.branches.r_pu[k] + 1j * network.branches.x_pu[k])
    f, t = network.bus("1"), network.bus("2")
    assert (opened.y_bus - network.y_bus)[f, t] == pytest.approx(series)


def test_opening_the_only_path_makes_an_island() -> None:
    island = library.load("ieee33").open_branch("6-7").islands()
    names = np.array(library.load("ieee33").buses.name)
    assert set(names[island != island[0]]) == {str(i) for i in range(7, 19)}


def test_every_island_has_a_reference_and_the_slack_is_its_own() -> None:
    network = library.load("ieee30").open_branch("6-8").open_branch("8-28")
    assert network.references[network.slack] == network.slack
    assert network.references[network.bus("8")] == network.bus("8")
    assert set(network.references) == {network.slack, network.bus("8")}
    network = library.load("ieee33").open_branch("6-7")
    assert set(network.references) == {network.slack, network.bus("7")}  # nothing there generates


def test_reference_of_an_island_is_its_largest_generator() -> None:
    network = library.load("ieee14")
    kind, generation = network.buses.kind.copy(), network.buses.p_gen_mw.copy()
    kind[[9, 10]], generation[[9, 10]] = BusKind.PV, [5.0, 20.0]
    network = changed(network, "buses", kind=kind, p_gen_mw=generation)
    for name in ("4-9", "7-9", "9-14", "6-11"):
        network = network.open_branch(name)
    assert set(network.references) == {network.slack, 10}


@pytest.mark.parametrize("grid", GRIDS)
def test_current_of_equal_voltages_is_that_of_shunts_and_taps_alone(grid: str) -> None:
    network = library.load(grid)
    plain = changed(
        network,
        "branches",
        tap=np.ones(network.n_branch),
        shift_rad=np.zeros(network.n_branch),
        b_pu=np.zeros(network.n_branch),
        g_pu=np.zeros(network.n_branch),
    )
    shunt = network.buses.g_shunt_pu + 1j * network.buses.b_shunt_pu
    np.testing.assert_allclose(plain.y_bus @ np.ones(network.n_bus), shunt, atol=1e-9)


def test_base_current_is_base_power_over_rated_voltage() -> None:
    network = library.load("ieee33")
    assert network.base_ka[4] == pytest.approx(network.base_mva / (np.sqrt(3) * 12.66))


@pytest.mark.parametrize(
    ("call", "name", "expected"),
    [
        ("bus", "331", "did you mean 33"),
        ("branch", "1-3", "did you mean"),
        ("bus", "x", "it has 33"),
    ],
)
def test_unknown_element_names_what_is_close(call: str, name: str, expected: str) -> None:
    with pytest.raises(GridError, match=expected) as caught:
        getattr(library.load("ieee33"), call)(name)
    assert repr(name) in str(caught.value)


def test_unknown_grid_names_what_is_close() -> None:
    with pytest.raises(GridError, match=r"did you mean 'ieee33'.*ieee14, ieee30"):
        library.load("ieee_33")


def spoilt(column: str, value: object, n: int = 14) -> np.ndarray:
    out = np.full(n, 1.0)
    out[3] = value  # type: ignore[call-overload]
    return out


@pytest.mark.parametrize(
    ("table", "columns", "expected"),
    [
        (
            "branches",
            {"r_pu": np.zeros(20), "x_pu": np.zeros(20)},
            "'1-2' has zero impedance.*merge",
        ),
        ("branches", {"r_pu": np.full(20, np.nan)}, "branches.r_pu must be finite, '1-2' has nan"),
        ("branches", {"to_bus": np.full(20, 14)}, "branch ends must lie in 0…13"),
        ("branches", {"tap": np.zeros(20)}, "tap of branch '1-2' must be positive.*1"),
        ("branches", {"x_pu": np.ones(19)}, "expected 20 values, one per name, received shape"),
        ("buses", {"vn_kv": spoilt("vn_kv", np.inf)}, "buses.vn_kv must be finite, '4' has inf"),
        ("buses", {"vn_kv": spoilt("vn_kv", 0.0)}, "vn_kv of bus '4' must be positive"),
        ("buses", {"kind": np.ones(14)}, "expected one slack bus, received 0"),
        ("buses", {"kind": np.full(14, 3)}, "expected one slack bus, received 14"),
        ("buses", {"kind": np.array([3, 7] + [1] * 12)}, "kind of bus '2' must be 1, 2 or 3"),
        ("buses", {"kind": np.array([3, 259] + [1] * 12)}, "kind of bus '2'.*received 259"),
        ("buses", {"kind": np.array([3, np.nan] + [1] * 12)}, "kind of bus '2'.*received nan"),
        ("buses", {"kind": ["3", "PQ"] + ["1"] * 12}, "kind of bus '2'.*received 'PQ'"),
        ("branches", {"x_pu": ["0,1"] * 20}, "x_pu of branch '1-2' must be a number; .*decimal"),
        ("branches", {"in_service": ["true", ""] * 10}, "in_service of .*true or false; rec.* ''"),
        ("branches", {"in_service": np.full(20, np.nan)}, "in_service of .*received nan"),
        ("branches", {"to_bus": np.arange(20) % 14, "from_bus": [0] * 20}, "ends at the bus where"),
        ("buses", {"q_max_mvar": np.full(14, np.nan)}, "q_max_mvar of bus '1'.*inf where"),
        ("buses", {"name": ("1",) * 14}, "distinct names, '1' repeats"),
        ("buses", {"vn_kv": spoilt("vn_kv", 12660.0)}, "vn_kv of bus '4'.*in V, divide it by 1000"),
        ("buses", {"vn_kv": spoilt("vn_kv", 1e-300)}, "vn_kv of bus '4' must be 0.001 … 1500 kV"),
        ("buses", {"p_load_mw": spoilt("p_load_mw", 1e300)}, "p_load_mw of bus '4'.*at most 1e.12"),
        ("buses", {"vm_set_pu": np.full(14, 110.0)}, "vm_set_pu of bus '1'.*kV, divide it by vn_k"),
        ("branches", {"shift_rad": np.full(20, 30.0)}, "shift_rad of branch '1-2'.*by π/180"),
        (
            "branches",
            {"tap": np.full(20, 230.0)},
            "tap of branch '1-2'.*over the rated ratio",
        ),
        ("branches", {"r_pu": [1e-14] * 20, "x_pu": [1e-14] * 20}, "'1-2' has zero impedance"),
        ("branches", {"from_bus": np.full(20, np.nan)}, "from_bus of branch '1-2'.*received nan"),
        ("branches", {"from_bus": np.full(20, 0.5)}, "from_bus of branch '1-2'.*received 0.5"),
        ("branches", {"x_pu": [10**400] * 20}, "x_pu of branch '1-2' must be a number"),
        ("branches", {"x_pu": [1j] * 20}, "x_pu of branch '1-2' must be a number; received 1j"),
    ],
)
def test_impossible_grid_is_refused(table: str, columns: dict[str, object], expected: str) -> None:
    with pytest.raises(GridError, match=expected):
        changed(library.load("ieee14"), table, **columns)


@pytest.mark.parametrize(
    ("table", "change", "expected"),
    [
        ("buses", lambda f: pd.concat([f, f[["kind"]]], axis=1), "'kind' is the name of two col"),
        ("buses", lambda f: f.assign(name=[None, *f.name[1:]]), "'buses': name is empty in row 0"),
        ("buses", lambda f: f.assign(name=["", *f.name[1:]]), "'buses': '' is no name"),
        ("buses", lambda f: f.assign(name=["a\x1b[2J", *f.name[1:]]), r"'a\\x1b\[2J' is no name"),
        ("branches", lambda f: f.assign(name=[None, *f.name[1:]]), "'branches': name is empty"),
        ("branches", lambda f: f.to_dict(), "expected a pandas DataFrame, received dict"),
        ("network", lambda f: f.assign(base_mva=10**400), "base_mva must be a number"),
        ("network", lambda f: f.assign(base_mva=[[1.0]]), "base_mva must be a number"),
    ],
)
def test_odd_tables_of_a_grid_are_refused(table: str, change: object, expected: str) -> None:
    tables = library.load("ieee14").to_tables()
    tables[table] = change(tables[table])  # type: ignore[operator]
    with pytest.raises(GridError, match=expected):
        Network.from_tables(**tables)


def test_one_of_two_like_columns_may_stand_alone() -> None:
    tables = library.load("ieee14").to_tables()
    alone = tables | {"buses": tables["buses"].drop(columns="g_shunt_pu")}
    assert Network.from_tables(**alone).buses.b_shunt_pu.any()


def test_tables_of_categories_make_the_same_grid() -> None:
    tables = library.load("ieee14").to_tables()
    coded = {name: frame.astype("category") for name, frame in tables.items()}
    for name, frame in Network.from_tables(**coded).to_tables().items():
        pd.testing.assert_frame_equal(frame, tables[name])


def test_base_power_must_be_positive() -> None:
    with pytest.raises(GridError, match="base_mva must be positive and finite, received 0"):
        dataclasses.replace(library.load("ieee14"), base_mva=0.0)
    with pytest.raises(GridError, match="base_mva must be positive and finite, received inf"):
        dataclasses.replace(library.load("ieee14"), base_mva=np.inf)
    tables = library.load("ieee14").to_tables()
    with pytest.raises(GridError, match="base_mva must be a number, received '25 MVA'"):
        Network.from_tables(**tables | {"network": tables["network"].assign(base_mva="25 MVA")})


def test_a_branch_is_out_of_service_however_a_table_spells_it() -> None:
    tables = library.load("ieee14").to_tables()
    for words in (["True", "False"], ["yes", "NO"], [True, False], [1.0, 0.0], ["1", "0"]):
        branches = tables["branches"].assign(in_service=words * 10)
        network = Network.from_tables(**tables | {"branches": branches})
        assert network.branches.in_service.tolist() == [True, False] * 10


@pytest.mark.parametrize(
    ("table", "column", "spelt"),
    [
        ("branches", "tap", "tap_ratio"),
        ("branches", "shift_rad", "shift_deg"),
        ("branches", "in_service", "In_Service"),
        ("buses", "p_load_mw", "p_laod_mw"),
        ("buses", "p_load_mw", "p_load"),
        ("buses", "vn_kv", "vn_kV"),
    ],
)
def test_a_misspelt_column_is_refused_and_an_unrelated_one_is_not(
    table: str, column: str, spelt: str
) -> None:
    tables = library.load("ieee14").to_tables()
    frame = tables[table]
    own = frame.assign(station="S", length_km=1.0, max_i_ka=1.0, q_gen_mvar=0.0)
    own = own.drop(columns=["q_min_mvar", "q_max_mvar"], errors="ignore")
    Network.from_tables(**tables | {table: own})
    with pytest.raises(GridError, match=f"unknown column '{spelt}': did you mean '{column}'"):
        Network.from_tables(**tables | {table: frame.rename(columns={column: spelt})})


def test_branch_to_nowhere_names_the_bus() -> None:
    tables = library.load("ieee14").to_tables()
    tables["branches"].loc[2, "to_bus"] = "99"
    with pytest.raises(GridError, match=r"to_bus '99' is no bus; expected .* as 1, 2"):
        Network.from_tables(**tables)
    tables = library.load("ieee14").to_tables()
    tables["buses"].loc[3, "name"] = "3"
    with pytest.raises(GridError, match="name '3' repeats"):
        Network.from_tables(**tables)
    tables["buses"].loc[3, "name"] = np.nan
    with pytest.raises(GridError, match="name is empty in row 3"):
        Network.from_tables(**tables)


def test_missing_column_names_it_and_what_came() -> None:
    tables = library.load("ieee14").to_tables()
    tables["buses"] = tables["buses"].drop(columns="vn_kv")
    with pytest.raises(GridError, match="'buses': column 'vn_kv' is missing; expected name, kind"):
        Network.from_tables(**tables)


def test_slack_is_where_its_kind_says() -> None:
    network = library.load("ieee118")
    assert network.buses.name[network.slack] == "69"
    assert network.buses.kind[network.slack] == BusKind.SLACK
