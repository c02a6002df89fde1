"""Which states the measurements leave open, whatever their σ and the size of the admittances."""

from __future__ import annotations

import numpy as np
from scipy import linalg, sparse
from scipy.sparse import linalg as sparse_linalg

from pse_analysis.arrays import BoolArray, FloatArray, IntArray
from pse_analysis.estimation.core.normal import equilibrated

RESOLUTION = 1e-9
"""Singular value, of a Jacobian with rows and columns of norm one, that counts as zero."""
SHARE = 1e-4
"""Share of a state in what is open beyond which the state is open itself."""
PROBES = 16
"""Random vectors in the first look for open directions; every further look takes twice as many."""
CLEAR = 1e-2
"""What a row must close of the gap, beside the one that closes most of it, to be taken as well."""
_BLOCK = 512
"""Right-hand sides solved at once; more cost memory."""
_SEED = 20240601


def open_states(jacobian: sparse.csr_array) -> BoolArray:
    """Finds the states whose value depends on what is not measured.

    Parameters
    ----------
    jacobian : (m, n) csr_array
        ∂h/∂x of the available rows; how its rows are weighed makes no difference.

    Returns
    -------
    (n,) ndarray of bool

    Notes
    -----
    With unit rows and columns, N Nᵀ is the projector on the null space, to which
    δ²(JᵀJ + δ²I)⁻¹ comes as close as (δ/s)² for the smallest singular value s that is not zero.
    Applied to random vectors it fills every row of an open state, and no other, by one sparse
    factorisation of [δI J; Jᵀ -δI], whose condition is 1/δ where that of JᵀJ would be 1/s².
    """
    return np.asarray(_into_the_gap(jacobian, PROBES, np.random.default_rng(_SEED)).any(axis=1))


def closing_rows(jacobian: sparse.csr_array, offered: sparse.csr_array) -> IntArray:
    """Picks rows that leave nothing open, as few as the null space has dimensions.

    Parameters
    ----------
    jacobian : (m, n) csr_array
        ∂h/∂x of the available rows.
    offered : (k, n) csr_array
        Rows that could be added; all of them together leave nothing open.

    Returns
    -------
    (d,) ndarray of int

    Notes
    -----
    What an offered row says along random vectors of the null space tells how much of it the row
    closes, and a pivoted QR factorisation picks a set of rows that close all of it, as many as
    there are vectors; so the null space is looked for again with these rows until nothing is open.
    """
    rng, n = np.random.default_rng(_SEED), jacobian.shape[1]
    size = sparse_linalg.norm(offered, axis=1)
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    offered = sparse.csr_array(sparse.diags_array(unit) @ offered)
    closing, probes = np.zeros(0, dtype=np.int64), PROBES
    while len(closing) < n:
        rows = sparse.csr_array(sparse.vstack([jacobian, offered[closing]]))
        inside = _into_the_gap(rows, probes, rng)
        if not inside.any():
            break
        _, upper, order = linalg.qr((offered @ inside).T, mode="economic", pivoting=True)
        step = np.abs(np.diagonal(upper))
        closing = np.concatenate([closing, order[: max(int((step > CLEAR * step[0]).sum()), 1)]])
        probes *= 2
    return closing


def influence(jacobian: sparse.csr_array, known: BoolArray) -> FloatArray:
    """Returns how far each row moves the known states, by least squares with unit rows and columns.

    Parameters
    ----------
    jacobian : (m, n) csr_array
        Rows that leave nothing open.
    known : (n,) ndarray of bool

    Returns
    -------
    (m,) ndarray
        Largest change of a known state by one unit of each row.
    """
    scaled, _, _ = equilibrated(jacobian)
    m, n = scaled.shape
    matrix = sparse.block_array([[sparse.eye_array(m), scaled], [scaled.T, None]], format="csc")
    factor = sparse_linalg.splu(matrix)
    out = np.zeros(m)
    for first in range(0, m, _BLOCK):
        count = min(_BLOCK, m - first)
        right = np.zeros((m + n, count))
        right[first + np.arange(count), np.arange(count)] = 1.0
        out[first : first + count] = np.abs(factor.solve(right)[m:][known]).max(axis=0)
    return out


def _into_the_gap(jacobian: sparse.csr_array, probes: int, rng: np.random.Generator) -> FloatArray:
    """Returns random vectors of the null space, exactly zero where states are determined. (n, k)"""
    scaled, _, column = equilibrated(jacobian)
    m, n = scaled.shape
    shift = sparse.diags_array(np.concatenate([np.full(m, RESOLUTION), np.full(n, -RESOLUTION)]))
    matrix = shift + sparse.block_array([[None, scaled], [scaled.T, None]])
    factor = sparse_linalg.splu(sparse.csc_array(matrix))
    right = np.zeros((m + n, min(probes, n)))
    right[m:] = -RESOLUTION * rng.normal(size=(n, right.shape[1]))
    inside = factor.solve(right)[m:]
    open_ = np.sqrt(np.mean(inside**2, axis=1)) > SHARE
    return np.asarray(np.where(open_[:, None], column[:, None] * inside, 0.0))


def named(names: tuple[str, ...], columns: IntArray) -> str:
    """Returns the angles and magnitudes at some places of [θ; |V|] in words.

    Parameters
    ----------
    names : tuple of str, length N
        Of the buses.
    columns : (k,) ndarray of int
        Places in [θ; |V|].
    """
    n = len(names)
    angle = [names[c] for c in columns if c < n]
    size = [names[c - n] for c in columns if c >= n]
    parts = [
        f"{kind} of buses {', '.join(some[:8])}{', …' if len(some) > 8 else ''}"
        for kind, some in (("the angles", angle), ("the magnitudes", size))
        if some
    ]
    return " and ".join(parts) or "no single bus"
