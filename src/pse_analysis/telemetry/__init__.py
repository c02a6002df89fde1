"""Raw telemetry: reading and writing a case's raw folder, and the door for tables of one's own."""

from __future__ import annotations

from pse_analysis.telemetry.channels import check_channels, check_shunts
from pse_analysis.telemetry.ingestion import ingest
from pse_analysis.telemetry.tables import (
    RawCase,
    read_model,
    read_raw,
    read_table,
    read_telemetry,
    write_raw,
    write_table,
)

__all__ = [
    "RawCase",
    "check_channels",
    "check_shunts",
    "ingest",
    "read_model",
    "read_raw",
    "read_table",
    "read_telemetry",
    "write_raw",
    "write_table",
]
