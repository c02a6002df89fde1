"""What figures and recordings share: colours, and where the buses of a grid are drawn.

Colours are the palette of Okabe and Ito [1]_, which stays legible with any colour vision. A method
has one colour in every figure and recording, so that a reader learns it once.

.. [1] M. Okabe, K. Ito, "Color Universal Design", 2008, https://jfly.uni-koeln.de/color/
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, shortest_path

from pse_analysis.arrays import FloatArray
from pse_analysis.vocabulary import Reason

if TYPE_CHECKING:
    from pse_analysis.grid.network import Network


ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#8C8C8C"

METHODS: MappingProxyType[str, str] = MappingProxyType(
    {
        **{"wls": ORANGE, "kf_scalar": GREEN, "kf_load": BLUE},
        **{"case_1": VERMILION, "case_2": SKY, "case_3": GREEN},
        **{"matched": BLUE, "luenberger": PURPLE},
    }
)
"""Colours of the methods that most cases run."""

SOURCES: MappingProxyType[str, str] = MappingProxyType(
    {"pmu": VERMILION, "scada": SKY, "ami": PURPLE, "pseudo": YELLOW}
)

REASONS: MappingProxyType[Reason, str] = MappingProxyType(
    {
        Reason.NOT_FINITE: "#FFFFFF",
        Reason.DUPLICATE: PURPLE,
        Reason.BACKWARD: YELLOW,
        Reason.LATE: SKY,
        Reason.LIMIT: VERMILION,
        Reason.INCREMENT: ORANGE,
        Reason.EXTRAPOLATION: BLUE,
        Reason.STUCK: GREEN,
        Reason.GAP: GREY,
        Reason.QUALITY: PURPLE,
        Reason.STEP_ACCEPTED: GREY,
        Reason.INNOVATION: VERMILION,
        Reason.AHEAD: YELLOW,
    }
)

_OTHERS = (PURPLE, SKY, VERMILION, YELLOW, GREY)

# Steps of matplotlib's "viridis", whose order of lightness survives any colour vision and a grey
# printer; its darkest end is left out because it vanishes on a dark screen. Written out so that a
# recording does not import matplotlib.
_SEQUENTIAL = np.array(
    [
        (72, 40, 120),
        (62, 74, 137),
        (49, 104, 142),
        (38, 130, 142),
        (31, 158, 137),
        (53, 183, 121),
        (110, 206, 88),
        (181, 222, 43),
        (253, 231, 37),
    ],
    dtype=np.float64,
)


def method_colours(methods: Iterable[str]) -> dict[str, str]:
    """Colour of each method, the same whatever other methods stand beside it.

    A method without a colour of its own takes one that follows from its name; it moves on only
    if another method of the same picture already holds that colour.

    Parameters
    ----------
    methods : iterable of str
        Names as the case file spells them.

    Returns
    -------
    dict
        Hexadecimal colour by method: the methods of `METHODS` in their order there, then others as
        given.
    """
    given = dict.fromkeys(methods)
    names = [*(name for name in METHODS if name in given), *(n for n in given if n not in METHODS)]
    colours = {name: METHODS[name] for name in names if name in METHODS}
    for name in sorted(set(names) - set(METHODS)):
        start = zlib.crc32(name.encode())
        turns = [_OTHERS[(start + turn) % len(_OTHERS)] for turn in range(len(_OTHERS))]
        free = [colour for colour in turns if colour not in colours.values()]
        colours[name] = (free or turns)[0]
    return {name: colours[name] for name in names}


def sequential(values: npt.ArrayLike, largest: float) -> npt.NDArray[np.uint8]:
    """Colours from violet (0) to yellow (`largest` and above); grey where there is no value.

    Parameters
    ----------
    values : array_like
        Any shape; NaN stands for "not known".
    largest : float
        Value that gets the last colour.

    Returns
    -------
    (..., 3) ndarray of uint8
        Red, green, blue.
    """
    v = np.asarray(values, dtype=np.float64)
    at = np.clip(np.nan_to_num(v) / largest if largest > 0 else np.zeros_like(v), 0.0, 1.0)
    steps = np.arange(len(_SEQUENTIAL)) / (len(_SEQUENTIAL) - 1)
    rgb = np.stack([np.interp(at, steps, _SEQUENTIAL[:, band]) for band in range(3)], axis=-1)
    rgb[~np.isfinite(v)] = (120.0, 120.0, 120.0)
    return np.round(rgb).astype(np.uint8)


def round_up(value: float) -> float:
    """Next value of the form 1, 2 or 5 times a power of ten, for the end of a scale."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value))


