"""Whether stored results descend from each other and from the case file as it is now.

A result is *older* when its stage read other parameters or other files than those that are there:
shown beside current ones, its numbers would speak of another study. Standard library only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pse_analysis.files import Facts, content
from pse_analysis.pipeline.cache import Entry
from pse_analysis.pipeline.case import Case
from pse_analysis.pipeline.fingerprint import canonical
from pse_analysis.pipeline.plan import STAGES, Stage


def read_parameters(case: Case, stage: Stage) -> dict[str, str]:
    """What a stage reads of the case file: canonical JSON by key."""
    texts = {"grid": case.grid, "title": case.title}
    return {key: canonical(texts.get(key, case.sections.get(key))) for key in stage.keys}


def inputs(
    stage: Stage, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
) -> dict[str, str]:
    """Digest of the content of every file that a stage reads, by name."""
    found = {
        f"raw/{name}": content(facts)
        for name, facts in raw_files.items()
        if name.split("/")[0] in stage.raw
    }
    for earlier, table in stage.tables:
        file = f"{table}.parquet"
        if earlier in entries and file in entries[earlier].files:
            found[f"{earlier}/{file}"] = content(entries[earlier].files[file])
    return found


def older(
    case: Case,
    entries: Mapping[str, Entry],
    raw_files: Mapping[str, Facts],
    marker: Mapping[str, Any] | None,
) -> dict[str, str]:
    """Stages whose result is older than the case file or than what it was made from, and why.

    Parameters
    ----------
    case
        The case as its file is now.
    entries
        Stored results.
    raw_files
        The raw folder's files as they are now.
    marker
        What the simulation noted in the raw folder; None if the folder is the user's.
    """
    found: dict[str, str] = {}
    for stage in STAGES:
        if stage.name == "simulate":
            noted = (marker or {}).get("parameters", {}) if case.simulated else None
            reason = "" if noted is None else _changed(case, stage, noted)
        elif stage.name in entries:
            reason = _reason(case, stage, entries, raw_files, found)
        else:
            continue
        if reason:
            found[stage.name] = reason
    return found


def _reason(
    case: Case,
    stage: Stage,
    entries: Mapping[str, Entry],
    raw_files: Mapping[str, Facts],
    found: Mapping[str, str],
) -> str:
    entry = entries[stage.name]
    for earlier in dict.fromkeys(("simulate", *(name for name, _ in stage.tables))):
        if earlier in found:
            return f"{earlier} is older: {found[earlier].removeprefix(f'{earlier} is older: ')}"
    now = inputs(stage, raw_files, entries)
    for name in sorted({*now, *entry.inputs}):
        if now.get(name) != entry.inputs.get(name):
            return f"{name} has changed since"
    return _changed(case, stage, entry.parameters)


def _changed(case: Case, stage: Stage, noted: object) -> str:
    """Which keys of the case file say something else than what was noted; "" if none does."""
    then = noted if isinstance(noted, Mapping) else {}
    now = read_parameters(case, stage)
    keys = [key for key in stage.keys if now.get(key) != then.get(key)]
    if not keys:
        return ""
    return f"{' and '.join(keys)} of the case file {'have' if keys[1:] else 'has'} changed since"
