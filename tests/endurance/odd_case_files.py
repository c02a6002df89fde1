"""Case files as hands and editors leave them: odd texts, and odd values in sound texts."""

from __future__ import annotations

import atexit
import copy
import shutil
import tempfile
import tomllib
from collections.abc import Callable
from datetime import UTC, date, datetime
from functools import cache
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from pse_analysis.grid import library
from pse_analysis.pipeline.case import load_case
from pse_analysis.pipeline.stages import Parameters, check_case
from pse_analysis.simulation import (
    MachineSimulateParams,
    SimulateParams,
    profiles,
    simulate,
    simulate_machine,
    simulate_series,
)
from pse_analysis.telemetry import RawCase
from pse_analysis.vocabulary import check

ROOT = Path(__file__).parents[2]
CASES = (
    ROOT / "tests" / "cases" / "small.toml",
    *(
        ROOT / "pipelines" / "cases" / f"{name}.toml"
        for name in ("machine", "industrial_load", "ieee33", "qi2025")
    ),
)

PIECES = (
    *("[", "]", "[[", "{", "}", "=", '"', "'", '"""', ",", "#", "\n", "\r\n", "\t", "\x00", "\x1b"),
    *("nan", "inf", "-inf", "1e400", "-1", "0", "0x10", "1_000", "1e-320", "true", "[]", "{}"),
    *(
        "9" * 25,
        "9" * 5000,
        "[" * 600,
        "{a=" * 200,
        "2016-06-09",
        "08:00:00",
        "2016-06-09T00:00:00",
    ),
    *('""', "''", '"\\u0000"', '"\\n"', '"../../etc"', '"<script>"', '"=cmd()"', "é", "\ufeff"),
    *("[study]", "[simulate]", "seed = 1", "[a.b.c]", "grid = 1", "[[estimate.methods]]"),
)
"""What a hand may insert into a text."""

Edit = tuple[str, int, int]
TEXTS = st.tuples(
    st.integers(0, len(CASES) - 1),
    st.lists(
        st.tuples(
            st.sampled_from(["insert", "delete", "cut", "twice", "line", "bytes"]),
            st.integers(0, 12_000),
            st.integers(0, len(PIECES) - 1),
        ),
        min_size=1,
        max_size=4,
    ),
)
"""A case file, and edits of its text."""

