"""What a recording shows of its tables: one trial, and the window it opens on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from pse_analysis.recording import stream as marks

if TYPE_CHECKING:
    from pse_analysis.parameters import Study

MAX_LANES = 40
"""Channels in one picture of lanes; beyond this only those with findings are shown."""

MAX_SERIES = 8
"""Channels whose samples are drawn one by one."""


def of_trial(table: pd.DataFrame, trial: int) -> pd.DataFrame:
    """Rows of one trial."""
    return table[table.trial == trial]


def coded(table: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """The table with texts as categories, among which a search is many times faster."""
    return table.assign(**{name: table[name].astype("category") for name in columns})


def open_on(times: pd.Series, study: Study | None) -> marks.Window:
    """The study window, or everything there is where no study is given."""
    if study is not None:
        return marks.Window(pd.Timestamp(study.start), pd.Timestamp(study.end))
    return marks.Window(times.min(), times.max())
