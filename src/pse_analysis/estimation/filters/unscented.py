"""Unscented prediction of the measurements, with a fixed or an adaptive spread of the points.

The points stand at x and x ± √s L_i, where P = L Lᵀ and s = α²(n + κ). With γ₀ = h(x) and the odd
and even parts d_i, e_i of h along L_i, h(x ± √s L_i) = γ₀ + e_i ± d_i, the weighted sums of the
unscented transform become

    ŷ = γ₀ + ē,  ē = Σ e_i/s
    S = R + (D Dᵀ + E Eᵀ)/s + (β - α²) ē ēᵀ
    C = L Dᵀ/√s

which are the same numbers without the cancellation of large weights. Rows that are linear in x have
no e, and a multiple of ē added to every e_i makes one product of the last two terms of S:

    E Eᵀ/s + (β - α²) ē ēᵀ = E' E'ᵀ/s,  E' = E + k ē 1ᵀ,  k (2 + k n/s) = β - α²,

which has a real k for every scaling, so that S is never diminished. Slopes behind x do not enter h,
and the points need not spread along them.

The step is conditioned in one of two forms, whose results agree to rounding. ``covariance`` takes a
symmetric product from P and repairs, at the next instant, a P that rounding left indefinite;
``square_root`` carries a root of P by orthogonal triangularisation and takes nothing from
anything. The former is the default because it measures better: a step takes two thirds of the time
(``benchmarks/unscented.py``), a gate that stays closed costs nothing because S and its factor are
there anyway, and where a measurement leaves next to nothing of a variance, so that the difference
would be rounding, the step is taken by the root as well
(`pse_analysis.estimation.filters.conditioning`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import optimize
from scipy.linalg import blas, lapack

from pse_analysis.arrays import ComplexArray, FloatArray, IntArray
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.core.cholesky import symmetric
from pse_analysis.estimation.core.interface import Snapshot
from pse_analysis.estimation.filters.conditioning import Moments, Predicted, Prior, block
from pse_analysis.estimation.filters.sigma_points import SigmaPoints, Spread
from pse_analysis.estimation.filters.square_root import Halves
from pse_analysis.estimation.filters.update import Observation
from pse_analysis.measurement import BUS, FROM, TO, MeasurementModel, P, Q, wrap

Form = Literal["covariance", "square_root"]

ALPHA_RANGE = (0.02, 1.0)
"""Where adaptive scaling looks for α."""
ALPHA_TOLERANCE = 1e-3
MAX_TRIALS = 8


@dataclass(frozen=True)
class Scaling:
    """Parameters of the scaled unscented transform; the defaults are those of [qu2018].

    Attributes
    ----------
    alpha, kappa
        Spread: the points stand √(α²(n + κ)) standard deviations from the mean.
    beta
        Weight of the central point in the covariance; 2 is best for normal states. α = 1, κ = 0,
        β = 0 is the cubature rule.
    """

    alpha: float = 1.0
    kappa: float = 0.0
    beta: float = 2.0

    def __post_init__(self) -> None:
        if not (0 < self.alpha <= 1 and self.kappa >= 0 and self.beta >= 0):
            raise ParameterError(
                "scaling: expected 0 < alpha ≤ 1, kappa ≥ 0 and beta ≥ 0, received alpha = "
                f"{self.alpha}, kappa = {self.kappa}, beta = {self.beta}"
            )


def _bent(prior: Prior, spread: Spread, scaling: Scaling, alpha: float) -> FloatArray:
    """E' of the curved rows. (k, n)"""
    ratio = spread.square / prior.n
    move = (np.sqrt(1.0 + (scaling.beta - alpha**2) / ratio) - 1.0) * ratio
    return np.asarray(spread.even + move * spread.shift[:, None])


