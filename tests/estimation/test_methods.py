"""Claim: every key of a method changes what it does or is refused, and anyone may add a method."""

from __future__ import annotations

import dataclasses
import math
import re
import sys
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.endurance import tiny_case

from pse_analysis import parameters
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.estimation import (
    Estimate,
    Estimated,
    EstimateParams,
    Estimator,
    Info,
    Method,
    Record,
    Setting,
    Snapshot,
    estimate,
    variants,
)
from pse_analysis.estimation.core.run import ConsistencyParams, consistent
from pse_analysis.estimation.methods import GROUP, KINDS
from pse_analysis.grid import power_flow
from pse_analysis.machine import Machine
from pse_analysis.measurement import MeasurementModel, SensorLayout
from pse_analysis.pipeline.fingerprint import BUILT_IN, ESTIMATORS, digest_installed
from pse_analysis.vocabulary import Status

SEED = 1214
HISTORY, STEPS = 36, 22
SLIGHT, STUCK, JUMP, ABSURD, SILENT = 1, slice(2, 6), 6, slice(14, 18), 19
"""When a meter errs a little, when one is stuck, when a load jumps, when all
meters are absurd, and when none reports."""

CONTEXTS: tuple[dict[str, Any], ...] = (
    {"filter": "wls"},
    {"filter": "wls", "screening": "scaled"},
    {"filter": "kalman"},
    {"filter": "kalman", "noise": "scalar", "compose": {"process": "holt"}},
    {"filter": "kalman", "noise": "innovation"},
    {"filter": "kalman", "screening": "innovation", "noise": "scalar", "variance": 1e-4},
    {"filter": "kalman", "reading": "instant"},
    {"filter": "ukf", "screening": "innovation", "noise": "scalar", "variance": 1e-4},
    {"filter": "ukf", "noise": "scalar", "compose": {"process": "local_trend"}},
    {"filter": "ukf", "compose": {"scaling": "moments", "learning": "sage_husa"}},
    {"filter": "ukf", "compose": {"scaling": "likelihood"}},
    {"filter": "ukf", "noise": "scalar", "compose": {"robustness": "trace"}},
    {"filter": "ekf"},
    {
        "filter": "ekf",
        "noise": "scalar",
        "compose": {"robustness": "per_channel", "process": "holt"},
    },
    {"filter": "ekf", "compose": {"robustness": "per_channel", "protected": False}},
)
"""Methods to which every key is added in turn; together they have every part."""

OTHERS: dict[str, tuple[Any, ...]] = {
    "variance": (1e-3,),
    "source_sigma": (0.02,),
    "tolerance": (0.01,),
    "confidence": (0.51, 0.01, 0.999999),
    "max_iterations": (1,),
    "window": (3.0, 9),
    "slot_s": (7200.0,),
    "bandwidth_s": (600.0,),
    "lowest": (0.9999,),
    "doubt": (1.01, math.inf),
    "lone": (1.5, math.inf),
    "bias": (3.0, math.inf),
    "highest": (1.001,),
    "patience": (1, 9),
    "share": (0.9,),
    "factor": (0.5, 2.0, 15.0),
    "decay": (0.1,),
    "release": (4, 10),
    "sigma_factor": (9.0,),
    "forecast_inflation": (1.0, 50.0),
    "alone": (0.0, 1000.0),
    "certain": (4.0, 1000.0),
    "largest_share": (0.01,),
    "passes": (5,),
    "forgetting": (0.6,),
    "alpha": (0.5,),
    "beta": (0.3,),
    "kappa": (2.0,),
    "as_printed": (True,),
    "absurd": (1.0, 10.0, float("inf")),
    "protected": (False,),
    "smooth": (True,),
    "steps": (1, 20),
    "ratio": ((0.0, 1e9), (0.999, 1.001)),
    "ahead": ((1, 3),),
}
"""What each key of a number is changed to; of a name, every other one is tried."""


