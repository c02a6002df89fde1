"""Raw telemetry: reading and writing a case's raw folder, and the door for tables of one's own."""

from __future__ import annotations

from pse_analysis.telemetry.channels import check_channels, check_shunts
from pse_analysis.telemetry.ingestion import ingest
from pse_analysis.telemetry.parquet import read_provenance, read_table, write_table
from pse_analysis.telemetry.tables import (
    RawCase,
    accept,
    read_model,
    read_raw,
    read_raw_table,
    read_telemetry,
    write_raw,
)
from pse_analysis.telemetry.units import check_units

__all__ = [
    "RawCase",
    "accept",
    "check_channels",
    "check_shunts",
    "check_units",
    "ingest",
    "read_model",
    "read_provenance",
    "read_raw",
    "read_raw_table",
    "read_table",
    "read_telemetry",
    "write_raw",
    "write_table",
]
