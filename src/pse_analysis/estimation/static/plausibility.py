"""Whether a state is one that a grid is operated in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pse_analysis.grid.network import Network
from pse_analysis.measurement import wrap

FARTHEST = 0.5
"""Distance of |V| from its rating at which no grid is operated. [p.u.]"""


def implausible(
    network: Network, x: npt.NDArray[np.float64], open_: npt.NDArray[np.bool_] | None = None
) -> str:
    """Returns why a state is none that a grid is operated in, "" if nothing speaks against it.

    Parameters
    ----------
    network : Network
    x : (2N,) ndarray
        [θ; |V|]. [rad, p.u.]
    open_ : (2N,) ndarray of bool, optional
        States that are not looked at.
    """
    n, branch = network.n_bus, network.branches
    off = np.abs(x[n:] - 1.0)
    apart = np.abs(x[branch.from_bus] - x[branch.to_bus] - branch.shift_rad)
    if off.max() < FARTHEST and apart.max(initial=0.0) <= 0.5 * np.pi:
        return ""
    unknown = np.zeros(2 * n, dtype=bool) if open_ is None else open_
    off[unknown[n:]] = 0.0
    if off.max(initial=0.0) >= FARTHEST:
        bus = int(off.argmax())
        return f"no state of operation: |V| of bus {network.buses.name[bus]} is {x[n + bus]:.3g}"
    across = np.abs(wrap(apart))
    across[~branch.in_service | unknown[branch.from_bus] | unknown[branch.to_bus]] = 0.0
    if across.max(initial=0.0) > 0.5 * np.pi:
        k = int(across.argmax())
        return (
            f"no state of operation: {np.rad2deg(across[k]):.0f} degrees across branch "
            f"{branch.name[k]}"
        )
    return ""
