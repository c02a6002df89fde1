"""Grids whose loads walk as filters believe, and meters with troubles drawn at random."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from pse_analysis.estimation import Record, Setting
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.process.load_noise import Sensitivity, at_least
from pse_analysis.grid import library
from pse_analysis.grid.elements import BusKind
from pse_analysis.grid.network import Network
from pse_analysis.grid.power_flow import solve
from pse_analysis.measurement import BUS, FROM, VA, VM, MeasurementModel, P, Q, SensorLayout
from pse_analysis.parameters import Study

STEP = np.timedelta64(60, "s")
START = np.datetime64("2016-06-09T00:00:00", "us")
STUDY = Study(datetime(2016, 6, 9, tzinfo=UTC), datetime(2016, 6, 10, tzinfo=UTC), step_s=60.0)
HISTORY = 600
"""Instants before the study, from which filters learn how loads move."""
MEMORY = 200.0
"""Instants after which loads have turned back to their mean by 1/e, so that no grid collapses."""
SHARE, SOURCE = 0.01, 5e-4
"""σ of a load's change per step as a share of nominal, and of that of held voltages. [p.u.]"""
QUIET = (12, 30)
"""Fewest and most instants without trouble before each."""
AFTER = 30
"""Instants without trouble after each."""


@dataclass(frozen=True, eq=False)
class Scene:
    """True states and what is reported of them, T instants.

    Attributes
    ----------
    truth : (T, 2N) ndarray
    z, sigma : (T, m) ndarray
    on : (T, m) ndarray of bool
    since : (T,) ndarray of int
        Instants since the last trouble ended, counted where anything reports; 0 inside one.
    trouble : (T,) ndarray of str
        The last trouble, "" before the first.
    """

    truth: np.ndarray
    z: np.ndarray
    sigma: np.ndarray
    on: np.ndarray
    since: np.ndarray
    trouble: np.ndarray

    def snapshots(self, first: int = 0) -> Iterator[Snapshot]:
        """One snapshot per instant, all samples of which are new."""
        m = self.z.shape[1]
        every, zero = np.ones(m, dtype=bool), np.zeros(m)
        for k in range(len(self.z)):
            z = np.where(self.on[k], self.z[k], 0.0)
            yield Snapshot(
                START + (first + k) * STEP, z, self.sigma[k], zero, self.on[k], every, zero
            )


