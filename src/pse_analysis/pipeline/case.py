"""Cases: TOML files that hold every number a study may change.

Standard library only: a cached run reads its case without waiting for numpy.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pse_analysis.errors import ParameterError
from pse_analysis.parameters import Study, brief, build

NAME = re.compile(r"[a-z0-9_-]+")
TEXTS = ("title", "grid", "notebook")
MOST_BYTES = 1 << 20
"""Size of a case file; the longest of this project has some ten thousand."""
SERIES = ("generated", "curves")
"""Tables of ``simulate`` that make a case of metered loads."""
SECTIONS = ("machine", "study", "simulate", "validate", "align", "estimate", "score")


@dataclass(frozen=True)
class Case:
    """One study as its file states it.

    Attributes
    ----------
    name, title : str
        The file's stem, and the line that describes it.
    path : Path
        The TOML file.
    grid : str or None
        Name in `pse_analysis.grid.library`; None if the raw folder brings its own grid, if the
        case is about a machine, whose nameplate is the table ``machine``, or about metered loads
        alone.
    notebook : str or None
        Notebook that tells the case's story, relative to the project.
    sections : mapping
        The TOML tables as read; `pse_analysis.pipeline.stages` builds parameters from them.
    """

    name: str
    title: str
    path: Path
    grid: str | None
    notebook: str | None
    sections: Mapping[str, Mapping[str, Any]]

    @property
    def simulated(self) -> bool:
        """Whether the raw folder is made by the case itself."""
        return "simulate" in self.sections

    @property
    def of_series(self) -> bool:
        """Whether the simulation is of metered loads alone, without a grid between them."""
        return not set(self.sections.get("simulate", {})).isdisjoint(SERIES)

    @property
    def study(self) -> Study:
        """The instants to estimate."""
        return build(Study, self.sections["study"], "study")


def project_root() -> Path:
    """The folder that holds ``pipelines/cases``: around the working folder, or the checkout's.

    Where neither is found it is the working folder itself, so that messages name a place the
    user knows.
    """
    here = Path.cwd()
    for folder in (here, *here.parents, *Path(__file__).resolve().parents):
        if (folder / "pipelines" / "cases").is_dir():
            return folder
    return here


def cases_folder(cases: Path | None = None) -> Path:
    """The folder of case files.

    Raises
    ------
    ParameterError
        If it does not exist.
    """
    folder = project_root() / "pipelines" / "cases" if cases is None else Path(cases)
    if not folder.is_dir():
        raise ParameterError(
            f"no folder of cases: expected {folder}; run from the project's folder or name "
            "one with --cases DIR"
        )
    return folder


def list_cases(cases: Path | None = None) -> tuple[str, ...]:
    """Names of the cases there are, sorted."""
    return tuple(sorted(path.stem for path in cases_folder(cases).glob("*.toml")))


def load_case(name: str, cases: Path | None = None) -> Case:
    """Find and read a case.

    Parameters
    ----------
    name
        Lower-case letters, digits, ``_`` and ``-``: the stem of a file in the folder of cases.
    cases
        Folder of case files; by default ``pipelines/cases`` of the project.

    Raises
    ------
    ParameterError
        On a name that cannot be a case's, an unknown case, a syntax error of the file (with its
        line) or a section that nothing reads.
    """
    if not NAME.fullmatch(name):
        raise ParameterError(
            f"case {name!r}: expected a name of lower-case letters, digits, '_' and '-', not a "
            "path; `pse cases` lists the names"
        )
    folder = cases_folder(cases)
    path = folder / f"{name}.toml"
    if not path.is_file():
        known = list_cases(cases)
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ParameterError(
            f"no case {name!r} in {folder}: {hint}expected any of {', '.join(known) or '(none)'}"
        )
    return _check(name, path, _read(path))


def _read(path: Path) -> dict[str, Any]:
    """The tables of a case file."""
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ParameterError(
                f"{path}: expected a case file of at most {MOST_BYTES} bytes, received {size}: "
                "telemetry belongs into the raw folder"
            )
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ParameterError(f"{path}: not valid TOML: {error}") from error
    except UnicodeDecodeError as error:
        raise ParameterError(f"{path}: expected UTF-8 text, received {error.reason}") from error
    except ParameterError:
        raise
    except (ValueError, RecursionError) as error:  # numbers of 4,300 digits, brackets in brackets
        why = str(error) or "its tables are nested too deeply"
        raise ParameterError(f"{path}: cannot be read: {why}") from error
    except OSError as error:
        raise ParameterError(
            f"{path}: cannot be read ({error.strerror}): check its owner and mode"
        ) from error


def _check(name: str, path: Path, data: dict[str, Any]) -> Case:
    allowed = (*TEXTS, *SECTIONS)
    for key, value in data.items():
        if key not in allowed:
            close = difflib.get_close_matches(key, allowed, n=1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            raise ParameterError(
                f"{path}: unknown key {key!r}: {hint}expected any of {', '.join(allowed)}"
            )
        kind, expected = (str, "a text") if key in TEXTS else (dict, f"a table [{key}]")
        if not isinstance(value, kind):
            raise ParameterError(f"{path}: {key} must be {expected}, received {brief(value)}")
        if isinstance(value, str) and not (value.strip() and value.isprintable()):
            raise ParameterError(
                f"{path}: {key} must be a text of one line without control characters, received "
                f"{brief(value)}"
            )
    for key in ("title", "study"):
        if key not in data:
            raise ParameterError(f"{path}: {key!r} is missing: add it to the case file")
    models: list[str] = [name for name in ("grid", "machine") if name in data]
    models += [f"simulate.{name}" for name in SERIES if name in data.get("simulate", {})][:1]
    if len(models) > 1:
        raise ParameterError(
            f"{path}: a case is about a grid or about a machine or about metered loads, received "
            f"{' and '.join(models)}: keep one of them"
        )
    if "grid" in data and "simulate" not in data:
        raise ParameterError(
            f"{path}: grid = {brief(data['grid'])} is simulated, but there is no table [simulate]: "
            "drop it to use the grid in the raw folder, or add [simulate]"
        )
    if "simulate" in data and not models:
        raise ParameterError(
            f'{path}: a case with [simulate] needs grid = "NAME", a name of the grid library, a '
            "table [machine] with a nameplate, or loads in [[simulate.generated]] or "
            "[[simulate.curves]]"
        )
    case = Case(
        name=name,
        title=data["title"],
        path=path,
        grid=data.get("grid"),
        notebook=data.get("notebook"),
        sections=MappingProxyType({key: data[key] for key in SECTIONS if key in data}),
    )
    try:
        _ = case.study
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from error
    return case
