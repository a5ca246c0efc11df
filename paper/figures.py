#!/usr/bin/env python3
"""Make the figures of the paper, each from an experiment, and check them.

Each figure command writes NAME.json (figure6: NAME.jsonl) and NAME.png. Figures 1 and 5 print their tables, and exit
with code 1 if a check fails. `write` makes docs/paper.md from the records in docs/paper/. ROOM is the folder of Wig42's
Grey & White Room, from Mitsuba's gallery of scenes.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks_measure import ROOT, code_state, draw, read_lines

from paper import page
from reslrb_cli.backend.doctor import device_name
from reslrb_cli.errors import ExitCode, ReslrbError, one_line
from reslrb_cli.measure.processes import Ended
from reslrb_cli.records.measurement_files import Origin

#: The seeds of each figure of gradients, and the fewest that tell anything.
SEEDS = {"figure1": (32, 12), "figure5": (24, 8)}
#: What is asked of `reslrb bench`, unless further options say otherwise.
BENCH = "--budget 300 --integrators ptracer,reslrb:reservoir,reslrb:stack --set integrator.rr_depth=100000"
HELPS = {"figure1": "a caustic and the gradient of its glass", "figure5": "the gradient of a room's floor",
         "figure6": "time and memory against depth; further options go to `reslrb bench`"}  # fmt: skip
BUILD, DEPTHS = ROOT / "build" / "paper", ["--max-depth", "128"]


def main(arguments: list[str]) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(prog="scripts/paper", description=__doc__)
    figures = parser.add_subparsers(dest="name", required=True)
    for name, text in HELPS.items():
        figure = figures.add_parser(name, help=text)
        figure.add_argument("-o", dest="folder", type=Path, default=BUILD, help="default: build/paper")
        figure.set_defaults(room=None, sets=[])
        if name != "figure1":
            figure.add_argument("room", type=Path, help="folder of the Grey & White Room")
        if name in SEEDS:
            figure.add_argument("--seeds", type=int, default=SEEDS[name][0], help="default: %(default)s")
            figure.add_argument("--set", dest="sets", action="append", metavar="KEY=VALUE", help="change a setting")
    write = figures.add_parser("write", help="write docs/paper.md; copies the records in FOLDER first, if given")
    write.add_argument("folder", type=Path, nargs="?")
    options, others = parser.parse_known_args(arguments)
    if others and options.name != "figure6":
        parser.error(f"unrecognized arguments: {' '.join(others)}")
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # so that no process stays behind
    try:
        if options.name == "write":
            return page.write(options.folder)
        options.folder.mkdir(parents=True, exist_ok=True)
        if options.name == "figure6":
            return _bench(options, others)
        least = SEEDS[options.name][1]
        return _figure(options) if options.seeds >= least else parser.error(f"--seeds must be at least {least}")
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except (ReslrbError, Ended, OSError) as error:
        print(one_line(f"{options.name}: {error}"), file=sys.stderr)
        return int(getattr(error, "exit_code", ExitCode.CHECK_FAILED))


def _figure(options: argparse.Namespace) -> int:
    """Measure, check and draw a figure of gradients. Return the exit code."""
    from make_figures import write_panels

    from paper.gradients import VARIANT

    def say(line: str) -> None:
        print(f"{options.name}: {line}", file=sys.stderr, flush=True)

    figure: Any = import_module(f"paper.{options.name}")
    config, plan = figure.plan(options.sets, options.seeds, options.room)
    record, panels = figure.measure(config, plan, say)
    # The command that makes the figure again does not name the user's folder of the room.
    words = ["scripts/paper", options.name, *(["ROOM"] if options.room else []), "--seeds", str(options.seeds)]
    words += [word for setting in options.sets for word in ("--set", setting)]
    origin = json.loads(Origin(device_name(VARIANT), VARIANT, words).to_json()) | code_state()
    text = json.dumps({"origin": origin} | record, indent=1)
    (options.folder / f"{options.name}.json").write_text(text + "\n", encoding="utf-8")
    write_panels(panels, options.folder / f"{options.name}.png")
    print(page.FIGURES[options.name](json.loads(text)))
    say("holds" if record["holds"] else "does not hold")
    return ExitCode.DONE if record["holds"] else ExitCode.CHECK_FAILED


def _bench(options: argparse.Namespace, others: list[str]) -> int:
    """Run `reslrb bench` in the room, write figure6.jsonl and figure6.png, and return the exit code."""
    from paper.figure5 import CONFIG, room_settings

    file = options.folder / "figure6.jsonl"
    settings = [word for setting in room_settings(options.room) for word in ("--set", setting)]
    depths = [] if any(word.partition("=")[0] == "--values" for word in others) else DEPTHS
    with tempfile.TemporaryDirectory(prefix="reslrb-figure6-") as folder:
        record = Path(folder) / "record.jsonl"  # a new file, so that no sample of an earlier commit counts
        words = ["bench", str(CONFIG), *settings, *BENCH.split(), *depths, "--json", str(record), *others]
        code = subprocess.run([sys.executable, "-m", "reslrb_cli", *words], check=False).returncode
        if record.exists():
            lines = read_lines(record)
            lines[0] |= {"command": ["scripts/paper", "figure6", "ROOM", *others]} | code_state()
            file.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
            draw(file, file.with_suffix(".png"))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