class World:
    """A grid with meters, whose loads and held voltages walk.

    Parameters
    ----------
    network : Network
    layout : SensorLayout
    rng : Generator
    """

    def __init__(self, network: Network, layout: SensorLayout, rng: np.random.Generator) -> None:
        self.network, self.layout, self.rng = network, layout, rng
        self.model = MeasurementModel(network, layout)
        nominal = np.concatenate([network.p_nominal_pu, network.q_nominal_pu])
        held = network.buses.kind != BusKind.PQ
        self._mean = np.concatenate([nominal, network.buses.vm_set_pu])
        # What `load` and `innovation` noise suppose of loads whose share is all that is known.
        inputs = Sensitivity(network).inputs
        move = np.zeros(2 * network.n_bus)
        move[inputs] = SHARE * at_least(np.abs(nominal[inputs]))
        self._move = np.concatenate([move, np.where(held, SOURCE, 0.0)])
        self._away = np.zeros(len(self._mean))
        self.setting = Setting(network, layout, STUDY, self._history())

    def walk(self, steps: int) -> np.ndarray:
        """True states of the next instants. (T, 2N)"""
        keep, away = 1.0 - 1.0 / MEMORY, self._away
        path = np.empty((steps, len(away)))
        for k in range(steps):
            away = keep * away + self._move * self.rng.standard_normal(len(away))
            path[k] = self._mean + away
        self._away = away
        p, q, level = np.split(path.T, 3)
        return np.asarray(solve(self.network, p, q, level, tolerance=1e-9).x.T)

    def read(self, truth: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Measurements (T, m) with normal noise."""
        return np.asarray(self.model.h(truth.T).T + sigma * self.rng.standard_normal(sigma.shape))

    def _history(self) -> Record:
        truth, m = self.walk(HISTORY), len(self.layout)
        sigma = np.tile(self.layout.sigma, (HISTORY, 1))
        on, zero = np.ones((HISTORY, m), dtype=bool), np.zeros((HISTORY, m))
        time = START + (np.arange(HISTORY) - HISTORY) * STEP
        return Record(time, self.read(truth, sigma), sigma, zero, on, on, zero)

    def scene(self, kinds: tuple[str, ...]) -> Scene:
        """The next troubles, each between quiet times."""
        starts, spans, at = [], [], 0
        for kind in kinds:
            quiet = int(self.rng.integers(*QUIET))
            spans.append(SPANS[kind])
            starts.append(at + quiet)
            at += quiet + spans[-1] + AFTER
        truth, m = self.walk(at), len(self.layout)
        sigma = np.tile(self.layout.sigma, (at, 1))
        on = np.ones((at, m), dtype=bool)
        where = [slice(a, a + span) for a, span in zip(starts, spans, strict=True)]
        for kind, during in zip(kinds, where, strict=True):
            if kind == "odd σ":
                some = self.rng.random(m) < 0.3
                drawn = 10.0 ** self.rng.uniform(-9, 6, m)
                sigma[during] = np.where(some, drawn, sigma[during])
        z = self.read(truth, sigma)
        since, trouble = np.zeros(at, dtype=int), np.full(at, "", dtype=object)
        for kind, during in zip(kinds, where, strict=True):
            TROUBLES[kind](self, z, on, during)
            trouble[during.start :] = kind
        inside = np.zeros(at, dtype=bool)
        for during in where:
            inside[during] = True
        count = AFTER
        for k in range(at):
            count = 0 if inside[k] else count + int(on[k].any())
            since[k] = count
        return Scene(truth, z, sigma, on, since, trouble)

    def few(self, most: int) -> np.ndarray:
        """Some channels."""
        count = int(self.rng.integers(1, most + 1))
        return self.rng.choice(len(self.layout), size=count, replace=False)


def _dropouts(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    on[during] = w.rng.random(on[during].shape) > w.rng.uniform(0.1, 0.7)


def _blackout(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    on[during] = False


def _gross(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    few = w.few(8)
    z[during.start, few] = 1e6 * w.rng.choice([-1.0, 1.0], size=len(few))


def _all_by(size: float) -> object:
    def apply(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
        z[during] += size

    return apply


def _zeros(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    z[during] = 0.0
    after = slice(during.stop, during.stop + AFTER)
    on[after] = w.rng.random(on[after].shape) > 0.2


def _odd_sigma(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    """Drawn before anything was read."""


def _stuck(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    few = w.few(3)
    z[during, few] = z[during.start, few]


def _spike(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    volts = np.flatnonzero(w.layout.quantity == VM)
    some = w.rng.choice(volts, size=int(w.rng.integers(1, len(volts) + 1)), replace=False)
    z[during, some] *= 10.0


def _sign(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    powers = np.flatnonzero(np.isin(w.layout.quantity, (P, Q)))
    # Two that conform would be right as far as anybody can tell.
    z[during, w.rng.choice(powers)] *= -1.0


def _offset(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    row = int(w.rng.integers(len(w.layout)))
    z[during, row] += w.layout.sigma[row] * w.rng.choice([-1, 1]) * 20.0 * 50.0 ** w.rng.random()


def _lost_and_wrong(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    on[during] = w.rng.random(on[during].shape) > 0.4
    wrong = w.rng.random(z[during].shape) < 0.02
    z[during] = np.where(wrong, 1e6, z[during])


def _blackout_then_zeros(w: World, z: np.ndarray, on: np.ndarray, during: slice) -> None:
    on[during.start : during.stop - 3] = False
    z[during.stop - 3 : during.stop] = 0.0


TROUBLES = {
    "dropouts": _dropouts,
    "blackout": _blackout,
    "gross errors": _gross,
    "all by 1e6": _all_by(1e6),
    "all by 100": _all_by(100.0),
    "zeros": _zeros,
    "odd σ": _odd_sigma,
    "stuck": _stuck,
    "spike": _spike,
    "sign": _sign,
    "offset": _offset,
    "lost and wrong": _lost_and_wrong,
    "blackout, zeros": _blackout_then_zeros,
}
SPANS = {
    "dropouts": 20,
    "blackout": 100,
    "gross errors": 1,
    "all by 1e6": 1,
    "all by 100": 1,
    "zeros": 3,
    "odd σ": 15,
    "stuck": 15,
    "spike": 1,
    "sign": 10,
    "offset": 15,
    "lost and wrong": 15,
    "blackout, zeros": 103,
}


def layout_of(network: Network, name: str) -> SensorLayout:
    """Meters of a grid: with phasors, without, or few more than states."""
    bus, branch = np.arange(network.n_bus), np.arange(0, network.n_branch, 2)
    some = bus[::4] if name != "feeder" else bus[:0]
    volts = bus if name != "feeder" else bus[::4]
    rows = [(VM, volts, BUS), (P, bus, BUS), (Q, bus, BUS)]
    if name != "lean":
        rows += [(P, branch, FROM), (Q, branch, FROM)]
    if name == "phasors":
        rows.append((VA, some, BUS))
    layout = SensorLayout.of(network, *rows)
    scale = np.abs(np.concatenate([network.p_nominal_pu, network.q_nominal_pu])).max()
    power = np.isin(layout.quantity, (P, Q))
    sigma = np.where(power, 5e-3 * scale, np.where(layout.quantity == VA, 1e-3, 2e-3))
    return dataclasses.replace(layout, sigma=sigma)


def world(grid: str, layout: str, seed: int) -> World:
    """A grid with meters and its own random numbers."""
    network = library.load(grid)
    return World(network, layout_of(network, layout), np.random.default_rng(seed))
