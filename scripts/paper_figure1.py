#!/usr/bin/env python3
"""Figure 1: a caustic, its target, and the gradient of their distance with respect to the heights of the glass.

Gradients by naive AD (Mitsuba's `ptracer`) and by ours, with few samples and with many, at one dL/dI that is held at a
reference image's. Writes figure1.png, figure1.txt (what is printed) and figure1.json. Exit code 1 where the gradients
do not agree in standard errors, noise does not fall with the root of the samples, or naive AD fits under the limit.

    scripts/paper figure1 [-o FOLDER] [--seeds N]
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

import paper_figure1_report as report
from paper_command import ROOT, add_sampling, figure_parser, run
from paper_figure1_measure import Plan, Result, measure

from reslrb_cli.config.loader import load

CONFIG = ROOT / "configs" / "paper" / "figure1.yaml"
#: Seeds with few samples for each of those with many; and the fewest, of which the spread of few can be told.
MANY, LEAST = 4, 12


def main(arguments: list[str]) -> int:
    """Measure, check, and write what the command line asks for; the exit code."""
    parser = figure_parser("figure1", __doc__)
    add_sampling(parser, Plan.seeds, "with few samples")
    return run("figure1", parser, arguments, LEAST, _measure, report)


def _measure(options: argparse.Namespace, folder: Path, say: Callable[[str], None]) -> Result:
    plan = Plan(seeds=options.seeds, many_seeds=options.seeds // MANY)
    return measure(load(os.path.relpath(CONFIG), options.sets), plan, folder, say)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
