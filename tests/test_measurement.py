"""Claim: h, its Jacobian, the linear form and the unit boundary agree with their definitions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import (
    GRIDS,
    central_differences,
    channels_table,
    every_quantity,
    measured,
    random_state,
)

from pse_analysis.errors import GridError, TableError
from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import (
    BUS,
    FROM,
    IA,
    IM,
    RELATIVE_FLOOR_PU,
    TO,
    VA,
    VM,
    MeasurementModel,
    P,
    Q,
    RectangularModel,
    SensorLayout,
    standard_deviation,
    wrap,
)

SEED = 2718


def harder(grid: str) -> Network:
    """A library grid with a branch open, phase shifts, and 37 MVA as its base power."""
    network = library.load(grid)
    rng = np.random.default_rng(SEED)
    shift = np.where(np.arange(network.n_branch) % 4 == 0, rng.normal(0, 0.3, network.n_branch), 0)
    tap = np.where(np.arange(network.n_branch) % 5 == 0, 0.93, network.branches.tap)
    in_service = network.branches.in_service.copy()
    in_service[7] = False
    return dataclasses.replace(
        network,
        base_mva=37.0,
        branches=dataclasses.replace(
            network.branches, shift_rad=shift, tap=tap, in_service=in_service
        ),
    )


@pytest.mark.parametrize("grid", GRIDS)
def test_every_quantity_equals_its_definition_branch_by_branch(grid: str) -> None:
    network = harder(grid)
    layout = every_quantity(network)
    x = random_state(network, np.random.default_rng(SEED))
    h = MeasurementModel(network, layout).h(x)
    np.testing.assert_allclose(h, measured(network, layout, x), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("grid", GRIDS)
def test_jacobian_equals_central_differences(grid: str, seed: int) -> None:
    network = harder(grid)
    model = MeasurementModel(network, every_quantity(network))
    x = random_state(network, np.random.default_rng(seed))
    step = 1e-6
    shifted = x[:, None] + step * np.hstack([np.eye(len(x)), -np.eye(len(x))])
    ahead, behind = np.hsplit(model.h(shifted), 2)
    change = np.where(model.angular[:, None], wrap(ahead - behind), ahead - behind)
    numeric = change / (2 * step)
    error = np.abs(model.jacobian(x).toarray() - numeric) / np.maximum(1.0, np.abs(numeric))
    assert error.max() < 1e-6


def test_jacobian_equals_differences_of_the_definition_itself() -> None:
    network = harder("ieee14")
    layout = every_quantity(network)
    x = random_state(network, np.random.default_rng(SEED))
    numeric = central_differences(lambda at: measured(network, layout, at), x)
    exact = MeasurementModel(network, layout).jacobian(x).toarray()
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("grid", GRIDS)
def test_many_states_equal_one_at_a_time(grid: str) -> None:
    network = harder(grid)
    model = MeasurementModel(network, every_quantity(network))
    rng = np.random.default_rng(SEED)
    states = np.stack([random_state(network, rng) for _ in range(5)], axis=1)
    values, entries = model.h(states), model.jacobian_data(states)
    for k in range(5):
        np.testing.assert_allclose(values[:, k], model.h(states[:, k]), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(
            entries[:, k], model.jacobian_data(states[:, k]), rtol=1e-11, atol=1e-11
        )


@settings(max_examples=25, deadline=None, derandomize=True)
@given(data=st.data())
def test_rows_and_columns_may_be_any_selection(data: st.DataObject) -> None:
    network = harder("ieee14")
    layout = every_quantity(network)
    rows = np.array(
        data.draw(st.lists(st.integers(0, len(layout) - 1), min_size=1, max_size=20)), dtype=int
    )
    columns = np.flatnonzero(
        data.draw(st.lists(st.booleans(), min_size=28, max_size=28).filter(any))
    )
    x = random_state(network, np.random.default_rng(SEED))
    whole = MeasurementModel(network, layout)
    part = MeasurementModel(network, layout.take(rows), columns)
    np.testing.assert_allclose(part.h(x), whole.h(x)[rows], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        part.jacobian(x).toarray(),
        whole.jacobian(x).toarray()[np.ix_(rows, columns)],
        rtol=1e-12,
        atol=1e-12,
    )
    assert part.shape == (len(rows), len(columns))


def test_currents_of_an_open_branch_are_zero_with_no_derivative() -> None:
    network = harder("ieee14")
    opened = np.flatnonzero(~network.branches.in_service)
    layout = SensorLayout.of(network, *[(q, opened, s) for q in (P, Q, IM, IA) for s in (FROM, TO)])
    model = MeasurementModel(network, layout)
    x = random_state(network, np.random.default_rng(SEED))
    assert not model.h(x).any()
    assert not model.jacobian(x).toarray().any()


def test_residuals_of_angles_are_folded() -> None:
    network = library.load("ieee14")
    layout = SensorLayout.of(network, (VA, np.array([3]), BUS), (VM, np.array([3]), BUS))
    model = MeasurementModel(network, layout)
    x = np.concatenate([np.full(14, -3.1), np.ones(14)])
    residual = model.residual(np.array([3.1, 5.0]), x)
    assert residual == pytest.approx([6.2 - 2 * np.pi, 4.0])


@settings(max_examples=50, deadline=None, derandomize=True)
@given(angle=st.floats(-50, 50), turns=st.integers(-3, 3))
def test_wrapping_takes_off_whole_turns_only(angle: float, turns: int) -> None:
    folded = wrap(np.array([angle]))[0]
    assert -np.pi <= folded < np.pi
    assert np.exp(1j * folded) == pytest.approx(np.exp(1j * (angle + 2 * np.pi * turns)), abs=1e-9)


# --- linear form ----------------------------------------------------------------------------------


def phasors_and_powers(network: Network) -> SensorLayout:
    """Voltage and current phasors and powers, each with its partner from the same device."""
    bus = np.arange(0, network.n_bus, 3)
    branch = np.flatnonzero(network.branches.in_service)[::2]
    rows = [(q, bus, BUS) for q in (VM, VA, P, Q, IM, IA)]
    rows += [(q, branch, side) for q in (P, Q, IM, IA) for side in (FROM, TO)]
    layout = SensorLayout.of(network, *rows)
    device = [name.split("@")[1] for name in layout.channel]
    names = tuple(f"pmu:{d}:{q}" for d, q in zip(device, layout.quantity, strict=True))
    return dataclasses.replace(layout, channel=names)


@pytest.mark.parametrize("grid", GRIDS)
def test_linear_form_is_exact_at_the_true_voltage(grid: str) -> None:
    network = harder(grid)
    layout = phasors_and_powers(network)
    x = random_state(network, np.random.default_rng(SEED))
    n = network.n_bus
    voltage = x[n:] * np.exp(1j * x[:n])
    z = MeasurementModel(network, layout).h(x)
    everything = np.ones(len(layout), dtype=bool)
    H, linear, _ = RectangularModel(network, layout).rows(
        z, np.full(len(z), 0.01), everything, voltage
    )
    state = np.concatenate([voltage.real, voltage.imag])
    np.testing.assert_allclose(H @ state, linear, atol=1e-10)


def test_linear_phasors_do_not_depend_on_the_predicted_voltage() -> None:
    network = harder("ieee14")
    layout = phasors_and_powers(network)
    model = RectangularModel(network, layout)
    x = random_state(network, np.random.default_rng(SEED))
    z = MeasurementModel(network, layout).h(x)
    everything = np.ones(len(layout), dtype=bool)
    sigma = np.full(len(z), 0.01)
    one = model.rows(z, sigma, everything, np.ones(14, dtype=complex))
    other = model.rows(z, sigma, everything, np.full(14, 0.9 * np.exp(0.3j)))
    phasor = np.isin(layout.quantity, (VM, VA, IM, IA))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(
            *(m.toarray()[phasor] if hasattr(m, "toarray") else m[phasor] for m in (a, b))
        )
    assert abs(one[0] - other[0]).toarray()[~phasor].max() > 0.01


@pytest.mark.parametrize("lost", [VA, VM, None])
def test_linear_rows_have_the_slope_and_the_spread_of_the_measurement(lost: int | None) -> None:
    """Near the truth: (z_lin - H x)/σ_lin of noisy z is standard normal and uncorrelated."""
    network = library.load("ieee14")
    layout = phasors_and_powers(network)
    model = RectangularModel(network, layout)
    x = solve(network).x
    n = network.n_bus
    voltage = x[n:] * np.exp(1j * x[:n])
    state = np.concatenate([voltage.real, voltage.imag])
    truth = MeasurementModel(network, layout).h(x)
    sigma = np.where(np.isin(layout.quantity, (VA, IA)), 1e-3, 2e-3)
    rng = np.random.default_rng(SEED)
    available = np.ones(len(layout), dtype=bool)
    if lost is not None:
        available &= ~np.isin(layout.quantity, (lost, {VM: IM, VA: IA}[lost]))
    draws = 2000
    white = np.empty((draws, len(layout)))
    for k in range(draws):
        z = truth + sigma * rng.normal(size=len(sigma))
        H, linear, spread = model.rows(z, sigma, available, voltage)
        white[k] = (linear - H @ state) / spread
    # A current as small as its σ has no direction to speak of: its row is not linear there.
    current = np.isin(layout.quantity, (IM, IA))
    place = {(q, p, s): i for i, (q, p, s) in enumerate(zip(
        layout.quantity, layout.position, layout.side, strict=True))}  # fmt: skip
    size = np.array([
        truth[place[IM, p, s]] if q in (IM, IA) else 1.0
        for q, p, s in zip(layout.quantity, layout.position, layout.side, strict=True)
    ])  # fmt: skip
    sound = available & ~(current & (size < 0.1))
    assert sound.sum() > 30
    mean, deviation = white[:, sound].mean(axis=0), white[:, sound].std(axis=0)
    assert np.abs(mean).max() < 4.5 / np.sqrt(draws) + 0.03
    assert np.abs(deviation - 1).max() < 4.5 / np.sqrt(2 * draws) + 0.02
    correlation = np.corrcoef(white[:, sound].T)
    assert np.abs(correlation - np.eye(int(sound.sum()))).max() < 4.8 / np.sqrt(draws)


def test_worthless_magnitude_makes_no_angle_exact() -> None:
    """|V| reads 0.045 ± 6 p.u. beside an angle of 1e-3: that lies 1e-3 · 1 p.u. across, not 4.5e-5.

    Nor does a magnitude below zero turn its angle by half a turn.
    """
    network = library.load("ieee14")
    layout = SensorLayout.of(network, (VM, np.array([4]), BUS), (VA, np.array([4]), BUS))
    layout = dataclasses.replace(layout, channel=("pmu:bus/5::vm_pu", "pmu:bus/5::va_degree"))
    model, voltage = RectangularModel(network, layout), np.full(14, np.exp(0.3j))
    on = np.ones(2, dtype=bool)
    for size, sigma in ((0.045, 6.0), (-0.8, 6.0), (-0.1, 1e-3)):
        _, _, spread = model.rows(np.array([size, 0.3]), np.array([sigma, 1e-3]), on, voltage)
        np.testing.assert_allclose(spread, [sigma, 1e-3])
    _, _, spread = model.rows(np.array([0.9, 0.3]), np.array([0.01, 1e-3]), on, voltage)
    np.testing.assert_allclose(spread, [0.01, 0.9e-3])


@pytest.mark.parametrize("grid", ["ieee14", "ieee33"])
def test_linear_rows_have_the_whole_derivative(grid: str) -> None:
    """A row is a measured value over |V|, or an angle times |c|; Q lies along the conjugate."""
    network = harder(grid)
    layout = phasors_and_powers(network)
    x = random_state(network, np.random.default_rng(SEED))
    n, sigma = network.n_bus, np.full(len(layout), 0.01)
    voltage = x[n:] * np.exp(1j * x[:n])
    state = np.concatenate([voltage.real, voltage.imag])

    def read(s: np.ndarray) -> np.ndarray:
        at = s[:n] + 1j * s[n:]
        return measured(network, layout, np.concatenate([np.angle(at), np.abs(at)]))

    model, on = RectangularModel(network, layout), np.ones(len(layout), dtype=bool)
    H, target, spread = model.rows(read(state), sigma, on, voltage, "derivative")
    np.testing.assert_allclose(H @ state, target, atol=1e-9)
    scale = np.where(layout.quantity == Q, -1.0, 1.0) * spread / sigma
    rows = scale[:, None] * central_differences(read, state)
    np.testing.assert_allclose(H.toarray(), rows, rtol=1e-5, atol=1e-5)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_powers_and_magnitudes_do_not_see_a_common_rotation(seed: int) -> None:
    network = library.load("ieee14")
    bus, branch = np.arange(network.n_bus), np.arange(network.n_branch)
    layout = SensorLayout.of(
        network,
        (VM, bus, BUS), (P, bus, BUS), (Q, bus, BUS),
        (P, branch, FROM), (Q, branch, FROM), (P, branch, TO), (Q, branch, TO),
    )  # fmt: skip
    x = random_state(network, np.random.default_rng(seed))
    voltage = x[14:] * np.exp(1j * x[:14])
    z, on = np.zeros(len(layout)), np.ones(len(layout), dtype=bool)
    rotation = np.concatenate([-voltage.imag, voltage.real])
    model, sigma = RectangularModel(network, layout), np.full(len(z), 0.01)
    H = model.rows(z, sigma, on, voltage, "derivative")[0]
    assert np.abs(H @ rotation).max() < 1e-12 * np.abs(H).max()
    # The information H'R⁻¹H of every other direction is left.
    value = np.linalg.eigvalsh((H.T @ H).toarray())
    assert np.count_nonzero(value < 1e-12 * value[-1]) == 1
    seen = model.rows(z, sigma, on, voltage, "transform")[0] @ rotation
    assert np.abs(seen).max() > 0.01


# --- units ----------------------------------------------------------------------------------------

UNIT_ROWS = [
    ("vm_pu", "bus/6", "", "pu", 1.0),
    ("vm_pu", "bus/6", "", "kv", 1 / 12.66),
    ("va_degree", "bus/6", "", "degree", np.pi / 180),
    ("va_degree", "bus/6", "", "rad", 1.0),
    ("p_mw", "bus/6", "", "mw", 1 / 37),
    ("p_mw", "branch/6-7", "to", "kw", 1e-3 / 37),
    ("q_mvar", "branch/6-7", "from", "mvar", 1 / 37),
    ("q_mvar", "bus/6", "", "kvar", 1e-3 / 37),
    ("p_mw", "bus/6", "", "pu", 1.0),
    ("i_ka", "branch/6-7", "to", "ka", np.sqrt(3) * 12.66 / 37),
    ("i_ka", "bus/6", "", "a", 1e-3 * np.sqrt(3) * 12.66 / 37),
    ("ia_degree", "branch/6-7", "from", "degree", np.pi / 180),
]


def units_layout(sign: int = 1) -> SensorLayout:
    rows = [
        {"channel": str(i), "quantity": q, "element": e, "side": s, "unit": u, "sigma": 0.5,
         "sign": sign}
        for i, (q, e, s, u, _) in enumerate(UNIT_ROWS)
    ]  # fmt: skip
    network = dataclasses.replace(library.load("ieee33"), base_mva=37.0)
    return SensorLayout.from_channels(channels_table(network, rows), network)


def test_every_unit_has_its_factor() -> None:
    layout = units_layout()
    expected = np.array([row[-1] for row in UNIT_ROWS])
    np.testing.assert_allclose(layout.to_per_unit(np.ones(len(expected))), expected)
    np.testing.assert_allclose(layout.sigma, 0.5 * expected)


def test_sign_turns_values_and_leaves_sigma() -> None:
    turned = units_layout(sign=-1)
    values = np.linspace(1, 2, len(turned))
    np.testing.assert_allclose(turned.to_per_unit(values), -units_layout().to_per_unit(values))
    np.testing.assert_allclose(turned.from_per_unit(turned.to_per_unit(values)), values)
    assert (turned.sigma > 0).all()


def test_relative_sigma_follows_the_value_down_to_its_floor() -> None:
    sigma = standard_deviation([-2.0, 1e-9, 3.0], [0.01, 0.01, 0.7], [True, True, False])
    assert sigma == pytest.approx([0.02, 0.01 * RELATIVE_FLOOR_PU, 0.7])


def test_mean_channels_have_their_period_as_window() -> None:
    network = library.load("ieee33")
    rows = [
        {"quantity": "p_mw", "element": "bus/2", "unit": "mw", "sigma": 0.1, "period_s": 900.0,
         "aggregation": kind, "source": source}
        for kind, source in (("mean", "ami"), ("instant", "scada"))
    ]  # fmt: skip
    layout = SensorLayout.from_channels(channels_table(network, rows), network)
    assert layout.window_s.tolist() == [900.0, 0.0]


@pytest.mark.parametrize(
    ("row", "error", "expected"),
    [
        ({"unit": "mw"}, TableError, "unit 'mw' of .* does not fit vm_pu: expected pu or kv"),
        ({"element": "bus/34"}, GridError, "ieee33 has no bus '34': did you mean"),
        ({"side": "from"}, TableError, "'bus/3' at side 'from': expected '' for a bus"),
        ({"element": "branch/2-3"}, TableError, "at side '': .*'from' or 'to' for a branch"),
        ({"element": "branch/2-3", "side": "to"}, TableError, "voltages belong to buses"),
        ({"element": "branch/2-33", "side": "to", "quantity": "p_mw", "unit": "mw"}, GridError,
         "no branch '2-33'"),
    ],
)  # fmt: skip
def test_channel_that_cannot_be_is_refused(
    row: dict[str, str], error: type[Exception], expected: str
) -> None:
    network = library.load("ieee33")
    usual = {"quantity": "vm_pu", "element": "bus/3", "unit": "pu", "sigma": 0.01}
    with pytest.raises(error, match=expected):
        SensorLayout.from_channels(channels_table(network, [{**usual, **row}]), network)
