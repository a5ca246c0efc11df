#!/usr/bin/env python3
"""Figure 6: time and peak memory of a gradient step against path depth, in the Grey & White Room.

Runs `reslrb bench` on the experiment of Figure 5, without roulette, and writes figure6.jsonl and figure6.png. Further
options go to `reslrb bench`.

    scripts/paper figure6 ROOM [-o FOLDER] [OPTIONS OF BENCH]
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from paper_command import figure_parser
from paper_room import ROOM, room_config

from reslrb_cli.errors import ReslrbError, one_line

#: What is asked of `reslrb bench`, unless further options say otherwise.
BENCH = "--max-depth 128 --budget 300 --integrators ptracer,reslrb:reservoir,reslrb:stack"


def main(arguments: list[str]) -> int:
    """Run the sweep; its exit code."""
    parser = figure_parser("figure6", __doc__)
    parser.add_argument("room", type=Path, help=ROOM)
    options, others = parser.parse_known_args(arguments)
    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="reslrb-figure6-") as folder:
            source = room_config(options.room, Path(folder), []).source
            command = [sys.executable, "-m", "reslrb_cli", "bench", str(source), "--set", "integrator.rr_depth=100000"]
            command += [*BENCH.split(), "--json", str(options.folder / "figure6.jsonl"), *others]
            return subprocess.run(command, check=False).returncode
    except (ReslrbError, OSError) as error:
        print(one_line(f"figure6: {error}"), file=sys.stderr)
        return int(getattr(error, "exit_code", 1))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
