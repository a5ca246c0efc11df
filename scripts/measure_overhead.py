#!/usr/bin/env python3
"""Measure what a step costs beside its work: rounds of calls with nothing to do on 1 to 16 workers of this machine.

    scripts/measure_overhead.py [--workers 1,2,4,8,16] [--shards 16] [--rounds 50]

prints, in milliseconds, medians over so many rounds, which are taken in turns: a round of one call for each worker, one
of so many shards, a step of two of those (`adjoint: others`); what each further call takes; and a MiB that is sent to a
worker and comes back, half of that. Needs the environment that `scripts/setup` makes, and the extra `cluster`: run it
with `.venv/bin/python`, on a machine that does nothing else. Workers beyond its cores share them.
"""

from __future__ import annotations

import argparse

from reslrb_cli.cluster.bundle import Bundle
from reslrb_cli.cluster.connection import Place, connected
from reslrb_cli.cluster.crew import Crew
from reslrb_cli.cluster.forecast import idle, measure_rounds, round_seconds
from reslrb_cli.cluster.worker import Opening


def measure(workers: int, shards: int, rounds: int) -> str:
    """A row of the table."""
    with connected(Place(workers)) as (client, _):
        client.wait_for_workers(workers, timeout=120)
        crew = Crew(client, Opening(Bundle().digest(), idle), {}, threads=1)
        crew.start()
        few, many = round_seconds(crew, [workers, shards], rounds)
        _, call_s, byte_s = measure_rounds(crew)
    cells = [1e3 * few, 1e3 * many, 2e3 * many, 1e3 * call_s, 1e3 * byte_s * 2**20]
    return f"| {len(crew.ready)} | " + " | ".join(f"{cell:.3g}" for cell in cells) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", default="1,2,4,8,16", help="how many workers, separated by commas")
    parser.add_argument("--shards", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=50)
    given = parser.parse_args()
    print(f"| workers | a round, a call each | a round of {given.shards} | a step of two | each call | each MiB |")
    print("|--:|--:|--:|--:|--:|--:|")
    for workers in given.workers.split(","):
        print(measure(int(workers), given.shards, given.rounds), flush=True)


if __name__ == "__main__":
    main()
