"""Claim: the table that ends a run brings trials together and shows only what is known."""

from __future__ import annotations

import pandas as pd
import pytest

from pse_analysis.pipeline.summary import detection, markdown, text

ROWS = [
    ("wls", 0, "vm_error_mean", "", 0.001, "pu"),
    ("wls", 1, "vm_error_mean", "", 0.003, "pu"),
    ("wls", 0, "vm_error_max", "", 0.010, "pu"),
    ("wls", 1, "vm_error_max", "", 0.020, "pu"),
    ("wls", 0, "vm_error_max", "bus/6", 0.5, "pu"),
    ("wls", 0, "va_error_mean", "", 0.001, "rad"),
    ("wls", 0, "coverage_vm", "", 0.95, ""),
    ("wls", 0, "nis_ratio", "", float("nan"), ""),
    ("validate", 0, "found", "", 6.0, ""),
    ("validate", 1, "found", "", 2.0, ""),
    ("validate", 0, "missed", "", 2.0, ""),
    ("validate", 0, "false_alarms", "", 1.0, ""),
]


@pytest.fixture
def scored() -> pd.DataFrame:
    columns = ["method", "trial", "metric", "element", "value", "unit"]
    return pd.DataFrame(ROWS, columns=columns)


def test_means_are_averaged_and_largest_errors_are_not(scored: pd.DataFrame) -> None:
    line = next(line for line in text("a case", scored).splitlines() if "wls" in line)
    # Thousandths of p.u., thousandths of a degree, shares; of what is unknown nothing is said.
    assert line.split() == ["wls", "2.000", "20.00", "57.3", "95.0%"]


def test_what_one_method_does_not_know_is_a_dash_beside_those_that_do(scored: pd.DataFrame) -> None:
    other = pd.DataFrame([("kf", 0, "nis_ratio", "", 1.0, "")], columns=scored.columns)
    table = text("a case", pd.concat([scored, other]), order=["kf", "wls"]).splitlines()
    kf, wls = (next(k for k, line in enumerate(table) if name in line) for name in ("kf", "wls"))
    assert kf < wls
    assert table[kf].split() == ["kf", *"–––", "1.00", "–"]


def test_without_truth_the_table_says_so_and_shows_no_empty_column() -> None:
    rows = [("wls", 0, "nis_ratio", "", 1.0, ""), ("wls", 0, "seconds", "", 2.0, "s")]
    columns = ["method", "trial", "metric", "element", "value", "unit"]
    table = text("a case", pd.DataFrame(rows, columns=columns), ["telemetry: 3 samples"])
    line = next(line for line in table.splitlines() if "wls" in line)
    assert line.split() == ["wls", "1.00", "2.0"]
    assert "truth is not known" in " ".join(table.split())
    assert table.rstrip().endswith("telemetry: 3 samples")
    assert "bad data" not in table


def test_text_is_the_same_where_a_notebook_runs_it(
    scored: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = text("a case", scored)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert text("a case", scored) == plain


def test_text_fits_any_terminal_of_100_columns(scored: pd.DataFrame) -> None:
    lines = text("a case", scored).splitlines()
    assert max(map(len, lines)) <= 100
    assert not any(line.endswith(" ") for line in lines)


def test_no_number_is_cut_off_where_filters_went_astray() -> None:
    metrics = {
        "vm_error_mean": (17.2, "pu"),
        "vm_error_max": (1172.27, "pu"),
        "va_error_mean": (0.7265, "rad"),
        "va_error_max": (3.1414, "rad"),
        "nis_ratio": (17227.361, ""),
        "nees_ratio": (1.5e8, ""),
        "coverage_vm": (1.0, ""),
        "coverage_va": (1.0, ""),
        "steps_not_ok": (17964.0, ""),
        "seconds": (1632.4, "s"),
    }
    rows = [("improved_ukf_2", 0, m, "", value, unit) for m, (value, unit) in metrics.items()]
    columns = ["method", "trial", "metric", "element", "value", "unit"]
    table = text("a case", pd.DataFrame(rows, columns=columns))
    assert "…" not in table
    assert max(map(len, table.splitlines())) <= 100
    line = next(line for line in table.splitlines() if "improved" in line)
    assert line.split()[1:7] == ["17200", "1172270", "41625.4", "179989", "17227", "1.5e+08"]


def test_units_in_brackets_are_shown(scored: pd.DataFrame) -> None:
    seconds = pd.DataFrame([("wls", 0, "seconds", "", 1.0, "s")], columns=scored.columns)
    assert "[s]" in text("a case [1]", pd.concat([scored, seconds]))
    assert "a case [1]" in text("a case [1]", scored)


def test_bad_data_are_counted_over_trials(scored: pd.DataFrame) -> None:
    assert detection(scored) == (
        "bad data: 8 of 10 found (recall 80%), 2 missed, 1 false alarms (precision 89%)"
    )


def test_nothing_is_said_of_faults_that_nobody_recorded(scored: pd.DataFrame) -> None:
    assert detection(scored[scored.method != "validate"]) == ""


def test_bars_of_magnitudes_do_not_break_the_markdown_table(scored: pd.DataFrame) -> None:
    rows = [line for line in markdown("a case", scored).splitlines() if line.startswith("|")]
    assert len({line.replace("\\|", "").count("|") for line in rows}) == 1


def test_machine_is_reported_in_its_own_columns() -> None:
    metrics = ("angle_rmse", "angle_rms", "angle_rms_theory", "speed_rms")
    rows = [("matched", t, m, "", 0.03 + 0.01 * t, "rad") for m in metrics for t in (0, 1)]
    columns = ["method", "trial", "metric", "element", "value", "unit"]
    table = text("a machine", pd.DataFrame(rows, columns=columns))
    line = next(line for line in table.splitlines() if "matched" in line)
    # Thousandths; simulated RMS values are brought together by their squares.
    assert line.split()[1:3] == ["35.4", "35.0"]
    assert "θ RMS" in table
    assert "|V|" not in table


def test_notices_stand_between_title_and_table_and_findings_below_it(scored: pd.DataFrame) -> None:
    notice, finding = "no threshold was learnt " * 8, "telemetry: 3 samples"
    table = text("a case", scored, [finding], ["wls"], [notice, "second"])
    lines = table.splitlines()
    assert max(map(len, lines)) <= 100
    places = [
        table.index(t) for t in ("a case", "attention: no", "attention: second", "wls", "3 s")
    ]
    assert places == sorted(places)
    page = markdown("a case", scored, [finding], ["wls"], [notice, "second"])
    order = ("# a case", "**attention:** no", "**attention:** second", "| method", finding)
    places = [page.index(t) for t in order]
    assert places == sorted(places)
    assert "attention" not in text("a case", scored, [finding]) + markdown("a case", scored)
