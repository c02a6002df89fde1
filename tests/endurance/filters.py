"""Filters that run for long through every trouble: ``python -m tests.endurance filters``.

What is measured, for every method, is what users see: the tables of
`pse_analysis.estimation.core.run`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tests.endurance.filter_troubles import TROUBLES, Scene, World, world

from pse_analysis.estimation import Method
from pse_analysis.estimation.core.interface import Estimator, Info, Snapshot
from pse_analysis.estimation.core.run import run
from pse_analysis.vocabulary import Status

SEED = 10
WRONG = 8.0
"""Error, in units of its σ, of a state that is wrong."""
RESOLUTION = 1e-6
"""Error that is none. [p.u., rad]

Beside meters of σ = 1e-9, what an expansion about voltages known to 5e-4 leaves out is larger than
σ, and of no use to anybody.
"""
SETTLED = 20
"""Instants with data after a trouble within which a filter is back."""
LOOKED_AT = 5
"""One in so many states has the eigenvalues of its P looked at."""

_scalar: dict[str, Any] = {"noise": "scalar", "variance": 1e-5}
METHODS: dict[str, dict[str, Any]] = {
    "kalman": {"filter": "kalman"},
    "kalman scalar": {"filter": "kalman", **_scalar},
    "kalman innovation": {"filter": "kalman", "noise": "innovation"},
    "kalman screened": {"filter": "kalman", "screening": "innovation"},
    "kalman scalar screened": {"filter": "kalman", "screening": "innovation", **_scalar},
    "kalman innovation screened": {
        "filter": "kalman",
        "noise": "innovation",
        "screening": "innovation",
    },
    "kalman instant": {"filter": "kalman", "reading": "instant"},
    "kalman trend": {"filter": "kalman", "compose": {"process": "local_trend"}},
    "kalman holt": {"filter": "kalman", "compose": {"process": "holt"}},
    "ukf": {"filter": "ukf"},
    "ukf screened": {"filter": "ukf", "screening": "innovation"},
    "ukf root": {"filter": "ukf", "compose": {"form": "square_root"}},
    "ukf root, channel": {
        "filter": "ukf",
        "compose": {"form": "square_root", "robustness": "per_channel"},
    },
    "ukf trace": {"filter": "ukf", "compose": {"robustness": "trace"}},
    "ukf channel": {"filter": "ukf", "compose": {"robustness": "per_channel"}},
    "ukf learning": {"filter": "ukf", "compose": {"learning": "sage_husa"}},
    "ukf trend": {"filter": "ukf", "compose": {"process": "local_trend"}},
    "ukf moments": {"filter": "ukf", "compose": {"scaling": "moments"}},
    "ukf holt": {"filter": "ukf", "compose": {"process": "holt"}},
    "ekf": {"filter": "ekf"},
    "ekf scalar": {"filter": "ekf", **_scalar},
    "ekf iterated": {"filter": "ekf", "compose": {"passes": 5}},
    "ekf trace": {"filter": "ekf", "compose": {"robustness": "trace"}},
    "ekf channel": {"filter": "ekf", "compose": {"robustness": "per_channel"}},
    "ekf learning": {"filter": "ekf", "compose": {"learning": "sage_husa"}},
    "ekf trend, channel": {
        "filter": "ekf",
        "compose": {"process": "local_trend", "robustness": "per_channel"},
    },
}


def optimistic(method: Mapping[str, Any]) -> bool:
    """Whether a method has the covariance of its paper, which is known to be too small.

    Holt's smoothing there takes earlier estimates for certain; `local_trend` does not.
    """
    return bool(method.get("compose", {}).get("process") == "holt")


@dataclass
class Tally:
    """What a filter did over a number of instants.

    Attributes
    ----------
    least : float
        Smallest eigenvalue of the correlation that belongs to P.
    deceived : list of str
        Trouble, and instants since, of the steps that were "ok" and wrong by more than `WRONG` σ.
    longest : int
        Most instants with good data in a row, after a trouble, at which a state was wrong.
    missing : int
        Instants without an estimate.
    ok, inside, believed : int
        Steps that were "ok", their states within 3 σ, and all of their states.
    quiet, not_ok, restarted : int
        Instants long after any trouble, those of them that were not "ok", and false restarts.
    error : float
        Largest error of a state at a quiet instant. [p.u., rad]
    seconds, kept_bytes : list
        Time of a step and memory of the process, scene by scene.
    """

    steps: int = 0
    least: float = np.inf
    deceived: list[str] = field(default_factory=list)
    longest: int = 0
    missing: int = 0
    ok: int = 0
    inside: int = 0
    believed: int = 0
    quiet: int = 0
    not_ok: int = 0
    restarted: int = 0
    error: float = 0.0
    seconds: list[float] = field(default_factory=list)
    kept_bytes: list[int] = field(default_factory=list)


class Kept:
    """An estimator whose state outlives a run, so that long runs need not keep their tables."""

    def __init__(self, made: Estimator) -> None:
        self.made, self.state = made, None
        self.estimator = made._replace(init=self._init, step=self._step)

    def _init(self, snapshot: Snapshot) -> tuple[Any, Info]:
        if self.state is None:
            return self._noted(self.made.init(snapshot))
        return self._step(self.state, snapshot)

    def _step(self, state: Any, snapshot: Snapshot) -> tuple[Any, Info]:
        return self._noted(self.made.step(state, snapshot))

    def _noted(self, done: tuple[Any, Info]) -> tuple[Any, Info]:
        self.state = done[0]
        return done


def resident_bytes() -> int:
    """Memory of this process; 0 where the system does not tell."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[1]) * 4096 if told.exists() else 0


