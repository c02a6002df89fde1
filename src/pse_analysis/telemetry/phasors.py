"""Complex values: the part of a phasor, or of complex power, that a channel measures."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis.arrays import ComplexArray, FloatArray
from pse_analysis.errors import TableError
from pse_analysis.vocabulary import Quantity

log = logging.getLogger(__name__)


MAGNITUDES = (Quantity.VM_PU, Quantity.I_KA)
ANGLES = (Quantity.VA_DEGREE, Quantity.IA_DEGREE)
POWERS = (Quantity.P_MW, Quantity.Q_MVAR)


def measured_part(
    value: ComplexArray, row: npt.NDArray[np.intp], channels: pd.DataFrame
) -> FloatArray:
    """What each channel measures of a complex value, in the channel's own unit.

    Parameters
    ----------
    value : (n,) ndarray of complex
        Phasors V or I, and complex power S = P + jQ.
    row : (n,) ndarray of int
        Row of each value's channel in ``channels``.
    channels : DataFrame
        Table ``channels`` as the source describes it.

    Returns
    -------
    (n,) ndarray
        |z| for voltage and current magnitudes, arg z for their angles, in degree or rad as the
        channel's unit says, and the real or imaginary part for P or Q. Where the source counts the
        other direction (sign −1) the angle is that of −z, stated so that the channel's sign turns
        it back. An angle is NaN where the phasor is zero or not finite: it has none.

    Raises
    ------
    TableError
        If a channel measures what has no complex value, as a machine's speed.
    """
    quantity = channels["quantity"].to_numpy(dtype=object)
    out = np.full(len(value), np.nan)
    for name in pd.unique(quantity[np.unique(row)]):
        mine = quantity[row] == name
        z = value[mine]
        if name in MAGNITUDES:
            with np.errstate(all="ignore"):
                out[mine] = np.abs(z)
        elif name in ANGLES:
            out[mine] = _angle(z, row[mine], channels)
        elif name == Quantity.P_MW:
            out[mine] = z.real
        elif name == Quantity.Q_MVAR:
            out[mine] = z.imag
        else:
            channel = channels["channel"].iloc[int(row[np.argmax(mine)])]
            raise TableError(
                f"telemetry: values of {channel!r} are complex, e.g. {complex(z[0])}, but {name} "
                "has no phasor; expected real numbers: pass the part it measures, e.g. frame.value."
                "map(lambda z: z.real)"
            )
    _name_without_imaginary_part(value, row, channels)
    return out


def _angle(z: ComplexArray, row: npt.NDArray[np.intp], channels: pd.DataFrame) -> FloatArray:
    sign = channels["sign"].to_numpy(dtype=float)[row]
    degrees = (channels["unit"] == "degree").to_numpy()[row]
    defined = np.isfinite(z.real) & np.isfinite(z.imag) & (z != 0)
    angle = np.full(len(z), np.nan)
    angle[defined] = np.angle(z[defined] * sign[defined]) * sign[defined]
    return np.where(degrees, np.degrees(angle), angle)


def _name_without_imaginary_part(
    value: ComplexArray, row: npt.NDArray[np.intp], channels: pd.DataFrame
) -> None:
    """Warn of angles and reactive powers that may be plain numbers in a column of phasors."""
    wanted = channels["quantity"].isin([*ANGLES, Quantity.Q_MVAR]).to_numpy()
    finite = np.isfinite(value.real) & np.isfinite(value.imag)
    count = np.bincount(row[finite], minlength=len(channels))
    turned = np.bincount(row[finite & (value.imag != 0)], minlength=len(channels))
    plain = wanted & (count > 0) & (turned == 0)
    for at in np.flatnonzero(plain):
        log.warning(
            "telemetry: no value of %s has an imaginary part, so that its %s is that of a real "
            "number, 0 or half a turn; if these are plain readings among phasors, pass them in a "
            "frame of their own",
            channels["channel"].iloc[at],
            "reactive power" if channels["quantity"].iloc[at] == Quantity.Q_MVAR else "angle",
        )
