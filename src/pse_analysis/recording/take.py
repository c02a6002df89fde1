"""What a recording shows: of which case, one trial, and the window that its plots open on."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from pse_analysis.errors import ParameterError
from pse_analysis.recording.views import Window
from pse_analysis.recording.whole import CountedStream, write_whole

if TYPE_CHECKING:
    from pse_analysis.parameters import Study

APPLICATION = "pse_analysis"

MAX_LANES = 40
"""Channels in one picture of lanes; beyond this only those with findings are shown."""

MAX_SERIES = 8
"""Channels whose samples are drawn one by one."""


@dataclass(frozen=True)
class Take:
    """One recording: the file that it goes into, and what of a case it shows.

    Attributes
    ----------
    path : str or Path
        The ``.rrd`` file to write; replaced if it exists.
    case : str
        Name of the case. All its files share an id, so the viewer shows them as one.
    study : Study, optional
        The plots open on its window; without it, on the whole record.
    trial : int
        Trial to draw; summaries speak of all.
    """

    path: str | Path
    case: str
    study: Study | None = None
    trial: int = 0

    def of(self, table: pd.DataFrame) -> pd.DataFrame:
        """Rows of the trial."""
        return table[table.trial == self.trial]

    def window(self, times: pd.Series) -> Window:
        """The study's window, or all of the given times where there is no study."""
        if self.study is not None:
            return Window(pd.Timestamp(self.study.start), pd.Timestamp(self.study.end))
        return Window(times.min(), times.max())

    @contextmanager
    def open(self, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
        """A stream of what the file is to hold, on which the viewer opens with the blueprint.

        The file is written when the block ends, and read back. If the block fails, no file is
        written.

        Raises
        ------
        StorageError
            If the file does not hold every byte, or not every row that was sent.
        ParameterError
            If the environment turned Rerun off.
        """
        stream = CountedStream(APPLICATION, recording_id=f"{APPLICATION}-{self.case}")
        if not rr.is_enabled(stream):
            raise ParameterError(
                f"the variable RERUN={os.environ.get('RERUN')} turns recordings off: unset it and "
                "run again"
            )
        # Rerun only logs what goes wrong while it writes a file, so it records to memory.
        memory = stream.memory_recording()
        try:
            stream.send_blueprint(blueprint, make_active=False, make_default=True)
            stream.send_recording_name(self.case)
            yield stream
            content = memory.drain_as_bytes()
        finally:
            stream.disconnect()
        write_whole(Path(self.path), content, stream.rows)


def coded(table: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """The table with texts as categories, among which a search is many times faster."""
    return table.assign(**{name: table[name].astype("category") for name in columns})
