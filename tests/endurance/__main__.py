"""Long forms of the tests of endurance: ``python -m tests.endurance FORM --count N``."""

from __future__ import annotations

import argparse
import sys
import time

from tests.endurance import filters, flips, kills, mutations

FORMS = {"kills": kills, "flips": flips, "mutations": mutations, "filters": filters}


def main() -> int:
    """Run one form and say how long it took."""
    parser = argparse.ArgumentParser(prog="python -m tests.endurance", description=__doc__)
    parser.add_argument("form", choices=FORMS)
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--seed", type=int)
    options = parser.parse_args()
    form, begun = FORMS[options.form], time.monotonic()
    code = form.main(options.count, form.SEED if options.seed is None else options.seed)
    print(f"{options.form}: {time.monotonic() - begun:.0f} s")
    return code


if __name__ == "__main__":
    sys.exit(main())