def least_of_correlation(P: np.ndarray) -> float:
    """Smallest eigenvalue of a covariance that is scaled to unit variances."""
    variance = np.diagonal(P)
    if (variance < 0).any() or not np.isfinite(P).all():
        return -np.inf
    moves = variance > 0
    size = np.sqrt(variance[moves])
    return float(np.linalg.eigvalsh(P[np.ix_(moves, moves)] / np.outer(size, size))[0])


def follow(kept: Kept, place: World, scene: Scene, tally: Tally, first: int = 0) -> None:
    """Run a filter over a scene, and add up what it did."""
    n = place.network.n_bus

    def watch(k: int, state: Any, _info: Info) -> None:
        if state is not None and k % LOOKED_AT == 0:
            tally.least = min(tally.least, least_of_correlation(state.inner.P))

    done = run(kept.estimator, scene.snapshots(first), place.network, place.layout, watch=[watch])
    value, sigma = (
        done.estimated[column].to_numpy().reshape(-1, 2 * n).copy() for column in ("value", "sigma")
    )
    value[:, :n], sigma[:, :n] = np.deg2rad(value[:, :n]), np.deg2rad(sigma[:, :n])
    error = value - scene.truth
    error[:, :n] = (error[:, :n] + np.pi) % (2.0 * np.pi) - np.pi
    ratio = np.abs(error) / np.maximum(sigma, RESOLUTION / WRONG)
    status = done.steps["status"].to_numpy()
    wrong, ok = ~(ratio <= WRONG).all(axis=1), status == Status.OK
    for k in np.flatnonzero(wrong & ok):
        tally.deceived.append(f"{scene.trouble[k]} +{scene.since[k]}")
    count = 0
    for lost, since, told in zip(wrong, scene.since, scene.on.any(axis=1), strict=True):
        count = count + int(told) if lost and since > 0 else 0
        tally.longest = max(tally.longest, count)
    quiet = scene.since > SETTLED
    tally.steps += len(status)
    tally.missing += int((~np.isfinite(value)).any(axis=1).sum())
    tally.ok += int(ok.sum())
    tally.inside += int((ratio[ok] <= 3.0).sum())
    tally.believed += ratio[ok].size
    tally.quiet += int(quiet.sum())
    tally.not_ok += int((quiet & ~ok).sum())
    tally.restarted += int((quiet & (status == Status.RESTARTED)).sum())
    tally.error = max(tally.error, float(np.abs(error[quiet]).max(initial=0.0)))
    tally.seconds.append(float(done.steps["seconds"].median()))


def made(name: str, place: World) -> Kept:
    """Filter of a case file's method, with noise learnt from what a place has seen."""
    return Kept(Method.of(name, **METHODS[name]).estimator(place.setting))


def main(count: int, seed: int) -> int:
    """Run every filter for a number of instants; 1 if any is deceived, indefinite or lost."""
    code = 0
    for number, name in enumerate(METHODS):
        place = world("ieee14", ("phasors", "plain")[number % 2], seed + number)
        kept, tally, begun = made(name, place), Tally(), time.monotonic()
        while tally.steps < count:
            kinds = tuple(place.rng.permutation(list(TROUBLES)))
            follow(kept, place, place.scene(kinds), tally, tally.steps)
            tally.kept_bytes.append(resident_bytes())
        own = not optimistic(METHODS[name])
        bad = tally.least < -1e-9 or tally.missing > 0 or (own and tally.longest > SETTLED)
        bad = bad or (own and bool(tally.deceived))
        code = max(code, int(bad))
        print(
            f"{'FAIL' if bad else 'pass'} {name:27s} {tally.steps} steps, least {tally.least:.1e}, "
            f"deceived {len(tally.deceived)}, wrong for {tally.longest}, missing {tally.missing}, "
            f"inside 3σ {tally.inside / max(tally.believed, 1):.3f}, quiet but not ok "
            f"{tally.not_ok / max(tally.quiet, 1):.3f}, false restarts "
            f"{1e3 * tally.restarted / max(tally.quiet, 1):.2f} ‰, "
            f"{1e3 * tally.seconds[0]:.2f} … {1e3 * tally.seconds[-1]:.2f} ms, "
            f"{tally.kept_bytes[0] / 1e6:.0f} … {tally.kept_bytes[-1] / 1e6:.0f} MB, "
            f"{time.monotonic() - begun:.0f} s",
            flush=True,
        )
        if tally.deceived:
            print("     ok but wrong:", ", ".join(tally.deceived[:12]), flush=True)
    return code
