"""How many of the injected faults of telemetry the checks found, and what they flagged besides."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pandas as pd

from pse_analysis.vocabulary import FaultKind, Flag, Reason

KEY = ["trial", "channel", "seq"]

CLAIMS: Mapping[FaultKind, Reason] = MappingProxyType(
    {
        FaultKind.EMPTY: Reason.NOT_FINITE,
        FaultKind.DUPLICATED: Reason.DUPLICATE,
        FaultKind.DELAYED: Reason.LATE | Reason.BACKWARD,
        FaultKind.STALE: Reason.STUCK,
        FaultKind.SPIKE: Reason.LIMIT | Reason.INCREMENT | Reason.EXTRAPOLATION,
    }
)
"""The kind of fault that a flag's reasons speak of; the first that holds."""


def of_faults(
    validated: pd.DataFrame, faults: pd.DataFrame, *, by_channel: bool = False
) -> pd.DataFrame:
    """Precision and recall of the flags.

    Parameters
    ----------
    validated, faults : DataFrame
        Tables of these names. A lost sample has no ``seq``: nothing can be flagged, so it does
        not count as missed.
    by_channel : bool
        Whether to give the same by channel.

    Returns
    -------
    DataFrame
        Method "validate", by trial: ``found``, ``missed``, ``false_alarms`` (flagged samples
        without a fault), ``precision``, ``recall``, ``false_alarm_rate`` (per good sample). They
        stand for the whole case (element ""), for each channel if asked, and, but for the last,
        by kind of fault: there a false alarm counts for the kind that its reasons speak of.
    """
    present = faults[faults["seq"].notna() & (faults["kind"] != FaultKind.LOST)]
    injected = present.assign(seq=present["seq"].astype("int64"))[[*KEY, "kind"]]
    flags = validated[[*KEY, "flag", "reasons"]]
    hit = injected.merge(flags, on=KEY, how="left")
    hit["found"] = hit["flag"] > Flag.GOOD
    both = flags.merge(injected[KEY].drop_duplicates(), on=KEY, how="left", indicator=True)
    clean = both[both["_merge"] == "left_only"].assign(alarm=lambda t: t["flag"] > Flag.GOOD)
    clean["kind"] = _claimed(clean["reasons"].to_numpy())
    rows: list[tuple[int, str, str, float]] = []
    for trial in sorted(validated["trial"].unique()):
        mine, good = hit[hit["trial"] == trial], clean[clean["trial"] == trial]
        once = mine.drop_duplicates(KEY)  # a sample may have several faults
        rows += _rows(trial, "", once["found"], good["alarm"])
        for kind, part in mine.groupby("kind", sort=True):
            alarms = good.loc[good["kind"] == kind, "alarm"]
            rows += _rows(trial, str(kind), part["found"], alarms)[:-1]
        if by_channel:
            own = dict(iter(once.groupby("channel", sort=True)["found"]))
            for channel, alarms in good.groupby("channel", sort=True)["alarm"]:
                found = own.get(channel, mine["found"].iloc[:0])
                rows += _rows(trial, str(channel), found, alarms)
    table = pd.DataFrame(rows, columns=["trial", "metric", "element", "value"])
    return table.assign(method="validate", unit="1")


def _rows(
    trial: int, element: str, found: pd.Series, alarmed: pd.Series
) -> list[tuple[int, str, str, float]]:
    total, hits, alarms = len(found), int(found.sum()), int(alarmed.sum())
    values = {
        "found": float(hits),
        "missed": float(total - hits),
        "recall": hits / total if total else float("nan"),
        "false_alarms": float(alarms),
        "precision": hits / (hits + alarms) if hits + alarms else float("nan"),
        "false_alarm_rate": alarms / len(alarmed) if len(alarmed) else float("nan"),
    }
    return [(trial, metric, element, value) for metric, value in values.items()]


def _claimed(reasons: np.ndarray[tuple[int], np.dtype[np.int32]]) -> list[str]:
    """Kind of fault that each sample's reasons speak of; "" for none."""
    kind = np.full(len(reasons), "", dtype=object)
    for claimed, bits in reversed(list(CLAIMS.items())):
        kind[(reasons & int(bits)) != 0] = str(claimed)
    return list(kind)
