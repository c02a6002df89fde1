"""Claim: a filter's curve looks alike in every figure, and curves that do not fit are refused."""

from __future__ import annotations

import numpy as np
import pytest

from pse_analysis.errors import TableError
from pse_analysis.figures import curves


def test_names_keep_their_colours_and_the_truth_is_black() -> None:
    k = np.arange(5)
    order = ("ukf", "aukf", "rukf")
    whole = curves(k, {"a": dict.fromkeys(order, k + 1.0)}, "k", order=order)
    part = curves(k, {"a": {"true": k + 1.0, "rukf": k + 2.0}}, "k", order=order, log_y=True)
    colours = {line.get_label(): line.get_color() for line in whole.axes[0].lines}
    shown = {line.get_label(): line.get_color() for line in part.axes[0].lines}
    assert len(set(colours.values())) == 3
    assert shown == {"true": "#000000", "rukf": colours["rukf"]}


def test_curve_of_another_length_is_refused() -> None:
    with pytest.raises(TableError, match=r"'ukf' has shape \(3,\)"):
        curves(np.arange(5), {"a": {"ukf": np.arange(3)}}, "k")
