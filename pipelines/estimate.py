"""Estimate a case's states with each method: python pipelines/estimate.py CASE... [--force]."""

import sys

from run import stage_main

if __name__ == "__main__":
    sys.exit(stage_main("estimate"))
