"""What the last good samples of a channel predict, over any time, and how surely.

Notes
-----
Eqs. (12), (14) of [anishchenko2018] with k₀ = 1, referred to the last *good* samples, so that the
good sample after a spike is not flagged with it. With v(n) the variance of the increment over n
periods, the increment D over g periods that ends at the reference predicts the one over the m
periods that follow as K·D, with K = [v(m+g) − v(m) − v(g)] / 2v(g) and error variance
v(m) − K²·v(g). At m = g = 1 these are K = ρ₁ and σ²(1 − ρ₁²).
"""

from __future__ import annotations

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.validation.motion import Motion, shortest


class Prediction:
    """Ordinary changes of the channels of one block, as `Motion` states them.

    Parameters
    ----------
    motion : Motion
    """

    def __init__(self, motion: Motion) -> None:
        self._turn = motion.turn
        self._turns = bool(np.isfinite(motion.turn).any())
        # v(n) and its slope to the right of each lag; past the last one it never falls.
        self._n_lag = motion.structure.shape[1] - 1
        self._v = np.ascontiguousarray(motion.structure).ravel()
        rise = np.diff(motion.structure, axis=1)
        self._rise = np.hstack([rise, np.maximum(rise[:, -1:], 0.0)]).ravel()

    def shortest(self, lane: IntArray, change: FloatArray) -> FloatArray:
        """Changes of the given channels; those of angles without whole turns. (n,) [unit]"""
        return shortest(change, self._turn[lane]) if self._turns else change

    def variance(self, lane: IntArray, periods: FloatArray, floor: FloatArray) -> FloatArray:
        """v(n) at real n ≥ 1, linear between whole lags and beyond the last; (n,) [unit²]."""
        n = np.fmax(periods, 1.0)
        low = np.minimum(n, self._n_lag).astype(np.int64)
        index = lane * (self._n_lag + 1) + low
        v = self._v[index] + (n - low) * self._rise[index]
        # Estimated v(n) may dip; over a gap nothing becomes more certain than over one period.
        return np.asarray(np.maximum(v, floor))

    def extrapolate(
        self,
        lane: IntArray,
        lead: FloatArray,
        span: FloatArray,
        elapsed: FloatArray,
        k_one: FloatArray,
        floor: FloatArray,
        older: BoolArray | None,
    ) -> tuple[FloatArray | float, FloatArray, FloatArray]:
        """Predict the change since the reference.

        Parameters
        ----------
        lane : (n,) array of int
            Channels.
        lead, span : (n,)
            Increment that led to the reference, NaN where it is not known, and the periods over
            which it did. [unit, 1]
        elapsed : (n,)
            Periods since the reference.
        k_one : (n,)
            Coefficient over one period; 0 predicts no change.
        floor : (n,)
            Variance of the error over one period. [unit²]
        older : (n,) array of bool, optional
            Samples from before the reference, which predicts nothing for them.

        Returns
        -------
        predicted, error, variance : (n,)
            Change, the variance of its error, and v(elapsed). [unit, unit², unit²]
        """
        usable = (k_one != 0.0) & (lead == lead)
        if older is not None:
            usable &= ~older
        if not usable.any():
            variance = self.variance(lane, elapsed, floor)
            return 0.0, variance, variance
        n = len(lane)
        three = self.variance(
            np.concatenate([lane, lane, lane]),
            np.concatenate([elapsed, span, elapsed + span]),
            np.concatenate([floor, floor, floor]),
        )
        variance, v_span, v_both = three[:n], three[n : 2 * n], three[2 * n :]
        # v(span) is 0 only where nothing ever changes; k is then of no account.
        k = 0.5 * (v_both - variance - v_span) / np.where(v_span > 0.0, v_span, np.inf)
        one = (elapsed == 1.0) & (span == 1.0)
        k = np.where(one, k_one, k)
        error = np.where(one, floor, np.maximum(variance - k * k * v_span, floor))
        # Within less than a period only part of the predicted change can have happened.
        predicted = k * lead * np.minimum(elapsed, 1.0)
        return np.where(usable, predicted, 0.0), np.where(usable, error, variance), variance
