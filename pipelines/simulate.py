"""Make a case's raw folder: python pipelines/simulate.py CASE... [--force]."""

import sys

from run import stage_main

if __name__ == "__main__":
    sys.exit(stage_main("simulate"))
