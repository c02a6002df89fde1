"""Claim: figures of alignment and screening show what they are given, with units on their axes."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pse_analysis import figures
from pse_analysis.alignment.dtw import Match
from pse_analysis.validation import adaptive

SEED = 5


def test_a_match_is_drawn_with_its_pairs() -> None:
    n = 40
    wave = np.sin(np.linspace(0, 6, n))
    path = np.stack([np.arange(n), np.arange(n)], axis=1)
    match = Match(60.0 * np.arange(n), wave, wave, path, np.full(4, np.nan))
    ax = figures.warped(match, "device", "unit", every=8).axes[0]
    assert len(ax.lines) == 2 + 5
    assert ax.get_xlabel() == "minutes of the window"
    np.testing.assert_allclose(ax.lines[-2].get_ydata() - ax.lines[-1].get_ydata(), 4.0)


def test_errors_stand_at_their_buses_in_thousandths() -> None:
    rows = [
        (method, f"bus/{bus}", quantity, scale * bus)
        for method, scale in (("a", 1e-3), ("b", -2e-3), ("c", 1.0))
        for bus in (1, 2, 10)
        for quantity in ("vm_pu", "va_degree")
    ]
    paired = pd.DataFrame(rows, columns=["method", "element", "quantity", "error"])
    left, right = figures.errors_at_instant(paired, {"a": "first", "b": "second"}).axes
    assert [line.get_label() for line in left.lines] == ["first", "second"]
    np.testing.assert_allclose(left.lines[1].get_xdata(), [1, 2, 10])
    np.testing.assert_allclose(left.lines[1].get_ydata(), [2, 4, 20])
    np.testing.assert_allclose(right.lines[0].get_ydata(), np.radians([1, 2, 10]))
    assert "10⁻³ p.u." in left.get_ylabel()
    assert "10⁻³ rad" in right.get_ylabel()


def test_a_screened_channel_shows_its_flags_inside_the_window() -> None:
    z = 1.0 + 0.005 * np.random.default_rng(SEED).standard_normal((80, 1))
    z[50] += 0.1
    calm = np.ones((80, 1))
    columns = {"calm": calm, "bad": z}
    drawn = figures.screened(
        np.arange(80),
        {title: (v, adaptive.screen(v, np.array([0.005]))) for title, v in columns.items()},
        label="|V|",
        unit="p.u.",
        window=(40, 60),
        bad=(50, 50),
    )
    _, above, _, below = drawn.axes
    flags = next(line for line in below.lines if line.get_label() == "flagged")
    assert 50 in flags.get_xdata()
    assert below.get_ylim()[1] > flags.get_ydata().max()  # nothing is cut off
    assert min(above.lines[0].get_xdata()) == 40
    assert max(above.lines[0].get_xdata()) == 60
    assert drawn.axes[0].get_ylabel() == "|V| [p.u.]"
