"""Claim: bridged load curves pass through the real points and move in between as stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pse_analysis.errors import ParameterError, TableError
from pse_analysis.simulation import profiles

SEED = 20160606
FOLDER = Path(__file__).parents[2] / "data" / "raw" / "load_profiles"


def lag1(increments: np.ndarray) -> float:
    return float(np.mean(increments[:, 1:] * increments[:, :-1]) / np.mean(increments**2))


def random_points(rng: np.random.Generator, rho1: float, n: int, intervals: int, k: int):
    """Points of AR(1)-increment walks whose increments per interval have variance 1."""
    burn = 50
    normal = rng.standard_normal((n, burn + intervals * k))
    step = np.zeros_like(normal)
    for j in range(1, normal.shape[1]):
        step[:, j] = rho1 * step[:, j - 1] + np.sqrt(1 - rho1**2) * normal[:, j]
    step = step[:, burn:] * np.sqrt(profiles.step_variance(k, rho1))
    return np.pad(np.cumsum(step, axis=1), ((0, 0), (1, 0)))[:, ::k]


def test_the_extract_is_a_week_of_quarter_hours():
    frame = profiles.load(FOLDER)
    assert len(frame) == 7 * 96 + 1
    assert str(frame.index[0]) == "2016-06-05 22:00:00+00:00"
    assert str(frame.index[0].tz_convert("Europe/Berlin").day_name()) == "Monday"
    loads = frame.filter(like="_pload")
    assert loads.shape[1] >= 20
    assert (loads > 0).all(axis=None)
    assert (loads <= 1).all(axis=None)
    noon = frame.filter(like="PV").between_time("10:00", "12:00").mean().mean()
    assert noon > 0.2
    assert frame.filter(like="PV").between_time("22:00", "01:00").to_numpy().max() == 0
    assert sum(f.stat().st_size for f in FOLDER.glob("*.parquet")) < 300_000


@pytest.mark.parametrize("scale", ["linear", "log", "nonnegative"])
@pytest.mark.parametrize("rho1", [0.0, 0.5])
def test_a_path_hits_every_point_exactly(scale: str, rho1: float):
    rng = np.random.default_rng(SEED)
    points = rng.uniform(0.2, 1.0, (3, 11))
    path = profiles.bridge(points, rng.standard_normal((3, 150)), rho1=rho1, scale=scale)
    assert path.shape == (3, 151)
    np.testing.assert_array_equal(path[:, ::15], points)


@pytest.mark.parametrize("rho1", [0.0, 0.5, -0.3])
def test_increments_have_the_stated_variance_and_autocorrelation(rho1: float):
    rng = np.random.default_rng(SEED)
    n, intervals, k = 60, 200, 15
    points = random_points(rng, rho1, n, intervals, k)
    path = profiles.bridge(
        points,
        rng.standard_normal((n, intervals * k)),
        rho1=rho1,
        volatility=np.ones((n, intervals)),
    )
    step = np.diff(path, axis=1)
    assert np.mean(step**2) == pytest.approx(profiles.step_variance(k, rho1), rel=0.02)
    assert lag1(step) == pytest.approx(rho1, abs=0.01)
    # Across the points as well: the last step of one interval with the first of the next.
    across = np.mean(step[:, k - 1 : -1 : k] * step[:, k::k]) / np.mean(step**2)
    assert across == pytest.approx(rho1, abs=0.04)


def test_the_conditional_law_equals_dense_gaussian_conditioning():
    rho1, k, intervals = 0.6, 4, 5
    lag = np.abs(np.subtract.outer(np.arange(k * intervals), np.arange(k * intervals)))
    cov = profiles.step_variance(k, rho1) * rho1**lag
    total = np.kron(np.eye(intervals), np.ones(k))
    gain = cov @ total.T @ np.linalg.inv(total @ cov @ total.T)
    increments = np.random.default_rng(SEED).standard_normal(intervals)
    points = np.pad(np.cumsum(increments), (1, 0))[None]
    unit_normals = np.eye(k * intervals)

    def steps(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        one = np.ones((len(points), intervals))
        return np.diff(profiles.bridge(points, normal, rho1=rho1, volatility=one), axis=1)

    mean = steps(points, np.zeros((1, k * intervals)))[0]
    np.testing.assert_allclose(mean, gain @ increments, atol=1e-12)
    response = steps(np.zeros((k * intervals, intervals + 1)), unit_normals)
    np.testing.assert_allclose(response.T @ response, cov - gain @ total @ cov, atol=1e-12)


def test_bridged_real_load_has_little_lag1_autocorrelation_where_linear_interpolation_has_much():
    frame = profiles.load(FOLDER).filter(like="_pload")
    points = np.ascontiguousarray(frame.to_numpy().T)
    normal = np.random.default_rng(SEED).standard_normal((len(points), 672 * 15))
    path = profiles.bridge(points, normal, scale="log")
    step = np.diff(np.log(path), axis=1)
    assert abs(lag1(step / step.std(axis=1, keepdims=True))) < 0.03
    line = np.diff(np.log(profiles.bridge(points, 0 * normal, scale="log")), axis=1)
    assert lag1(line / line.std(axis=1, keepdims=True)) > 0.86
    assert path.min() > 0


def test_pv_stays_at_zero_by_night_and_never_below():
    frame = profiles.load(FOLDER).filter(like="PV")
    points = np.ascontiguousarray(frame.to_numpy().T)
    normal = np.random.default_rng(SEED).standard_normal((len(points), 672 * 15))
    path = profiles.bridge(points, normal, scale="nonnegative")
    assert path.min() == 0
    night = (points[:, 1:] == 0) & (points[:, :-1] == 0)
    assert not path[:, 1:].reshape(*night.shape, 15)[night].any()


def test_volatility_follows_the_increments_nearby():
    points = np.cumsum(np.r_[np.tile([0.1, -0.1], 20), np.tile([1.0, -1.0], 20)])[None]
    sigma = profiles.local_volatility(points, window=4)[0]
    np.testing.assert_allclose(sigma[:30], 0.1)
    np.testing.assert_allclose(sigma[-30:], 1.0)


def test_points_that_do_not_allow_the_scale_are_refused():
    with pytest.raises(ParameterError, match="needs positive points, received a smallest of 0"):
        profiles.bridge(np.zeros((1, 2)), np.zeros((1, 3)), scale="log")
    with pytest.raises(ParameterError, match=r"shape \(1, 2·k\), received \(1, 3\)"):
        profiles.bridge(np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(ParameterError, match="rho1 must lie between"):
        profiles.bridge(np.zeros((1, 2)), np.zeros((1, 3)), rho1=1.0)


def test_missing_or_broken_profiles_say_what_to_do(tmp_path: Path):
    with pytest.raises(TableError, match="pass the data folder"):
        profiles.load(tmp_path)
    (tmp_path / profiles.FILE).write_bytes(b"PAR1 cut short")
    with pytest.raises(
        TableError, match=r"not a whole parquet file.*restore it from the repository"
    ):
        profiles.load(tmp_path)
    frame = pd.read_parquet(FOLDER / profiles.FILE)
    frame.drop(index=5).to_parquet(tmp_path / profiles.FILE)
    with pytest.raises(TableError, match="steps of 900 s"):
        profiles.load(tmp_path)
    frame.assign(time_utc=frame.time_utc.dt.tz_localize(None)).to_parquet(tmp_path / profiles.FILE)
    with pytest.raises(TableError, match="no time zone"):
        profiles.load(tmp_path)
    frame.drop(columns="time_utc").to_parquet(tmp_path / profiles.FILE)
    with pytest.raises(TableError, match="lacks the column 'time_utc'"):
        profiles.load(tmp_path)


def test_a_study_outside_the_curves_names_their_reach():
    frame = profiles.load(FOLDER)
    start = pd.Timestamp("2016-06-11", tz="UTC")
    with pytest.raises(ParameterError, match="reach from 2016-06-05T22:00:00"):
        profiles.between(frame, start, start + pd.Timedelta(days=3))
    part = profiles.between(
        frame, start + pd.Timedelta(minutes=5), start + pd.Timedelta(minutes=20)
    )
    assert part.index[0] == start
    assert part.index[-1] == start + pd.Timedelta(minutes=30)


def test_an_unknown_class_lists_the_known_ones():
    with pytest.raises(ParameterError, match=r"no curve 'H9_pload'.*H0-A"):
        profiles.column(profiles.load(FOLDER), "H9_pload", "simulate.load")
