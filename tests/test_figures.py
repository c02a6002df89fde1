"""Figures name units on every axis, give a method one colour, and keep legends off the data."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex
from study_tables import METHODS, StudyTables, study_tables

from pse_analysis import figures
from pse_analysis.drawing import method_colours
from pse_analysis.errors import TableError

CHANNEL = "scada:bus/18:vm_pu"


@pytest.fixture(scope="module")
def tables() -> StudyTables:
    return study_tables(n_instant=288)


@pytest.fixture(scope="module")
def drawn(tables) -> dict[str, figures.Paper]:
    t = tables
    return {
        "voltage": figures.voltage(t.estimated, t.truth, t.aligned, "bus/18"),
        "angle": figures.voltage(t.estimated, None, None, "bus/18", quantity="va_degree"),
        "flags": figures.flags(t.validated, CHANNEL, sample_truth=t.sample_truth),
        "errors_by_bus": figures.errors_by_bus(t.scored),
        "consistency": figures.consistency(t.steps, t.scored),
        "consistency alone": figures.consistency(t.steps),
        "coverage_by_hour": figures.coverage_by_hour(t.scored),
    }


def test_every_axis_has_a_label_with_a_unit(drawn):
    for name, figure in drawn.items():
        for ax in figure.axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                assert label, name
                assert label.endswith("]"), (name, label)
                assert "[" in label, (name, label)


def test_the_method_colours_are_the_same_in_every_figure(drawn):
    expected = method_colours(METHODS)
    seen = 0
    for figure in drawn.values():
        for ax in figure.axes:
            handles, labels = ax.get_legend_handles_labels()
            for handle, label in zip(handles, labels, strict=True):
                method = label.removesuffix(" ±2σ")
                if method in expected:
                    patch = handle[0] if hasattr(handle, "patches") else handle
                    colour = patch.get_facecolor() if patch is not handle else handle.get_color()
                    assert to_hex(colour).upper() == expected[method]
                    seen += 1
    assert seen >= 15


def test_a_method_keeps_its_colour_whatever_stands_beside_it():
    assert method_colours(["kf_load"])["kf_load"] == method_colours(["wls", "kf_load"])["kf_load"]
    many = method_colours(["wls", "ukf_robust", "ekf", "kf_load", "hybrid"])
    assert len(set(many.values())) == 5


def test_legends_and_labels_lie_inside_the_page_and_outside_the_axes(tables):
    for width in (figures.SINGLE, figures.DOUBLE):
        figure = figures.voltage(
            tables.estimated, tables.truth, tables.aligned, "bus/18", width=width
        )
        figure.canvas.draw()
        (legend,) = figure.legends
        box = legend.get_window_extent()
        page = figure.bbox
        assert box.x0 >= page.x0 - 1
        assert box.x1 <= page.x1 + 1
        assert box.y0 >= figure.axes[0].bbox.y1 - 1


def test_a_flagged_sample_is_marked_with_its_reason_and_their_number(tables, drawn):
    own = tables.validated[(tables.validated.channel == CHANNEL) & (tables.validated.trial == 0)]
    _, labels = drawn["flags"].axes[0].get_legend_handles_labels()
    assert f"limit ({int((own.reasons & 16 > 0).sum())})" in labels


def test_a_figure_shows_itself_in_a_notebook_and_leaves_the_global_style_alone(tables):
    before = dict(mpl.rcParams)
    figure = figures.coverage_by_hour(tables.scored)
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert dict(mpl.rcParams) == before


def test_grid_colours_buses_and_names_what_the_colours_mean(tables):
    values = np.linspace(0.0, 2.0, tables.network.n_bus)
    figure = figures.grid(tables.network, values, "mean |V| error [10⁻³ p.u.]")
    drawing, bar = figure.axes
    assert bar.get_xlabel() == "mean |V| error [10⁻³ p.u.]"
    assert {text.get_text() for text in drawing.texts} == set(tables.network.buses.name)
    assert len(figures.grid(tables.network).axes) == 1


def test_score_table_speaks_thousandths_and_degrees(tables):
    table = figures.score_table(tables.scored)
    assert list(table.index) == list(METHODS)
    assert table.loc["wls", "mean |V| error [10⁻³ p.u.]"] == pytest.approx(1.6)
    assert table.loc["wls", "mean angle error [10⁻³ °]"] == pytest.approx(np.degrees(0.8e-3) * 1e3)
    assert table.loc["wls", "time [s]"] == pytest.approx(0.6)


def test_detection_table_adds_trials_up_and_ends_with_all(tables):
    table = figures.detection_table(tables.scored)
    assert list(table.index) == ["spike", "stale", "all"]
    assert table.loc["all", "found"] == 180
    assert table.loc["all", "recall [%]"] == pytest.approx(90.0)


def test_real_telemetry_without_truth_has_figures_and_an_empty_detection_table(tables):
    scored = tables.scored[(tables.scored.metric == "nis_ratio")]
    assert figures.detection_table(scored).empty
    assert list(figures.score_table(scored).columns) == ["NIS/m [1]"]
    figures.consistency(tables.steps, scored)
    figures.voltage(tables.estimated, None, tables.aligned, "bus/18")


def test_an_unknown_name_is_refused_with_names_that_exist(tables):
    with pytest.raises(TableError, match=r"'bus/99'.*bus/1"):
        figures.voltage(tables.estimated, None, None, "bus/99")
    with pytest.raises(TableError, match=r"'pmu:x'.*scada:bus/1:vm_pu"):
        figures.flags(tables.validated, "pmu:x")
    with pytest.raises(TableError, match="by_element"):
        figures.errors_by_bus(tables.scored[tables.scored.element == ""])
