"""Kalman filter on the linear rectangular model, with the recent past in its state.

A sample is rarely taken at the instant it is used at: a meter reports the mean of the last quarter
of an hour, SCADA arrives some seconds late. The filter therefore keeps the states of the last K
instants beside the present one, and reads a sample through the weights with which its interval
covers them (`pse_analysis.estimation.intervals`). So a sample enters once, where it belongs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import linalg, sparse

from pse_analysis.estimation import intervals
from pse_analysis.estimation.estimator import Estimator, Info, Snapshot, Voltages
from pse_analysis.estimation.process import ProcessNoise, to_polar, to_rectangular
from pse_analysis.estimation.screening import Refuse
from pse_analysis.estimation.start import begin
from pse_analysis.estimation.wls import WeightedLeastSquares
from pse_analysis.grid.network import Network
from pse_analysis.measurement import RectangularModel, SensorLayout
from pse_analysis.vocabulary import Reason, Status

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

REFINE_PU = 1e-3
"""The measurements are transformed again if an update moves a voltage by more than this. [p.u.]"""
MAX_PASSES = 3


@dataclass(frozen=True, eq=False)
class KalmanState:
    """State of the filter.

    Attributes
    ----------
    x : ((K+1)·2N,) ndarray
        [e; f] now, one step ago, …, K steps ago. [p.u.]
    P : ((K+1)·2N, (K+1)·2N) ndarray
        Its covariance.
    """

    x: FloatArray
    P: FloatArray


def predict(state: KalmanState, noise: FloatArray) -> KalmanState:
    """One step of the random walk: the present gets Q, every older state moves back by one."""
    n = noise.shape[0]
    source = np.concatenate([np.arange(n), np.arange(len(state.x) - n)])
    x = state.x[source]
    covariance = state.P[np.ix_(source, source)]
    covariance[:n, :n] += noise
    return KalmanState(x, covariance)


def update(
    state: KalmanState, H: FloatArray | sparse.csr_array, z: FloatArray, R: FloatArray
) -> tuple[KalmanState, FloatArray, FloatArray, float]:
    """Condition on z = H x + v.

    Parameters
    ----------
    state : KalmanState
    H : (m, n) ndarray or csr_array
    z : (m,) ndarray
    R : (m, m) ndarray
        Covariance of v.

    Returns
    -------
    state : KalmanState
    innovation : (m,) ndarray
        η = z - H x.
    sigma_innovation : (m,) ndarray
        √S_ii.
    nis : float
        ηᵀS⁻¹η.

    Raises
    ------
    numpy.linalg.LinAlgError
        If S is not positive definite.
    """
    innovation = z - H @ state.x
    HP = H @ state.P
    S = HP @ H.T + R
    chol_S = linalg.cholesky(S, lower=True, check_finite=False)
    white = linalg.solve_triangular(chol_S, innovation, lower=True, check_finite=False)
    # P - K S Kᵀ = P - WᵀW with W = chol(S)⁻¹ H P: one symmetric product.
    W = linalg.solve_triangular(chol_S, HP, lower=True, check_finite=False)
    return (
        KalmanState(state.x + W.T @ white, state.P - W.T @ W),
        innovation,
        np.sqrt(np.diagonal(S)),
        float(white @ white),
    )


def kalman_filter(
    name: str,
    network: Network,
    layout: SensorLayout,
    noise: ProcessNoise,
    *,
    step_s: float,
    reach_s: float = 0.0,
    instant: bool = False,
    refuse: Refuse | None = None,
) -> Estimator:
    """Kalman filter with F = I on the linear rectangular model.

    Parameters
    ----------
    name : str
        Of the method.
    network : Network
    layout : SensorLayout
    noise : ProcessNoise
        Q of the step to an instant.
    step_s : float
        Step between instants. [s]
    reach_s : float
        How far samples reach back from the instant at which they are used, age and interval
        together; it sets how many past states are kept, and older samples are passed over. [s]
    instant : bool
        Whether every value counts as one of the present instant, with the σ that its age adds, and
        held values count again. Cheap, and what [qi2025] does; but errors of values that are used
        twice are correlated, so the filter is too sure of itself.
    refuse : Refuse, optional
        Asked about the innovation before every update; rows that it names are left out, and stand
        in the info with their innovation.

    Returns
    -------
    Estimator
        It starts from a weighted least-squares estimate and uses every sample once, unless
        ``instant``.

    Notes
    -----
    Eqs. (25)–(29) of [qi2025] with constant H where all samples are instantaneous and of
    age 0.
    """
    model = RectangularModel(network, layout)
    wls = WeightedLeastSquares(network, layout)
    n2 = 2 * network.n_bus
    lags = 0 if instant else int(np.ceil(reach_s / step_s - 1e-9))
    # Without an outside angle reference the slack's f stays 0: no noise, no prior, no gain.
    held = None if layout.has_angle else network.n_bus + network.slack

    def process(voltage: ComplexArray, time: np.datetime64) -> FloatArray:
        covariance = noise(voltage, time)
        if held is not None:
            covariance = covariance.copy()
            covariance[held, :] = covariance[:, held] = 0.0
        return covariance

    def init(snapshot: Snapshot) -> tuple[KalmanState | None, Info]:
        solution, info = begin(wls, snapshot)
        if solution is None:
            return None, info
        n = network.n_bus
        voltage = solution.x[n:] * np.exp(1j * solution.x[:n])
        turn = to_rectangular(voltage)
        start = turn @ solution.covariance() @ turn.T
        walk = process(voltage, snapshot.time)
        # Backwards the random walk spreads again: Cov(x₋ⱼ, x₋ₖ) = P₀ + min(j, k) Q.
        older = np.minimum.outer(np.arange(lags + 1), np.arange(lags + 1))
        covariance = np.kron(np.ones_like(older), start) + np.kron(older, walk)
        x = np.tile(np.concatenate([voltage.real, voltage.imag]), lags + 1)
        return KalmanState(x, covariance), info

    def linear(
        snapshot: Snapshot,
        sigma: FloatArray,
        used: BoolArray,
        rows: IntArray,
        at: ComplexArray,
        walk: FloatArray,
    ) -> tuple[sparse.csr_array, FloatArray, FloatArray]:
        """H over the kept instants, z and R of some rows, transformed at a voltage."""
        H, z, spread = model.rows(snapshot.z, sigma, used, at)
        H, z, spread = sparse.csr_array(H[rows]), z[rows], spread[rows]
        if instant:
            return H, z, np.diag(spread**2)
        age, window = snapshot.age_s[rows], layout.window_s[rows]
        R = intervals.bridge_covariance(age, window, step_s, lags) * (H @ walk @ H.T)
        R[np.diag_indices_from(R)] += spread**2
        return _lagged(H, intervals.weights(age, window, step_s, lags)), z, R

    def step(state: KalmanState, snapshot: Snapshot) -> tuple[KalmanState | None, Info]:
        m = len(layout)
        before = _voltage(state.x, network.n_bus)
        walk = process(before, snapshot.time)
        prior = predict(state, walk)
        if instant:
            used, sigma = snapshot.available, snapshot.sigma
        else:
            near = intervals.covered(snapshot.age_s, layout.window_s, step_s, lags)
            used = snapshot.available & snapshot.fresh & near
            sigma = np.sqrt(np.maximum(snapshot.sigma**2 - snapshot.sigma_age**2, 0.0))
        if not used.any():
            return prior, Info.nothing(m, Status.PREDICTED)
        refused = np.zeros(m, dtype=bool)
        full = np.full((2, m), np.nan)
        if refuse is not None:
            rows = np.flatnonzero(used)
            lagged, z, R = linear(snapshot, sigma, used, rows, before, walk)
            full[0, rows] = z - lagged @ prior.x
            S = _symmetric(lagged @ (lagged @ prior.P).T) + R
            full[1, rows] = np.sqrt(np.diagonal(S))
            refused[rows] = refuse(full[0, rows], S)
            used = used & ~refused
            if not used.any():
                return prior, replace(
                    Info.nothing(m, Status.PREDICTED),
                    innovation=full[0],
                    sigma_innovation=full[1],
                    reasons=_refusals(refused),
                )
        rows = np.flatnonzero(used)
        at = before
        for passes in range(1, MAX_PASSES + 1):  # noqa: B007 (reported after the loop)
            lagged, z, R = linear(snapshot, sigma, used, rows, at, walk)
            try:
                posterior, innovation, deviation, nis = update(prior, lagged, z, R)
            except np.linalg.LinAlgError:
                return None, Info.nothing(
                    m,
                    Status.DIVERGED,
                    "the innovation's covariance is not positive definite: the filter starts "
                    "again from least squares",
                )
            after = _voltage(posterior.x, network.n_bus)
            if np.abs(after - at).max() < REFINE_PU:
                break
            at = after
        full[0, rows], full[1, rows] = innovation, deviation
        return posterior, Info(
            Status.OK,
            passes,
            nis,
            len(rows),
            used,
            full[0],
            full[1],
            np.zeros(m),
            reasons=_refusals(refused),
        )

    def read(state: KalmanState) -> Voltages:
        voltage = _voltage(state.x, network.n_bus)
        turn = to_polar(voltage)
        covariance = turn @ state.P[:n2, :n2] @ turn.T
        return Voltages(np.concatenate([np.angle(voltage), np.abs(voltage)]), covariance)

    return Estimator(name, init, step, read)


def _lagged(H: sparse.csr_array, share: FloatArray) -> sparse.csr_array:
    """[w₀H, w₁H, …, w_K H] with a row's own weights; most of them are zero. (m, (K+1)·2N)"""
    m, n = H.shape
    row = np.repeat(np.arange(m), np.diff(H.indptr))
    data = H.data[:, None] * share[row]
    column = H.indices[:, None] + n * np.arange(share.shape[1])
    kept = share[row] != 0
    count = np.bincount(row, weights=kept.sum(axis=1), minlength=m)
    indptr = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return sparse.csr_array((data[kept], column[kept], indptr), shape=(m, n * share.shape[1]))


def _refusals(refused: BoolArray) -> npt.NDArray[np.int32]:
    return np.where(refused, int(Reason.INNOVATION), 0).astype(np.int32)


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))


def _voltage(x: FloatArray, n_bus: int) -> ComplexArray:
    return np.asarray(x[:n_bus] + 1j * x[n_bus : 2 * n_bus])
