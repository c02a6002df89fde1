"""Compare everything that is stored of a case with what was written, and say what was touched."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pse_analysis.checksums import CHECKSUMS, is_raw_table, read_checksums, remedy
from pse_analysis.errors import DamagedFile, PseError
from pse_analysis.files import Facts, files_below, unchanged
from pse_analysis.pipeline.cache import MANIFEST, Entry, Store
from pse_analysis.pipeline.case import Case
from pse_analysis.pipeline.descent import older, simulation_inputs
from pse_analysis.pipeline.plan import Options
from pse_analysis.pipeline.raw_folder import RawFolder


@dataclass(frozen=True)
class Finding:
    """One thing that is not as it was written.

    Attributes
    ----------
    path : Path
        The file or folder.
    what : str
        What is wrong with it, and what to do.
    damage : bool
        Whether numbers are at stake; False for what is merely older, or somebody else's.
    """

    path: Path
    what: str
    damage: bool


def verify(case: Case, options: Options) -> tuple[int, list[Finding]]:
    """Compare the raw folder and every stored result of a case with their digests.

    Nothing is changed. Tables are compared with the manifest to the last bit; their provenance
    must name the fingerprint and inputs under which the manifest has them.

    Returns
    -------
    int
        Number of files compared.
    list of Finding
        What is not as it was written.
    """
    store = Store(options.data_folder / "processed" / case.name)
    raw = RawFolder(options.data_folder / "raw" / case.name)
    entries = store.entries()
    found = list(_raw(raw))
    count = len(_listed(raw))
    for stage, entry in entries.items():
        count += len(entry.files)
        found += _stage(case, stage, entry)
    manifest, again = store.folder / MANIFEST, f"`pse run {case.name}` makes it again"
    for stage in store.damaged():
        found.append(Finding(manifest, f"{stage}: its part was damaged or changed: {again}", True))
    if os.path.lexists(manifest) and not entries and not store.damaged():
        found.append(Finding(manifest, f"names no result: {again}", True))
    try:
        files = raw.describe() if raw.occupied else {}
    except PseError as error:
        return count, [*found, Finding(raw.folder, str(error), True)]
    read = simulation_inputs(case, options.data_folder)
    for stage, why in older(case, entries, files, raw.marker(), read).items():
        place = raw.folder if stage == "simulate" else entries[stage].folder
        found.append(Finding(place, f"older: {why}; `pse run {case.name}` makes it anew", False))
    return count, found


def _listed(raw: RawFolder) -> Mapping[str, Facts]:
    try:
        return read_checksums(raw.folder)
    except DamagedFile:
        return {}


def _raw(raw: RawFolder) -> Iterator[Finding]:
    if not raw.occupied:
        yield Finding(raw.folder, "no raw data", False)
        return
    try:
        listed = read_checksums(raw.folder)
    except DamagedFile as error:
        yield Finding(raw.folder / CHECKSUMS, str(error), True)
        return
    simulated = raw.marker() is not None
    if not listed:
        what = remedy(raw.folder) if simulated else "--accept lists its files as they are now"
        yield Finding(raw.folder, f"has no {CHECKSUMS}: {what}", simulated)
    for name, facts in listed.items():
        path = raw.folder / name
        if not unchanged(path, facts, thorough=True):
            what = "differs from what was written" if path.is_file() else "is gone"
            yield Finding(path, f"{what}: {remedy(raw.folder)}", True)
    for path in files_below(raw.folder):
        name = path.relative_to(raw.folder).as_posix()
        if listed and is_raw_table(name) and name not in listed:
            what = f": {remedy(raw.folder)}" if simulated else ""
            yield Finding(path, f"was added since{what}", simulated)


def _stage(case: Case, stage: str, entry: Entry) -> Iterator[Finding]:
    again = f"`pse run {case.name} --force` makes it again"
    for name, facts in entry.files.items():
        path = entry.folder / name
        if not path.is_file():
            yield Finding(path, f"is gone: {again}", True)
        elif not unchanged(path, facts, thorough=True):
            yield Finding(path, f"differs from what was written: {again}", True)
        elif name.endswith(".parquet"):
            yield from _provenance(path, case, stage, entry, again)
    for path in files_below(entry.folder):
        if path.relative_to(entry.folder).as_posix() not in entry.files:
            yield Finding(path, "is not a file of this program", False)


def _provenance(path: Path, case: Case, stage: str, entry: Entry, again: str) -> Iterator[Finding]:
    # pyarrow is imported here, so that the command line starts without it.
    from pse_analysis.telemetry import read_provenance

    try:
        told = read_provenance(path)
    except PseError as error:
        yield Finding(path, f"{error}; {again}", True)
        return
    expected = {
        "case": case.name,
        "stage": stage,
        "fingerprint": entry.fingerprint,
        "inputs": dict(entry.inputs),
        "parameters": dict(entry.parameters),
    }
    for key, value in expected.items():
        if told.get(key) != value:
            yield Finding(
                path,
                f"says {key} {told.get(key)!r}, but {MANIFEST} says {value!r}: one of the two was "
                f"changed: {again}",
                True,
            )
            return
