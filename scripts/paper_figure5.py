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
import sys
from collections.abc import Callable
from pathlib import Path

import paper_figure5_report as report
from paper_command import add_sampling, figure_parser, run
from paper_figure5_measure import Plan, Result, measure
from paper_room import ROOM, room_config

#: The fewest seeds of which tails can be told.
LEAST = 8


def main(arguments: list[str]) -> int:
    """Measure, check, and write what the command line asks for; the exit code."""
    parser = figure_parser("figure5", __doc__)
    parser.add_argument("room", type=Path, help=ROOM)
    add_sampling(parser, Plan.seeds, "of each")
    return run("figure5", parser, arguments, LEAST, _measure, report)


def _measure(options: argparse.Namespace, folder: Path, say: Callable[[str], None]) -> Result:
    config = room_config(options.room, folder, options.sets)
    return measure(config, Plan(spp=config.run.spp, seeds=options.seeds), folder, say)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
