"""Claim: a table of a case file becomes a frozen dataclass, or the message says what to mend."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta, timezone
from typing import Any, Literal

import pytest

from pse_analysis.alignment import AlignParams
from pse_analysis.errors import ParameterError, PseError
from pse_analysis.estimation import EstimateParams, Method
from pse_analysis.parameters import Study, Unbounded, build
from pse_analysis.validation import Rule


@dataclass(frozen=True)
class Inner:
    """A row of a table in a table."""

    place: str
    weight: float = 1.0


@dataclass(frozen=True)
class Outer:
    """One field of every kind that a case file may hold."""

    count: int
    share: float = 0.5
    label: str | None = None
    on: bool = False
    kind: Literal["a", "b"] = "a"
    inner: Inner | None = None
    rows: tuple[Inner, ...] = ()
    span: tuple[float, float] = (0.0, 1.0)
    by_name: dict[str, float] = field(default_factory=dict)
    anything: Any = None
    either: int | str | None = None


def test_all_kinds_of_fields_are_built() -> None:
    got = build(
        Outer,
        {
            "count": 3,
            "share": 1,
            "label": "x",
            "on": True,
            "kind": "b",
            "inner": {"place": "here", "weight": 2},
            "rows": [{"place": "p"}, {"place": "q", "weight": 0.25}],
            "span": [1, 2.5],
            "by_name": {"pmu": 3},
            "anything": [1, "two"],
            "either": "x",
        },
        "table",
    )
    assert got == Outer(
        3, 1.0, "x", True, "b", Inner("here", 2.0), (Inner("p"), Inner("q", 0.25)), (1.0, 2.5),
        {"pmu": 3.0}, [1, "two"], "x",
    )  # fmt: skip
    assert [type(v) for v in (got.share, got.span[0], got.by_name["pmu"])] == [float] * 3


def test_keys_that_are_not_given_take_their_defaults() -> None:
    assert build(Outer, {"count": 1}, "table") == Outer(1)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (
            {"cuont": 1},
            r"\[t\] unknown key 'cuont': did you mean 'count'\? expected any of count, s",
        ),
        ({"count": 1, "zzz": 1}, r"\[t\] unknown key 'zzz': expected any of"),
        ({}, r"\[t\] key 'count' is missing: add it to the case file"),
        ({"count": 1.5}, r"\[t.count\] expected int, received 1.5"),
        ({"count": True}, r"\[t.count\] expected int, received True"),
        ({"count": "1"}, r"\[t.count\] expected int, received '1'"),
        ({"count": 1, "share": "x"}, r"\[t.share\] expected float, received 'x'"),
        ({"count": 1, "share": True}, r"\[t.share\] expected float, received True"),
        ({"count": 1, "share": float("nan")}, r"\[t.share\] expected a number, received nan"),
        ({"count": 1, "on": 1}, r"\[t.on\] expected bool, received 1"),
        ({"count": 1, "label": 4}, r"\[t.label\] expected str, received 4"),
        ({"count": 1, "kind": "c"}, r"\[t.kind\] must be one of 'a', 'b', received 'c'"),
        ({"count": 1, "kind": ["a"]}, r"\[t.kind\] must be one of 'a', 'b'"),
        (
            {"count": 1, "inner": {"plaec": "p"}},
            r"\[t.inner\] unknown key 'plaec': did you mean 'pl",
        ),
        ({"count": 1, "inner": "p"}, r"\[t.inner\] expected a table, received 'p'"),
        ({"count": 1, "rows": {"place": "p"}}, r"\[t.rows\] expected a list, received \{'place'"),
        ({"count": 1, "rows": [{"place": "p"}, {}]}, r"\[t.rows\[1\]\] key 'place' is missing"),
        ({"count": 1, "rows": [{"place": 7}]}, r"\[t.rows\[0\].place\] expected str, received 7"),
        ({"count": 1, "span": [1.0]}, r"\[t.span\] expected a list of 2, received \[1.0\]"),
        ({"count": 1, "span": [1.0, "x"]}, r"\[t.span\[1\]\] expected float, received 'x'"),
        ({"count": 1, "by_name": {"pmu": "x"}}, r"\[t.by_name.pmu\] expected float"),
        ({"count": 1, "either": 1.5}, r"\[t.either\] expected int or str, received 1.5"),
        ({"count": 1, "by_name": [1]}, r"\[t.by_name\] expected a table, received \[1\]"),
    ],
)
def test_message_names_the_key_what_is_allowed_and_what_came(
    data: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ParameterError, match=expected):
        build(Outer, data, "t")


def test_table_must_be_a_table() -> None:
    with pytest.raises(ParameterError, match=r"\[align\] expected a table, received 5"):
        build(AlignParams, 5, "align")  # type: ignore[arg-type]


def test_parameters_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        build(Outer, {"count": 1}, "t").count = 2  # type: ignore[misc]


def test_method_of_a_case_file_is_built_and_a_misspelt_filter_refused() -> None:
    data = {"methods": [{"name": "kf", "filter": "kalman", "noise": "scalar", "variance": 1}]}
    built = build(EstimateParams, data, "estimate").methods[0]
    assert built == Method.of("kf", "kalman", noise="scalar", variance=1.0)
    data["methods"][0]["filter"] = "kallman"
    with pytest.raises(ParameterError, match=r"methods\[0\]\] filter .*'kalman'.*'kallman'"):
        build(EstimateParams, data, "estimate")


def test_choices_are_spelt_out() -> None:
    with pytest.raises(ParameterError, match=r"expected 'optimal' or 'scan' or float, received 'b"):
        build(Rule, {"k": "best"}, "validate.rules[0]")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"name": " "}, "name is empty"),
        ({"noise": "scalar", "variance": 0.0}, r"variance > 0 .* received 0.0 and None"),
        ({"noise": "scalar", "variance": float("inf")}, r"variance > 0 .* received inf"),
        ({"source_sigma": -0.1}, r"source_sigma ≥ 0, .* received None and -0.1"),
        ({"source_sigma": float("inf")}, r"source_sigma ≥ 0, .* and inf"),
        (
            {"filter": "ukf", "compose": {"passes": 3}},
            r"compose\.passes has no effect here.*\"ekf\"",
        ),
        (
            {"filter": "ekf", "compose": {"scaling": "moments"}},
            r"compose\.scaling has no effect here.*\"ukf\"",
        ),
        (
            {"filter": "ekf", "compose": {"form": "square_root"}},
            r"compose\.form has no effect here.*\"ukf\"",
        ),
    ],
)
def test_numbers_and_parts_that_a_method_cannot_use_are_refused(
    change: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ParameterError, match=expected):
        build(Method, {"name": "m", "filter": "kalman", **change}, "estimate.methods[0]")


@dataclass(frozen=True)
class Limits:
    """Numbers of which some may be infinite."""

    upper: Unbounded = float("inf")
    span: tuple[Unbounded, Unbounded] = (0.0, 1.0)
    ages: dict[str, Unbounded] = field(default_factory=dict)
    maybe: Unbounded | None = None
    share: float = 0.5
    pair: tuple[float, float] = (0.0, 1.0)
    by_name: dict[str, float] = field(default_factory=dict)
    sign: Literal[1, -1] = 1
    text: str = ""
    ratio: float = 1.0

    def __post_init__(self) -> None:
        _ = 10.0**self.ratio  # overflows where the ratio is large


INFINITE = float("inf")


@pytest.mark.parametrize(
    "data",
    [
        {"upper": INFINITE, "span": [-INFINITE, INFINITE], "maybe": INFINITE},
        {"ages": {"pmu": INFINITE}},
        {"share": 0, "pair": [1e12, -1e12], "by_name": {"a": 1e-30}},
        {"sign": -1, "text": "<script> | =cmd() é"},
    ],
)
def test_numbers_of_any_credible_size_are_taken(data: dict[str, Any]) -> None:
    assert build(Limits, data, "t") is not None


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"share": INFINITE}, r"\[t.share\] expected a finite number, .* received inf"),
        ({"pair": [0.0, -INFINITE]}, r"\[t.pair\] expected a finite number, .* received -inf"),
        ({"by_name": {"a": 1e300}}, r"\[t.by_name\] expected a finite .* 1e.300: check its unit"),
        ({"share": 1e-300}, r"\[t.share\] expected a finite number, 0 or 1e-30 … 1e\+12"),
        ({"upper": float("nan")}, r"\[t.upper\] expected a number, received nan"),
        ({"upper": 1e300}, r"\[t.upper\] expected a finite number, .* received 1e.300"),
        ({"share": 2**63}, r"\[t.share\] expected a whole number of 64 bits, received one of 64"),
        ({"sign": True}, r"\[t.sign\] must be one of 1, -1, received True"),
        ({"sign": 1.0}, r"\[t.sign\] must be one of 1, -1, received 1.0"),
        ({"sign": []}, r"\[t.sign\] must be one of 1, -1, received \[\]"),
        ({"text": "a\x1b[2J"}, r"a text of one line without control characters, received 'a.x1b"),
        ({"text": "a" * 10 + "\n"}, r"a text of one line"),
        ({"text": ["a" * 500]}, r"expected str, received \['a{195,200}…"),
        ({"ratio": 1e9}, r"\[t\] these values cannot be computed with \(.*check their sizes"),
        ({"ratio": INFINITE}, r"\[t.ratio\] expected a finite number"),
    ],
)
def test_numbers_and_texts_that_no_study_has_are_refused(
    data: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ParameterError, match=expected):
        build(Limits, data, "t")


# --- study ----------------------------------------------------------------------------------------

START = datetime(2016, 6, 9, tzinfo=UTC)
STUDY = {"start": START, "end": START + timedelta(hours=1), "step_s": 300}


def test_history_begins_before_the_study() -> None:
    study = build(Study, {**STUDY, "history_s": 7200}, "study")
    assert study.history_start == datetime(2016, 6, 8, 22, tzinfo=UTC)


def test_another_zone_is_the_same_instant() -> None:
    local = START.astimezone(timezone(timedelta(hours=7)))
    assert build(Study, {**STUDY, "start": local}, "study").start == START


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"start": datetime(2016, 6, 9)}, r"start has no time zone: expected UTC.*append 'Z'"),
        ({"start": date(2016, 6, 9)}, r"\[study.start\] expected datetime"),
        ({"start": "2016-06-09T00:00:00Z"}, r"\[study.start\] expected datetime, received '2016"),
        ({"end": START}, r"end must lie after start, received 2016-06-09"),
        ({"step_s": 0}, r"step_s > 0 .* received step_s = 0.0"),
        ({"step_s": 1e-7}, r"step_s"),
        ({"history_s": 1e12}, r"history_s = 1e\+12 reaches back beyond the calendar"),
        ({"history_s": -1}, r"history_s ≥ 0, received .*history_s = -1.0"),
        ({"step_s": float("inf")}, r"finite step_s > 0 .*received step_s = inf"),
        (
            {"step_s": 10**400},
            r"\[study.step_s\] expected a whole number of 64 bits, .* of 1329",
        ),
        ({"step_s": []}, r"\[study.step_s\] expected float, received \[\]"),
        ({"step_s": {"s": 300}}, r"\[study.step_s\] expected float, received \{'s': 300\}"),
        ({"step_s": True}, r"\[study.step_s\] expected float, received True"),
        ({"step_s": 1e-5}, r"more than 10000000 instants: raise step_s, or study a part at a time"),
        ({"start": datetime(1, 1, 1, tzinfo=UTC)}, r"more than 10000000 instants|1900 … 2200"),
        (
            {
                "start": datetime(9999, 12, 31, tzinfo=UTC),
                "end": datetime(9999, 12, 31, 1, tzinfo=UTC),
            },
            r"expected start and end in the years 1900 … 2200",
        ),
    ],
)
def test_impossible_study_is_refused(change: dict[str, Any], expected: str) -> None:
    with pytest.raises(PseError, match=expected):
        build(Study, {**STUDY, **change}, "study")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_step_and_history_must_be_finite_without_a_case_file_too(value: float) -> None:
    with pytest.raises(ParameterError, match="step_s"):
        Study(START, START + timedelta(hours=1), value)
    with pytest.raises(ParameterError, match="history_s"):
        Study(START, START + timedelta(hours=1), 300.0, value)