EDITS: dict[str, Callable[[bytes, int, bytes], bytes]] = {
    "insert": lambda text, at, piece: text[:at] + piece + text[at:],
    "delete": lambda text, at, piece: text[:at] + text[at + len(piece) :],
    "cut": lambda text, at, _piece: text[:at],
    "twice": lambda text, at, _piece: text[:at] + text[at // 2 :],
    "line": lambda text, at, piece: _line(text, at, piece),
    "bytes": lambda text, at, _piece: text[:at] + b"\xff\xfe" + text[at:],
}


def _line(text: bytes, at: int, piece: bytes) -> bytes:
    """A line's value replaced."""
    lines = text.split(b"\n")
    key, equal, _ = lines[at % len(lines)].partition(b"=")
    lines[at % len(lines)] = key + equal + piece
    return b"\n".join(lines)


@cache
def _folder() -> Path:
    """A folder of this process."""
    folder = Path(tempfile.mkdtemp(prefix="pse_cases_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _load(text: bytes) -> Parameters:
    (_folder() / "odd.toml").write_bytes(text)
    return check_case(load_case("odd", _folder()))


def read_text(drawn: tuple[int, list[Edit]]) -> None:
    """Read an edited text."""
    number, edits = drawn
    text = CASES[number].read_bytes()
    for name, at, piece in edits:
        text = EDITS[name](text, at % (len(text) + 1), PIECES[piece].encode())
    _load(text)


# --------------------------------------------------------------------------------------------------
# Odd values
# --------------------------------------------------------------------------------------------------

VALUES_OF_KEYS: tuple[Any, ...] = (
    *(
        float("inf"),
        float("-inf"),
        float("nan"),
        0,
        1,
        -1,
        0.5,
        2,
        1e300,
        -1e300,
        1e-300,
        1e-7,
        1e9,
    ),
    *(
        10**30,
        2**63,
        -(10**400),
        True,
        False,
        "",
        "text",
        "\x00",
        "a\nb",
        "<script>|=cmd()",
        "é" * 300,
    ),
    *(
        [],
        [[]],
        [1],
        [1, 2],
        [2, 1],
        [float("inf")] * 2,
        [0.0, float("inf")],
        [1] * 400,
        ["a", 1],
        {},
    ),
    *({"a": 1}, {"a": {"b": {}}}, date(2016, 6, 9), datetime(2016, 6, 9), datetime(1, 1, 1)),
    *(datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC), datetime(2016, 6, 9, 6, tzinfo=UTC)),
    *(datetime(1, 1, 1, tzinfo=UTC), "bus/1", "buses", "wls", "kalman", "vm_pu", "pmu", "relative"),
)
LIKE, ANY, NONE = range(3)
VALUES = st.tuples(
    st.sampled_from([*range(len(CASES)), *[len(CASES)] * 5]),
    st.lists(
        st.tuples(
            st.integers(0, 400),
            st.integers(0, len(VALUES_OF_KEYS) - 1),
            st.sampled_from([LIKE, LIKE, LIKE, ANY, NONE]),
        ),
        min_size=1,
        max_size=3,
    ),
    st.integers(0, 9),
)
"""A case, which keys get which values (like theirs, any, or none), and whether it is run."""

TINY = {
    "title": "An hour of 14 buses",
    "grid": "ieee14",
    "study": {
        "start": datetime(2016, 6, 9, 6, tzinfo=UTC),
        "end": datetime(2016, 6, 9, 6, 30, tzinfo=UTC),
        "step_s": 300,
        "history_s": 1800,
    },
    "simulate": {
        "seed": 14,
        "trials": 1,
        "truth_step_s": 300,
        "load": {"per_bus": 3, "concentration": 2.0, "level": 0.6, "rho1": 0.1, "window": 8},
        "load_steps": {"per_day": 20, "size": [0.1, 0.3], "duration_s": [600, 900], "at": []},
        "source_voltage": {"sigma_pu": 0.002, "time_constant_s": 1800, "taps_per_day": 4},
        "sensors": [
            {
                "source": "pmu",
                "quantities": ["vm_pu", "va_degree"],
                "at": ["buses"],
                "sigma": 0.002,
                "period_s": 300,
                "phase_s": 0,
                "delay_s": 1,
                "jitter_s": 1,
                "wander_s": 1,
                "limits": {"vm_pu": [0.8, 1.2]},
            },
            {
                "source": "ami",
                "quantities": ["p_mw", "q_mvar"],
                "at": ["loads"],
                "sigma": 0.02,
                "sigma_kind": "relative",
                "period_s": 900,
                "aggregation": "mean",
                "limit_factor": 3,
                "sign": -1,
            },
        ],
        "faults": [
            {"kind": "spike", "rate": 0.01, "size": [20.0, 40.0], "relative": False},
            {"kind": "delayed", "rate": 0.01, "size": [20.0, 40.0]},
            {"kind": "stale", "rate": 0.01, "size": [20.0, 900.0]},
            {"kind": "duplicated", "rate": 0.01, "size": [1.0, 2.0]},
        ],
    },
    "validate": {"rules": [{"quantity": "vm_pu", "quantile": 4.0, "late_s": 60.0}]},
    "align": {"latency_s": 0, "default_max_age_s": 3600, "growth": "history"},
    "estimate": {"methods": [{"name": "wls", "filter": "wls"}]},
    "score": {"by_hour": True},
}
"""A case that is simulated in a moment."""


def _places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all values in a case, tables and lists among them."""
    found = [path] if path else []
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        if isinstance(value, dict | list):
            found += _places(value, (*path, key))
        else:
            found.append((*path, key))
    return found


def _alike(value: Any) -> list[Any]:
    """Odd values of the kind that a value has."""
    kinds = ((bool,), (int, float), (str,), (list,), (dict,), (date,))
    kind = next((kind for kind in kinds if isinstance(value, kind)), (object,))
    return [odd for odd in VALUES_OF_KEYS if isinstance(odd, kind)]


def changed(data: dict[str, Any], changes: list[tuple[int, int, int]]) -> dict[str, Any]:
    """The tables of a case after some of their values have changed."""
    for at, value, way in changes:
        places = _places(data)
        if not places:
            break
        *above, key = places[at % len(places)]
        inner: Any = data
        for step in above:
            inner = inner[step]
        if way == NONE:
            del inner[key]
            continue
        choice = _alike(inner[key]) if way == LIKE else VALUES_OF_KEYS
        inner[key] = copy.deepcopy(choice[value % len(choice)])
    return data


def dumped(value: Any) -> str:
    """A value as TOML, tables inline."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = "".join(
            c if c.isprintable() and c not in '"\\' else f"\\u{ord(c):04x}" for c in value
        )
        return f'"{escaped}"'
    if isinstance(value, list):
        return f"[{', '.join(map(dumped, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{dumped(str(k))} = {dumped(v)}" for k, v in value.items()) + "}"
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, int) and abs(value) > 10**4000:
        return "9" * 5000
    return repr(value)


def read_values(drawn: tuple[int, list[tuple[int, int, int]], int]) -> None:
    """Read a case with odd values; of the tiny one half of what is accepted is simulated."""
    number, changes, run = drawn
    tiny = number == len(CASES)
    data = (
        tomllib.loads(dumped_file(TINY))
        if tiny
        else tomllib.loads(CASES[number].read_text("utf-8"))
    )
    parameters = _load(dumped_file(changed(data, changes)).encode())
    if tiny and run % 2 == 0:
        _simulate(parameters, data)


def dumped_file(data: dict[str, Any]) -> str:
    """A case as TOML, a line for each table."""
    return "".join(f"{dumped(key)} = {dumped(value)}\n" for key, value in data.items())


@cache
def _curves() -> Any:
    return profiles.load(ROOT / "data" / "raw" / "load_profiles")


def _simulate(parameters: Parameters, data: dict[str, Any]) -> None:
    """Simulate an accepted case, and check what is made."""
    params, raw = parameters.simulate, None
    if isinstance(params, SimulateParams):
        raw = simulate(library.load(data["grid"]), _curves(), parameters.study, params)
    elif isinstance(params, MachineSimulateParams):
        assert parameters.machine is not None
        raw = simulate_machine(parameters.machine, parameters.study, params)
    elif params is not None:
        raw = simulate_series(_curves(), parameters.study, params)
    if isinstance(raw, RawCase):
        check("telemetry", raw.telemetry)
        check("faults", raw.faults)
