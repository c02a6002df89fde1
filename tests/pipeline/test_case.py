"""Claim: a case file is found by its name alone, and whatever nothing reads in it is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from pse_analysis.errors import ParameterError
from pse_analysis.pipeline.case import list_cases, load_case

GOOD = """
title = "A small study"
grid = "ieee14"
[study]
start = 2016-06-09T00:00:00Z
end = 2016-06-09T01:00:00Z
step_s = 300
[simulate]
seed = 3
"""


@pytest.fixture
def cases(tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(GOOD, encoding="utf-8")
    return tmp_path


def test_case_is_read_by_name(cases: Path) -> None:
    case = load_case("small", cases)
    assert (case.name, case.title, case.grid) == ("small", "A small study", "ieee14")
    assert case.simulated
    assert case.study.step_s == 300.0
    assert list_cases(cases) == ("small",)


@pytest.mark.parametrize(
    "name", ["..", "../small", "a/b", "/etc/passwd", "Small", "", "small.toml"]
)
def test_name_that_could_be_a_path_is_refused(cases: Path, name: str) -> None:
    with pytest.raises(ParameterError, match="expected a name of lower-case letters"):
        load_case(name, cases)


def test_unknown_case_names_a_close_match(cases: Path) -> None:
    with pytest.raises(ParameterError, match="did you mean 'small'"):
        load_case("smal", cases)


def test_missing_folder_of_cases_names_the_option(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="--cases DIR"):
        load_case("small", tmp_path / "nowhere")


def test_syntax_error_names_file_and_line(cases: Path) -> None:
    (cases / "small.toml").write_text(GOOD + "trials 3\n", encoding="utf-8")
    with pytest.raises(ParameterError, match=r"small\.toml.*line 10"):
        load_case("small", cases)


def test_unknown_section_names_a_close_match(cases: Path) -> None:
    (cases / "small.toml").write_text(GOOD + "[validat]\n", encoding="utf-8")
    with pytest.raises(ParameterError, match="unknown key 'validat': did you mean 'validate'"):
        load_case("small", cases)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('title = "A small study"', "", "'title' is missing"),
        ('title = "A small study"', "title = 3", "title must be a text, received 3"),
        ('grid = "ieee14"', "", "needs grid"),
        ("[simulate]\nseed = 3", "[validate]", "'ieee14' is simulated, but there is no table"),
        ("T00:00:00Z", "T00:00:00", "append 'Z'"),
        ("step_s = 300", "stepp_s = 300", "did you mean 'step_s'"),
        ("step_s = 300", "step_s = '5 min'", "expected float, received '5 min'"),
        ('grid = "ieee14"', "score = 3", r"must be a table \[score\], received 3"),
    ],
)
def test_ill_formed_case_is_refused_with_its_file(
    cases: Path, old: str, new: str, message: str
) -> None:
    (cases / "small.toml").write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ParameterError, match=message) as caught:
        load_case("small", cases)
    assert "small.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (GOOD + "trials = " + "9" * 5000, r"small\.toml: cannot be read: .*4300"),
        (GOOD + "faults = " + "[" * 3000 + "]" * 3000, r"small\.toml: cannot be read"),
        (GOOD.replace("A small study", "A\\u001b[2J study"), "title must be a text of one line"),
        (GOOD.replace("A small study", " "), "title must be a text of one line"),
        (GOOD.replace('"ieee14"', "1979-05-27"), r"grid must be a text, received datetime.date"),
        (GOOD.replace("00:00Z\nend", "00:00\nend"), r"start has no time zone: .*append 'Z'"),
        (GOOD.replace("step_s = 300", "step_s = inf"), "finite step_s > 0"),
        (GOOD.replace("step_s = 300", "step_s = {}"), r"\[study.step_s\] expected float, rec"),
        (GOOD + "#" * (1 << 20), "a case file of at most 1048576 bytes, received"),
    ],
)
def test_odd_texts_end_in_an_error_that_names_the_file(
    cases: Path, text: str, expected: str
) -> None:
    (cases / "small.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ParameterError, match=expected):
        load_case("small", cases)


def test_a_file_that_cannot_be_opened_is_named(cases: Path) -> None:
    (cases / "small.toml").unlink()
    (cases / "small.toml").symlink_to("small.toml")
    with pytest.raises(ParameterError, match="no case 'small'"):
        load_case("small", cases)
