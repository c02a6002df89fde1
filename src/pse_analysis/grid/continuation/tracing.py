"""Tracing of a loaded grid's curve: tangent predictor, pseudo-arc-length corrector, events."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import GridError, NotConverged
from pse_analysis.grid.continuation.base import UPPER, VOLTAGE, BaseState, StatusArray
from pse_analysis.grid.continuation.curve import Curve, EndKind, switching
from pse_analysis.grid.continuation.equations import LoadedGrid, coordinate, distance
from pse_analysis.grid.continuation.loading import Loading
from pse_analysis.grid.continuation.params import ContinuationParams
from pse_analysis.grid.continuation.reactive_limits import MARGIN, excess, settled
from pse_analysis.grid.network import Network

_LEAST_STEP = 1e-9
"""Step below which a curve counts as stuck, in units of the largest."""
_SAME = 1e-9
"""Change of a state that is no move along the curve. [rad, p.u.]"""
_AHEAD = 1e-5
"""Change of a state that shows whether a curve goes on. [rad, p.u.]"""
_FOLD = 1e-9
"""dλ/ds at a nose, in units of the first one."""


def continuation(
    network: Network,
    loading: Loading,
    params: ContinuationParams | None = None,
    *,
    state: FloatArray | None = None,
) -> Curve:
    """Trace the states of a grid along a loading direction, past the nose.

    Parameters
    ----------
    network : Network
    loading : Loading
    params : ContinuationParams, optional
    state : (2N,) ndarray, optional
        [θ; |V|] from which the loading starts, such as an estimate; by default the solution of the
        grid's own tables. [rad, p.u.]

    Returns
    -------
    Curve

    Raises
    ------
    GridError
        If the loading changes nothing.
    NotConverged
        If the base case has no solution, or the curve no nose.

    Notes
    -----
    Ajjarapu and Christy, The continuation power flow, IEEE Trans. Power Systems 7 (1992) 416-423;
    limit-induced ends as in Dobson and Lu, IEEE Trans. Circuits and Systems I 39 (1992) 762-766.
    """
    params = params or ContinuationParams()
    enforce = params.enforce_q_limits
    base = (
        BaseState.solved(network, enforce_q_limits=enforce)
        if state is None
        else BaseState.of_estimate(network, state, enforce_q_limits=enforce)
    )
    return trace(LoadedGrid(network, base, loading.direction(network)), params)


def trace(
    grid: LoadedGrid, params: ContinuationParams | None = None, *, start: float = 0.0
) -> Curve:
    """Trace a loaded grid's curve from a loading to its nose and a little past it.

    Parameters
    ----------
    grid : LoadedGrid
    params : ContinuationParams, optional
    start : float
        λ to start from; it may be negative.

    Raises
    ------
    GridError
        If the loading changes nothing in the grid.
    NotConverged
        If there is no solution at the start, or no nose within ``max_points``.
    """
    return _Tracer(grid, params or ContinuationParams()).run(start)


class _Point(NamedTuple):
    """A point of the curve: what buses hold after it, the tangent there, and what happened.

    ``switched`` are all buses that changed what they hold at this very state.
    """

    y: FloatArray
    status: StatusArray
    tangent: FloatArray
    event: str = ""
    bus: int = -1
    switched: tuple[int, ...] = ()


class _Event(NamedTuple):
    """A state at which a bus changes what it holds, and what it holds from there on."""

    y: FloatArray
    bus: int
    status: int


class _Tracer:
    def __init__(self, grid: LoadedGrid, params: ContinuationParams) -> None:
        self.grid, self.params = grid, params
        self.n = grid.n
        self.weight = np.zeros(2 * self.n + 2)
        self.weight[: 2 * self.n] = 1.0

    def run(self, start: float) -> Curve:
        point = self._first(start)
        points, nose, end, nose_bus = [point], -1, EndKind.SADDLE_NODE, -1
        nose_tangent = point.tangent
        step, stalls = self.params.first_step, 0
        while len(points) < self.params.max_points:
            if nose >= 0 and len(points) > nose + self.params.past_nose:
                return self._curve(points, nose, end, nose_bus, nose_tangent)
            found = self._advance(point, step)
            if found is None:
                step *= 0.5
                if step < _LEAST_STEP * self.params.largest_step:
                    if nose >= 0:  # what lies past the nose is only for show
                        return self._curve(points, nose, end, nose_bus, nose_tangent)
                    point = self._passed(points, point, point.tangent)
                    step = self.params.first_step
                continue
            reached, arriving = found
            if nose < 0 and arriving[-1] < 0:
                fold = self._fold(point, reached.y)
                points.append(fold)
                nose, nose_tangent = len(points) - 1, fold.tangent
            elif nose < 0 and reached.tangent[-1] < 0:
                if (further := self._further(reached, arriving)) is not None:
                    points += [_towards(reached, further), further]
                    point = further
                    continue
                nose, end, nose_bus = len(points), EndKind.LIMIT_INDUCED, reached.bus
                nose_tangent = arriving
            moved = np.abs(reached.y - point.y)[: 2 * self.n].max()
            stalls = stalls + 1 if moved < _SAME else 0
            step = self._next_step(step, point, reached)
            points.append(reached)
            point = reached
            if stalls > 2 * self.n and nose < 0:
                point, stalls = self._passed(points, point, arriving), 0
        raise NotConverged(
            f"{self.grid.network.name}: no limit within {len(points)} points up to λ = "
            f"{point.y[-1]:g}: the loading may relieve the grid, so turn its sign; or raise "
            "max_points"
        )

    def _curve(
        self, points: list[_Point], nose: int, end: EndKind, bus: int, tangent: FloatArray
    ) -> Curve:
        slope = np.array([p.tangent[-1] for p in points])
        if end == EndKind.SADDLE_NODE:
            slope[nose] = 0.0
        return Curve(
            grid=self.grid,
            y=np.stack([p.y for p in points], axis=1),
            slope=slope,
            status=np.stack([p.status for p in points]),
            event=tuple(p.event for p in points),
            nose=nose,
            end=end,
            nose_bus=bus,
            nose_tangent=tangent,
            tolerance=self.params.tolerance,
        )

    def _first(self, start: float) -> _Point:
        """Returns the state at the loading to start from, and the direction of rising λ."""
        grid = self.grid
        y = np.concatenate([grid.base.x, [0.0, start]])
        found = settled(grid, y, grid.status, start, self.params.tolerance)
        if found is None:
            raise NotConverged(
                f"{grid.network.name}: no state at λ = {start:g}: the grid cannot carry that load; "
                "start from a lower λ"
            )
        return self._oriented_start(*found)

    def _further(self, point: _Point, arriving: FloatArray) -> _Point | None:
        """Returns a state a little further along λ; None if the curve really turns back here.

        Where several generators stand at their limits at once, as they may in an estimate, the one
        that changes first does not tell where the curve goes.
        """
        n2 = 2 * self.n
        ahead = point.y + _AHEAD / np.abs(arriving[:n2]).max() * arriving
        found = settled(
            self.grid, ahead, point.status, float(ahead[-1]), self.params.tolerance, near=True
        )
        if found is None or np.abs(found[0] - point.y)[:n2].max() > 20.0 * _AHEAD:
            return None
        y, status = found
        along = np.zeros(len(y))
        along[-1] = 1.0
        tangent = self.grid.tangent(y, status, along)
        if tangent is None:
            return None
        return _Point(y, status, self._normed(tangent))

    def _passed(self, points: list[_Point], point: _Point, arriving: FloatArray) -> _Point:
        """Adds a state a little further along λ than one at which the curve is stuck.

        Raises
        ------
        NotConverged
            If there is none.
        """
        further = self._further(point, arriving) if arriving[-1] > 0 else None
        if further is None:
            raise NotConverged(
                f"{self.grid.network.name}: the curve could not be followed beyond λ = "
                f"{point.y[-1]:g}: lower largest_step, or trace without reactive limits to see "
                "which generator is in the way"
            )
        points[-1] = _towards(point, further)
        points.append(further)
        return further

    def _oriented_start(self, y: FloatArray, status: StatusArray) -> _Point:
        grid, n2 = self.grid, 2 * self.n
        along = np.zeros(len(y))
        along[-1] = 1.0
        tangent = grid.tangent(y, status, along)
        if tangent is None:
            raise NotConverged(
                f"{grid.network.name}: the Jacobian is singular at λ = {y[-1]:g}, so the grid "
                "stands at its limit already: start from a lower λ"
            )
        size = float(np.linalg.norm(tangent[:n2]))
        scale = float(np.abs(np.concatenate([grid.d_p, grid.d_q])).max())
        if size <= 1e-9 * scale or scale == 0.0:
            raise GridError(
                f"the loading sums to nothing in {grid.network.name}: only buses that take up the "
                "imbalance, or that are cut off, change along it; change others, or set balance"
            )
        self.weight[-1] = size**2
        return _Point(y, status.copy(), self._normed(tangent))

    def _normed(self, tangent: FloatArray) -> FloatArray:
        return np.asarray(tangent / np.sqrt(self.weight @ tangent**2))

    def _advance(self, point: _Point, step: float) -> tuple[_Point, FloatArray] | None:
        """Returns the next point and the tangent of the branch that arrives there.

        It is None where the step is too long.
        """
        grid, n2 = self.grid, 2 * self.n
        length = step / np.abs(point.tangent[:n2]).max()
        y = self._corrected(point, length)
        if y is None or not np.abs(y - point.y)[:n2].max() < 2.0 * step:
            return None
        event = None
        if (excess(self.grid, y, point.status)[0] > MARGIN).any():
            event = self._first_event(point, y)
            if event is None:
                return None
        arriving_at = y if event is None else event.y
        arriving = grid.tangent(arriving_at, point.status, self.weight * point.tangent)
        if arriving is None:
            return None
        arriving = self._normed(arriving)
        if event is None:
            # A sharp turn hides folds between its ends.
            if (self.weight * arriving) @ point.tangent < 0.7 and step > 1e-4:
                return None
            return _Point(y, point.status, arriving), arriving
        switched = self._switched(event, point, arriving)
        return None if switched is None else (switched, arriving)

    def _corrected(self, point: _Point, length: float) -> FloatArray | None:
        return self.grid.solve(
            point.y + length * point.tangent,
            point.status,
            distance(point.y, self.weight * point.tangent, length),
            tolerance=self.params.tolerance,
        )

    def _next_step(self, step: float, before: _Point, after: _Point) -> float:
        """Returns a longer step where the curve is straight, a shorter one where it turns."""
        straight = float((self.weight * before.tangent) @ after.tangent)
        factor = 2.0 if straight > 0.995 else 1.3 if straight > 0.97 else 0.8
        return min(step * factor, self.params.largest_step)

    def _first_event(self, point: _Point, y: FloatArray) -> _Event | None:
        """Returns where before y the first generator changes what it holds; None if not found."""
        before, target = excess(self.grid, point.y, point.status)
        after, target = excess(self.grid, y, point.status)
        for _ in range(self.n):
            beyond = np.flatnonzero(after > MARGIN)
            room = np.maximum(-before[beyond], 0.0)
            fraction = room / (room + after[beyond])
            first = int(np.argmin(fraction))
            bus = int(beyond[first])
            status = point.status.copy()
            if status[bus] == VOLTAGE:
                status[bus] = target[bus]
            located = self.grid.solve(
                point.y + fraction[first] * (y - point.y),
                status,
                coordinate(self.n + bus, float(self.grid.base.vm_set[bus])),
                tolerance=self.params.tolerance,
            )
            if located is None:
                return None
            along = (self.weight * point.tangent) @ np.stack([located - point.y, y - point.y]).T
            if not -1e-9 <= along[0] <= along[1] + 1e-9:
                return None
            if bus in point.switched and along[0] <= 1e-9:
                # It left its limit here and comes back within the step: a shorter one tells where.
                return None
            after, target_there = excess(self.grid, located, point.status)
            after[bus] = -np.inf
            if not (after > MARGIN).any():
                return _Event(located, bus, int(target[bus]))
            y, target = located, target_there
        return None

    def _switched(self, event: _Event, point: _Point, arriving: FloatArray) -> _Point | None:
        """Returns the point at which a generator changes what it holds.

        The branch that leaves it is the one on which the change is allowed: a bus at its upper
        limit must let its voltage fall, one that takes up its voltage must leave its limit.
        """
        grid, n, bus = self.grid, self.n, event.bus
        was, status = int(point.status[bus]), point.status.copy()
        status[bus] = event.status
        tangent = grid.tangent(event.y, status, self.weight * arriving)
        if tangent is None:
            return None
        tangent = self._normed(tangent)
        if event.status == VOLTAGE:
            data = grid.model.jacobian_data(event.y[: 2 * n])
            row = slice(grid.model.indptr[n + bus], grid.model.indptr[n + bus + 1])
            change = data[row] @ tangent[grid.model.indices[row]] - grid.d_q[bus] * tangent[-1]
            wrong = change > 0 if was == UPPER else change < 0
        else:
            change = tangent[n + bus]
            wrong = change > 0 if event.status == UPPER else change < 0
        tangent = -tangent if wrong else tangent
        still = np.abs(event.y - point.y)[: 2 * n].max() < _SAME
        switched = (*(point.switched if still else ()), bus)
        return _Point(event.y, status, tangent, switching(grid, bus, event.status), bus, switched)

    def _fold(self, point: _Point, beyond: FloatArray) -> _Point:
        """Returns the saddle node between a point before it and a state past it.

        dλ/ds is driven to zero by the Illinois form of regula falsi, on corrected states.
        """
        grid, weighted = self.grid, self.weight * point.tangent
        ends = [grid.tangent(y, point.status, weighted) for y in (point.y, beyond)]
        low, high = 0.0, float(weighted @ (beyond - point.y))
        f_low, f_high = (np.nan if t is None else float(t[-1]) for t in ends)
        best, aim, side = point, _FOLD * abs(f_low), 0
        for _ in range(60):
            length = (low * f_high - high * f_low) / (f_high - f_low)
            y = self._corrected(point, length)
            tangent = None if y is None else grid.tangent(y, point.status, weighted)
            if y is None or tangent is None:
                break
            best = _Point(y, point.status, self._normed(tangent), "nose")
            value = float(tangent[-1])
            if abs(value) <= aim or high - low < 1e-14:
                break
            if value > 0:
                low, f_low, f_high = length, value, f_high * (0.5 if side > 0 else 1.0)
                side = 1
            else:
                high, f_high, f_low = length, value, f_low * (0.5 if side < 0 else 1.0)
                side = -1
        return best


def _towards(point: _Point, further: _Point) -> _Point:
    """Returns a point with what buses hold, and the direction of travel, towards a further one."""
    return point._replace(status=further.status, tangent=further.tangent)
