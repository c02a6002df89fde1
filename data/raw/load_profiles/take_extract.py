"""Take one week of load and PV curves out of the SimBench data set.

    python data/raw/load_profiles/take_extract.py

needs ``pip install simbench==1.6.3`` beside this project's own dependencies; nothing else in the
project uses that package. The tables written are committed, so that nobody has to run this again.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

FIRST, LAST = "06.06.2016 00:00", "13.06.2016 00:00"
"""Monday to Monday in German local time, both included: the last point closes the last bridge."""

LOADS = (
    *("lv_rural1", "lv_rural2", "lv_rural3", "lv_semiurb4", "lv_semiurb5", "lv_urban6", "mv_comm"),
    *("H0-H", "G3-H", "G4-H", "BL-H", "WB-H"),
    *("G0-M", "G3-M", "G4-M", "L2-M"),
    *("G0-A", "G1-B", "G3-A", "G4-B", "G5-A", "H0-A", "H0-C", "L0-A"),
)
PV = tuple(f"PV{i}" for i in range(1, 9))


def week(path: Path, columns: list[str]) -> pd.DataFrame:
    """Rows of the week from one of SimBench's profile files, indexed by UTC."""
    frame = pd.read_csv(path, sep=";", usecols=["time", *columns])
    # The file is in local time with summer time (the hour 02:00 occurs twice on 30 October), so
    # rows are taken by position, between two stamps that occur once.
    first, last = (int(np.flatnonzero(frame["time"] == t)[0]) for t in (FIRST, LAST))
    frame = frame.iloc[first : last + 1]
    local = pd.DatetimeIndex(pd.to_datetime(frame["time"], format="%d.%m.%Y %H:%M"))
    frame.index = local.tz_localize("Europe/Berlin").tz_convert("UTC").as_unit("us")
    return frame[columns].astype("float32")


def main() -> None:
    """Write the extract beside this script."""
    spec = importlib.util.find_spec("simbench")
    if spec is None or spec.origin is None:
        raise SystemExit("simbench is not installed: pip install simbench==1.6.3")
    source = Path(spec.origin).parent / "networks" / "1-complete_data-mixed-all-0-sw"
    here = Path(__file__).parent
    loads = week(
        source / "LoadProfile.csv", [f"{c}_{k}" for c in LOADS for k in ("pload", "qload")]
    )
    pv = week(source / "RESProfile.csv", list(PV))
    frame = pd.concat([loads, pv], axis=1)
    table = pa.table(
        {
            "time_utc": pa.array(frame.index.to_numpy(), pa.timestamp("us")).cast(
                pa.timestamp("us", tz="UTC")
            ),
            **{c: pa.array(frame[c].to_numpy(), pa.float32()) for c in frame.columns},
        }
    )
    pq.write_table(table, here / "week.parquet", compression="zstd", compression_level=19)


if __name__ == "__main__":
    main()
