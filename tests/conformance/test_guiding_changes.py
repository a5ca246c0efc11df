"""A scene that changes so that a table is wrong: a shutter slides from one opening of a room to the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from reslrb_cli.guiding.tables import EVERY
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.scenes.small import SIZE, diffuse, rgb, texture, transform

pytestmark = pytest.mark.usefixtures("llvm")
SPP = 64
#: Steps with the one opening, and with the other: it slides when tables have just learned, and do not again for as long
#: as they ever do.
BEFORE, WITHIN = 2 * EVERY, 20
AT_FIRST, AT_LAST = 2.0, 1.1  # how many times the error of unguided samples a step's may have
TELLING = 0.1  # the largest standard error, as a share of the limit, of which anything is to be said
RIGHT, LEFT = 0.6, -0.6  # where the shutter is
KEY = "ground.reflectance.data"


def place(x: float) -> Any:
    """Where the shutter hangs, closely below the ceiling."""
    return transform(translate=[x, 0.98, 0], rotate=([1, 0, 0], 90), scale=[0.25, 0.35, 1])


def chamber() -> dict[str, Any]:
    """A closed room under a sky, with two openings in its ceiling, of which a shutter covers the one on the right."""
    import mitsuba as mi

    grey = {"type": "twosided", "bsdf": diffuse(0.6, 0.6, 0.6)}
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 80,
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0.2, 0.9], target=[0, -1, -0.2], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb",
                     "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        "ground": {"type": "diffuse", "reflectance": texture(3, 6)},
        "grey": grey,
        "floor": {"type": "rectangle", "to_world": transform(translate=[0, -1, 0], rotate=([1, 0, 0], -90)),
                  "bsdf": {"type": "ref", "id": "ground"}},
        "shutter": {"type": "rectangle", "to_world": place(RIGHT), "bsdf": {"type": "ref", "id": "grey"}},
        "sky": {"type": "constant", "radiance": rgb(1.0, 1.2, 1.5)},
    }  # fmt: skip
    for number in range(4):
        turned = transform(rotate=([0, 1, 0], 90 * number), translate=[0, 0, -1])
        scene[f"wall_{number}"] = {"type": "rectangle", "to_world": turned, "bsdf": {"type": "ref", "id": "grey"}}
    strips = ((0, 0.65, 1, 0.35), (0, -0.65, 1, 0.35), (-0.9, 0, 0.1, 0.3), (0, 0, 0.4, 0.3), (0.9, 0, 0.1, 0.3))
    for number, (x, z, wide, deep) in enumerate(strips):
        lies = transform(translate=[x, 1, z], rotate=([1, 0, 0], 90), scale=[wide, deep, 1])
        scene[f"strip_{number}"] = {"type": "rectangle", "to_world": lies, "bsdf": {"type": "ref", "id": "grey"}}
    return scene


def slide(scene: Case, x: float) -> None:
    """Move the shutter."""
    import mitsuba as mi

    scene.params["shutter.to_world"] = mi.Transform4f(place(x).matrix)
    scene.params.update()


def rows(scene: Case, ours: Any, count: int, block: int) -> np.ndarray:
    """Gradients of so many steps from which no table learns, (count, P)."""
    tables = ours.preparation.guiding
    if tables is not None:
        tables.held = True
    found = scene.gradients(ours, seeds(count, block), SPP, adjoint="correlated")
    if tables is not None:
        tables.held = False
    return found


def errors(count: int, before: int = BEFORE) -> tuple[tuple[float, float], ...]:
    """Root mean square errors of guided steps, in those of unguided ones, with their standard errors: before the
    shutter slides, in the first step after that, and WITHIN steps later."""
    scene = Case(chamber(), [KEY])
    ours, plain = (integrator("reslrb", 5, 1000, estimator="stack", guiding=tables) for tables in ("on", "off"))
    found, blocks = [], iter(range(100))

    def compared() -> tuple[float, float]:
        squares = []
        for each in (ours, plain):
            gradients = rows(scene, each, count, next(blocks))
            squares.append(np.square(gradients - gradients.mean(0)).sum(1) / (count - 1))
        guided, even = (row.sum() for row in squares)
        spread = sum(row.var(ddof=1) * count / row.sum() ** 2 for row in squares)
        ratio = float(np.sqrt(guided / even))
        return ratio, ratio * float(np.sqrt(spread)) / 2

    for seed in range(before):
        scene.gradient(ours, 9000 + seed, SPP, adjoint="correlated")
    found.append(compared())
    slide(scene, LEFT)
    found.append(compared())
    for seed in range(WITHIN):
        scene.gradient(ours, 9500 + seed, SPP, adjoint="correlated")
    found.append(compared())
    return tuple(found)


def holds(found: tuple[tuple[float, float], ...]) -> bool:
    """Whether what is asked for is found: no error is beyond its limit by more than three of its standard errors."""
    print(found)
    assert found[0][0] + 3 * found[0][1] < 1, "the table has learned nothing"
    assert found[1][0] - 3 * found[1][1] > 1, "what has changed does not matter to the table"
    beyond = [ratio - 3 * error > limit for (ratio, error), limit in zip(found[1:], (AT_FIRST, AT_LAST), strict=True)]
    telling = (error < TELLING * limit for (_, error), limit in zip(found, (1, AT_FIRST, AT_LAST), strict=True))
    assert any(beyond) or all(telling), "too few steps to tell"
    return not any(beyond)


def test_a_table_that_has_gone_wrong_does_little_harm_and_is_soon_corrected() -> None:
    assert holds(errors(48))


@pytest.mark.long
def test_many_steps_say_so_too() -> None:
    assert holds(errors(400))


@pytest.mark.long
def test_tables_that_know_much_forget_it_as_soon() -> None:
    assert holds(errors(100, 8 * EVERY))


@pytest.mark.long
def test_tables_that_do_not_look_again_in_time_are_too_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.guiding import tables

    monkeypatch.setattr(tables, "EVERY", 2 * EVERY)
    assert not holds(errors(32))


@pytest.mark.long
def test_tables_that_learn_no_more_stay_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.guiding.tables import Guiding

    right = Guiding.due

    def due(self: Guiding, number: int) -> bool:
        return right(self, number) and (not self.learned or self.learned[0].calls <= BEFORE)

    monkeypatch.setattr(Guiding, "due", due)
    assert not holds(errors(32))


@pytest.mark.long
def test_tables_without_an_even_share_are_too_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.transport import plan

    monkeypatch.setattr(plan, "GUIDE_UNIFORM", 0.02)
    monkeypatch.setattr(plan, "SLOTS_PER_CELL", 64)
    assert not holds(errors(32))