@cache
def probe() -> tuple[Setting, Record]:
    """History and study of a grid of four buses, with all that a part of a method acts on.

    Loads walk, meters of power report every second instant and late, one meter is stuck for a
    while, a load jumps, some whole snapshots are absurd and one is silent.
    """
    rng = np.random.default_rng(SEED)
    grid, about = tiny_case.network(), tiny_case.channel_table()
    layout = SensorLayout.from_channels(about, grid)
    count, m = HISTORY + STEPS, len(layout)
    level = 1.0 + np.cumsum(rng.normal(0.0, 0.03, (grid.n_bus, count)), axis=1)
    level[3, HISTORY + JUMP :] += 3.0
    p, q = grid.p_nominal_pu[:, None] * level, grid.q_nominal_pu[:, None] * level
    exact = MeasurementModel(grid, layout).h(power_flow.solve(grid, p, q).x)
    sigma = layout.sigma_pu(np.abs(exact).mean(axis=1))
    z = (exact + sigma[:, None] * rng.normal(size=exact.shape)).T
    slow = np.asarray(layout.source) == "ami"
    fresh = np.ones((count, m), dtype=bool)
    fresh[np.arange(count) % 2 != 0] = ~slow
    age = np.where(slow, 90.0 + tiny_case.STEP_S * (np.arange(count) % 2)[:, None], 0.0)
    for k in range(1, count):
        z[k] = np.where(fresh[k], z[k], z[k - 1])
    available = np.ones((count, m), dtype=bool)
    study = HISTORY
    one, other = (list(layout.channel).index(name) for name in ("U3", "U1"))
    z[study + SLIGHT, other] += 7.0 * sigma[other]
    z[study + STUCK.start : study + STUCK.stop, one] = 1.2
    z[study + ABSURD.start : study + ABSURD.stop] *= 3.0
    available[study + SILENT] = False
    old = 0.02 * np.sqrt(age / tiny_case.STEP_S) * np.abs(z).clip(1e-3)
    start = np.datetime64(tiny_case.START.replace(tzinfo=None), "us")
    step = np.timedelta64(round(tiny_case.STEP_S * 1e6), "us")
    whole = Record(
        start + step * np.arange(-HISTORY, STEPS),
        z,
        np.hypot(sigma, old),
        old,
        available,
        fresh & available,
        age,
    )
    return Setting(grid, layout, tiny_case.STUDY, whole.between(None, start)), whole.between(
        start, None
    )


def result(data: Mapping[str, Any]) -> Estimated:
    """What a method makes of the probe."""
    setting, studied = probe()
    method = Method.of("m", **data)
    return variants.run(
        method.estimator(setting),
        list(studied.snapshots()),
        setting.model,
        setting.layout,
        smooth=getattr(method, "smooth", False),
        ahead=getattr(method, "ahead", ()),
        consistency=getattr(method, "consistency", None),
    )


def same(one: Estimated, other: Estimated) -> bool:
    """Whether two results agree to the last bit, but for the time that they took."""
    return all(
        a.drop(columns="seconds", errors="ignore").equals(
            b.drop(columns="seconds", errors="ignore")
        )
        for a, b in (
            (getattr(one, name), getattr(other, name))
            for name in ("estimated", "residuals", "steps")
        )
    )


