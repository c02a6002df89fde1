"""Claim: on the same model the unscented filter equals filterpy's to 1e-9 over 20 steps."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from qu_bench import VARIANCE, still

from pse_analysis.estimation.core.run_arrays import EPOCH
from pse_analysis.estimation.filters.unscented import Scaling
from pse_analysis.estimation.process.dynamics import HoltParams

SEED = 1
ALPHA, BETA = 0.85, 0.05


@pytest.mark.parametrize("grid", ["ieee14", "ieee30"])
@pytest.mark.parametrize("process", ["random_walk", "holt"])
@pytest.mark.parametrize("form", ["covariance", "square_root"])
@pytest.mark.parametrize(
    "points",
    [{"alpha": 1.0, "kappa": 0.0, "beta": 2.0}, {"alpha": 0.3, "kappa": 1.0, "beta": 2.0}],
    ids=["paper", "narrow"],
)
def test_unscented_filter_equals_filterpy(
    grid: str, process: str, form: str, points: dict[str, float]
) -> None:
    b = still(grid)
    printed = {"holt": HoltParams(as_printed=True)} if process == "holt" else {}
    made = b.filter(process=process, form=form, points=Scaling(**points), **printed)
    n, m = len(b.start), len(b.layout)
    merwe = MerweScaledSigmaPoints(n, points["alpha"], points["beta"], points["kappa"])
    peer = UnscentedKalmanFilter(n, m, 1.0, made.model.h, lambda x, dt: x, merwe)
    peer.x, peer.P = b.truth[0].copy(), b.start
    peer.Q, peer.R = VARIANCE * np.eye(n), np.diag(b.layout.sigma**2)
    state = made.begin(b.truth[0], b.start, EPOCH)
    rng = np.random.default_rng(SEED)
    forecast, before, slope = b.truth[0], b.truth[0], np.zeros(n)
    for z in b.measure(rng)[1:]:
        if process == "holt":
            level = ALPHA * peer.x + (1 - ALPHA) * forecast
            slope = BETA * (level - before) + (1 - BETA) * slope
            forecast, before = level + slope, level
            factor = ALPHA * (1 + BETA)
            peer.fx = lambda x, dt, g=forecast - factor * peer.x, f=factor: f * x + g
        peer.predict()
        peer.sigmas_f = merwe.sigma_points(peer.x, peer.P)  # the paper draws the points again
        peer.update(z)
        after, info = made.step(state, b.snapshot(z))
        assert after is not None
        state = after
        np.testing.assert_allclose(state.s, peer.x, atol=1e-9, rtol=0)
        np.testing.assert_allclose(state.P, peer.P, atol=1e-9, rtol=0)
        np.testing.assert_allclose(info.innovation, peer.y, atol=1e-9, rtol=0)
        assert abs(info.nis - peer.mahalanobis**2) < 1e-6
