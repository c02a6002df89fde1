"""The validate stage: telemetry in, the same samples with flags, reasons and thresholds out."""

from __future__ import annotations

import difflib
import logging
from datetime import UTC, datetime, timedelta

import numpy as np
import numpy.typing as npt
import pandas as pd

from pse_analysis import vocabulary
from pse_analysis.arrays import FloatArray, IntArray, utc_microseconds
from pse_analysis.errors import ParameterError, TableError
from pse_analysis.measurement import Model
from pse_analysis.validation import extrapolation, periods
from pse_analysis.validation.block import RULED_OUT, Criteria, screen
from pse_analysis.validation.criteria import decide
from pse_analysis.validation.default_limits import PhysicalLimits, physical_limits
from pse_analysis.validation.increments import Structure, learn, unwound
from pse_analysis.validation.rules import Rule, ValidateParams, resolve
from pse_analysis.validation.timing import Stamps, time_reasons
from pse_analysis.vocabulary import Quantity, Reason

log = logging.getLogger(__name__)

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECONDS = 1e6
_DAY = 86_400_000_000

TURNS = {"degree": 360.0, "rad": 2.0 * np.pi}
"""Full turn of an angle in the units it may have."""
LEARNING = frozenset({"increment", "extrapolation", "stuck"})
"""Checks that need to know how a channel usually moves."""
FOLDED = (Quantity.VA_DEGREE, Quantity.IA_DEGREE)
"""Angles that are known up to full turns; a rotor's is not."""


def validate(
    telemetry: pd.DataFrame,
    channels: pd.DataFrame,
    params: ValidateParams | None = None,
    *,
    history_end: datetime | None = None,
    model: Model | None = None,
) -> pd.DataFrame:
    """Flag the samples of a telemetry table; none is deleted and none is overwritten.

    Parameters
    ----------
    telemetry : DataFrame
        Of schema ``telemetry``.
    channels : DataFrame
        Of schema ``channels``.
    params : ValidateParams, optional
        Rules per source, quantity or channel; the defaults check limits from ``channels``, or
        else physical ones, and changes against thresholds learnt from the history.
    history_end : datetime, optional
        Samples stamped and arrived before it are the history that σ, k and the usual delay are
        learnt from. Without it only stated thresholds are applied.
    model : Network or Machine, optional
        What the default limits of powers, currents and rotors follow from; without it those have
        none. Needed where a rule is stated in kV or A and its channel in p.u., or the reverse.

    Returns
    -------
    DataFrame
        Of schema ``validated``, in the rows' own order and with their index: ``flag``,
        ``reasons``, ``statistic`` and ``threshold`` of the decisive check, and ``corrected``, the
        value a later stage may use (NaN where it must not).

    Raises
    ------
    TableError
        If a sample's channel is not in ``channels``.
    ParameterError
        If a rule fits no channel, or its prior and costs lead to rejecting every sample.

    Notes
    -----
    From ``history_end`` on, flags depend on samples up to their own only; but a stamp that has
    jumped ahead is known by the next one, well before the time it claims. One bad channel stops
    nothing: where limits reject every sample of a channel, or its samples come in another period
    than is stated, a warning is logged. The stage goes on with the stated period: the spacing is
    known only afterwards, and a mean's interval is no matter of its stamps.
    """
    params = ValidateParams() if params is None else params
    rules = resolve(channels, params, model)
    code = _channel_code(telemetry, channels)
    trial = telemetry["trial"].to_numpy()
    seq = telemetry["seq"].to_numpy()
    order = np.lexsort((seq, code, trial))
    stamps = Stamps(
        lane=_lanes(trial[order], code[order]),
        time=_microseconds(telemetry["time_utc"])[order],
        arrival=_microseconds(telemetry["arrival_utc"])[order],
    )
    value = telemetry["value"].to_numpy(dtype=float)[order]
    lane_channel = code[order][stamps.start]
    lane_rules = [rules[i] for i in lane_channel]
    period = channels["period_s"].to_numpy(dtype=float)[lane_channel]

    until = _instant(history_end)
    history = np.zeros(len(value), dtype=bool)
    if until is not None:
        known = np.where(stamps.arrived, stamps.arrival, stamps.time)
        history = (stamps.time < until) & (known < until)
    late = np.array([np.nan if r.late_s is None else r.late_s for r in lane_rules])
    reasons, backward = time_reasons(stamps, value, period, late, history)
    checks_time = np.array(["time" in (r.checks or ()) for r in lane_rules], dtype=bool)
    always = Reason.DUPLICATE | Reason.BACKWARD | Reason.AHEAD
    reasons[~checks_time[stamps.lane]] &= int(always)
    reasons |= _quality(telemetry["quality"].iloc[order], lane_rules, stamps.lane)

    statistic, threshold = np.full(len(value), np.nan), np.full(len(value), np.nan)
    sigma, relative = _sigmas(channels, lane_channel)
    folded = channels["quantity"].isin(FOLDED)
    turns = channels["unit"].map(TURNS).where(folded).fillna(np.inf).to_numpy(dtype=float)
    turn = turns[lane_channel]
    for lanes in _alike(stamps.length, lane_rules):
        _screen_lanes(
            lanes, stamps, value, period, lane_rules, history, until, sigma, relative, turn,
            reasons, backward, statistic, threshold,
        )  # fmt: skip

    default = physical_limits(channels, model, params.default_limits)
    _warn_of_limits(channels, rules, default, lane_channel[stamps.lane], value, reasons)
    for sentence in periods.sentences(periods.wrong_periods(telemetry, channels)):
        log.warning(sentence)

    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    out = telemetry.copy(deep=False)
    out["reasons"] = reasons[back]
    out["flag"] = vocabulary.severity(out["reasons"].to_numpy())
    out["statistic"] = statistic[back]
    out["threshold"] = threshold[back]
    usable = vocabulary.usable(out["flag"].to_numpy())
    out["corrected"] = np.where(usable, telemetry["value"].to_numpy(dtype=float), np.nan)
    return vocabulary.check("validated", out)


