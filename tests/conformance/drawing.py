"""Ways of drawing paths that change no mean: guided emission, aimed scattering, and low-discrepancy numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from conformance import attached_cases, moving_lamps
from conformance.gradient_cases import CASES

from reslrb_cli.guiding.tables import Learned, Purpose
from reslrb_cli.integrators import context
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.integrators.step import known_step
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.transport.samples import Table

BY_NAME = {case.name: case for case in CASES}
MOVING = {case.name: case for case in (*attached_cases.CASES, *moving_lamps.CASES)}
SPP = 64
LOW_DISCREPANCY: dict[str, Any] = {"sequence": "low_discrepancy"}


def guided(name: str, steps: int, **options: Any) -> tuple[Case, Any, Any]:
    """Return a case, a guided integrator and an unguided one. The guided integrator's tables have learned from `steps`
    gradients and learn no more.
    """
    case = BY_NAME[name]
    scene = Case(case.scene(), case.keys)
    own = case.own | options
    ours = integrator("reslrb", **{"estimator": "stack", **own}, guiding="on")
    for seed in range(steps):
        learn(scene, ours, seed)
    ours.preparation.guiding.due = lambda number: False
    return scene, ours, integrator("reslrb", **{"estimator": "stack", **own})


def learn(scene: Case, ours: Any, seed: int) -> None:
    """Run one step from which the tables learn."""
    ours.preparation.guiding.due = lambda number: True
    sample(scene, ours, 9000 + seed)


def sample(scene: Case, ours: Any, seed: int) -> np.ndarray:
    """Return the gradient of a step with known dL/dI, followed by its image's means over blocks of pixels, as
    one row.
    """
    images = []

    def step(integrator: Any, film: Any, sensor: Any, _objective: Any, **options: Any) -> Any:
        result = known_step(integrator, film, sensor, scene.adjoint, **options)
        images.append(np.array(result.image, np.float64)[:, :, :3])
        return result

    gradient = scene.gradient(ours, seed, SPP, step=step)
    return np.concatenate([gradient, tiles(images[0])])


def tiles(image: np.ndarray) -> np.ndarray:
    """Return means over tiles of 4 x 4 pixels, (T,). Smaller tiles at the edge count too."""
    rows, columns = (range(0, size, 4) for size in image.shape[:2])
    return np.concatenate([image[y : y + 4, x : x + 4].mean((0, 1)) for y in rows for x in columns])


def samples(scene: Case, ours: Any, count: int, block: int = 0) -> np.ndarray:
    """Return one row of samples for each of `count` seeds."""
    return np.stack([sample(scene, ours, seed) for seed in seeds(count, block)])


def strength(ours: Any) -> float:
    """Return how much more often the most frequent cell is drawn than in a uniform distribution."""
    guiding = ours.preparation.guiding
    measures = guiding.grid.measures()
    counts = guiding.counts(0, Purpose.BOTH)[measures > 0]
    return float((counts / (guiding.grid.slots * measures[measures > 0])).max())


def askew(scene: Case, ours: Any, factor: float = 1.5) -> None:
    """Aim the samples of the first sensor by a random table of large contrasts."""
    tables = ours.preparation.guiding
    areas = tables.films[0].areas()
    loud = np.random.default_rng(1).lognormal(0, factor, len(areas)) * areas
    learned = tables.learned.get(0) or Learned.nothing(tables.grid)
    tables.learned[0] = replace(learned, film=np.square([loud, loud], dtype=np.float32))
    tables._tables.clear()


def aimed(name: str, **options: Any) -> tuple[Case, Any, Any]:
    """Return the tracers of `guided`, of which the first aims its paths by the table of `askew`."""
    scene, ours, plain = guided(name, 1, **options)
    askew(scene, ours)
    return scene, ours, plain


def aim_everywhere(patch: pytest.MonkeyPatch) -> None:
    """Aim also in scenes without glossy surfaces."""
    patch.setattr(context, "worthwhile", lambda needs, max_depth: max_depth > 2)


def both(name: str, **options: Any) -> tuple[Case, Any, Any]:
    """Return a case, an integrator with low-discrepancy numbers, and an integrator with independent numbers."""
    case = BY_NAME[name]
    own = {"estimator": "stack"} | case.own | options
    return Case(case.scene(), case.keys), integrator("reslrb", **own, **LOW_DISCREPANCY), integrator("reslrb", **own)


def replayed_from(patch: pytest.MonkeyPatch, other: Callable[[Table], Table]) -> None:
    """Let the replay use the table that `other` makes from its own table."""
    right = Reslrb._differentiate

    def wrong(self: Reslrb, parts: Any, gradient: Any, params: Any, state: Any = None) -> None:
        [samples] = parts
        again = replace(samples, guide=replace(samples.guide, table=other(samples.guide.table)))
        right(self, [again], gradient, params, state)

    patch.setattr(Reslrb, "_differentiate", wrong)


@dataclass(frozen=True)
class Way:
    """A way of drawing paths, with the names of the cases that test it. The default suite runs only `few`.

    `make` returns a case, an integrator that draws in this way, and an integrator that does not. `telling` is the case
    for which replays, recordings and kinds of steps are tested, with options that `make` gets. `change` gives an
    integrator another table before step number `n` of a recording.
    """

    make: Callable[..., tuple[Case, Any, Any]]
    names: tuple[str, ...]
    few: tuple[str, ...]
    telling: str
    options: dict[str, Any]
    change: Callable[[Case, Any, int], None]


def _changed_aim(scene: Case, ours: Any, number: int) -> None:
    if number == 0:
        sample(scene, ours, 4)  # this fixes the grid
    askew(scene, ours, float(number))


#: Cases for every way of drawing random numbers.
EVERY = ("texture", "two_emitters", "envmap", "roulette", "passes", "glass", "mask")
GLOSSY = ("roughconductor", "roughplastic", "plastic", "blend", "roughdielectric", "principled", "crop", "gaussian",
          "plastic_beside_mask", "twosided")  # fmt: skip
WAYS = {
    "guided": Way(lambda name, **options: guided(name, 4, **options), (*EVERY, "gaussian", "area_texture", "rgba"),
                  (), "two_emitters", {"freeze": True},
                  lambda scene, ours, number: learn(scene, ours, number)),
    "aimed": Way(aimed, (*EVERY, *GLOSSY), ("crop",), "roughplastic", {"freeze": True},
                 _changed_aim),
    "aimed_sequence": Way(lambda name, **options: aimed(name, **LOW_DISCREPANCY, **options), ("roughplastic",),
                          (), "roughplastic", {"freeze": True}, _changed_aim),
    "sequence": Way(both, (*EVERY, "area_texture", "point", "plastic"), (), "texture", {"freeze": True},
                    lambda scene, ours, number: None),
}  # fmt: skip
