#!/usr/bin/env python3
"""Figure 5: the gradient of an image's loss with respect to the floor of the Grey & White Room, paths of length 32.

Naive AD (of our walk) and ResLRB at 32 spp, at one dL/dI that is held at a reference image's: red positive,
blue negative, grey zero, and the z map of their means. Writes figure5.png, figure5.txt (what is printed) and
figure5.json. Exit code 1 where the means do not agree in standard errors, or the exact estimators are not naive AD of
the same paths.

    scripts/paper figure5 ROOM [-o FOLDER] [--seeds N]
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
from pathlib import Path

from paper_room import room_config

from reslrb_cli.errors import ExitCode, ReslrbError, one_line
from reslrb_cli.measure.figure5 import Plan, measure
from reslrb_cli.measure.processes import Ended
from reslrb_cli.report.figure5 import draw, table, to_json

ROOT = Path(__file__).resolve().parent.parent
#: The fewest seeds of which tails can be told.
LEAST = 8


def main(arguments: list[str]) -> int:
    """Measure, check, and write what the command line asks for; the exit code."""
    parser = argparse.ArgumentParser(prog="scripts/paper figure5", description=__doc__.split("\n\n")[1])
    parser.add_argument("room", type=Path, help="folder of the Grey & White Room (Mitsuba's gallery)")
    parser.add_argument("-o", dest="folder", type=Path, default=ROOT / "build" / "paper", help="default: build/paper")
    parser.add_argument("--seeds", type=int, default=Plan.seeds, help=f"of each; default: {Plan.seeds}")
    parser.add_argument("--set", dest="sets", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    options = parser.parse_args(arguments)
    if options.seeds < LEAST:
        parser.error(f"--seeds must be at least {LEAST}")
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # so that nothing stays behind
    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="reslrb-figure5-") as folder:
            config = room_config(options.room, Path(folder), options.sets)
            result = measure(config, Plan(spp=config.run.spp, seeds=options.seeds), Path(folder), _say)
        text = table(result)
        print(text)
        (options.folder / "figure5.txt").write_text(text + "\n", encoding="utf-8")
        (options.folder / "figure5.json").write_text(json.dumps(to_json(result), indent=1) + "\n", encoding="utf-8")
        draw(result, options.folder / "figure5.png")
        _say(f"figure5.png, figure5.txt and figure5.json are in {options.folder}")
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except (ReslrbError, Ended, OSError) as error:
        print(one_line(f"figure5: {error}"), file=sys.stderr)
        return int(getattr(error, "exit_code", ExitCode.CHECK_FAILED))
    return ExitCode.DONE if result.holds else ExitCode.CHECK_FAILED


def _say(line: str) -> None:
    print(f"figure5: {line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
