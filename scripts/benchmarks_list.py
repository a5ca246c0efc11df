"""The measurements that docs/benchmarks.md and the README's results are made of: names, and the command of each."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "docs" / "benchmarks"
#: Of the experiments in configs/, in the order of the README's table.
EXPERIMENTS = ("cornell_floor", "mixed_room", "caustic_slab", "grey_room", "furnace", "lens_pose", "caustic_heightmap",
               "paper/figure1", "stiff/lamp", "stiff/plate", "stiff/wall")  # fmt: skip
#: Whole runs by other integrators: the record's name, what the README calls the run, and its command.
OTHERS = {
    f"optimize_cornell_floor_{name}": (
        f"`cornell_floor` by {words}",
        f"optimize configs/cornell_floor.yaml --set integrator.type={name}",
    )
    for name, words in {"ptracer": "`ptracer` under naive AD", "prb": "`prb`"}.items()
}
CHECKED = ("furnace", "caustic_slab", "cornell_floor", "grey_room")
_GLASS = (
    "bench configs/caustic_heightmap.yaml --integrators ptracer,reslrb:reservoir,reslrb:stack --max-depth 16 "
    "--budget 180 --set parameters.0.heightmap.resolution=[128,128] --set run.spp=16 --set target.render.spp=64"
)


@dataclass(frozen=True)
class Measurement:
    """One measurement: the words of `reslrb` that make it, without where it is written. Its record is NAME.jsonl."""

    name: str
    words: tuple[str, ...]

    @property
    def file(self) -> Path:
        """Where its record lies."""
        return RECORDS / f"{self.name}.jsonl"

    @property
    def command(self) -> list[str]:
        """What a user types."""
        return ["reslrb", *self.words]


def experiment_record(experiment: str) -> str:
    """The name of the measurement of a whole run of configs/EXPERIMENT.yaml."""
    return f"optimize_{experiment.replace('/', '_')}"


def _all() -> list[Measurement]:
    commands = {
        "depth": "bench --max-depth 128",
        "spp": "bench --sweep spp --values 1,4,16,64 --integrators ptracer,reslrb:reservoir,reslrb:stack --budget 120",
        "moving": _GLASS,
    }
    commands |= {f"gradcheck_{name}": f"gradcheck configs/{name}.yaml --seeds 16" for name in CHECKED}
    for name in EXPERIMENTS:
        commands[experiment_record(name)] = f"optimize configs/{name}.yaml"
    commands |= {name: command for name, (_, command) in OTHERS.items()}
    return [Measurement(name, tuple(shlex.split(command))) for name, command in commands.items()]


MEASUREMENTS = {measurement.name: measurement for measurement in _all()}
