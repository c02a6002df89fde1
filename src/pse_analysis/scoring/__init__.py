"""Scores: errors against truth, faults found, and whether a filter's σ means what it says."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from pse_analysis.scoring import consistency, detection, errors
from pse_analysis.vocabulary import check

__all__ = ["ScoreParams", "consistency", "detection", "errors", "score"]


@dataclass(frozen=True)
class ScoreParams:
    """How results are judged.

    Attributes
    ----------
    by_hour : bool
        Whether consistency is also given by hour of day (UTC).
    by_element : bool
        Whether errors are also given by bus.
    """

    by_hour: bool = True
    by_element: bool = True


def score(
    estimated: pd.DataFrame,
    steps: pd.DataFrame,
    validated: pd.DataFrame,
    truth: pd.DataFrame | None = None,
    faults: pd.DataFrame | None = None,
    params: ScoreParams | None = None,
) -> pd.DataFrame:
    """Score every method and trial of a case.

    Parameters
    ----------
    estimated, steps, validated : DataFrame
        Tables of these names.
    truth, faults : DataFrame, optional
        Of simulated cases; without them what needs them is left out.
    params : ScoreParams, optional

    Returns
    -------
    DataFrame
        Table ``scored``. ``element`` is "" for the whole case, ``bus/…`` or ``hour/…`` for a part
        of it, and the kind of fault for detection, whose method is "validate".
    """
    params = params or ScoreParams()
    parts = [consistency.of_steps(steps, by_hour=params.by_hour)]
    if truth is not None:
        paired = errors.against_truth(estimated, truth)
        parts.append(errors.of_voltages(paired, by_element=params.by_element))
        parts.append(consistency.coverage(paired, by_hour=params.by_hour))
    if faults is not None:
        parts.append(detection.of_faults(validated, faults))
    scored = pd.concat([p for p in parts if len(p)], ignore_index=True)
    scored["published"] = float("nan")
    scored["source"] = ""
    scored["trial"] = scored["trial"].astype("int32")
    return check("scored", scored)