def _warn_of_limits(
    channels: pd.DataFrame,
    rules: list[Rule],
    default: PhysicalLimits,
    channel: IntArray,
    value: FloatArray,
    reasons: npt.NDArray[np.int32],
) -> None:
    """Say which channels have no sample inside their limits: mostly limits in another unit."""
    n = len(channels)
    finite = np.bincount(channel[np.isfinite(value)], minlength=n)
    outside = np.bincount(channel[(reasons & Reason.LIMIT) != 0], minlength=n)
    for at in map(int, np.flatnonzero((finite > 0) & (outside >= finite))):
        rule = rules[at]
        low, high = (limit in (rule.lower, rule.upper) for limit in default.of(at))
        log.warning(
            "%s: all %d samples lie outside the limits %s … %s %s%s, e.g. %.4g, and none is used: "
            "check limits and unit of the channel, and those of [validate.rules]",
            *(rule.channel, outside[at], rule.lower, rule.upper, channels["unit"].iloc[at]),
            f" (default: {default.origin[at]})" if low or high else "",
            value[(channel == at) & np.isfinite(value)][0],
        )


def _screen_lanes(
    lanes: IntArray,
    stamps: Stamps,
    value: FloatArray,
    period: FloatArray,
    rules: list[Rule],
    history: npt.NDArray[np.bool_],
    until: int | None,
    sigma: FloatArray,
    relative: npt.NDArray[np.bool_],
    turn: FloatArray,
    reasons: npt.NDArray[np.int32],
    backward: npt.NDArray[np.bool_],
    statistic: FloatArray,
    threshold: FloatArray,
) -> None:
    """Screen channels of like length as one block and scatter the findings."""
    length = stamps.length[lanes]
    n = int(length.max(initial=0))
    row = np.arange(n)[:, None]
    real = row < length
    at = np.where(real, stamps.start[lanes] + row, stamps.start[lanes])
    x = np.where(real, value[at], np.nan)
    origin = stamps.time[stamps.start[lanes]]
    t = (stamps.time[at] - origin) / (period[lanes] * _MICROSECONDS)
    t = np.where(real, t, np.nan)
    found = np.where(real, reasons[at], np.int32(0)).astype(np.int32)
    chosen = [rules[i] for i in lanes]
    n_bin = int(chosen[0].time_of_day_bins or 0)
    bins = (stamps.time[at] % _DAY * n_bin // _DAY).astype(np.intp) if n_bin else None

    structure: Structure | None = None
    scan_k: FloatArray | None = None
    noise = sigma[lanes]
    if until is not None:
        past = real & history[at] & ((found & RULED_OUT) == 0) & ~np.where(real, backward[at], True)
        limits = decide(chosen, None, noise)
        past &= ~(x < limits.lower) & ~(x > limits.upper)
        depth = int(np.flatnonzero(past.any(axis=1)).max(initial=-1)) + 1
        seen = unwound(np.where(past[:depth], x[:depth], np.nan), turn[lanes])
        if any(not LEARNING.isdisjoint(rule.checks or ()) for rule in chosen):
            kept = None if bins is None else bins[:depth]
            structure = learn(seen, t[:depth], bins=kept, n_bin=n_bin)
        noise = noise * np.where(relative[lanes], _typical(seen), 1.0)
        if any(rule.k == "scan" for rule in chosen):
            scan_k, _ = extrapolation.scan(seen, time=t[:depth])
    criteria: Criteria = decide(chosen, structure, noise, scan_k, turn[lanes])
    scale = None
    if structure is not None and structure.scale is not None and bins is not None:
        scale = structure.scale[bins, np.arange(len(lanes))[None, :]]
    result = screen(
        x,
        t,
        criteria,
        reasons=found,
        scale=scale,
        backward=np.where(real, backward[at], False) if backward.any() else None,
        n_row=length,
    )
    target = at[real]
    reasons[target] = result.reasons[real]
    if result.statistic is not None and result.threshold is not None:
        statistic[target] = result.statistic[real]
        threshold[target] = np.where(np.isinf(result.threshold), np.nan, result.threshold)[real]


def _alike(length: IntArray, rules: list[Rule]) -> list[IntArray]:
    """Groups of channels that make one block: lengths within a factor of two, one set of bins."""
    if not len(length):
        return []
    size = np.ceil(np.log2(np.maximum(length, 1))).astype(np.int64)
    bins = np.array([r.time_of_day_bins or 0 for r in rules], dtype=np.int64)
    _, group = np.unique(np.stack([size, bins]), axis=1, return_inverse=True)
    return [np.flatnonzero(group == g) for g in range(int(group.max()) + 1)]


def _typical(value: FloatArray) -> FloatArray:
    """Median magnitude of each channel's history; 0 where it is empty."""
    out = np.zeros(value.shape[1])
    some = np.isfinite(value).any(axis=0)
    if some.any():
        out[some] = np.nanmedian(np.abs(value[:, some]), axis=0)
    return out


def _sigmas(
    channels: pd.DataFrame, lane_channel: IntArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    relative = (channels["sigma_kind"] == vocabulary.SigmaKind.RELATIVE).to_numpy(dtype=bool)
    return channels["sigma"].to_numpy(dtype=float)[lane_channel], relative[lane_channel]


def _channel_code(telemetry: pd.DataFrame, channels: pd.DataFrame) -> IntArray:
    known = pd.Index(channels["channel"])
    which, names = pd.factorize(telemetry["channel"])
    position = known.get_indexer(pd.Index(names))
    if (position < 0).any():
        name = str(names[int(np.argmin(position))])
        close = difflib.get_close_matches(name, [str(c) for c in known], n=2)
        raise TableError(
            f"telemetry: channel {name!r} is not in the table of channels "
            f"({len(known)} channels{', closest: ' + ', '.join(close) if close else ''}): "
            "add it there or drop its samples"
        )
    return np.asarray(position[which], dtype=np.int64)


def _lanes(trial: npt.NDArray[np.int32], code: IntArray) -> IntArray:
    if not len(code):
        return np.zeros(0, dtype=np.int64)
    new = (np.diff(trial) != 0) | (np.diff(code) != 0)
    return np.concatenate([[0], np.cumsum(new)]).astype(np.int64)


def _quality(quality: pd.Series, rules: list[Rule], lane: IntArray) -> npt.NDArray[np.int32]:
    out = np.zeros(len(lane), dtype=np.int32)
    if not any(rule.bad_quality for rule in rules) or quality.isna().all():
        return out
    codes = quality.fillna(-32768).to_numpy(dtype=np.int64)
    sets = {rule.bad_quality or () for rule in rules}
    for bad in sets:
        mine = np.array([(rule.bad_quality or ()) == bad for rule in rules], dtype=bool)
        out[mine[lane] & np.isin(codes, bad)] = int(Reason.QUALITY)
    return out


def _microseconds(times: pd.Series) -> IntArray:
    """Microseconds since 1970; the least int64 where there is no time."""
    if not isinstance(times.dtype, pd.DatetimeTZDtype):
        raise TableError(
            f"telemetry: {times.name} is {times.dtype}, expected datetime64[us, UTC]: "
            "state the time zone with .dt.tz_localize(...) and .dt.tz_convert('UTC')"
        )
    return utc_microseconds(times).astype(np.int64)


def _instant(moment: datetime | None) -> int | None:
    if moment is None:
        return None
    if moment.tzinfo is None:
        raise ParameterError(
            f"history_end has no time zone: expected UTC, received {moment.isoformat()}; "
            "append tzinfo=UTC"
        )
    return (moment - _EPOCH) // timedelta(microseconds=1)
