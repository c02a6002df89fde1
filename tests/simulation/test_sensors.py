"""Claim: a sample is h of the truth at its time, plus noise of the stated σ, and arrives late."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated_case import PARAMS, SENSORS, STUDY, case, curves, feeder, make

from pse_analysis.errors import GridError, ParameterError
from pse_analysis.measurement import (
    FROM,
    RELATIVE_FLOOR_PU,
    MeasurementModel,
    P,
    SensorLayout,
    wrap,
)
from pse_analysis.simulation import scenario, sensors, simulate
from pse_analysis.simulation.scenario import Truth
from pse_analysis.simulation.settings import SensorParams, SimulateParams

SEED = 5
CLEAN = dataclasses.replace(PARAMS, faults=())


@pytest.fixture(scope="module")
def truth() -> Truth:
    """A ramp of states: every quantity changes, and none is linear in another."""
    network = feeder()
    time = scenario.truth_times(STUDY, 60.0)
    rng = np.random.default_rng(SEED)
    share = np.linspace(0, 1, len(time))
    ends = np.concatenate(
        [rng.normal(0, 0.05, (network.n_bus, 2)), rng.normal(1, 0.03, (network.n_bus, 2))]
    )
    x = ends[:, :1] * (1 - share) + ends[:, 1:] * share
    return Truth(
        time, x, np.zeros((network.n_bus, len(time))), np.zeros((network.n_bus, len(time)))
    )


def read(truth: Truth, group: SensorParams) -> tuple[sensors.Samples, SensorLayout]:
    (table,) = sensors.channels(feeder(), (group,))
    layout = SensorLayout.from_channels(table, feeder())
    samples = sensors.observe(feeder(), truth, group, table, 0, np.random.default_rng(SEED))
    return samples, layout


def test_an_instant_is_h_at_its_time_and_a_mean_averages_h_over_the_period(truth: Truth):
    place = ("branch/7-8", "branch/24-25")
    instant, layout = read(truth, SensorParams("scada", ("p_mw",), place, 0.01, 300.0))
    exact = MeasurementModel(feeder(), layout).h(truth.x) * feeder().base_mva
    np.testing.assert_allclose(instant.truth.reshape(2, -1), exact[:, :-1:5], rtol=1e-12)
    mean, _ = read(truth, SensorParams("ami", ("p_mw",), place, 0.01, 300.0, aggregation="mean"))
    by_hand = exact[:, 1:236].reshape(2, -1, 5).mean(axis=2)
    np.testing.assert_allclose(mean.truth.reshape(2, -1), by_hand, rtol=1e-12)
    np.testing.assert_array_equal(mean.sampled.reshape(2, -1)[0], truth.time[5:-1:5])


def test_a_sample_between_two_instants_is_interpolated(truth: Truth):
    group = SensorParams("pmu", ("vm_pu", "va_degree"), ("bus/6",), 0.01, 60.0, phase_s=15.0)
    samples, _ = read(truth, group)
    i = feeder().bus("6")
    vm = truth.x[feeder().n_bus + i]
    np.testing.assert_allclose(
        samples.truth.reshape(2, -1)[0], 0.75 * vm[:-1] + 0.25 * vm[1:], rtol=1e-12
    )


@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_noise_has_the_stated_sigma(kind: str):
    group = SensorParams("scada", ("p_mw",), ("branch/7-8", "bus/1"), 0.02, 1.0, sigma_kind=kind)
    network = feeder()
    time = np.arange(0, 20_000_000_001, 1_000_000, dtype=np.int64)
    x = np.zeros((2 * network.n_bus, len(time)))
    x[network.n_bus :] = np.linspace(1.0, 0.95, network.n_bus)[:, None]
    still = Truth(time, x, x[: network.n_bus], x[: network.n_bus])
    samples, _ = read(still, group)
    error = (samples.value - samples.truth).reshape(2, -1)
    magnitude = np.abs(samples.truth.reshape(2, -1)[:, 0])
    expected = 0.02 * magnitude if kind == "relative" else np.full(2, 0.02)
    np.testing.assert_allclose(error.std(axis=1), expected, rtol=0.03)
    np.testing.assert_allclose(samples.sigma.reshape(2, -1)[:, 0], expected, rtol=1e-9)
    assert np.abs(error.mean(axis=1) / expected).max() < 4 / np.sqrt(20_000)


def test_relative_noise_does_not_vanish_with_the_value(truth: Truth):
    flat = dataclasses.replace(truth, x=np.vstack([0 * truth.x[:33], 1 + 0 * truth.x[33:]]))
    samples, _ = read(
        flat, SensorParams("scada", ("p_mw",), ("branch/7-8",), 0.02, 60.0, sigma_kind="relative")
    )
    floor = 0.02 * RELATIVE_FLOOR_PU * feeder().base_mva
    np.testing.assert_allclose(samples.sigma, floor, rtol=1e-9)
    assert samples.value.std() > 0


def test_angles_stay_folded_and_are_not_averaged_across_the_fold(truth: Truth):
    # The current's angle lies at ±180° when power flows backwards through the branch.
    group = SensorParams(
        "pmu", ("ia_degree",), ("branch/7-8",), 1.0, 300.0, aggregation="mean", side="to"
    )
    network = feeder()
    rng = np.random.default_rng(SEED)
    theta = np.tile(-0.001 * np.arange(network.n_bus)[:, None], len(truth.time))
    theta += 1e-5 * rng.standard_normal(theta.shape)
    x = np.concatenate([theta, np.tile(1 - 0.001 * np.arange(33)[:, None], len(truth.time))])
    (table,) = sensors.channels(network, (group,))
    layout = SensorLayout.from_channels(table, network)
    raw = MeasurementModel(network, layout).h(x)[0]
    middle = np.angle(np.exp(1j * raw).mean())
    x[: network.n_bus] += np.pi - middle
    samples, _ = read(dataclasses.replace(truth, x=x), group)
    assert np.abs(samples.value).max() <= 180.0
    distance = np.degrees(wrap(np.radians(samples.truth) - np.pi))
    assert np.abs(distance).max() < 5.0


def test_the_sign_turns_the_value_and_nothing_else(truth: Truth):
    group = SensorParams("ami", ("p_mw",), ("bus/6",), 0.01, 60.0)
    plain, _ = read(truth, group)
    turned, layout = read(truth, dataclasses.replace(group, sign=-1))
    np.testing.assert_allclose(turned.truth, -plain.truth)
    np.testing.assert_allclose(
        layout.to_per_unit(turned.value[None]) * feeder().base_mva, plain.value[None], atol=1e-12
    )
    assert (turned.sigma > 0).all()


def test_samples_arrive_within_the_stated_delay_and_one_device_sends_together():
    scada = case().telemetry[case().telemetry.channel.str.startswith("scada:branch/7-8")]
    faults = case().faults
    faulty = faults[faults.kind.isin(["delayed", "duplicated"])]
    key = ["trial", "channel", "seq"]
    clean = scada.merge(faulty[key].dropna().astype({"seq": "int64"}), how="left", on=key,
                        indicator=True)  # fmt: skip
    clean = clean[clean._merge == "left_only"]
    delay = (clean.arrival_utc - clean.time_utc).dt.total_seconds()
    assert delay.min() >= 2.0
    assert delay.max() <= 10.0
    assert clean.groupby(["trial", "time_utc"]).arrival_utc.nunique().max() == 1


def wandering() -> SensorParams:
    return SensorParams(
        "scada", ("p_mw", "q_mvar"), ("branch/7-8", "branch/24-25"), 0.01, 60.0,
        delay_s=30.0, jitter_s=20.0, wander_s=200.0, wander_time_s=1800.0,
    )  # fmt: skip


def test_a_wandering_delay_drifts_by_element_and_leaves_samples_in_order():
    minutes = 40_000
    time = np.arange(0, (minutes + 1) * 60_000_000, 60_000_000, dtype=np.int64)
    x = np.broadcast_to(
        np.concatenate([np.zeros(33), np.linspace(1.0, 0.95, 33)])[:, None], (66, len(time))
    )
    samples, _ = read(Truth(time, x, x[:33], x[:33]), wandering())
    late = ((samples.arrival - samples.sampled) / 1e6).reshape(4, -1)
    np.testing.assert_array_equal(late[0], late[1])
    np.testing.assert_array_equal(late[2], late[3])
    assert (np.diff(samples.arrival.reshape(4, -1), axis=1) > 0).all()
    assert late.min() >= 30.0
    assert late.max() <= 250.0
    # U(0, 200) of the drift and U(0, 20) of the jitter; some 500 independent values each.
    drift = late - late.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(late.mean(axis=1), 140.0, atol=12.0)
    np.testing.assert_allclose(drift.std(axis=1), np.hypot(200.0, 20.0) / np.sqrt(12.0), rtol=0.08)
    assert abs(np.corrcoef(late[0], late[2])[0, 1]) < 0.2
    lag = 15
    fraction = 2.0 * lag * 60.0 / 1800.0
    found = np.corrcoef(late[::2, lag:].ravel(), late[::2, :-lag].ravel())[0, 1]
    assert found == pytest.approx((1 + fraction) * np.exp(-fraction), abs=0.08)


def test_a_source_without_a_clock_is_stamped_at_arrival():
    group = dataclasses.replace(SENSORS[1], stamp="arrival")
    raw = make(CLEAN, sensors=(group,), trials=1)
    assert (raw.telemetry.time_utc == raw.telemetry.arrival_utc).all()
    delay = (raw.telemetry.time_utc - raw.sample_truth.time_utc).dt.total_seconds()
    assert delay.between(2, 10).all()


def test_nominal_limits_are_a_multiple_of_the_apparent_power():
    channels = case().channels.set_index("channel")
    p, q = (channels.loc[f"scada:branch/7-8:from:{k}"] for k in ("p_mw", "q_mvar"))
    assert p.upper == pytest.approx(q.upper)
    assert p.lower == -p.upper
    layout = SensorLayout.of(feeder(), (P, np.array([feeder().branch("7-8")]), FROM))
    from pse_analysis.grid import power_flow

    flow = MeasurementModel(feeder(), layout).h(power_flow.solve(feeder()).x)[0] * 10
    assert p.upper > 3 * flow
    ami = channels.loc["ami:bus/6:p_mw"]
    assert np.isnan(ami.upper)


def test_groups_name_the_elements_of_the_grid():
    assert len(sensors.elements(feeder(), ("loads",))) == 32
    assert len(sensors.elements(feeder(), ("buses", "bus/6"))) == 33
    assert len(sensors.elements(feeder(), ("branches",))) == 32


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"at": ("bus/330",)}, GridError, "has no bus '330'"),
        ({"at": ("6",)}, ParameterError, "expected 'bus/NAME'"),
        ({"period_s": 90.0, "aggregation": "mean"}, ParameterError, "multiples of truth_step_s"),
        ({"phase_s": 1e6}, ParameterError, "no sample before the study's end"),
    ],
)
def test_sensors_that_cannot_be_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        make(CLEAN, sensors=(dataclasses.replace(SENSORS[2], **change),))


def test_a_channel_given_twice_is_refused():
    with pytest.raises(ParameterError, match=r"'pmu:bus/2:vm_pu' is given twice"):
        simulate(feeder(), curves(), STUDY, SimulateParams(seed=1, sensors=(SENSORS[0],) * 2))


@pytest.mark.parametrize("change", [{"jitter_s": 45.0}, {"wander_time_s": 600.0}])
def test_delays_by_which_samples_would_overtake_each_other_are_refused(change):
    with pytest.raises(ParameterError, match="samples overtake each other"):
        dataclasses.replace(wandering(), **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wander_time_s": 0.0}, "wander_time_s > 0"),
        ({"sigma": 0.0}, "sigma > 0, received 0.0"),
        ({"source": "radar"}, "source in scada, pmu, ami"),
        ({"quantities": ("vm",)}, "quantities in vm_pu"),
        ({"period_s": 0.0}, "period_s > 0"),
    ],
)
def test_parameters_out_of_range_are_refused(change, message):
    with pytest.raises(ParameterError, match=message):
        dataclasses.replace(SENSORS[0], **change)
