"""Claim: a doubted forecast is widened where it is contradicted, and still tells elsewhere."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from qu_bench import Bench, still

from pse_analysis.estimation.bad_data import robust
from pse_analysis.estimation.bad_data.robust import Protection
from pse_analysis.estimation.filters.conditioning import Prior
from pse_analysis.estimation.filters.protection import Recovery
from pse_analysis.estimation.filters.update import Update, update
from pse_analysis.estimation.static.robust_wls import begin
from pse_analysis.estimation.static.wls import WeightedLeastSquares
from pse_analysis.measurement import VA, VM, P, Q

SEED = 5
TIGHT = 1e-6


def forecast(b: Bench, variance: float = TIGHT) -> Prior:
    """The truth, known to a variance."""
    made = b.filter()
    x, columns = b.truth[0], made.model.columns
    return Prior(x[columns], variance * np.eye(len(columns)), x, columns)


def refused(b: Bench, prior: Prior, z: np.ndarray, rows: np.ndarray) -> Update:
    made = b.filter()
    return update(made.model, made.observation, prior, b.snapshot(z), rows, 1.0, robust.per_channel)


def test_forecast_is_widened_by_what_a_stuck_voltmeter_reads() -> None:
    """P = p I, and bus 3 reads 0.4 p.u. too much: its variance grows by 0.4², no other does."""
    b = still("ieee14")
    prior, rows = forecast(b), np.arange(len(b.layout))
    meter = int(np.flatnonzero((b.layout.quantity == VM) & (b.layout.position == 3))[0])
    z = b.exact[0].copy()
    z[meter] += 0.4
    done = refused(b, prior, z, rows)
    wide = Recovery(b.filter().model, Protection()).widened(prior, rows, done, rows == meter)
    grown = np.diagonal(wide.P - prior.P)
    at = b.network.n_bus + 3
    assert grown[at] == pytest.approx(0.4**2, rel=1e-3)
    assert np.abs(np.delete(grown, at)).max() == 0.0


def test_every_stuck_channel_is_expected_to_be_off_as_far_as_it_is() -> None:
    b = still("ieee14")
    prior, rows = forecast(b), np.arange(len(b.layout))
    z = b.exact[0].copy()
    stuck = np.isin(rows, [2, 17, 40])
    z[stuck] += 0.7
    done = refused(b, prior, z, rows)
    model = b.filter().model
    wide = Recovery(model, Protection()).widened(prior, rows, done, stuck)
    H = model.jacobian(prior.x).toarray()[stuck]
    expected = np.einsum("ij,jk,ik->i", H, wide.P, H)
    assert (expected >= 0.999 * done.innovation[stuck] ** 2).all()


def end_of_a_line(b: Bench) -> tuple[np.ndarray, int]:
    """Rows that report, where P alone sees the angle of bus 26 of ieee30; and that of P."""
    near = [b.network.bus(name) for name in ("25", "26")]
    position, quantity = b.layout.position, b.layout.quantity
    on = ~(np.isin(position, near) & np.isin(quantity, (P, Q)))
    last = (position == near[1]) & np.isin(quantity, (P, Q))
    return on | last, int(np.flatnonzero(last & (quantity == P))[0])


def test_forecast_still_tells_a_wrong_meter_where_nothing_else_does() -> None:
    """All angles have moved by 0.1 rad, and P at the end of a line reads 1 p.u. too much."""
    b = still("ieee30")
    on, wrong = end_of_a_line(b)
    moved = b.truth[0].copy()
    moved[: b.network.n_bus] += 0.1
    model = b.filter().model
    z = model.h(moved) + b.layout.sigma * np.random.default_rng(SEED).standard_normal(len(on))
    z[wrong] += 1.0
    prior, rows = forecast(b), np.flatnonzero(on)
    done = refused(b, prior, z, rows)
    refusals = np.where(b.layout.quantity[rows] == VA, 3, 1)
    snapshot = dataclasses.replace(b.snapshot(z, on))
    restart, detail = Recovery(model, Protection()).find(prior, snapshot, rows, done, refusals)
    assert restart is not None
    assert "widened" in detail
    named = rows[restart.report.inflation > 0]
    assert wrong in named
    assert len(named) <= 2
    off, end = np.abs(restart.x - moved)[: b.network.n_bus], b.network.bus("26")
    assert np.delete(off, end).max() < 0.03
    # Nothing credible says that the end has moved as well.
    assert off[end] < 0.1
    alone, _ = begin(WeightedLeastSquares(b.network, b.layout), snapshot)
    assert alone is not None
    assert np.abs(alone.x - moved)[end] > 0.3
