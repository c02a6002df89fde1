"""The standard error of a transfer limit by sampling the base state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from pse_analysis.arrays import FloatArray
from pse_analysis.errors import NotConverged, ParameterError
from pse_analysis.grid.continuation import Loading
from pse_analysis.grid.network import Network
from pse_analysis.scoring.transfer_limit.limit import Run, transfer_limit
from pse_analysis.scoring.transfer_limit.params import Contingency, TransferLimitParams
from pse_analysis.scoring.transfer_limit.result import TransferLimit
from pse_analysis.scoring.transfer_limit.sections import Section

FAR = 8.0
"""Standard errors by which a result lies above the lowest so that sampling leaves it out."""


@dataclass(frozen=True, eq=False)
class SampledLimit:
    """Transfer limits of sampled base states.

    Attributes
    ----------
    values_mw : (count,) ndarray
        NaN where a sample has no limit. [MW]
    mean_mw, sigma_mw : float
        Their mean and standard deviation. [MW]
    undetermined : int
        Samples without a limit.
    binding : DataFrame
        ``loading``, ``contingency``, ``criterion``, and the ``share`` of samples in which each
        binds.
    """

    values_mw: FloatArray
    mean_mw: float
    sigma_mw: float
    undetermined: int
    binding: pd.DataFrame


@dataclass(frozen=True, eq=False)
class _Sample:
    """One base state, and what is computed for it."""

    state: FloatArray
    network: Network
    section: Section
    loadings: tuple[Loading, ...]
    params: TransferLimitParams
    contingencies: tuple[Contingency, ...]


def sampled_limit(
    network: Network,
    section: Section,
    loadings: Sequence[Loading],
    params: TransferLimitParams | None = None,
    *,
    contingencies: Sequence[Contingency | str] = (),
    state: FloatArray,
    covariance: FloatArray,
    rng: np.random.Generator,
    count: int = 200,
    limit: TransferLimit | None = None,
    run: Run = map,
    progress: Callable[[int, int], None] | None = None,
) -> SampledLimit:
    """Draw base states from their distribution and find the limit of each anew.

    Every sample is traced to its own nose, so that changes of the binding criterion count, which
    the delta method does not see. Loading vectors and outages whose every criterion lies more than
    `FAR` standard errors above the lowest are left out.

    Parameters
    ----------
    network, section, loadings, params, contingencies
        As in `transfer_limit`.
    state : (2N,) ndarray
        Mean [θ; |V|]. [rad, p.u.]
    covariance : (2N, 2N) ndarray
    rng : Generator
    count : int
        Number of samples; their standard deviation has a relative error of 1/√(2 count).
    limit : TransferLimit, optional
        Of the mean state with the covariance, if it is there already.
    run : callable
        As in `transfer_limit`.
    progress : callable, optional
        Called with the number of samples done and that of all.

    Raises
    ------
    ParameterError
        On fewer than two samples.
    NotConverged
        If fewer than two samples have a limit.
    """
    if count < 2:
        raise ParameterError(f"sampling needs two samples at least, received count = {count}")
    params = params or TransferLimitParams()
    limit = limit or transfer_limit(
        network,
        section,
        loadings,
        params,
        contingencies=contingencies,
        state=state,
        covariance=covariance,
    )
    near = _near(limit.table)
    wanted = tuple(loading for loading in loadings if loading.name in set(near["loading"]))
    outages = [c if isinstance(c, Contingency) else Contingency(c, (c,)) for c in contingencies]
    mean = _Sample(
        state=state,
        network=network,
        section=section,
        loadings=wanted,
        # What lies past the nose is only for show.
        params=replace(params, continuation=replace(params.continuation, past_nose=0)),
        contingencies=tuple(c for c in outages if c.name in set(near["contingency"])),
    )
    states = state + rng.standard_normal((count, len(state))) @ _root(covariance).T
    found = []
    for number, one in enumerate(run(_limit_of, [replace(mean, state=x) for x in states]), start=1):
        found.append(one)
        if progress is not None:
            progress(number, count)
    return _summary(network.name, found)


def _summary(grid: str, found: Sequence[tuple[float, str, str, str]]) -> SampledLimit:
    """Mean, standard deviation and binding criteria of samples."""
    table = pd.DataFrame(found, columns=["value", "loading", "contingency", "criterion"])
    values = table["value"].to_numpy(dtype=float)
    known = np.isfinite(values)
    if known.sum() < 2:
        raise NotConverged(
            f"{grid}: {int((~known).sum())} of {len(known)} sampled states have no limit: "
            "the base state is too uncertain, or too near to the limit itself"
        )
    key = ["loading", "contingency", "criterion"]
    share = table[known].groupby(key, sort=False).size() / known.sum()
    return SampledLimit(
        values_mw=values,
        mean_mw=float(values[known].mean()),
        sigma_mw=float(values[known].std(ddof=1)),
        undetermined=int((~known).sum()),
        binding=share.rename("share").reset_index(),
    )


def _limit_of(sample: _Sample) -> tuple[float, str, str, str]:
    """The limit of one base state, and what binds; NaN where there is none."""
    try:
        found = transfer_limit(
            sample.network,
            sample.section,
            sample.loadings,
            sample.params,
            contingencies=sample.contingencies,
            state=sample.state,
        )
    except NotConverged:
        return np.nan, "", "", ""
    return found.mapf_mw, found.loading, found.contingency, found.criterion


def _near(table: pd.DataFrame) -> pd.DataFrame:
    """Rows that may bind in some sample."""
    value, sigma = table["value_mw"], table["sigma_mw"].fillna(0.0)
    found = table["state"] == "found"
    lowest = value[found].idxmin()
    far = value - value[lowest] > FAR * np.hypot(sigma, sigma[lowest])
    return table[~(found & far) & (table["state"] != "not_reached")]


def _root(covariance: FloatArray) -> FloatArray:
    """A square root of a covariance that may be singular, as where the reference is fixed."""
    size, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(size, 0.0)))
