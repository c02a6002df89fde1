"""A grid's state with its recent past: how it moves, and the moments of rows that read it.

A state is B blocks of n numbers: [e; f] now, one step ago, …, L-1 steps ago, and behind them what
a process adds to the present (the slopes of a trend). When it moves, the present becomes the first
past block, so that before an update L past instants can be read although only L blocks are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from pse_analysis.arrays import BoolArray, ComplexArray, FloatArray
from pse_analysis.estimation.process.dynamics import Process
from pse_analysis.measurement.rectangular import Linear, Memo, Pattern

MOST_SIGMAS = 3.0
"""How far a voltage may be moved, in its σ, by turning it instead of adding a correction."""


class Belief(NamedTuple):
    """Mean and covariance of a lagged state.

    Attributes
    ----------
    x : (B·n,) ndarray
    P : (B·n, B·n) ndarray
        Exactly symmetric.
    memory : object
        What the process remembers.
    """

    x: FloatArray
    P: FloatArray
    memory: Any


class Expected(NamedTuple):
    """Covariances of some rows and a moved state.

    Attributes
    ----------
    cross : (r, B·n) ndarray
        With the state.
    own : (r, r) ndarray
        Of the rows, that of what interpolation between instants leaves out included.
    """

    cross: FloatArray
    own: FloatArray


class Reach(NamedTuple):
    """How rows reach into the past.

    Attributes
    ----------
    share : (r, K+1) ndarray
        Weights of the present and the K instants before it.
    bridge : (r, r) ndarray
        Covariance of what interpolation between instants leaves out, in units of Q.
    """

    share: FloatArray
    bridge: FloatArray

    @property
    def moving(self) -> FloatArray:
        """Share of Q in the covariance of the rows. (r, r)"""
        return np.asarray(np.outer(self.share[:, 0], self.share[:, 0]) + self.bridge)


class Rows:
    """Real rows that read complex phasors of one instant's voltages, Re(conj(turn) y (e + jf)).

    Parameters
    ----------
    pattern : Pattern
        Its functionals are y.

    Attributes
    ----------
    pattern : Pattern
    """

    def __init__(self, pattern: Pattern) -> None:
        y = pattern.functionals
        self.pattern = pattern
        self._of_row = np.repeat(np.arange(y.shape[0]), np.diff(y.indptr))
        at_power = np.full(y.shape[0], -1)
        at_power[pattern.power] = pattern.metered
        self._own = np.flatnonzero(at_power[self._of_row] == y.indices)
        self._conjugate = y.data.conj()
        # Re(w V) = Re(w)·e - Im(w)·f: two columns for every entry.
        self._column = np.stack([y.indices, y.indices + y.shape[1]], axis=1).ravel()
        self._ends = 2 * y.indptr
        self._shape = y.shape[0], 2 * y.shape[1]
        entries = np.ones(len(self._column)), self._column, self._ends
        self._plane = sparse.csr_array(entries, shape=self._shape)
        self._patterns: Memo[tuple[BoolArray, sparse.csr_array]] = Memo()

    def read(self, instants: ComplexArray) -> ComplexArray:
        """The complex phasors y V of some instants' voltages (N, K+1). (r, K+1)"""
        y = self.pattern.functionals
        # Every row reads something; a sparse product would take thrice the time for so few columns.
        return np.asarray(np.add.reduceat(y.data[:, None] * instants[y.indices], y.indptr[:-1]))

    def plane(self, linear: Linear) -> sparse.csr_array:
        """The rows as functionals of [e; f]. (r, 2N)

        What an earlier call returned is written over.
        """
        w = linear.turn[self._of_row] * self._conjugate
        w[self._own] += linear.bend
        self._plane.data = w.view(np.float64)
        return self._plane

    def of_blocks(self, plane: sparse.csr_array, share: FloatArray) -> sparse.csr_array:
        """The rows as functionals of several blocks, with weights (r, B). (r, B·2N)

        What an earlier call returned is written over.
        """
        kept, rows = self._patterns.get((share != 0).tobytes(), lambda: self._laid_out(share != 0))
        whole = plane.data[:, None] * np.repeat(share, np.diff(self._ends), axis=0)
        rows.data = whole[kept]
        return rows

    def _laid_out(self, reached: BoolArray) -> tuple[BoolArray, sparse.csr_array]:
        """Which entries of which blocks there are, and the rows that they make."""
        (m, n), blocks, entries = self._shape, reached.shape[1], np.diff(self._ends)
        kept = np.repeat(reached, entries, axis=0)
        column = (self._column[:, None] + n * np.arange(blocks))[kept]
        ends = np.concatenate([[0], np.cumsum(entries * reached.sum(axis=1))])
        return kept, sparse.csr_array((np.ones(len(column)), column, ends), shape=(m, blocks * n))


