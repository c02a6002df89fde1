"""The Rerun viewer as this project starts it: on this machine only, and without usage data.

Standard library only.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from pse_analysis.errors import ParameterError

ADDRESS = "127.0.0.1"
"""Where the viewer listens; unless told otherwise it listens on every interface."""


def quiet(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment in which Rerun's programs neither collect usage data nor announce it.

    They collect none where ``CI`` is set, and then write nothing to the user's own configuration
    either. ``rerun analytics disable`` would change that configuration for all programs.
    """
    kept = {k: value for k, value in environment.items() if k != "FORCE_RERUN_ANALYTICS"}
    return {**kept, "CI": "true"}


def find() -> str:
    """The viewer's program: the one beside this Python, or else the first on the PATH.

    Raises
    ------
    ParameterError
        If there is none.
    """
    beside = Path(sys.executable).with_name("rerun")
    program = str(beside) if beside.is_file() else shutil.which("rerun")
    if program is None:
        raise ParameterError(
            f"no Rerun viewer: expected {beside} or rerun on the PATH; install rerun-sdk"
        )
    return program


def start(recordings: Sequence[Path]) -> NoReturn:
    """Become the viewer of the recordings: this process does not return.

    Raises
    ------
    ParameterError
        If there is no viewer.
    """
    program = find()
    command = [program, *map(str, recordings), "--bind", ADDRESS]
    os.execve(program, command, quiet(os.environ))