def moments(prior: Prior, spread: Spread, scaling: Scaling, alpha: float) -> Moments:
    """The prediction as a mean and covariances, under the α that the spread was made with.

    A row that reads an entry of s has that entry's column of P for its column of C, and S of it
    with any row is an entry of C: products are needed for the curved rows only.
    """
    m, n = len(spread.centre), prior.n
    # Row by row here: column by column, as BLAS reads it, in what is returned.
    cross, own = np.zeros((m, len(prior.s))), np.zeros((m, m))
    linear, entry, curved = spread.linear, spread.entry, spread.curved
    first = isinstance(linear, slice) and linear.start == 0
    if len(spread.shift):
        root = 1.0 / np.sqrt(spread.square)
        if n == len(prior.s):
            product = blas.dtrmm(root, prior.chol_P, spread.odd.T, lower=1)
        else:
            product = blas.dgemm(root, prior.chol_P[:, :n], spread.odd.T)
        cross[curved] = product.T
        both = np.hstack([spread.odd, _bent(prior, spread, scaling, alpha)])
        own[block(curved, curved)] = blas.dsyrk(root**2, both.T, trans=1, lower=1).T
        if not first:
            own[block(curved, linear)] = product[entry].T
    cross[linear] = prior.P[entry]
    own[linear] = cross[:, entry].T

    def along(given: Prior) -> tuple[FloatArray, FloatArray]:
        found = halves(given, spread, scaling, alpha)
        return found.odd, symmetric(found.rest)

    return Moments(spread.mean, own.T, cross.T, alpha, entry if first else None, along)


def halves(prior: Prior, spread: Spread, scaling: Scaling, alpha: float) -> Halves:
    """The prediction as a mean and weighted deviations."""
    root = 1.0 / np.sqrt(spread.square)
    odd = np.zeros((len(spread.centre), prior.n))
    odd[spread.linear] = prior.chol_P[spread.entry, : prior.n]
    odd[spread.curved] = root * spread.odd
    bent = root * _bent(prior, spread, scaling, alpha)
    return Halves(spread.mean, odd, spread.curved, bent, alpha)


_FORMS: dict[Form, Callable[[Prior, Spread, Scaling, float], Predicted]] = {
    "covariance": moments,
    "square_root": halves,
}


def fixed(
    model: MeasurementModel, scaling: Scaling | None = None, form: Form = "covariance"
) -> Observation:
    """Unscented prediction with a constant α.

    Notes
    -----
    Eqs. (9)–(22) of [qu2018].
    """
    scaling = scaling or Scaling()
    points = SigmaPoints(model)

    def predict(
        prior: Prior, _snapshot: Snapshot, rows: IntArray, _tuned: float, _at: FloatArray
    ) -> Predicted:
        spread = points.spread(prior, _square(scaling, scaling.alpha, prior.n), rows)
        return _FORMS[form](prior, spread, scaling, scaling.alpha)

    return Observation(predict, scaling.alpha)


def by_moments(
    model: MeasurementModel, scaling: Scaling | None = None, form: Form = "covariance"
) -> Observation:
    """Unscented prediction with the α whose mean is nearest to the true one.

    Parameters
    ----------
    model : MeasurementModel
    scaling : Scaling, optional
        α to start from, κ and β.

    Returns
    -------
    Observation

    Notes
    -----
    α_k = argmin ‖ŷ(α) - E[h]‖² in the norm of R⁻¹, to 1e-3, over injected and branch powers, whose
    mean is closed (`mean_power`); voltages have no error at any α, currents are left out. Read from
    eqs. (23)–(26) of [qu2018], whose print is lost. The error of the mean is nearly linear in s
    (its fourth-order term is), so secant steps find the least square in a few of them.
    """
    scaling = scaling or Scaling()
    points = SigmaPoints(model)
    power = PowerMean(model)

    def predict(
        prior: Prior, snapshot: Snapshot, rows: IntArray, alpha: float, _at: FloatArray
    ) -> Predicted:
        target, which = power.mean(prior, rows)
        sigma = snapshot.sigma[rows[which]]

        def error(alpha: float) -> tuple[FloatArray, Spread]:
            spread = points.spread(prior, _square(scaling, alpha, prior.n), rows)
            return (spread.mean[which] - target) / sigma, spread

        alpha, spread = _least(error, alpha)
        return _FORMS[form](prior, spread, scaling, alpha)

    return Observation(predict, scaling.alpha)


