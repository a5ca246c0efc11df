#!/usr/bin/env python3
"""Measures what docs/benchmarks.md says, and writes it, and the README's results, from what was measured.

`scripts/benchmarks` calls it. No figure in those tables is typed.
"""

from __future__ import annotations

import difflib
import shlex
import sys

from benchmarks_list import MEASUREMENTS


def main(arguments: list[str]) -> int:
    """Do what the first argument says; the exit code."""
    what, *names = arguments
    if what != "measure" and names:
        print(f"benchmarks: {what} takes no names", file=sys.stderr)
        return 2
    for name in names:
        if name not in MEASUREMENTS:
            near = difflib.get_close_matches(name, MEASUREMENTS, n=1, cutoff=0)[0]
            print(f"benchmarks: there is no measurement `{name}`; did you mean {near}?", file=sys.stderr)
            return 2
    if what == "list":
        for measurement in MEASUREMENTS.values():
            print(f"{measurement.name:28} {shlex.join(measurement.command)}")
        return 0
    if what == "measure":
        from benchmarks_measure import measure

        for name in names or MEASUREMENTS:
            measure(MEASUREMENTS[name])
    from benchmarks_page import write

    write()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
