"""Score a case's estimates against the truth: python pipelines/score.py CASE... [--force]."""

import sys

from run import stage_main

if __name__ == "__main__":
    sys.exit(stage_main("score"))