@dataclass(frozen=True, eq=False)
class AugmentedState:
    """Shape of a lagged state, and its movement.

    Attributes
    ----------
    n : int
        Numbers per block.
    lags : int
        K, the past instants that can be read before an update.
    process : Process
        How the present moves.
    """

    n: int
    lags: int
    process: Process

    @property
    def past(self) -> int:
        """L, the blocks of the present and the past that are kept."""
        return max(self.lags, 1)

    @property
    def blocks(self) -> int:
        """B."""
        return self.past + self.process.order - 1

    @property
    def head(self) -> tuple[int, ...]:
        """Blocks that describe the present."""
        return (0, *range(self.past, self.blocks))

    def begin(self, x: FloatArray, P: FloatArray, noise: FloatArray) -> Belief:
        """State from an estimate of the present, x (n,) and P (n, n); noise is that of a step.

        Backwards the walk spreads again: Cov(x₋ⱼ, x₋ₖ) = P + min(j, k) Q.
        """
        n, past = self.n, self.past
        P = 0.5 * (P + P.T)
        s, started, memory = self.process.begin(x, P, noise)
        older = np.minimum.outer(np.arange(past), np.arange(past))
        covariance = np.zeros((self.blocks * n, self.blocks * n))
        covariance[: past * n, : past * n] = np.kron(np.ones_like(older), P) + np.kron(older, noise)
        covariance[past * n :, past * n :] = started[n:, n:]
        return Belief(np.concatenate([np.tile(x, past), s[n:]]), covariance, memory)

    def forecast(self, belief: Belief) -> tuple[FloatArray, FloatArray, Any]:
        """F s + g and F P Fᵀ of the present, and what the process then remembers."""
        n, head, size = self.n, self.head, self.process.order * self.n
        P = belief.P.reshape(self.blocks, n, self.blocks, n)
        s, present = belief.x[:n], P[0, :, 0]
        if len(head) > 1:
            s = np.concatenate([belief.x.reshape(self.blocks, n)[block] for block in head])
            present = P[head, ...][:, :, head].reshape(size, size)
        return self.process.forecast(s, present, belief.memory)

    def moved(
        self, belief: Belief, forecast: tuple[FloatArray, FloatArray, Any], noise: FloatArray
    ) -> Belief:
        """The state one step later, with the noise (order·n, order·n) of the present."""
        ahead, covariance, memory = forecast
        n, past, blocks, head = self.n, self.past, self.blocks, self.head
        P = belief.P.reshape(blocks, n, blocks, n)
        x, out = np.empty((blocks, n)), np.empty((blocks, n, blocks, n))
        x[1:past] = belief.x.reshape(blocks, n)[: past - 1]
        out[1:past, :, 1:past] = P[: past - 1, :, : past - 1]
        present = (covariance + noise).reshape(len(head), n, len(head), n)
        for i, block in enumerate(head):
            x[block] = ahead[i * n : (i + 1) * n]
            towards = self._carried(P[:, :, : past - 1], i)
            out[block, :, 1:past] = towards
            out[1:past, :, block] = towards.transpose(1, 2, 0)
            for j, other in enumerate(head):
                out[block, :, other] = present[i, :, j]
        return Belief(x.ravel(), out.reshape(blocks * n, blocks * n), memory)

    def cross(self, belief: Belief) -> FloatArray:
        """Covariance of a state (rows) and the one that it moves to (columns). (B·n, B·n)"""
        n, past, blocks = self.n, self.past, self.blocks
        P = belief.P.reshape(blocks, n, blocks * n)
        moved = np.empty_like(P)
        moved[1:past] = P[: past - 1]
        for i, block in enumerate(self.head):
            moved[block] = self._carried(P, i)
        return moved.reshape(blocks * n, blocks * n).T

    def _carried(self, blocks: FloatArray, i: int) -> FloatArray:
        """Part i of F s from the blocks of a state, along the first axis."""
        row = self.process.transition[i]
        total = blocks[0] if row[0] == 1.0 else row[0] * blocks[0]
        for factor, block in zip(row[1:], self.head[1:], strict=True):
            total = total + factor * blocks[block]
        return np.asarray(total)

    def instants(self, belief: Belief, prior: Belief) -> ComplexArray:
        """Voltages of the present and the K instants before it, one step later. (N, K+1)"""
        n = self.n
        whole = np.concatenate([prior.x[:n], belief.x[: self.lags * n]]).reshape(-1, n).T
        return np.asarray(whole[: n // 2] + 1j * whole[n // 2 :])

    def revised(self, instants: ComplexArray, x: FloatArray) -> ComplexArray:
        """Those voltages with what another state has of them. (N, K+1)"""
        n, kept = self.n, min(self.past, self.lags + 1)
        known = x[: kept * n].reshape(kept, 2, n // 2)
        out = instants.copy()
        out[:, :kept] = (known[:, 0] + 1j * known[:, 1]).T
        return out

    def turned(self, before: FloatArray, after: FloatArray, P: FloatArray) -> FloatArray:
        """A corrected state in which what goes across a voltage has turned it.

        Added to a voltage, a correction by an angle δ would lengthen it by δ²/2. A voltage that is
        told more exactly than that (`MOST_SIGMAS`) stays as its rows, expanded about it, have it.
        What a process adds to the present is left as it is.

        Parameters
        ----------
        before, after : (B·n,) ndarray
            A state and what it was corrected to.
        P : (B·n, B·n) ndarray
            Its covariance.

        Returns
        -------
        (B·n,) ndarray
        """
        n, kept = self.n // 2, self.past * self.n
        old, new = (s[:kept].reshape(-1, 2, n) for s in (before, after))
        voltage, added = (s[:, 0] + 1j * s[:, 1] for s in (old, new))
        change = added / voltage - 1.0
        turned = voltage * (1.0 + change.real) * np.exp(1j * change.imag)
        direction = added / np.abs(added)
        apart = (turned - added) / direction
        e = (self.n * np.arange(self.past)[:, None] + np.arange(n)).ravel()
        e_e, e_f, f_f = (P[i, j].reshape(-1, n) for i, j in ((e, e), (e, e + n), (e + n, e + n)))
        both, c, s = 2.0 * direction.real * direction.imag * e_f, direction.real, direction.imag
        along, across = c**2 * e_e + both + s**2 * f_f, s**2 * e_e - both + c**2 * f_f
        exact = (apart.real**2 > MOST_SIGMAS**2 * along) | (apart.imag**2 > MOST_SIGMAS**2 * across)
        voltage = np.where(exact, added, turned)
        out = after.copy()
        out[:kept] = np.stack([voltage.real, voltage.imag], axis=1).ravel()
        return out

    def expect(
        self,
        belief: Belief,
        prior: Belief,
        noise: FloatArray,
        rows: Rows,
        plane: sparse.csr_array,
        reach: Reach | None,
    ) -> Expected:
        """Covariances of rows that read the voltages of several instants, one step later.

        Parameters
        ----------
        belief, prior : Belief
            Before the step, and what it has `moved` to.
        noise : (order·n, order·n) ndarray
            Q of the present.
        rows : Rows
        plane : (r, n) csr_array
            Their functionals of one instant.
        reach : Reach, optional
            None if they read the present only.

        Returns
        -------
        Expected
        """
        n, past, blocks, head = self.n, self.past, self.blocks, self.head
        if reach is None:
            cross = plane @ prior.P[:n]
            return Expected(cross, plane @ cross[:, :n].T)
        share, now = reach.share, reach.share[:, 0]
        # Weights of the blocks as they stand before the step: the present is F s + g.
        folded = np.zeros((len(share), blocks))
        folded[:, : self.lags] = share[:, 1:]
        for factor, block in zip(self.process.transition[0], head, strict=True):
            folded[:, block] += factor * now
        reading = rows.of_blocks(plane, folded)

        before = reading @ belief.P
        moving = plane @ noise[:n]
        own = reading @ before.T
        own += reach.moving * (plane @ moving[:, :n].T)

        cross = np.empty((len(share), blocks, n))
        known = before.reshape(len(share), blocks, n)
        cross[:, 1:past] = known[:, : past - 1]
        for i, block in enumerate(head):
            np.multiply(now[:, None], moving[:, i * n : (i + 1) * n], out=cross[:, block])
            cross[:, block] += self._carried(known.swapaxes(0, 1), i)
        return Expected(cross.reshape(len(share), blocks * n), own)
