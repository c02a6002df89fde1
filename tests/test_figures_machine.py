"""Claim: figures of a machine's observers carry units and draw what they are given."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from pse_analysis.errors import TableError
from pse_analysis.figures import Paper, machine
from pse_analysis.machine import INPUT, STATES

COUNT = 500
TIMES = pd.date_range("2025-08-12", periods=COUNT, freq="10ms", tz="UTC").as_unit("us")


@pytest.fixture(scope="module")
def tables() -> dict[str, pd.DataFrame]:
    """Five seconds of a rotor that turns at 1 rad/s, one observer of it, and one flagged sample."""
    ramp = np.arange(COUNT) * 0.01
    values = dict(zip(STATES, (ramp, np.ones(COUNT)), strict=True))
    truth = pd.concat(
        pd.DataFrame({"trial": 0, "time_utc": TIMES, "quantity": q, "value": v})
        for q, v in values.items()
    )
    estimated = truth.assign(method="matched", value=truth.value + 0.1, sigma=0.1)
    aligned = pd.concat(
        pd.DataFrame(
            {
                "trial": 0, "time_utc": TIMES, "sample_utc": TIMES, "origin": "measured",
                "channel": f"pmu:machine/1:{q}", "value_pu": v,
            }
        )
        for q, v in ((STATES[0], ramp), (INPUT, 0.0 * ramp))
    )  # fmt: skip
    validated = pd.DataFrame({"trial": 0, "time_utc": TIMES, "flag": np.arange(COUNT) == 200})
    return {"truth": truth, "estimated": estimated, "aligned": aligned, "validated": validated}


def labels(figure: Paper) -> set[str]:
    figure.draw_without_rendering()
    named = [ax for ax in figure.axes if ax.axison]
    return {t for ax in named for t in (ax.get_xlabel(), ax.get_ylabel()) if t}


def test_every_axis_carries_its_unit(tables: dict[str, pd.DataFrame]) -> None:
    t = tables
    factor, rms = np.geomspace(0.5, 2.0, 9), np.ones((9, 2))
    points = pd.DataFrame({"ratio": 1.0, "quantity": STATES, "rms": 1.0, "standard_error": 0.1})
    drawn = {
        "scheme": machine.scheme(t["aligned"]),
        "oscillogram": machine.oscillogram(t["estimated"], t["truth"], t["aligned"], "matched"),
        "gap": machine.through_gap(
            t["estimated"], t["truth"], t["validated"], "matched", (1.0, 3.0)
        ),
        "ratio": machine.ratio_curve(factor, {"theory": rms}, points, 1.0, {"here": 1.0}),
        "cost": machine.model_cost(factor, {"T_j": 2.0 * rms}, [1.0, 1.0]),
    }
    for name, figure in drawn.items():
        found = labels(figure)
        assert found, name
        assert all("[" in label and "]" in label for label in found), (name, found)
        assert len(figure._repr_png_()) > 5000


def test_part_of_the_time_gets_the_whole_height(tables: dict[str, pd.DataFrame]) -> None:
    whole = machine.oscillogram(
        tables["estimated"], tables["truth"], tables["aligned"], "matched", until_s=1.0
    )
    low, high = whole.axes[1].get_ylim()
    assert -0.2 < low < 0.0
    assert 1.0 < high < 1.3


def test_flagged_sample_is_marked_at_its_time(tables: dict[str, pd.DataFrame]) -> None:
    t = tables
    figure = machine.through_gap(t["estimated"], t["truth"], t["validated"], "matched", (0.0, 4.0))
    marks = [line for line in figure.axes[0].lines if line.get_label() == "flagged sample"]
    assert [line.get_xdata()[0] for line in marks] == [2.0]


def test_unknown_observer_is_named_with_the_known_ones(tables: dict[str, pd.DataFrame]) -> None:
    with pytest.raises(TableError, match="'mached' in trial 0; expected matched"):
        machine.oscillogram(tables["estimated"], tables["truth"], tables["aligned"], "mached")
