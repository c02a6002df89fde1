"""One seed to one raw case: truth, samples and faults of every trial as tables."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd

from pse_analysis.grid.network import Network
from pse_analysis.parameters import Study
from pse_analysis.simulation import faults, scenario, sensors
from pse_analysis.simulation.scenario import SECOND, Truth, microseconds
from pse_analysis.simulation.sensors import Samples
from pse_analysis.simulation.settings import SimulateParams, require_few
from pse_analysis.telemetry import RawCase
from pse_analysis.vocabulary import FaultKind, Quantity


def simulate(
    network: Network, profiles: pd.DataFrame, study: Study, params: SimulateParams
) -> RawCase:
    """Simulate the telemetry of a case.

    Parameters
    ----------
    network
        The grid.
    profiles
        Curves of load and PV, from `pse_analysis.simulation.profiles.load`.
    study
        Telemetry begins ``history_s`` before its start and ends with it.
    params
        What the case file says in ``[simulate]``.

    Returns
    -------
    RawCase
        Truth is given at the study's instants; telemetry, sample_truth and faults from the start
        of the history on.

    Raises
    ------
    ParameterError
        If times do not fit each other, or a name is unknown.
    GridError
        If an element is not in the grid.
    NotConverged
        If a state has no power flow.
    """
    span = (study.end - study.history_start).total_seconds()
    require_few(network.n_bus * span / params.truth_step_s, "true states of buses")
    time = scenario.truth_times(study, params.truth_step_s)
    groups = sensors.channels(network, params.sensors)
    channels = pd.concat(groups, ignore_index=True)
    read = sum(len(g) * span / p.period_s for g, p in zip(groups, params.sensors, strict=True))
    require_few(params.trials * read, "samples")
    first_channel = np.cumsum([0, *(len(g) for g in groups)])
    case_seed, *trial_seeds = np.random.SeedSequence(params.seed).spawn(1 + params.trials)
    start, end = (pd.Timestamp(int(t), unit="us", tz="UTC") for t in (time[0], time[-1]))
    mix = scenario.mix_loads(
        network, profiles, start, end, params.load, np.random.default_rng(case_seed)
    )
    by_arrival = np.concatenate(
        [np.full(len(g), p.stamp == "arrival") for g, p in zip(groups, params.sensors, strict=True)]
    )
    parts: list[tuple[pd.DataFrame, ...]] = []
    for trial, seed in enumerate(trial_seeds):
        truth_seed, noise_seed, fault_seed = seed.spawn(3)
        truth = scenario.draw_truth(network, profiles, mix, time, params, truth_seed)
        observed = [
            sensors.observe(network, truth, group, table, int(first), np.random.default_rng(child))
            for group, table, first, child in zip(
                params.sensors,
                groups,
                first_channel[:-1],
                noise_seed.spawn(len(groups)),
                strict=True,
            )
        ]
        samples = Samples(
            **{
                f.name: np.concatenate([getattr(s, f.name) for s in observed])
                for f in dataclasses.fields(Samples)
            }
        )
        samples = faults.inject(samples, channels, params.faults, fault_seed)
        parts.append(
            (
                _truth_table(network, truth, study, trial),
                *sample_tables(samples, channels, by_arrival, trial),
            )
        )
    truth_table, telemetry, sample_truth, fault_table = (
        pd.concat(part, ignore_index=True) for part in zip(*parts, strict=True)
    )
    return RawCase(network, channels, telemetry, truth_table, sample_truth, fault_table)


def utc(microsecond: np.ndarray[tuple[int], np.dtype[np.int64]]) -> pd.DatetimeIndex:
    """Times from microseconds since 1970 UTC."""
    return pd.DatetimeIndex(microsecond.astype("datetime64[us]")).tz_localize("UTC")


def _truth_table(network: Network, truth: Truth, study: Study, trial: int) -> pd.DataFrame:
    step = int(truth.time[1] - truth.time[0])
    first = (microseconds(study.start) - int(truth.time[0])) // step
    at = np.arange(first, len(truth.time) - 1, round(study.step_s * SECOND) // step)
    n = network.n_bus
    blocks = {
        Quantity.VM_PU: truth.x[n:, at],
        Quantity.VA_DEGREE: np.degrees(truth.x[:n, at]),
        Quantity.P_MW: truth.p_pu[:, at] * network.base_mva,
        Quantity.Q_MVAR: truth.q_pu[:, at] * network.base_mva,
    }
    values = np.stack(list(blocks.values()))  # quantity, bus, instant
    names = np.array([f"bus/{b}" for b in network.buses.name], dtype=object)
    quantities = np.array([str(q) for q in blocks], dtype=object)
    return pd.DataFrame(
        {
            "trial": np.full(values.size, trial, dtype=np.int32),
            "time_utc": utc(np.repeat(truth.time[at], n * len(quantities))),
            "element": np.tile(np.repeat(names, len(quantities)), len(at)),
            "quantity": np.tile(quantities, n * len(at)),
            "value": values.transpose(2, 1, 0).ravel(),
        }
    )


def sample_tables(
    samples: Samples,
    channels: pd.DataFrame,
    by_arrival: np.ndarray[tuple[int], np.dtype[np.bool_]],
    trial: int,
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Telemetry, sample_truth and faults; ``seq`` counts what arrives, without gaps."""
    stamp = np.where(by_arrival[samples.channel], samples.arrival, samples.sampled)
    lost = samples.kind == faults.code(FaultKind.LOST)
    order = np.lexsort((samples.sampled, samples.arrival, samples.channel, lost))
    arrived = order[: len(order) - int(lost.sum())]
    channel = samples.channel[arrived]
    start = np.flatnonzero(np.r_[True, channel[1:] != channel[:-1]])
    seq = np.arange(len(arrived)) - np.repeat(start, np.diff(np.r_[start, len(arrived)]))
    names = channels["channel"].to_numpy(dtype=object)
    key = {
        "trial": np.full(len(arrived), trial, dtype=np.int32),
        "channel": names[channel],
        "seq": seq.astype(np.int64),
    }
    telemetry = pd.DataFrame(
        {
            **key,
            "time_utc": utc(stamp[arrived]),
            "arrival_utc": utc(samples.arrival[arrived]),
            "value": samples.value[arrived],
            "quality": pd.array(np.full(len(arrived), None), dtype="Int16"),
        }
    )
    sample_truth = pd.DataFrame(
        {**key, "time_utc": utc(samples.sampled[arrived]), "value": samples.truth[arrived]}
    )
    number = np.full(len(samples.kind), -1, dtype=np.int64)
    number[arrived] = seq
    faulty = np.flatnonzero(samples.kind)
    faulty = faulty[np.lexsort((samples.sampled[faulty], samples.channel[faulty]))]
    kinds = np.array([str(k) for k in faults.KINDS], dtype=object)
    fault_table = pd.DataFrame(
        {
            "trial": np.full(len(faulty), trial, dtype=np.int32),
            "channel": names[samples.channel[faulty]],
            "seq": pd.array(np.where(number[faulty] < 0, 0, number[faulty]), dtype="Int64"),
            "time_utc": utc(stamp[faulty]),
            "kind": kinds[samples.kind[faulty] - 1],
            "size": samples.size[faulty],
        }
    )
    fault_table.loc[lost[faulty], "seq"] = pd.NA
    return telemetry, sample_truth, fault_table
