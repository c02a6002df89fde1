"""Claim: odd input ends in a result or a clear error, and means the same however it is stored.

A short form of ``python -m tests.endurance mutations``, with a fixed seed.
"""

from __future__ import annotations

import warnings

import pytest
from hypothesis import strategies as st
from tests.endurance import mutations
from tests.endurance.mutations import TARGETS, Target, search
from tests.endurance.outcomes import NOT_FINITE, NotFinite, outcome, place

from pse_analysis.errors import TableError

SEED = 417
COUNTS = {
    "ingest": 60,
    "channels": 60,
    "grid": 80,
    "machine": 40,
    "schema": 50,
    "parquet": 80,
    "case text": 100,
    "case values": 80,
    "parameters": 16,
    "pipeline": 8,
    "meaning": 8,
}
"""Inputs of each kind; `make endurance` tries a hundred thousand."""


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name.replace(" ", "_"))
def test_odd_input_ends_in_a_result_or_a_clear_error(target: Target) -> None:
    counts, failure = search(target, COUNTS[target.name], SEED, set())
    assert failure is None, failure.text()
    assert counts.total() >= COUNTS[target.name] // 2
    # Neither everything nor nothing is refused.
    assert counts["ok"] > 0
    assert counts["PseError"] > 0 or target.name == "meaning"


def planted(number: int) -> None:
    """A reader with three faults."""
    if number > 900:
        raise NotFinite("a value")
    if number > 700:
        raise KeyError("foreign")
    if number > 500:
        warnings.warn("divide by zero", RuntimeWarning, stacklevel=1)
    if number > 300:
        raise TableError("expected at most 300, received more: lower it")


def test_planted_faults_are_found_and_shrunk_to_the_smallest() -> None:
    target = Target("planted", 1.0, st.integers(0, 1000), planted)
    counts, failure = search(target, 500, SEED, set())
    assert failure is not None
    assert int(failure.example) in (501, 701, 901)
    assert counts["ok"] > 0
    _, failures = mutations.run(1500, SEED, [target])
    assert {place(one.error).split()[0] for one in failures} == {
        "NotFinite",
        "KeyError",
        "RuntimeWarning",
    }
    assert {int(one.example) for one in failures} == {501, 701, 901}


def test_what_hangs_is_ended_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.endurance.outcomes.PATIENCE_S", 1)

    def endless() -> None:
        while True:
            pass

    ended, error = outcome(endless)
    assert ended == "slow"
    assert "after 1 s" in str(error)
    assert outcome(lambda: planted(950))[0] == NOT_FINITE
