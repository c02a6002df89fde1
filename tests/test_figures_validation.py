"""Figures of the checks name units on every axis, draw what they are given and fit their page."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from pse_analysis.drawing import BLUE, ORANGE, VERMILION
from pse_analysis.figures import DOUBLE, SINGLE, Paper
from pse_analysis.figures import validation as drawn
from pse_analysis.validation import experiments, thresholds, trials

SEED = 7


def rates() -> pd.DataFrame:
    rows = [
        (check, q, rate, 0.1 * q + 0.01, 0.1 * q + 0.011, 0.001, 0.4 * q + 0.02)
        for check in ("increment", "extrapolation")
        for q in (0.01, 0.1)
        for rate in ("false_alarm", "miss")
    ]
    columns = ["check", "q", "rate", "predicted", "conditional", "conditional_error"]
    return pd.DataFrame(rows, columns=[*columns, "unconditional"])


def margins() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "rho": [0.8, -0.1, 0.0], "claimed": [True, False, False], "margin": [0.2, 0.0, -0.01],
            "error": [0.05, 0.01, 0.01], "as_they_come": [0.1, 0.0, -0.02],
        },
        index=["PV1", "G3-H_pload", "H0-H_pload"],
    )  # fmt: skip


@pytest.fixture(scope="module")
def figures() -> dict[str, Paper]:
    rng = np.random.default_rng(SEED)
    k = np.linspace(-0.5, 1.5, 41)
    parabola = 1.0 - k + k * k
    load = trials.generated_load(40, rng)[:, 0]
    gamma = np.linspace(0.0, 4.0, 9)
    share = np.exp(-gamma)
    x = np.linspace(-8.0, 8.0, 81)
    q = np.linspace(0.0, 1.0, 21)
    minimax, bayes = thresholds.minimax(2.0), thresholds.bayes(0.1, 2.0)
    roc = experiments.predicted_roc([1.0, 2.0, 3.0])
    gains = pd.DataFrame({"rho": [-0.5, 0.5], "simulated": [25.1, 24.8], "error": [0.2, 0.2]})
    times = pd.date_range("2016-06-09", periods=40, freq="2min", tz="UTC")
    return {
        "scheme": drawn.scheme((59.0, 59.6, 59.2), 0.5, 0.5, (57.0, 61.0)),
        "variance": drawn.variance_against_k(k, parabola, parabola, 0.5),
        "extrapolated": drawn.extrapolated(times, load, load - 0.1, load + 0.1),
        "share": drawn.share_against_threshold(gamma, share, share**2, faulty=(share, share)),
        "densities": drawn.densities(x, {"good": (thresholds.good_density(x), 1.0)}),
        "risk": drawn.risk_curves(
            gamma,
            {0.1: thresholds.risk(gamma, 0.1, 2.0)},
            {0.1: (float(bayes.k), float(bayes.risk))},
            q,
            {"bayes": thresholds.bayes(q, 2.0).risk, "minimax": thresholds.risk(minimax.k, q, 2.0)},
            (float(minimax.q), float(minimax.risk)),
        ),
        "roc": drawn.roc_curves(roc, roc),
        "gain": drawn.gain_against_autocorrelation(gains),
        "rates": drawn.realised_rates(rates()),
        "margins": drawn.margins(margins()),
    }


def test_every_axis_has_a_label_with_a_unit(figures: dict[str, Paper]) -> None:
    for name, figure in figures.items():
        for ax in figure.axes:
            shares_x = not any(label.get_visible() for label in ax.get_xticklabels())
            shares_y = not any(label.get_visible() for label in ax.get_yticklabels())
            for label, shared in ((ax.get_xlabel(), shares_x), (ax.get_ylabel(), shares_y)):
                assert shared or (label.endswith("]") and "[" in label), (name, label)


def test_all_ink_lies_on_the_page(figures: dict[str, Paper]) -> None:
    for name, figure in figures.items():
        assert figure.get_figwidth() in (SINGLE, DOUBLE)
        box = figure.get_tightbbox()
        assert box.x0 >= -0.01, name
        assert box.y0 >= -0.01, name
        assert box.x1 <= figure.get_figwidth() + 0.01, name
        assert box.y1 <= figure.get_figheight() + 0.01, name


def test_a_check_has_one_colour_in_every_figure(figures: dict[str, Paper]) -> None:
    expected = {"first increment": ORANGE, "extrapolation": BLUE}
    seen = 0
    for figure in figures.values():
        for ax in figure.axes:
            handles, labels = ax.get_legend_handles_labels()
            for handle, label in zip(handles, labels, strict=True):
                name = label.split(",")[0].removesuffix(" ≤ γ")
                if name in expected and hasattr(handle, "get_color"):
                    assert to_hex(handle.get_color()).upper() == expected[name]
                    seen += 1
    assert seen >= 4


def test_gain_in_resolution_is_read_off_the_curve(figures: dict[str, Paper]) -> None:
    texts = [text.get_text() for text in figures["variance"].axes[0].texts]
    assert "ΔPC = 25.0 %" in texts


def test_zero_shares_leave_a_gap_on_the_logarithmic_axis() -> None:
    figure = drawn.share_against_threshold([0.0, 1.0], [0.5, 0.0], [0.5, 0.1])
    line = figure.axes[0].lines[1]
    assert np.isnan(line.get_ydata()).tolist() == [False, True]


def test_minimax_point_lies_on_the_bayes_risk(figures: dict[str, Paper]) -> None:
    right = figures["risk"].axes[1]
    (point,) = [line for line in right.lines if line.get_marker() == "D"]
    assert to_hex(point.get_color()).upper() == VERMILION
    bayes = next(line for line in right.lines if line.get_label() == "Bayes at each q")
    on_curve = np.interp(point.get_xdata()[0], bayes.get_xdata(), bayes.get_ydata())
    assert point.get_ydata()[0] == pytest.approx(on_curve, abs=5e-3)


def test_curves_are_named_and_ordered_by_autocorrelation(figures: dict[str, Paper]) -> None:
    names = [label.get_text() for label in figures["margins"].axes[0].get_yticklabels()]
    assert names == ["H0-H", "G3-H", "PV1"]


def test_drawing_leaves_the_global_style_alone() -> None:
    before = dict(mpl.rcParams)
    assert drawn.margins(margins())._repr_png_().startswith(b"\x89PNG")
    assert dict(mpl.rcParams) == before
