"""Least squares that the gross errors of a snapshot do not spoil: where a filter starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pse_analysis.arrays import BoolArray, FloatArray
from pse_analysis.errors import Unobservable
from pse_analysis.estimation.bad_data.identification import of_snapshot
from pse_analysis.estimation.bad_data.robust import GROSS_ERROR_SIGMAS, gate
from pse_analysis.estimation.core.interface import Info, Snapshot
from pse_analysis.estimation.static.plausibility import implausible
from pse_analysis.estimation.static.wls import WeightedLeastSquares, WlsSolution
from pse_analysis.vocabulary import Reason, Status

HUBER = 1.5
"""Residual in units of σ beyond which a row pulls no harder, on the way to the first estimate."""
MAX_ROUNDS = 6


def robust_wls(
    wls: WeightedLeastSquares, z: FloatArray, sigma: FloatArray, available: BoolArray
) -> tuple[WlsSolution, BoolArray]:
    """Estimate the state from the measurements of a snapshot that do not contradict each other.

    Parameters
    ----------
    wls : WeightedLeastSquares
    z, sigma : (m,) ndarray
        Measurements and their σ; only available rows are read. [p.u., rad]
    available : (m,) ndarray of bool

    Returns
    -------
    solution : WlsSolution
        Of the kept rows; ``residual`` has those of the rows that were left out as well.
    left_out : (m,) ndarray of bool

    Raises
    ------
    Unobservable
        If all available rows do not make the state observable. A row without which it would not be
        is kept, whatever it says.

    Notes
    -----
    If plain least squares passes the χ² test and nothing stands out, it is the estimate. Otherwise
    an estimate by Huber's cost, which one row cannot draw far, shows what to leave out: the search
    of `pse_analysis.estimation.bad_data.identification` about it, renewed until the estimate
    without these rows leaves out the same ones.
    """
    left_out = np.zeros(len(z), dtype=bool)
    solution = wls.solve(z, sigma, available)
    freedom = solution.dof
    if freedom <= 0:
        return solution, left_out
    if solution.converged and solution.objective <= gate(freedom)[0]:
        found, _ = _contradicting(wls, solution.x, z, sigma, available, left_out)
        if not found.any():
            return solution, left_out
    rough = wls.solve(z, sigma, available, huber=HUBER)
    if not np.isfinite(rough.x).all():
        return solution, left_out
    x = rough.x
    left_out = available & (np.abs(wls.model.residual(z, x)) > GROSS_ERROR_SIGMAS * sigma)
    for _ in range(MAX_ROUNDS):
        before = left_out
        left_out, unseen = _contradicting(wls, x, z, sigma, available, before)
        solution, left_out = _solve_rest(wls, z, sigma, available, x, left_out, unseen)
        if not solution.converged or (left_out == before).all():
            break
        x = solution.x
    if implausible(wls.network, solution.x):
        solution = replace(solution, converged=False)
    residual = np.where(available, wls.model.residual(z, solution.x), np.nan)
    return replace(solution, residual=residual), left_out


def _contradicting(
    wls: WeightedLeastSquares,
    x: FloatArray,
    z: FloatArray,
    sigma: FloatArray,
    available: BoolArray,
    start: BoolArray,
) -> tuple[BoolArray, FloatArray]:
    """Rows that contradict the others, and how little these know of each row, in units of σ²."""
    rows = np.flatnonzero(available)
    residual, noise = wls.model.residual(z, x)[rows], sigma[rows] ** 2
    every = np.arange(len(rows))
    out, unseen = np.zeros(len(z), dtype=bool), np.zeros(len(z))
    try:
        deletion = of_snapshot(wls.model, x, rows, residual, noise, every)
        found = np.flatnonzero(deletion.search(start[rows], gate(len(rows))[1]))
        seen = deletion.error_estimate(found)[1]
    except np.linalg.LinAlgError:
        # Rounding hides which of them contradict each other: what was left out stays so.
        return start, unseen
    out[rows[found]], unseen[rows[found]] = True, seen / noise[found]
    return out, unseen


def _solve_rest(
    wls: WeightedLeastSquares,
    z: FloatArray,
    sigma: FloatArray,
    available: BoolArray,
    x: FloatArray,
    left_out: BoolArray,
    unseen: FloatArray,
) -> tuple[WlsSolution, BoolArray]:
    """Estimate without some rows; those that are needed are put back, the least seen first."""
    out = left_out.copy()
    while True:
        try:
            return wls.solve(z, sigma, available & ~out, start=x), out
        except Unobservable:
            if not out.any():
                raise
            out[int(np.where(out, unseen, -np.inf).argmax())] = False


def begin(wls: WeightedLeastSquares, snapshot: Snapshot) -> tuple[WlsSolution | None, Info]:
    """Start a filter: the estimate of a snapshot, or None and why there is none.

    Parameters
    ----------
    wls : WeightedLeastSquares
    snapshot : Snapshot

    Returns
    -------
    solution : WlsSolution or None
    info : Info
        Rows that contradict the others are not ``used``, their ``reasons`` say
        `Reason.INNOVATION`, and ``detail`` names them.
    """
    m = len(snapshot.z)
    try:
        solution, left_out = robust_wls(wls, snapshot.z, snapshot.sigma, snapshot.available)
    except Unobservable as error:
        return None, Info.nothing(m, Status.UNOBSERVABLE, str(error))
    if not solution.converged:
        return None, Info.nothing(m, Status.NOT_CONVERGED, "no start from least squares")
    given = snapshot.available
    return solution, Info(
        Status.OK,
        solution.iterations,
        np.nan,
        0,
        given & ~left_out,
        np.where(given, solution.residual, np.nan),
        np.where(given, snapshot.sigma, np.nan),
        np.zeros(m),
        _told(wls.model.layout.channel, left_out),
        np.where(left_out, int(Reason.INNOVATION), 0).astype(np.int32),
    )


def _told(channel: tuple[str, ...], left_out: BoolArray) -> str:
    names = [channel[row] for row in np.flatnonzero(left_out)]
    if not names:
        return ""
    more = ", …" if len(names) > 8 else ""
    return (
        f"left out {len(names)} measurements that contradict the others of the snapshot: "
        f"{', '.join(names[:8])}{more}"
    )
