"""Scores: errors against truth, faults found, and whether a filter's σ means what it says.

How much power a section may carry stands in `pse_analysis.scoring.transfer_limit`, which no stage
of a case needs, so that it is imported where it is asked for.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType

import pandas as pd

from pse_analysis.errors import ParameterError
from pse_analysis.scoring import consistency, detection, errors, observers
from pse_analysis.vocabulary import check

__all__ = [
    "Published",
    "ScoreParams",
    "consistency",
    "detection",
    "errors",
    "observers",
    "score",
]


def __getattr__(name: str) -> ModuleType:
    """Import the study of transfer limits on first use."""
    if name == "transfer_limit":
        return importlib.import_module("pse_analysis.scoring.transfer_limit")
    raise AttributeError(f"module 'pse_analysis.scoring' has no attribute {name!r}")


@dataclass(frozen=True)
class Published:
    """A printed number that stands beside a score.

    Attributes
    ----------
    method, metric, element : str
        Of the score.
    value : float
        As printed.
    source : str
        Paper and place.
    """

    method: str
    metric: str
    value: float
    source: str
    element: str = ""


@dataclass(frozen=True)
class ScoreParams:
    """How results are judged.

    Attributes
    ----------
    by_hour : bool
        Whether consistency is also given by hour of day (UTC).
    by_element : bool
        Whether errors are also given by bus.
    by_channel : bool
        Whether detection of faults is also given by channel.
    settling : SettlingParams
        When an observer of a machine counts as settled.
    published : tuple of Published
        Printed numbers, which no score is computed from.
    """

    by_hour: bool = True
    by_element: bool = True
    by_channel: bool = False
    settling: observers.SettlingParams = field(default_factory=observers.SettlingParams)
    published: tuple[Published, ...] = ()


def score(
    estimated: pd.DataFrame,
    steps: pd.DataFrame,
    validated: pd.DataFrame,
    truth: pd.DataFrame | None = None,
    faults: pd.DataFrame | None = None,
    params: ScoreParams | None = None,
    *,
    expected: Mapping[str, observers.Expected] | None = None,
) -> pd.DataFrame:
    """Score every method and trial of a case.

    Parameters
    ----------
    estimated, steps, validated : DataFrame
        Tables of these names.
    truth, faults : DataFrame, optional
        Of simulated cases; without them what needs them is left out.
    params : ScoreParams, optional
    expected : mapping of str to Expected, optional
        What theory says of each observer of a machine.

    Returns
    -------
    DataFrame
        Table ``scored``. ``element`` is "" for the whole case, ``bus/…`` or ``hour/…`` for a part
        of it, and the kind of fault or the channel for detection, whose method is "validate".
    """
    params = params or ScoreParams()
    parts = [consistency.of_steps(steps, estimated, by_hour=params.by_hour)] if len(steps) else []
    if truth is not None and len(estimated):
        paired = errors.against_truth(estimated, truth)
        parts.append(errors.of_states(paired, by_element=params.by_element))
        parts.append(consistency.coverage(paired, by_hour=params.by_hour))
        if expected:
            parts.append(observers.of_observers(paired, expected, params.settling))
    if faults is not None:
        parts.append(detection.of_faults(validated, faults, by_channel=params.by_channel))
    parts = [p for p in parts if len(p)]
    if not parts:
        raise ParameterError(
            "nothing to score: the case has no [[estimate.methods]] and no record of its faults; "
            "add a method, or end the run with --until validate"
        )
    scored = pd.concat(parts, ignore_index=True)
    scored = _beside_print(scored, params.published)
    scored["trial"] = scored["trial"].astype("int32")
    return check("scored", scored)


def _beside_print(scored: pd.DataFrame, published: tuple[Published, ...]) -> pd.DataFrame:
    scored = scored.assign(published=float("nan"), source="")
    for one in published:
        rows = (
            (scored["method"] == one.method)
            & (scored["metric"] == one.metric)
            & (scored["element"] == one.element)
        )
        if not rows.any():
            raise ParameterError(
                f"[score.published] no score {one.metric!r} of method {one.method!r}: expected one "
                f"of {', '.join(sorted(set(scored['metric'])))}"
            )
        scored.loc[rows, ["published", "source"]] = [one.value, one.source]
    return scored
