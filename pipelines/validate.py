"""Flag what is wrong with a case's telemetry: python pipelines/validate.py CASE... [--force]."""

import sys

from run import stage_main

if __name__ == "__main__":
    sys.exit(stage_main("validate"))
