#!/usr/bin/env python3
"""Figure 6: time and peak memory of a gradient step against path depth, in the Grey & White Room.

Runs `reslrb bench` on the experiment of Figure 5, without roulette, and writes figure6.jsonl and figure6.png. Further
options go to `reslrb bench`.

    scripts/paper figure6 ROOM [-o FOLDER] [OPTIONS OF BENCH]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from paper_room import room_config

from reslrb_cli.errors import ReslrbError, one_line

ROOT = Path(__file__).resolve().parent.parent


def main(arguments: list[str]) -> int:
    """Run the sweep; its exit code."""
    parser = argparse.ArgumentParser(prog="scripts/paper figure6", description=__doc__.split("\n\n")[1])
    parser.add_argument("room", type=Path, help="folder of the Grey & White Room (Mitsuba's gallery)")
    parser.add_argument("-o", dest="folder", type=Path, default=ROOT / "build" / "paper", help="default: build/paper")
    options, others = parser.parse_known_args(arguments)
    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="reslrb-figure6-") as folder:
            source = room_config(options.room, Path(folder), []).source
            command = [sys.executable, "-m", "reslrb_cli", "bench", str(source), "--set", "integrator.rr_depth=100000"]
            command += [
                "--max-depth",
                "128",
                "--budget",
                "300",
                "--integrators",
                "ptracer,reslrb:reservoir,reslrb:stack",
            ]
            command += ["--json", str(options.folder / "figure6.jsonl"), *others]
            return subprocess.run(command, check=False, cwd=ROOT).returncode
    except (ReslrbError, OSError) as error:
        print(one_line(f"figure6: {error}"), file=sys.stderr)
        return int(getattr(error, "exit_code", 1))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
