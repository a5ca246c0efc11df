#!/usr/bin/env python3
"""Figure 1: a caustic, its target, and the gradient of their distance with respect to the heights of the glass.

Gradients by naive AD (Mitsuba's `ptracer`) and by ours, with few samples and with many, at one dL/dI that is held at a
reference image's. Writes figure1.png, figure1.txt (what is printed) and figure1.json. Exit code 1 where the gradients
do not agree in standard errors, noise does not fall with the root of the samples, or naive AD fits under the limit.

    scripts/paper figure1 [-o FOLDER] [--seeds N]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
from pathlib import Path

from reslrb_cli.config import load
from reslrb_cli.errors import ExitCode, ReslrbError, one_line
from reslrb_cli.measure.figure1 import Plan, measure
from reslrb_cli.measure.processes import Ended
from reslrb_cli.report.figure1 import draw, table, to_json

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "configs" / "paper" / "figure1.yaml"
#: Seeds with few samples for each of those with many; and the fewest, of which the spread of few can be told.
MANY, LEAST = 4, 12


def main(arguments: list[str]) -> int:
    """Measure, check, and write what the command line asks for; the exit code."""
    parser = argparse.ArgumentParser(prog="scripts/paper figure1", description=__doc__.split("\n\n")[1])
    parser.add_argument("-o", dest="folder", type=Path, default=ROOT / "build" / "paper", help="default: build/paper")
    parser.add_argument("--seeds", type=int, default=Plan.seeds, help=f"with few samples; default: {Plan.seeds}")
    parser.add_argument("--set", dest="sets", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    options = parser.parse_args(arguments)
    if options.seeds < LEAST:
        parser.error(f"--seeds must be at least {LEAST}")
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # so that nothing stays behind
    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        plan = Plan(seeds=options.seeds, many_seeds=options.seeds // MANY)
        with tempfile.TemporaryDirectory(prefix="reslrb-figure1-") as folder:
            result = measure(load(os.path.relpath(CONFIG), options.sets), plan, Path(folder), _say)
        text = table(result)
        print(text)
        (options.folder / "figure1.txt").write_text(text + "\n", encoding="utf-8")
        (options.folder / "figure1.json").write_text(json.dumps(to_json(result), indent=1) + "\n", encoding="utf-8")
        draw(result, options.folder / "figure1.png")
        _say(f"figure1.png, figure1.txt and figure1.json are in {options.folder}")
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except (ReslrbError, Ended, OSError) as error:
        print(one_line(f"figure1: {error}"), file=sys.stderr)
        return int(getattr(error, "exit_code", ExitCode.CHECK_FAILED))
    return ExitCode.DONE if result.holds else ExitCode.CHECK_FAILED


def _say(line: str) -> None:
    print(f"figure1: {line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