def layout(network: Network) -> FloatArray:
    """Where each bus is drawn; the same grid always gets the same picture.

    A radial feeder is drawn as its textbooks draw it: the longest path from the source on a
    straight line, laterals on rows above and below. A meshed grid gets the drawing whose distances
    follow the number of branches between buses best (stress majorisation from a classical-scaling
    start), turned so that its long side lies across.

    Parameters
    ----------
    network : Network
        Branches out of service do not count.

    Returns
    -------
    (n_bus, 2) ndarray
        Positions; buses one branch apart lie about 1 apart.
    """
    live = network.branches.in_service
    ends = np.stack([network.branches.from_bus[live], network.branches.to_bus[live]])
    pairs = np.unique(np.sort(ends, axis=0), axis=1)
    n = network.n_bus
    graph = csr_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(n, n))
    parts, _ = connected_components(graph, directed=False)
    if parts == 1 and pairs.shape[1] == n - 1:
        return _rows(graph, int(network.slack))
    return _stress(graph)


def _rows(graph: csr_array, root: int) -> FloatArray:
    """Tidy drawing of a tree: x is the depth, each path of tallest children has its own row."""
    order, parent = breadth_first_order(graph, root, directed=False)
    height = np.zeros(len(order), dtype=np.int64)
    children: dict[int, list[int]] = {int(bus): [] for bus in order}
    for bus in order[:0:-1]:
        height[parent[bus]] = max(height[parent[bus]], height[bus] + 1)
        children[int(parent[bus])].insert(0, int(bus))
    xy = np.zeros((len(order), 2))
    taken: dict[int, list[tuple[int, int]]] = {}
    waiting = [(root, 0, 0)]
    while waiting:
        bus, depth, near = waiting.pop(0)
        span = (depth, depth + int(height[bus]))
        row = next(r for r in _rows_near(near) if _free(taken.get(r, []), span))
        taken.setdefault(row, []).append(span)
        while True:
            xy[bus] = depth, 1.6 * row
            depth += 1
            if not children[bus]:
                break
            tallest = max(children[bus], key=lambda child: height[child])
            waiting += [(child, depth, row) for child in children[bus] if child != tallest]
            bus = tallest
    return xy


def _rows_near(row: int) -> Iterable[int]:
    """The row itself, then its neighbours outwards: above, below, two above …"""
    yield row
    for far in range(1, 10_000):
        yield row + far
        yield row - far


def _free(spans: list[tuple[int, int]], span: tuple[int, int]) -> bool:
    return all(span[0] > last or span[1] < first for first, last in spans)


def _stress(graph: csr_array, iterations: int = 300) -> FloatArray:
    """Positions whose distances follow the number of branches between buses."""
    hops = shortest_path(graph, directed=False, unweighted=True)
    hops[~np.isfinite(hops)] = np.max(hops[np.isfinite(hops)]) + 2.0
    n = len(hops)
    if n == 1:
        return np.zeros((1, 2))
    centred = np.eye(n) - 1.0 / n
    values, vectors = np.linalg.eigh(-0.5 * centred @ hops**2 @ centred)
    xy = vectors[:, [-1, -2]] * np.sqrt(np.maximum(values[[-1, -2]], 1e-9))
    # Buses that hang on the same neighbours coincide in the start; a fixed spiral parts them.
    turn = np.arange(n)
    xy += 1e-3 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    weight = np.where(hops > 0, 1.0 / np.maximum(hops, 1.0) ** 2, 0.0)
    laplacian = np.diag(weight.sum(axis=1)) - weight
    inverse = np.linalg.inv(laplacian + 1.0 / n) - 1.0 / n
    for _ in range(iterations):
        apart = np.linalg.norm(xy[:, None, :] - xy[None, :, :], axis=2)
        pull = -weight * hops / np.where(apart > 1e-12, apart, np.inf)
        np.fill_diagonal(pull, 0.0)
        np.fill_diagonal(pull, -pull.sum(axis=1))
        xy = inverse @ (pull @ xy)
    xy -= xy.mean(axis=0)
    _, _, axes = np.linalg.svd(xy, full_matrices=False)
    xy = xy @ axes.T
    # An axis has no sign of its own: the bus farthest out along each lies on the positive side.
    sign = np.sign(xy[np.argmax(np.abs(np.round(xy, 6)), axis=0), [0, 1]])
    return np.asarray(xy * np.where(sign == 0, 1.0, sign))
