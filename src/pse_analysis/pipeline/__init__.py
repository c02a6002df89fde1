"""Cases and their stages: run them, and read what they left behind.

Importing this package imports the standard library only; tables are read when asked for.
"""

from __future__ import annotations

from pse_analysis.pipeline.results import Results, load, run

__all__ = ["Results", "load", "run"]
