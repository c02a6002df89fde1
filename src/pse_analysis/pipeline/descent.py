"""Whether stored results descend from each other and from the case file as it is now.

A result is *older* when its stage read other parameters or other files than those that are there:
shown beside current ones, its numbers would speak of another study. Standard library only.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pse_analysis.files import Facts, content, describe_folder
from pse_analysis.pipeline.cache import Entry
from pse_analysis.pipeline.case import NAME, Case, project_root
from pse_analysis.pipeline.fingerprint import SOURCE_ROOT, canonical
from pse_analysis.pipeline.plan import STAGES, Stage

PROFILES = "load_profiles"


def profiles_folder(data: Path) -> Path:
    """Load profiles beside the data, or else the project's own."""
    own = data / "raw" / PROFILES
    return own if own.is_dir() else project_root() / "data" / "raw" / PROFILES


def simulation_inputs(case: Case, data: Path) -> dict[str, str]:
    """Digest of every file that a case's simulation reads, by name; empty if it has none."""
    if not case.simulated:
        return {}
    folders = {"profiles": profiles_folder(data)}
    # A name that is none is refused when the grid is loaded.
    if NAME.fullmatch(case.grid or ""):
        folders["tables"] = SOURCE_ROOT / "pse_analysis" / "grid" / "tables" / str(case.grid)
    return {
        f"{kind}/{name}": facts["digest"]
        for kind, folder in folders.items()
        for name, facts in describe_folder(
            folder, asked=lambda name: name.endswith((".parquet", ".csv"))
        ).items()
    }


def read_parameters(case: Case, stage: Stage) -> dict[str, str]:
    """What a stage reads of the case file: canonical JSON by key."""
    texts = {"grid": case.grid, "title": case.title}
    return {key: canonical(texts.get(key, case.sections.get(key))) for key in stage.keys}


def filters(case: Case, stage: Stage) -> list[str]:
    """Names of the filters that a stage runs, whatever else the case file says."""
    section = case.sections.get("estimate") if "estimate" in stage.keys else None
    tables = section.get("methods") if isinstance(section, Mapping) else None
    listed = tables if isinstance(tables, list) else []
    found = [table.get("filter") for table in listed if isinstance(table, Mapping)]
    return [name for name in found if isinstance(name, str)]


def inputs(
    stage: Stage, raw_files: Mapping[str, Facts], entries: Mapping[str, Entry]
) -> dict[str, str]:
    """Digest of every file that a stage reads, by name.

    Of a derived table its pages count: what they mean is fixed by its schema, and the footer names
    versions. Of a raw table all counts: its footer says in which unit a column is.
    """
    found = {
        f"raw/{name}": str(facts["digest"])
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
    simulated_from: Mapping[str, str],
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
    simulated_from
        What a simulation would read now, `simulation_inputs`.
    """
    found: dict[str, str] = {}
    for stage in STAGES:
        if stage.name == "simulate":
            reason = _of_simulation(case, stage, marker, simulated_from) if case.simulated else ""
        elif stage.name in entries:
            reason = _of_stage(case, stage, entries, raw_files, found)
        else:
            continue
        if reason:
            found[stage.name] = reason
    return found


def _of_simulation(
    case: Case, stage: Stage, marker: Mapping[str, Any] | None, now: Mapping[str, str]
) -> str:
    if marker is None:
        return "its raw data are gone, or were not made by a simulation"
    return _files(now, marker.get("inputs")) or _keys(case, stage, marker.get("parameters"))


def _of_stage(
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
    changed = _files(inputs(stage, raw_files, entries), entry.inputs)
    return changed or _keys(case, stage, entry.parameters)


def _files(now: Mapping[str, str], noted: object) -> str:
    """Which file is not the one that was read; "" if all are."""
    then = noted if isinstance(noted, Mapping) else {}
    for name in sorted({*now, *then}):
        if now.get(name) != then.get(name):
            what = "is new" if name not in then else "is gone" if name not in now else "has changed"
            return f"{name} {what} since"
    return ""


def _keys(case: Case, stage: Stage, noted: object) -> str:
    """Which keys of the case file say something else than what was noted; "" if none does."""
    then = noted if isinstance(noted, Mapping) else {}
    now = read_parameters(case, stage)
    keys = [key for key in stage.keys if now.get(key) != then.get(key)]
    if not keys:
        return ""
    return f"{' and '.join(keys)} of the case file {'have' if keys[1:] else 'has'} changed since"
