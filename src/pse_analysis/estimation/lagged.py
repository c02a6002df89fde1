"""A grid's state with its recent past: how it moves, and what functionals of it are expected.

A state is B blocks of n numbers: [e; f] now, one step ago, …, L-1 steps ago, and behind them what
a process adds to the present (the slopes of a trend). When it moves, the present becomes the first
past block, so that before an update L past instants can be read although only L blocks are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pse_analysis.estimation.holt import Process
from pse_analysis.measurement.rectangular import Memo

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
ComplexArray = npt.NDArray[np.complex128]


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
    """Joint moments of complex functionals and a moved state; their real parts stand first.

    Attributes
    ----------
    mean : (2k,) ndarray
    cross : (2k, B·n) ndarray
        Covariance with the state.
    own : (2k, 2k) ndarray
        Covariance, that of what interpolation between instants leaves out included.
    """

    mean: FloatArray
    cross: FloatArray
    own: FloatArray


class Reach(NamedTuple):
    """How functionals reach into the past.

    Attributes
    ----------
    share : (k, K+1) ndarray
        Weights of the present and the K instants before it.
    bridge : (k, k) ndarray
        Covariance of what interpolation between instants leaves out, in units of Q.
    """

    share: FloatArray
    bridge: FloatArray

    @property
    def moving(self) -> FloatArray:
        """Share of Q in the covariance of the functionals. (k, k)"""
        return np.asarray(np.outer(self.share[:, 0], self.share[:, 0]) + self.bridge)


class Functionals:
    """Complex functionals c = y (e + jf) of one instant's voltages as real rows, [Re; Im].

    Parameters
    ----------
    y : (k, N) ndarray of complex

    Attributes
    ----------
    plane : (2k, 2N) ndarray
        The rows themselves.
    """

    def __init__(self, y: ComplexArray) -> None:
        # Re(y V) = Re(y)·e - Im(y)·f and Im(y V) = Im(y)·e + Re(y)·f.
        self.plane = np.block([[y.real, -y.imag], [y.imag, y.real]])
        row, column = np.nonzero(self.plane)
        self._value, self._functional = self.plane[row, column], row % max(len(y), 1)
        self._row, self._column = row, column
        self._patterns: Memo[tuple[BoolArray, sparse.csr_array]] = Memo()

    def __len__(self) -> int:
        return len(self.plane) // 2

    def of_blocks(self, share: FloatArray) -> sparse.csr_array:
        """The rows as functionals of several blocks, with weights (k, B). (2k, B·2N)

        What an earlier call returned is written over.
        """
        kept, rows = self._patterns.get((share != 0).tobytes(), lambda: self._laid_out(share != 0))
        rows.data = (self._value[:, None] * share[self._functional])[kept]
        return rows

    def _laid_out(self, reached: BoolArray) -> tuple[BoolArray, sparse.csr_array]:
        """Which entries of which blocks there are, and the rows that they make."""
        (m, n), blocks = self.plane.shape, reached.shape[1]
        kept = reached[self._functional]
        column = (self._column[:, None] + n * np.arange(blocks))[kept]
        count = np.bincount(self._row, weights=kept.sum(axis=1), minlength=m)
        ends = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        return kept, sparse.csr_array((np.ones(len(column)), column, ends), shape=(m, blocks * n))


@dataclass(frozen=True, eq=False)
class Lagged:
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

    def _carried(self, blocks: FloatArray, i: int) -> FloatArray:
        """Part i of F s from the blocks of a state, along the first axis."""
        row = self.process.transition[i]
        total = blocks[0] if row[0] == 1.0 else row[0] * blocks[0]
        for factor, block in zip(row[1:], self.head[1:], strict=True):
            total = total + factor * blocks[block]
        return np.asarray(total)

    def expect(
        self,
        belief: Belief,
        prior: Belief,
        noise: FloatArray,
        functionals: Functionals,
        reach: Reach | None,
    ) -> Expected:
        """Moments of functionals of the voltages at several instants, one step later.

        Parameters
        ----------
        belief, prior : Belief
            Before the step, and what it has `moved` to.
        noise : (order·n, order·n) ndarray
            Q of the present.
        functionals : Functionals
        reach : Reach, optional
            None if they do not.

        Returns
        -------
        Expected
        """
        n, past, blocks, head = self.n, self.past, self.blocks, self.head
        m, plane = 2 * len(functionals), functionals.plane
        if reach is None:
            cross = plane @ prior.P[:n]
            return Expected(plane @ prior.x[:n], cross, cross[:, :n] @ plane.T)
        share, now = reach.share, reach.share[:, 0]
        # Weights of the blocks as they stand before the step: the present is F s + g.
        folded = np.zeros((len(share), blocks))
        folded[:, : self.lags] = share[:, 1:]
        for factor, block in zip(self.process.transition[0], head, strict=True):
            folded[:, block] += factor * now
        rows = functionals.of_blocks(folded)

        instants = np.concatenate([prior.x[:n], belief.x[: self.lags * n]]).reshape(-1, n)
        mean = ((plane @ instants.T).reshape(2, *share.shape) * share).sum(axis=2).ravel()

        before = rows @ belief.P
        moving = plane @ noise[:n]
        own = rows @ before.T
        own.reshape(2, len(now), 2, len(now))[...] += reach.moving[:, None] * (
            moving[:, :n] @ plane.T
        ).reshape(2, len(now), 2, len(now))

        cross = np.empty((m, blocks, n))
        known = before.reshape(m, blocks, n)
        cross[:, 1:past] = known[:, : past - 1]
        twice = np.concatenate([now, now])[:, None]
        for i, block in enumerate(head):
            np.multiply(twice, moving[:, i * n : (i + 1) * n], out=cross[:, block])
            cross[:, block] += self._carried(known.swapaxes(0, 1), i)
        return Expected(mean, cross.reshape(m, blocks * n), own)


def turned(own: FloatArray, turn: ComplexArray, group: IntArray) -> FloatArray:
    """Covariance of real rows Re(conj(turn_i) c_i), c_i being functional number group_i. (m, m)"""
    return turned_rows(turned_rows(own, turn, group).T.copy(), turn, group)


def turned_rows(functionals: FloatArray, turn: ComplexArray, group: IntArray) -> FloatArray:
    """Re(conj(turn_i) c_i) of what stands for the real and imaginary parts of c. (m, …)"""
    out = functionals.take(group, axis=0)
    out *= turn.real[:, None]
    other = functionals.take(group + len(functionals) // 2, axis=0)
    other *= turn.imag[:, None]
    out += other
    return out
