"""The angle that all buses share, and how it moves.

Phasor units count their angles from a clock, so that the slack's angle is a state like any other:
it drifts with the frequency of the system, and steps where the reference is changed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.estimation.core.interface import Estimate, Snapshot
from pse_analysis.estimation.process.covariance_matching import CovarianceMatching, Matched
from pse_analysis.measurement import BUS, VA, SensorLayout, wrap

START_RAD = np.deg2rad(1e-3)
"""σ of the reference's movement in one step, before anything was seen of it. [rad]"""
ANY_RAD = np.pi / np.sqrt(3.0)
"""σ of an angle of which nothing is known. [rad]"""
LARGE_RAD = 0.2
"""Turn from which the reference has jumped whatever its σ: a filter corrects small angles. [rad]"""
FAR = 4.0
"""Turn, in units of its σ, from which the reference has jumped."""
NEAR = 4.0
"""Distance of two deviations, in units of its σ, up to which they agree."""


class CommonAngle(NamedTuple):
    """Holds the angle by which most phasors are turned alike.

    Attributes
    ----------
    angle : float
        Weighted mean of those that agree. [rad]
    agree : (k,) ndarray of bool
    """

    angle: float
    agree: BoolArray


def common_angle(deviation: FloatArray, sigma: FloatArray) -> CommonAngle:
    """Find by how much most of some angles are turned alike.

    Parameters
    ----------
    deviation : (k,) ndarray
        Measured less expected angles, up to full turns. [rad]
    sigma : (k,) ndarray
        Their σ, not counting that of what they have in common. [rad]

    Returns
    -------
    CommonAngle
        Of the largest group of deviations that lie near one of them; of the smallest turn where
        two groups are equally large.
    """
    apart = wrap(deviation[None, :] - deviation[:, None])
    near = np.abs(apart) <= NEAR * np.hypot(sigma[None, :], sigma[:, None])
    number = near.sum(axis=1)
    largest = np.flatnonzero(number == number.max())
    centre = int(largest[np.argmin(np.abs(wrap(deviation[largest])))])
    agree = near[centre]
    weight = np.where(agree, sigma**-2, 0.0)
    angle = deviation[centre] + weight @ apart[centre] / weight.sum()
    return CommonAngle(float(wrap(np.array([angle]))[0]), agree)


class Frame(NamedTuple):
    """Holds the angle that a filter's own angles count from.

    Attributes
    ----------
    angle : float
        Measured angles are the filter's plus this. [rad]
    sampled : (m,) ndarray
        The same when each channel was last sampled: a held value belongs to that frame. [rad]
    learnt : Matched
        What innovations have told of the variance of the reference's movement.
    jumped : float
        Square of the last jump, which fades: by so much it may move while no angle is measured.
        [rad²]
    doubt : float
        Variance of ``angle`` itself, which the filter's own angles do not have. [rad²]
    """

    angle: float
    sampled: FloatArray
    learnt: Matched
    jumped: float = 0.0
    doubt: float = 0.0


class Followed(NamedTuple):
    """Says where the reference stands at the next instant, and how surely.

    Attributes
    ----------
    frame : Frame
    variance : float
        By which it may have moved. [rad²]
    snapshot : Snapshot
        With angles as the filter counts them.
    """

    frame: Frame
    variance: float
    snapshot: Snapshot