def keys(cls: type, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every key of a class of parameters with values to try, those of its tables included."""
    hints = typing.get_type_hints(cls)
    for one in dataclasses.fields(cls):
        if not place and one.name in ("name", "filter", "variant"):
            continue
        hint = hints[one.name]
        if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
            (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
        here = (*place, one.name)
        if dataclasses.is_dataclass(hint):
            yield from keys(typing.cast(type, hint), here)
        elif typing.get_origin(hint) is typing.Literal:
            yield from ((here, value) for value in typing.get_args(hint))
        else:
            yield from ((here, value) for value in OTHERS[one.name])


def with_key(data: Mapping[str, Any], place: tuple[str, ...], value: Any) -> dict[str, Any]:
    """A method's table with one key more."""
    head, *rest = place
    inner = with_key(data.get(head, {}), tuple(rest), value) if rest else value
    return {**data, head: inner}


def spelt(data: Mapping[str, Any]) -> str:
    """A context as an identifier of a test."""
    compose = data.get("compose", {})
    return "-".join(str(v) for v in (*data.values(), *compose.values()) if not isinstance(v, dict))


@pytest.mark.parametrize("context", CONTEXTS, ids=spelt)
def test_every_key_changes_the_estimate_or_is_refused(context: dict[str, Any]) -> None:
    base = result(context)
    assert same(base, result(context))
    tried: dict[tuple[str, ...], bool] = {}
    for cls in (KINDS["wls"], KINDS["kalman"], KINDS["ukf"], KINDS["ekf"]):
        for place, value in keys(cls):
            changed = with_key(context, place, value)
            if changed == context or tried.get(place, False):
                continue
            try:
                moved = not same(base, result(changed))
            except ParameterError:
                moved = True
            tried[place] = moved
    for place in [place for place in tried if place[0] == "consistency"]:
        # Whether a sum of NIS passes a bound is chance; see the test of the bounds below.
        tried[place] = True
    judges = context.get("compose", {}).get("robustness", "none") != "none"
    if context.get("screening") == "innovation":
        # What the test refuses does not contradict the forecast any more, so none waits for that.
        tried["restart", "patience"] = True
    if context.get("screening") == "innovation" or judges:
        tried["restart", "doubt"] = tried["restart", "lone"] = True
    idle = [".".join(place) for place, moved in tried.items() if not moved]
    assert not idle


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"filter": "ukf", "reading": "instant"}, 'reading has no effect with filter = .ukf.*"kal'),
        ({"filter": "kalman", "variance": 1e-5}, 'variance has no effect here.*noise = "scalar"'),
        (
            {"filter": "ekf", "noise": "scalar", "source_sigma": 1e-3},
            'source_sigma has no effect here.*noise = "load"',
        ),
        (
            {"filter": "ukf", "compose": {"holt": {"alpha": 0.5}}},
            'compose.holt has no effect here.*process = "holt"',
        ),
        ({"filter": "ekf", "compose": {"form": "square_root"}}, 'compose.form .*filter = "ukf"'),
        ({"filter": "wls", "innovation_test": {}}, "innovation_test has no effect with filter"),
        ({"filter": "wls", "adaptive_threshold": {}}, "adaptive_threshold has no effect here"),
        (
            {
                "filter": "wls",
                "screening": "scaled",
                "adaptive_threshold": {"threshold": "literal"},
            },
            "say it as screening",
        ),
        (
            {"filter": "ukf", "screening": "innovation", "compose": {"robustness": "trace"}},
            'screening = "innovation" has no effect here.*robustness = "none"',
        ),
        ({"filter": "lstm"}, "filter must be one of 'wls', .*'observer'.*entry point"),
        ({"filter": 3}, "'filter' is missing"),
        ({"filter": "wls", "tolerance": 0.0}, "expected 0 < tolerance ≤ 0.01"),
        ({"filter": "kalman", "history": {"slot_s": 1.0}}, "expected slot_s in 60"),
    ],
)
def test_a_key_in_vain_is_refused_with_what_it_needs(data: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        parameters.build(EstimateParams, {"methods": [{"name": "m", **data}]}, "estimate")


@pytest.mark.parametrize(
    ("change", "inconsistent"),
    [
        ({}, [3, 4]),
        ({"steps": 1}, [3]),
        ({"ratio": (0.5, 7.0)}, []),
        ({"confidence": 1.0 - 1e-9}, []),
    ],
)
def test_bounds_of_consistency_are_those_of_the_case_file(
    change: dict[str, Any], inconsistent: list[int]
) -> None:
    """By hand: 99.95 % of χ² lie below 31.4 for 10 measurements, and below 47.5 for 20."""
    nis, dof = np.array([10.0, 10.0, 10.0, 50.0, 30.0]), np.full(5, 10)
    good = consistent(nis, dof, ConsistencyParams(**{"steps": 2, **change}))
    assert np.flatnonzero(~good).tolist() == inconsistent
    assert Method.of("f", "ekf", consistency=change).consistency == ConsistencyParams(**change)


def test_keys_of_an_observer_change_what_it_is() -> None:
    machine = Machine(200.0, 6.4, 0.032, u_kv=13.8)
    study = dataclasses.replace(tiny_case.STUDY, step_s=0.01)
    setting = Setting(machine, probe()[0].layout, study, probe()[1])
    base = {"q": (5.0, 5.0), "r": 1.0}
    others = {
        "q": {"q": (50.0, 5.0)},
        "r": {"r": 2.0},
        "poles": {
            **{"q": None, "r": None, "poles": (-20.0, -25.0)},
            **{"belief_q": (5.0, 5.0), "belief_r": 1.0},
        },
        "belief": {"belief_q": (0.1, 0.1), "belief_r": 0.01},
        "gain": {"gain": "recursive"},
        "start": {"start": (0.1, 0.0)},
        "start_sigma": {"start_sigma": (1.0, 1.0)},
    }
    seen = []
    for change in ({}, *others.values()):
        method = Method.of("o", "observer", observer={**base, **change})
        estimator = method.estimator(setting)
        state, _ = estimator.init(reading(0))
        for k in range(1, 6):
            state, _ = estimator.step(state, reading(k))
        found = estimator.read(state)
        assert found is not None
        seen.append(np.concatenate([found.x, found.covariance.ravel()]).tobytes())
    assert len(set(seen)) == len(seen)


def reading(k: int) -> Snapshot:
    """A measured angle of a machine and its known input."""
    angle = 0.5 + 0.1 * np.sin(0.3 * k)
    one = np.ones(1, dtype=bool)
    return Snapshot(
        np.datetime64("2016-06-09T00:00:00", "us") + np.timedelta64(10_000 * k, "us"),
        np.array([angle]),
        np.array([0.01]),
        np.zeros(1),
        one,
        one,
        np.zeros(1),
        inputs=np.array([0.2]),
    )


GUIDE = (Path(__file__).parents[2] / "docs" / "methods.md").read_text(encoding="utf-8")
FENCES = re.findall(r"^```(\w+)\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
(TOY,) = (text for kind, text in FENCES if kind == "python")
"""The example of the guide: a method of one's own."""


def test_methods_of_the_guide_are_accepted() -> None:
    tables = [tomllib.loads(text) for kind, text in FENCES if kind == "toml"]
    (section,) = (table for table in tables if "methods" in table)
    names = [m.names for m in parameters.build(EstimateParams, section, "estimate").methods]
    assert names[0] == ("kf", "kf_smoothed", "kf_ahead_1", "kf_ahead_3", "kf_ahead_12")
    (project,) = (table["project"] for table in tables if "project" in table)
    assert list(project["entry-points"]) == [GROUP]


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package with an estimator, installed as pip would."""
    (tmp_path / "toy_estimator.py").write_text(TOY, encoding="utf-8")
    about = tmp_path / "toy_estimator-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-estimator\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        f"[{GROUP}]\nmean_voltage = toy_estimator:MeanVoltage\nbroken = toy_estimator:Nothing\n"
        "no_method = toy_estimator:TOY\n".replace("TOY", "np")
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path / "toy_estimator.py"
    sys.modules.pop("toy_estimator", None)


def test_an_installed_package_adds_a_method_to_case_files(toy: Path) -> None:
    section = {"methods": [{"name": "mean", "filter": "mean_voltage", "offset": 0.5}]}
    (method,) = parameters.build(EstimateParams, section, "estimate").methods
    run_ = tiny_case.plain_run()
    found = estimate(run_.aligned, run_.raw.channels, run_.raw.model, tiny_case.STUDY, method)
    vm = found.estimated[found.estimated["quantity"] == "vm_pu"]["value"]
    assert (vm.between(1.4, 1.6)).all()
    assert set(found.steps["status"]) == {"ok"}
    # Its keys are checked like those of any other.
    section["methods"][0]["ofset"] = 0.5
    with pytest.raises(ParameterError, match="unknown key 'ofset': did you mean 'offset'"):
        parameters.build(EstimateParams, section, "estimate")


def test_what_an_installed_package_does_not_keep_is_told(toy: Path) -> None:
    with pytest.raises(ParameterError, match=r"cannot be loaded .AttributeError"):
        Method.of("m", "broken")
    with pytest.raises(ParameterError, match=r"no subclass of pse_analysis\.estimation\.Method"):
        Method.of("m", "no_method")


def test_fingerprint_follows_the_code_of_an_installed_package(toy: Path) -> None:
    assert not digest_installed(["wls", "nowhere"])
    before = digest_installed(["wls", "mean_voltage"])
    assert len(before) == 1
    toy.write_text(TOY.replace("offset: float = 0.0", "offset: float = 0.1"), encoding="utf-8")
    assert digest_installed(["mean_voltage"]) != before
    assert "toy_estimator" not in sys.modules


def test_names_that_need_no_look_at_installed_packages_are_those_of_this_one() -> None:
    assert frozenset(KINDS) == BUILT_IN
    assert ESTIMATORS == GROUP


def test_a_function_makes_an_estimator_of_ones_own() -> None:
    run_ = tiny_case.plain_run()

    def rated(setting: Setting) -> Estimator:
        n, m = setting.network.n_bus, len(setting.layout)
        made = Estimate(np.repeat([0.0, 1.0], n), np.eye(2 * n))
        info = Info.nothing(m, Status.OK)
        return Estimator("rated", lambda _: (made, info), lambda s, _: (s, info), lambda s: s)

    found = estimate(run_.aligned, run_.raw.channels, run_.raw.model, tiny_case.STUDY, rated)
    assert set(found.steps["method"]) == {"rated"}
    assert set(found.estimated["value"]) == {0.0, 1.0}
    nowhere = run_.aligned[run_.aligned["trial"] > 0]
    with pytest.raises(TableError, match="method 'rated' reads variant 'last'"):
        estimate(nowhere, run_.raw.channels, run_.raw.model, tiny_case.STUDY, rated)
