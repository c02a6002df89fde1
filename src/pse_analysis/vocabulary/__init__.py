"""The glossary: names, units, flags and table schemas that every other module speaks.

Conventions, fixed here once:

- Users meet pandapower's names and units (``vm_pu``, ``va_degree``, ``p_mw``, ``q_mvar``,
  ``i_ka``); the mathematics works in per unit and radians. `pse_analysis.measurement` holds the
  only boundary.
- Injection is positive into the grid (generation), branch flow is positive from the metered bus
  into the branch. Shunts and line charging belong to the grid, never to the injection.
- Time is UTC with microseconds. σ is a standard deviation.
- A flag says what is wrong; only `usable` says what is good.

Glossary
--------
case            one study: a TOML file and a folder of raw parquet
channel         one measured quantity of one sensor, e.g. ``pmu:bus/6:vm_pu``
element         ``bus/NAME``, ``branch/NAME`` or ``machine/NAME``, with NAME as the model spells it
instant         a time at which the state is estimated
sample          one value of one channel as it arrived
study window    the instants that are estimated and scored; telemetry before it is *history*
trial           one realisation of load, noise and faults, drawn from its own seed
variant         a named way to run one stage (for example alignment with or without DTW)
innovation      measurement minus its prediction, η
NIS, NEES       normalised squared innovation ηᵀS⁻¹η and state error eᵀP⁻¹e
section         branch ends, with signs, that together cut a grid in two areas
loading vector  changes of generation and load that grow together, λ times
contingency     branches that trip together; also *outage*
nose            the largest λ that a grid carries: a saddle node, or limit-induced where a generator
                reaches its reactive limit
MAPF            maximum allowed power flow of a section: the lowest of six criteria
"""

from __future__ import annotations

from pse_analysis.vocabulary.columns import as_number, plain_columns, plain_values, unwritable
from pse_analysis.vocabulary.schemas import KEYS, check, schema, shown
from pse_analysis.vocabulary.terms import (
    SEVERITY,
    UNITS,
    Aggregation,
    FaultKind,
    Flag,
    Origin,
    Quantity,
    Reason,
    Side,
    SigmaKind,
    Source,
    Status,
    plain_unit,
    severity,
    usable,
)
from pse_analysis.vocabulary.texts import markdown_text

__all__ = [
    "KEYS",
    "SEVERITY",
    "UNITS",
    "Aggregation",
    "FaultKind",
    "Flag",
    "Origin",
    "Quantity",
    "Reason",
    "Side",
    "SigmaKind",
    "Source",
    "Status",
    "as_number",
    "check",
    "markdown_text",
    "plain_columns",
    "plain_unit",
    "plain_values",
    "schema",
    "severity",
    "shown",
    "unwritable",
    "usable",
]
