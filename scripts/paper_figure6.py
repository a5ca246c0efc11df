#!/usr/bin/env python3
"""Figure 6: time and peak memory of a gradient step against path depth, in the Grey & White Room.

Runs `reslrb bench` on the experiment of Figure 5, without roulette, and writes figure6.jsonl and figure6.png. Further
options go to `reslrb bench`; depths are 2, 4, 8, ... 128, or those of `--values`.

    scripts/paper figure6 ROOM [-o FOLDER] [OPTIONS OF BENCH]
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks_measure import code_state, draw_bench
from paper_command import figure_parser
from paper_room import ROOM, room_config

from reslrb_cli.errors import ReslrbError, one_line

#: What is asked of `reslrb bench`, unless further options say otherwise.
BENCH = "--budget 300 --integrators ptracer,reslrb:reservoir,reslrb:stack"
DEPTHS = "--max-depth", "128"


def main(arguments: list[str]) -> int:
    """Run the sweep; its exit code."""
    parser = figure_parser("figure6", __doc__)
    parser.add_argument("room", type=Path, help=ROOM)
    options, others = parser.parse_known_args(arguments)
    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="reslrb-figure6-") as folder:
            room_config(options.room, Path(folder), [])
            command = [sys.executable, "-m", "reslrb_cli", "bench", "room.yaml", "--set", "integrator.rr_depth=100000"]
            record, file = Path(folder) / "record.jsonl", options.folder / "figure6.jsonl"
            chosen = [] if any(word.partition("=")[0] == "--values" for word in others) else [*DEPTHS]
            command += [*BENCH.split(), *chosen, "--json", str(record), *others]
            code = subprocess.run(command, cwd=folder, check=False).returncode
            if record.exists():
                lines = [json.loads(line) for line in record.read_text(encoding="utf-8").splitlines()]
                # The command saw an experiment that is gone now.
                lines[0] |= {"command": ["scripts/paper", "figure6", "ROOM", *others]} | code_state()
                file.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
                draw_bench(lines, file.with_suffix(".png"))
        return code
    except (ReslrbError, OSError) as error:
        print(one_line(f"figure6: {error}"), file=sys.stderr)
        return int(getattr(error, "exit_code", 1))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
