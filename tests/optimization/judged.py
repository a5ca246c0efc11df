"""Small scenes with known true values, for runs that succeed or are made to fail, and for the verdicts on their
results.

The wall has lamps of different colours, and two more that light the wall alike. There are also a rough mirror and a
lamp that lights nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from kit import POSTER_BSDF, area, diffuse, ref, scene, sensor, shape

from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.state import standing
from reslrb_cli.optimization.uncertainty.measuring import Certainty
from reslrb_cli.optimization.uncertainty.verdicts import CertaintyRecord
from reslrb_cli.records.metrics import Record

LEFT, RIGHT, HIDDEN = (f"{name}.emitter.radiance.value" for name in ("left", "right", "hidden"))
TWIN, OTHER_TWIN = (f"{name}.emitter.radiance.value" for name in ("twin", "other_twin"))
WALL, ALPHA, POSTER = "wall.reflectance.value", "metal.alpha.value", "poster.reflectance.data"


def lamp(name: str, x: float, radiance: str, size: float = 0.6, facing: float = 180) -> str:
    place = f'<scale value="{size}"/><rotate x="1" angle="{facing}"/><translate x="{x}" y="0.8" z="3"/>'
    return shape("rectangle", name, diffuse("0, 0, 0"), area(radiance), place=place)


SCENE = scene(
    sensor("0, -0.5, 4", size=16, fov=42), diffuse("0.6, 0.4, 0.25", "wall"),
    '<bsdf type="roughconductor" id="metal"><float name="alpha" value="0.25"/></bsdf>', POSTER_BSDF,
    shape("rectangle", "back", ref("wall"), place='<scale value="3"/><translate z="-0.5"/>'),
    shape("rectangle", "plate", ref("metal"), place='<scale value="0.5"/><translate x="0.9" y="0.3"/>'),
    shape("rectangle", "print", ref("poster"), place='<scale value="0.9"/><translate x="-0.6"/>'),
    lamp("left", -2, "9, 6, 4"), lamp("right", 2, "3, 5, 8"), lamp("hidden", 0, "2, 2, 2", facing=0),
    lamp("twin", 0.5, "4, 4, 4", 0.3), lamp("other_twin", 0.5001, "4, 4, 4", 0.3),
)  # fmt: skip
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {render: {spp: 4096}}
parameters: [{key: wall.reflectance.value}]
integrator: {type: reslrb, max_depth: 3, estimator: stack}
optimizer: {type: adam, learning_rate: 0.02}
run: {iterations: 100, spp: 16}
"""


@dataclass(frozen=True)
class Toy:
    """One run, with its parameters and their options, its settings, and the correct verdict for each parameter.

    The options of a motion contain its `motion`.
    """

    name: str
    parameters: dict[str, str]
    right: dict[str, tuple[str, ...]]
    settings: tuple[str, ...] = ()
    fails: bool = False


@dataclass
class Outcome:
    """Result of a run."""

    certainty: CertaintyRecord
    final: dict[str, np.ndarray]
    true: dict[str, np.ndarray]
    errors: dict[str, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        self.errors = {key: self.final[key] - self.true[key] for key in self.final}


def write_scene(folder: Path) -> None:
    """Write scene, texture and `toy.yaml`. A variant must be set."""
    import mitsuba as mi

    texture = np.random.default_rng(2).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
    mi.Bitmap(texture).write(str(folder / "poster.exr"))
    (folder / "scene.xml").write_text(SCENE)
    (folder / "toy.yaml").write_text(CONFIG)


def iterate_to_the_end(problem: Problem) -> tuple[Certainty, Record]:
    """Make all iterations. Return the certainty, with their gradients and values, and the last record."""
    certainty, state = Certainty(problem), standing(problem)
    for after, record in iterate(problem, state):
        certainty.see(state, after)
        certainty.rates.append(record.lr / problem.config.optimizer.learning_rate)
        state, last = after, record
    return certainty, last


def run(folder: Path, toy: Toy, seed: int = 0, truth: Mapping[str, Any] | None = None) -> Outcome:
    """Run the recovery in `folder`, which holds the scene, and return the measured certainty. `truth` has the true
    values of a run whose target is a file.
    """
    entries = {key: "" if options.startswith("motion:") else f"key: {key}, " for key, options in toy.parameters.items()}
    parameters = ", ".join(f"{{{named}{toy.parameters[key]}}}" for key, named in entries.items())
    settings = [f"parameters=[{parameters}]", f"run.seed={seed}", *toy.settings]
    problem = assemble(load(folder / "toy.yaml", settings))
    true = {key: np.asarray(value, dtype=np.float64) for key, value in (truth or problem.truth).items()}
    problem.truth.clear()  # no verdict uses the truth
    certainty, last = iterate_to_the_end(problem)
    before = {key: value.copy() for key, value in problem.values().items()}
    found = certainty.measure(last.iteration + 1, last.elapsed_s, lambda: False)
    assert found is not None
    for key, value in problem.values().items():  # measuring changes no value and no gradient
        np.testing.assert_array_equal(value, before[key])
        assert not np.any(np.array(problem.optimizer.gradient(key)))
    return Outcome(found, {key: value.astype(np.float64) for key, value in problem.values().items()}, true)