class AngleReference:
    """How the reference of measured angles moves between two instants.

    It is a random walk whose variance is estimated from the innovations of the measured angles, and
    which may jump: where most of them are turned alike beyond what the walk allows, the frame of
    the filter is turned, and what it knew of the reference is forgotten. All else that it knows
    stays as it is, whatever the size of the turn.

    Parameters
    ----------
    layout : SensorLayout
    variance : float
        Of the movement in one step, before innovations tell. [rad²]
    """

    def __init__(self, layout: SensorLayout, variance: float = START_RAD**2) -> None:
        at_bus = (layout.quantity == VA) & (layout.side == BUS)
        self._rows, self._angular = np.flatnonzero(at_bus), layout.angular
        self._bus = layout.position[self._rows]
        self._matching = CovarianceMatching(lambda _voltage: (), np.array([variance]))

    def begin(self, *, measured: bool = True) -> Frame:
        """Returns the first frame: that of the phasors, or any if no angle was measured."""
        doubt = 0.0 if measured else ANY_RAD**2
        return Frame(0.0, np.zeros(len(self._angular)), self._matching.begin(), doubt=doubt)

    def follow(
        self,
        frame: Frame,
        snapshot: Snapshot,
        theta: FloatArray,
        covariance: Callable[[IntArray], FloatArray],
    ) -> Followed:
        """The frame at an instant.

        Parameters
        ----------
        frame : Frame
            At the instant before.
        snapshot : Snapshot
            As it was measured.
        theta : (N,) ndarray
            Forecast angles of the buses, in the filter's frame. [rad]
        covariance : (buses (k,)) -> (k, k) ndarray
            Of the forecast angles of some buses, without any movement of the reference. [rad²]

        Returns
        -------
        Followed
        """
        used = (snapshot.available & snapshot.fresh)[self._rows]
        variance = float(frame.learnt.level[0])
        if not used.any():
            # The filter need not know: it could not tell, and its angles are as they were.
            unseen = frame._replace(doubt=frame.doubt + max(variance, frame.jumped))
            return Followed(unseen, 0.0, self._seen(frame, snapshot))
        variance += frame.doubt
        rows, bus = self._rows[used], self._bus[used]
        eta = wrap(snapshot.z[rows] - frame.angle - theta[bus])
        S = covariance(bus)
        S.flat[:: len(rows) + 1] += snapshot.sigma[rows] ** 2
        most = len(rows)
        if (eta**2 > FAR**2 * (np.diagonal(S) + variance)).any():
            found = common_angle(eta, np.sqrt(np.diagonal(S)))
            # Deviations across a half turn are counted from the same side.
            eta = found.angle + wrap(eta - found.angle)
            most = int(np.count_nonzero(found.agree))
            eta, S = eta[found.agree], S[np.ix_(found.agree, found.agree)]
        weight = np.linalg.solve(S, np.ones(most))
        spread = 1.0 / float(weight.sum())
        turn = spread * float(weight @ eta)
        surprise = turn**2 / (spread + variance)
        # Its size says no more of the usual movement than that it was large.
        response = np.full((1, 1, 1), 1.0 / (spread + variance))
        white = np.array([np.sqrt(min(surprise, FAR**2))])
        learnt = self._matching.learn(frame.learnt, response, white)
        angle, jumped = frame.angle, np.exp(-1.0 / self._matching.window) * frame.jumped
        if (surprise > FAR**2 or abs(turn) > LARGE_RAD) and 2 * most > len(rows):
            angle, variance = float(wrap(np.array([angle + turn]))[0]), max(turn**2, variance)
            jumped = jumped if frame.doubt >= ANY_RAD**2 else max(jumped, turn**2)
        sampled = frame.sampled
        if angle != 0.0 or sampled.any():
            sampled = np.where(snapshot.available & snapshot.fresh, angle, sampled)
        after = Frame(angle, sampled, learnt, jumped)
        return Followed(after, variance, self._seen(after, snapshot))

    def _seen(self, frame: Frame, snapshot: Snapshot) -> Snapshot:
        """The snapshot with angles as the filter counts them."""
        if not frame.sampled.any():
            return snapshot
        turned = wrap(snapshot.z - frame.sampled)
        return replace(snapshot, z=np.where(self._angular, turned, snapshot.z))


def absolute(x: FloatArray, covariance: FloatArray, frame: Frame | None) -> Estimate:
    """Returns an estimate whose angles count as measured ones do.

    Parameters
    ----------
    x : (2N,) ndarray
        [θ; |V|]. [rad, p.u.]
    covariance : (2N, 2N) ndarray
    frame : Frame or None
        None where the reference stands still.

    Returns
    -------
    Estimate
        Its angles lie within half a turn of 0 if the reference has ever jumped.
    """
    if frame is None:
        return Estimate(x, covariance)
    n = len(x) // 2
    if frame.angle != 0.0:
        x = np.concatenate([wrap(x[:n] + frame.angle), x[n:]])
    if frame.doubt > 0.0:
        covariance = covariance.copy()
        covariance[:n, :n] += frame.doubt
    return Estimate(x, covariance)
