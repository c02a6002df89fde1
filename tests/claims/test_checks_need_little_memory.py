"""Claim: all checks on 1,000 channels need at most four times their memory, themselves included."""

from __future__ import annotations

import tracemalloc

import numpy as np

from pse_analysis.validation import experiments, trials
from pse_analysis.validation.block import screen

SEED = 20


def test_memory_is_at_most_four_times_the_block() -> None:
    shape = (5_000, 1_000)
    rng = np.random.default_rng(SEED)
    load = trials.generated_load(shape[0], rng, n_channel=shape[1])
    value = trials.with_errors(load, rng, share=0.01, largest=6.0).value
    known = experiments.known_structure(shape[1])
    checked = trials.criteria("combination", 3.5, known, lower=-1e4, upper=1e4)
    stamps = np.arange(shape[0])
    tracemalloc.start()
    found = screen(value, stamps, checked)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.statistic is not None
    assert 1.0 + peak / value.nbytes <= 4.0
