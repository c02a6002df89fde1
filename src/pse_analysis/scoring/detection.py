"""How many of the injected faults of telemetry the checks found, and what they flagged besides."""

from __future__ import annotations

import pandas as pd

from pse_analysis.vocabulary import FaultKind, Flag

KEY = ["trial", "channel", "seq"]


def of_faults(validated: pd.DataFrame, faults: pd.DataFrame) -> pd.DataFrame:
    """Precision and recall of the flags.

    Parameters
    ----------
    validated, faults : DataFrame
        Tables of these names. A lost sample has no ``seq``: nothing can be flagged, so it does
        not count as missed.

    Returns
    -------
    DataFrame
        Method "validate", by trial: ``found``, ``missed``, ``false_alarms`` (flagged samples
        without a fault), ``precision``, ``recall``, ``false_alarm_rate`` (per good sample), and
        ``found``, ``missed`` and ``recall`` by kind of fault in ``element``.
    """
    present = faults[faults["seq"].notna() & (faults["kind"] != FaultKind.LOST)]
    injected = present.assign(seq=present["seq"].astype("int64"))[[*KEY, "kind"]]
    flags = validated[[*KEY, "flag"]]
    hit = injected.merge(flags, on=KEY, how="left")
    hit["found"] = (hit["flag"] > Flag.GOOD).astype("int64")
    faulty = flags.merge(injected[KEY].drop_duplicates(), on=KEY, how="left", indicator=True)
    clean = faulty["_merge"] == "left_only"
    alarmed = (faulty["flag"] > Flag.GOOD) & clean
    rows: list[tuple[int, str, str, float]] = []
    for trial in sorted(validated["trial"].unique()):
        mine = hit[hit["trial"] == trial]
        own = faulty["trial"] == trial
        alarms = int((alarmed & own).sum())
        once = mine.drop_duplicates(KEY)["found"]  # a sample may have several faults
        rows.extend((trial, name, "", value) for name, value in _counts(once))
        found = int(once.sum())
        flagged = found + alarms
        rows.append((trial, "false_alarms", "", float(alarms)))
        rows.append((trial, "precision", "", found / flagged if flagged else float("nan")))
        good = int((clean & own).sum())
        rows.append((trial, "false_alarm_rate", "", alarms / good if good else float("nan")))
        for kind, part in mine.groupby("kind", sort=True):
            rows.extend((trial, name, str(kind), value) for name, value in _counts(part["found"]))
    table = pd.DataFrame(rows, columns=["trial", "metric", "element", "value"])
    return table.assign(method="validate", unit="1")


def _counts(found: pd.Series) -> list[tuple[str, float]]:
    total, hits = len(found), int(found.sum())
    return [
        ("found", float(hits)),
        ("missed", float(total - hits)),
        ("recall", hits / total if total else float("nan")),
    ]
