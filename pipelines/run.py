"""Run the stages of cases that are not current: python pipelines/run.py CASE... [--until STAGE]."""

import sys

try:
    from pse_analysis.pipeline.cli import run_main, stage_main
except ModuleNotFoundError as error:
    if error.name != "pse_analysis":
        raise
    sys.exit(
        f"pse_analysis is not installed for {sys.executable}: run `make install` once, then "
        "start this script with .venv/bin/python"
    )

__all__ = ["run_main", "stage_main"]

if __name__ == "__main__":
    sys.exit(run_main())
