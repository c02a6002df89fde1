"""Types of arrays, and times as arrays: defined once for the whole package."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
TimeArray = npt.NDArray[np.datetime64]


def utc_microseconds(times: pd.Series | pd.DatetimeIndex) -> TimeArray:
    """Times with a zone as UTC without one, in microseconds. (n,)

    Parameters
    ----------
    times : Series or DatetimeIndex
        With a time zone; a naive index counts as UTC.
    """
    index = pd.DatetimeIndex(times)
    if index.tz is not None:
        index = index.tz_convert("UTC").tz_localize(None)
    return np.asarray(index.to_numpy().astype("datetime64[us]"))
