"""Claim: whatever reports, a filter stays definite, comes back, and is not "ok" while it is wrong.

Loads and held voltages walk as the filters believe. Meters drop out, fall silent for a hundred
instants, read 1e6, read zero, shift as one, stick, change their sign, and are next to exact
(σ = 1e-9) or next to worthless (σ = 1e6) for a while. A short form, with a fixed seed, of
``python -m tests.endurance filters``.

Holt's smoothing is asked for less: P is that of its paper, in which earlier estimates are certain
(`pse_analysis.estimation.process.dynamics.holt`), so that it is too small by design.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.endurance.filter_troubles import TROUBLES, World, world
from tests.endurance.filters import METHODS, SETTLED, Tally, follow, made, optimistic

SEED = 10
EACH = 4
"""Troubles that a filter meets here; the filters after it meet the next ones."""


def troubles(number: int) -> tuple[str, ...]:
    names = list(TROUBLES)
    return tuple(names[(EACH * number + k) % len(names)] for k in range(EACH))


@pytest.fixture(scope="module")
def places() -> dict[str, World]:
    return {layout: world("ieee14", layout, SEED) for layout in ("phasors", "plain")}


@pytest.mark.parametrize("name", METHODS)
def test_filter_endures(name: str, places: dict[str, World]) -> None:
    number = list(METHODS).index(name)
    place = places[("phasors", "plain")[number % 2]]
    place.rng = np.random.default_rng([SEED, number])
    tally = Tally()
    follow(made(name, place), place, place.scene(troubles(number)), tally)
    assert tally.least > -1e-9
    assert tally.missing == 0
    assert tally.restarted == 0
    assert tally.error < 0.1
    if optimistic(METHODS[name]):
        return
    assert tally.deceived == []
    assert tally.longest <= SETTLED
    assert tally.inside > 0.95 * tally.believed
    assert tally.not_ok <= 0.02 * tally.quiet


def test_polls_of_zeros_lose_no_filter_of_a_feeder() -> None:
    place = world("ieee33", "feeder", SEED)
    for name in ("kalman", "ukf channel"):
        tally = Tally()
        follow(made(name, place), place, place.scene(("zeros",)), tally)
        assert tally.deceived == []
        assert tally.longest <= SETTLED
        assert tally.least > -1e-9
