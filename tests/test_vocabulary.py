"""Claim: a table obeys its schema, or the message names table, column, expectation and value."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from study_tables import study_tables

from pse_analysis.errors import TableError
from pse_analysis.vocabulary import (
    KEYS,
    SEVERITY,
    UNITS,
    Flag,
    Quantity,
    Reason,
    check,
    schema,
    severity,
    usable,
)

TABLES = study_tables(n_instant=60, n_trial=1)


def test_largest_severity_of_several_reasons_counts() -> None:
    bits = [
        0,
        Reason.GAP,
        Reason.LATE,
        Reason.LATE | Reason.LIMIT,
        Reason.LIMIT | Reason.NOT_FINITE,
    ]
    expected = [Flag.GOOD, Flag.GOOD, Flag.SUSPECT, Flag.BAD, Flag.MISSING]
    assert severity([int(b) for b in bits]).tolist() == [int(f) for f in expected]


def test_every_reason_has_a_severity_and_a_bit_of_its_own() -> None:
    reasons = [r for r in Reason if r]
    assert set(SEVERITY) == set(reasons)
    assert sum(reasons) == 2 ** len(reasons) - 1


def test_good_and_suspect_are_usable() -> None:
    flags = [Flag.GOOD, Flag.SUSPECT, Flag.BAD, Flag.MISSING]
    assert usable(flags).tolist() == [True, True, False, False]


def test_every_quantity_has_units() -> None:
    assert set(UNITS) == set(Quantity)
    assert all(len(units) > 0 for units in UNITS.values())


@pytest.mark.parametrize("table", sorted(KEYS))
def test_every_table_has_its_keys_among_its_columns(table: str) -> None:
    assert set(KEYS[table]) <= set(schema(table).columns)


def test_columns_come_back_in_order_and_strangers_stay_behind() -> None:
    frame = TABLES.truth[TABLES.truth.columns[::-1]].assign(stranger=1)
    checked = check("truth", frame)
    assert list(checked.columns) == ["trial", "time_utc", "element", "quantity", "value"]
    pd.testing.assert_frame_equal(checked, TABLES.truth)


def set_(column: str, value: object) -> object:
    """A change of one column, the whole of it."""
    return lambda frame: frame.assign(**{column: value})


@pytest.mark.parametrize(
    ("table", "change", "expected"),
    [
        ("channels", lambda f: f.drop(columns="unit"), "channels: column 'unit' is missing; exp"),
        ("channels", set_("sigma", 0.0), r"of channel '.+': expected above 0, received 0.0; m"),
        ("channels", set_("sigma", -1.0), "'sigma'.*received -1.0"),
        ("channels", set_("sigma", np.nan), "a value in every row, received nan"),
        ("channels", set_("source", "radar"), "one of 'scada', 'pmu'.*received 'radar'"),
        ("channels", set_("side", np.nan), "'side' of.*every row, received nan"),
        ("channels", set_("quantity", "p_kw"), "'quantity'.*received 'p_kw'"),
        ("channels", set_("element", "node/4"), "'element'.*received 'node/4'"),
        ("channels", set_("sign", np.int8(0)), "'sign'.*received 0"),
        ("channels", set_("period_s", 0.0), "'period_s'.*received 0.0"),
        ("validated", set_("value", "1.0"), "type float64, received object, e.g. '1.0'"),
        ("validated", set_("trial", 0), "column 'trial'.*int32"),
        ("validated", set_("flag", np.int8(9)), "'flag'.*received 9"),
        ("truth", lambda f: f.assign(time_utc=f.time_utc.dt.tz_localize(None)), "'time_utc'.*UTC"),
        ("aligned", set_("sigma_pu", 0.0), "aligned: column 'sigma_pu'"),
        ("aligned", set_("age_s", -1e-3), "'age_s'.*-0.001"),
        ("aligned", set_("origin", "guessed"), "'origin'.*'guessed'"),
        ("steps", set_("status", "fine"), "'status'.*'fine'"),
        ("truth", lambda f: pd.concat([f, f.head(2)]), "2 rows repeat the key .*bus/1"),
    ],
)  # fmt: skip
def test_message_names_table_column_expectation_and_value(
    table: str, change: object, expected: str
) -> None:
    with pytest.raises(TableError, match=expected):
        check(table, change(getattr(TABLES, table)))  # type: ignore[operator]


def test_missing_values_stand_where_they_may() -> None:
    frame = TABLES.validated.assign(value=np.nan)
    frame["arrival_utc"] = frame["arrival_utc"].where(frame["trial"] < 0)
    assert check("validated", frame)["value"].isna().all()
    with pytest.raises(TableError, match="'value'"):
        check("truth", TABLES.truth.assign(value=np.nan))


def test_input_is_left_as_it_was() -> None:
    before = TABLES.truth.copy()
    check("truth", TABLES.truth)
    pd.testing.assert_frame_equal(TABLES.truth, before)