def by_likelihood(
    model: MeasurementModel, scaling: Scaling | None = None, form: Form = "covariance"
) -> Observation:
    """Unscented prediction with the α under which the innovation is most likely.

    It looks at the measurements that it then uses, so that P is a little too small.
    """
    scaling = scaling or Scaling()
    points = SigmaPoints(model)

    def predict(
        prior: Prior, snapshot: Snapshot, rows: IntArray, _tuned: float, _at: FloatArray
    ) -> Predicted:
        noise = np.diag(snapshot.sigma[rows] ** 2)

        def spread(alpha: float) -> Spread:
            return points.spread(prior, _square(scaling, alpha, prior.n), rows)

        def cost(alpha: float) -> float:
            found = moments(prior, spread(alpha), scaling, alpha)
            factor, failed = lapack.dpotrf(found.own + noise, lower=1)
            if failed:
                return float(np.finfo(float).max)
            eta = snapshot.z[rows] - found.mean
            eta[model.angular[rows]] = wrap(eta[model.angular[rows]])
            white, _ = lapack.dtrtrs(factor, eta, lower=1)
            return float(white @ white + 2.0 * np.log(np.diagonal(factor)).sum())

        best = optimize.minimize_scalar(
            cost, bounds=ALPHA_RANGE, method="bounded", options={"xatol": ALPHA_TOLERANCE}
        )
        alpha = float(best.x)
        return _FORMS[form](prior, spread(alpha), scaling, alpha)

    return Observation(predict, scaling.alpha)


def _square(scaling: Scaling, alpha: float, n: int) -> float:
    return alpha**2 * (n + scaling.kappa)


def _least(
    error: Callable[[float], tuple[FloatArray, Spread]], start: float
) -> tuple[float, Spread]:
    """α of least squared error, by Gauss-Newton secants in α²."""
    low, high = ALPHA_RANGE
    before = min(max(start, low), high)
    value, spread = error(before)
    alpha = before * 0.9 if before > 0.5 * high else before * 1.1
    for _ in range(MAX_TRIALS):
        new_value, spread = error(alpha)
        slope = (new_value - value) / (alpha**2 - before**2)
        steepness = float(slope @ slope)
        if steepness == 0.0:
            break
        square = alpha**2 - float(slope @ new_value) / steepness
        before, value = alpha, new_value
        alpha = float(np.sqrt(np.clip(square, low**2, high**2)))
        if abs(alpha - before) < ALPHA_TOLERANCE:
            return before, spread
    return before, spread


class PowerMean:
    """E[h] of the powers of a layout under a normal state, in closed form.

    Parameters
    ----------
    model : MeasurementModel

    Notes
    -----
    With δ = θ_i - θ_k, c_i = Cov(V_i, δ) and c_k = Cov(V_k, δ):
    E[V_i V_k e^{jδ}] = e^{jE[δ] - Var(δ)/2} [(E V_i + j c_i)(E V_k + j c_k) + Cov(V_i, V_k)].
    """

    def __init__(self, model: MeasurementModel) -> None:
        layout, network = model.layout, model.network
        self._power = np.isin(layout.quantity, (P, Q))
        self._active = layout.quantity == P
        self._n_bus = network.n_bus
        ends = np.stack([network.branches.from_bus, network.branches.to_bus])
        entries: list[tuple[IntArray, ...]] = []
        for side, y in ((BUS, network.y_bus), (FROM, network.y_from), (TO, network.y_to)):
            row = np.flatnonzero(self._power & (layout.side == side))
            at = layout.position[row]
            chosen = y[at].tocoo()
            metered = at if side == BUS else ends[side - FROM][at]
            entries.append((row[chosen.row], metered[chosen.row], chosen.col, chosen.data))
        # Every term of every row: V_i V_k y* of the metered bus i and the bus k at the other end.
        self._row, self._i, self._k, admittance = (
            np.concatenate(part) for part in zip(*entries, strict=True)
        )
        self._admittance: ComplexArray = admittance.conj()

    def mean(self, prior: Prior, rows: IntArray) -> tuple[FloatArray, IntArray]:
        """Means of the powers among the rows, and where among them they stand."""
        n, i, k = self._n_bus, self._i, self._k
        covariance = np.zeros((2 * n, 2 * n))
        covariance[np.ix_(prior.columns, prior.columns)] = prior.P[: prior.n, : prior.n]
        angle, both, size = covariance[:n, :n], covariance[n:, :n], covariance[n:, n:]
        x = prior.x
        variance = angle[i, i] - 2.0 * angle[i, k] + angle[k, k]
        at_i, at_k = both[i, i] - both[i, k], both[k, i] - both[k, k]
        product = np.exp(1j * (x[i] - x[k]) - 0.5 * variance) * (
            (x[n + i] + 1j * at_i) * (x[n + k] + 1j * at_k) + size[i, k]
        )
        power = np.zeros(len(self._power), dtype=np.complex128)
        np.add.at(power, self._row, self._admittance * product)
        which = np.flatnonzero(self._power[rows])
        chosen = rows[which]
        return np.where(self._active[chosen], power.real[chosen], power.imag[chosen]), which
