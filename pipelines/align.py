"""Bring telemetry onto the instants of the study: python pipelines/align.py CASE... [--force]."""

import sys

from run import stage_main

if __name__ == "__main__":
    sys.exit(stage_main("align"))
