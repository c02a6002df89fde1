"""A made-up study whose tables obey the schemas, for tests of what reads tables.

No physics: voltages fall with the distance from the source and breathe with a daily curve.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pandas as pd

from pse_analysis.grid import library
from pse_analysis.grid.network import Network
from pse_analysis.vocabulary import Reason, check, severity

SEED = 20160609
START = pd.Timestamp("2016-06-09T00:00:00Z")
METHODS = {"wls": 1.6e-3, "kf_scalar": 1.0e-3, "kf_load": 4.0e-4}
VM_BUSES = ("1", "6", "18", "25", "33")


@dataclass(frozen=True)
class StudyTables:
    """One study: everything that the stages would have produced."""

    study: SimpleNamespace
    network: Network
    channels: pd.DataFrame
    validated: pd.DataFrame
    aligned: pd.DataFrame
    estimated: pd.DataFrame
    residuals: pd.DataFrame
    steps: pd.DataFrame
    scored: pd.DataFrame
    truth: pd.DataFrame
    sample_truth: pd.DataFrame
    faults: pd.DataFrame


def study_tables(n_instant: int = 288, n_trial: int = 2) -> StudyTables:
    """Tables of a day on the 33-bus feeder, with three methods."""
    rng = np.random.default_rng(SEED)
    network = library.load("ieee33")
    step = pd.Timedelta(minutes=5)
    instants = pd.date_range(START, periods=n_instant, freq=step, unit="us")
    study = SimpleNamespace(
        start=START.to_pydatetime(),
        end=(START + n_instant * step).to_pydatetime(),
        step_s=300.0,
        history_s=10 * 300.0,
    )
    curve = 0.7 - 0.3 * np.cos(2 * np.pi * np.arange(n_instant) / 288 - 0.8)
    depth = np.minimum(np.arange(network.n_bus), 17) / 17
    vm = 1.0 - 0.09 * np.outer(curve, depth) + rng.normal(0, 6e-4, (n_trial, n_instant, 1)) * depth
    va = -2.0 * np.outer(curve, depth) + np.zeros((n_trial, 1, 1))
    elements = [f"bus/{name}" for name in network.buses.name]

    truth = pd.concat(
        [_long(vm, instants, elements, "vm_pu"), _long(va, instants, elements, "va_degree")],
        ignore_index=True,
    )
    channels = _channels(network)
    history = pd.date_range(START - 10 * step, instants[-1], freq=step, unit="us")
    samples = _samples(channels, history, vm, network, rng)
    validated = check("validated", samples.drop(columns=["true"]))
    sample_truth = samples[["trial", "channel", "seq", "time_utc", "true"]]
    found = samples[(samples.reasons & int(Reason.LIMIT)) > 0]
    faults = found[["trial", "channel", "seq", "time_utc"]].assign(kind="spike", size=0.2)
    faults["seq"] = faults.seq.astype("Int64")

    keep = samples[(samples.flag < 2) & samples.time_utc.isin(instants)]
    aligned = pd.DataFrame(
        {
            "variant": "last",
            "trial": keep.trial.astype("int32"),
            "time_utc": keep.time_utc,
            "channel": keep.channel,
            "value_pu": keep.value,
            "sigma_pu": 0.004,
            "sigma_age_pu": 0.001,
            "origin": np.where(keep.seq % 3 == 0, "measured", "held"),
            "sample_utc": keep.time_utc,
            "time_confidence": 1.0,
            "age_s": 60.0 * (keep.seq % 3),
            "flag": keep.flag,
            "reasons": keep.reasons,
        }
    ).reset_index(drop=True)

    estimates, steps = [], []
    for method, sigma in METHODS.items():
        for quantity, true, scale in (("vm_pu", vm, 1.0), ("va_degree", va, 40.0)):
            error = rng.normal(0, sigma * scale, true.shape) * (0.3 + curve)[:, None]
            frame = _long(true + error, instants, elements, quantity)
            estimates.append(frame.assign(method=method, sigma=sigma * scale))
        dof = len(channels)
        steps.append(
            pd.DataFrame(
                {
                    "method": method,
                    "trial": np.repeat(np.arange(n_trial, dtype=np.int32), n_instant),
                    "time_utc": instants[np.tile(np.arange(n_instant), n_trial)],
                    "status": "ok",
                    "iterations": np.int32(3),
                    "nis": rng.chisquare(dof, n_trial * n_instant) * (1 + 200 * sigma),
                    "nees": rng.chisquare(65, n_trial * n_instant),
                    "dof": np.int32(dof),
                    "rejected": np.int32(0),
                    "seconds": 1e-3,
                    "detail": "",
                }
            )
        )
    residuals = pd.concat(
        [
            pd.DataFrame(
                {
                    "method": method,
                    "trial": aligned.trial,
                    "time_utc": aligned.time_utc,
                    "channel": aligned.channel,
                    "innovation": rng.normal(0, 0.004, len(aligned)),
                    "sigma_innovation": 0.004,
                    "inflation": 0.0,
                    "used": True,
                    "reasons": np.int32(0),
                }
            )
            for method in METHODS
        ],
        ignore_index=True,
    )
    return StudyTables(
        study=study,
        network=network,
        channels=check("channels", channels),
        validated=validated,
        aligned=check("aligned", aligned),
        estimated=check(
            "estimated",
            pd.concat(estimates, ignore_index=True).assign(relative=np.nan, sigma_relative=np.nan),
        ),
        residuals=check("residuals", residuals),
        steps=check("steps", pd.concat(steps, ignore_index=True)),
        scored=check("scored", _scored(network, n_trial, rng)),
        truth=check("truth", truth),
        sample_truth=check("sample_truth", sample_truth.rename(columns={"true": "value"})),
        faults=check("faults", faults),
    )


def _long(values, instants, elements, quantity) -> pd.DataFrame:
    n_trial, n_instant, n_bus = values.shape
    return pd.DataFrame(
        {
            "trial": np.repeat(np.arange(n_trial, dtype=np.int32), n_instant * n_bus),
            "time_utc": instants[np.tile(np.repeat(np.arange(n_instant), n_bus), n_trial)],
            "element": np.tile(elements, n_trial * n_instant),
            "quantity": quantity,
            "value": values.reshape(-1),
        }
    )


def _channels(network: Network) -> pd.DataFrame:
    metered = [("scada", "vm_pu", bus, 0.004) for bus in VM_BUSES]
    metered += [("ami", "p_mw", bus, 0.01) for bus in network.buses.name[1:]]
    frame = pd.DataFrame(metered, columns=["source", "quantity", "bus", "sigma"])
    return pd.DataFrame(
        {
            "channel": frame.source + ":bus/" + frame.bus + ":" + frame.quantity,
            "source": frame.source,
            "quantity": frame.quantity,
            "element": "bus/" + frame.bus,
            "side": "",
            "unit": np.where(frame.quantity == "vm_pu", "pu", "mw"),
            "sigma": frame.sigma,
            "sigma_kind": "absolute",
            "lower": np.nan,
            "upper": np.nan,
            "period_s": 300.0,
            "sign": np.int8(1),
            "aggregation": "instant",
        }
    )


def _samples(channels, times, vm, network, rng) -> pd.DataFrame:
    rows = []
    n_trial, n_instant, _ = vm.shape
    for trial in range(n_trial):
        for number, channel in enumerate(channels.itertuples()):
            at = np.maximum(np.arange(len(times)) - 10, 0)
            bus = network.bus(channel.element.removeprefix("bus/"))
            true = vm[trial, at, bus] if channel.quantity == "vm_pu" else -0.1 * (0.5 + at / 500)
            value = true + rng.normal(0, channel.sigma, len(times))
            reasons = np.zeros(len(times), dtype=np.int32)
            spikes = rng.choice(n_instant, 3, replace=False) + 10 if number % 2 == 0 else []
            value[spikes] += 0.2
            reasons[spikes] = int(Reason.LIMIT)
            reasons[30:42] |= int(Reason.STUCK) if number % 5 == 0 else 0
            if number == 3:
                value[25], reasons[25] = np.nan, int(Reason.NOT_FINITE)
            rows.append(
                pd.DataFrame(
                    {
                        "trial": np.int32(trial),
                        "channel": channel.channel,
                        "seq": np.arange(len(times), dtype=np.int64),
                        "time_utc": times,
                        "arrival_utc": (times + pd.Timedelta(seconds=5)).as_unit("us"),
                        "value": value,
                        "quality": pd.array([pd.NA] * len(times), dtype="Int16"),
                        "flag": severity(reasons),
                        "reasons": reasons,
                        "statistic": np.nan,
                        "threshold": np.nan,
                        "corrected": np.nan,
                        "true": true,
                    }
                )
            )
    return pd.concat(rows, ignore_index=True)


def _scored(network, n_trial, rng) -> pd.DataFrame:
    rows = []
    for trial in range(n_trial):
        for method, sigma in METHODS.items():
            row = [
                (name, "", value, unit)
                for name, value, unit in (
                    ("vm_error_mean", sigma, "pu"),
                    ("vm_error_max", 6 * sigma, "pu"),
                    ("va_error_mean", sigma / 2, "rad"),
                    ("va_error_max", 3 * sigma, "rad"),
                    ("nis_ratio", 1 + 200 * sigma, ""),
                    ("nees_ratio", 1.0, ""),
                    ("coverage_vm", 0.95, ""),
                    ("coverage_va", 0.94, ""),
                    ("seconds", 0.3, "s"),
                    ("steps_not_ok", 0.0, ""),
                )
            ]
            for name in network.buses.name:
                size = sigma * rng.uniform(0.5, 1.5)
                row.append(("vm_error_mean", f"bus/{name}", size, "pu"))
                row.append(("vm_error_max", f"bus/{name}", 4 * size, "pu"))
            for hour in range(24):
                share = rng.uniform(0.9, 0.99)
                row.append(("coverage_vm", f"hour/{hour:02d}", share, ""))
                row.append(("coverage_va", f"hour/{hour:02d}", share - 0.01, ""))
                row.append(("nis_ratio", f"hour/{hour:02d}", rng.uniform(0.9, 1.2), ""))
            rows += [(method, trial, *r) for r in row]
        for kind, element in (("", ""), ("spike", "spike"), ("stale", "stale")):
            share = 0.9 if kind != "stale" else 0.6
            rows += [
                ("validate", trial, "precision", element, 0.97, ""),
                ("validate", trial, "recall", element, share, ""),
                ("validate", trial, "found", element, 90.0, ""),
                ("validate", trial, "missed", element, 10.0, ""),
                ("validate", trial, "false_alarms", element, 3.0, ""),
            ]
    frame = pd.DataFrame(rows, columns=["method", "trial", "metric", "element", "value", "unit"])
    frame["trial"] = frame.trial.astype("int32")
    return frame.assign(published=np.nan, source="")
