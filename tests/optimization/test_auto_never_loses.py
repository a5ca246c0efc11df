"""`guiding: auto` reduces the efficiency of no scene. The tests cover all shipped configurations, and scenes of the
extreme suite.

If guiding is on, its gain has an interval above 1. If it is off, a step traces the same operations as with `off`.
Shipped films keep their size, or are smaller where an iteration takes seconds. Scenes of the extreme suite have so many
samples that there is time to measure.
"""

from __future__ import annotations

import dataclasses
import gc
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from optimization.deciding import decision, operations

from reslrb_cli.config.loader import load, loads
from reslrb_cli.config.schema import Config
from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.gradients import integrator
from reslrb_cli.measure.scenes.case import SceneCase
from reslrb_cli.measure.scenes.catalogue import CASES
from reslrb_cli.measure.scenes.small import load as load_scene
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.autotune.race import Finding, Turns
from reslrb_cli.optimization.autotune.sampling import decide, is_auto
from reslrb_cli.optimization.memory import check_step
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.records.images import write_file

pytestmark = [pytest.mark.usefixtures("llvm"), pytest.mark.long]
FOLDER = Path(__file__).resolve().parents[2] / "configs"
#: The prism needs another variant than these tests.
SHIPPED = sorted({str(path.relative_to(FOLDER).with_suffix("")) for path in FOLDER.rglob("*.yaml")} - {"prism"})
#: Film sizes at which a step takes a second at most.
SMALLER = {
    "grey_room": ["scene.options.resx=120", "scene.options.resy=90"],
    "cornell_floor": ["scene.options.resx=128", "scene.options.resy=128"],
}
#: Experiments whose target is a picture.
PICTURED = ("mixed_room", "table")
AUTO = ["integrator.guiding=auto", "integrator.sequence=auto", "run.measuring=1000"]
#: Scenes in which gradients break, each with another reason to draw samples differently. They have a sun, a tiny lamp,
#: parallel light that grazes a floor, glass in glass, black texels, or a film of one column.
EXTREME = ["sun_1e6", "lamp_of_area_1e-8", "grazing_light", "nested_dielectrics", "albedo_0_roulette", "film_1x4096"]
PREFIX = "extreme/"
#: Light paths in a step of these scenes.
PATHS = 2**20
#: Function that decides on the integrator.
DECIDE: dict[str, Callable[[Problem, Callable[[str], None]], Problem]] = {"decide": decide}


@pytest.fixture(autouse=True)
def alone() -> None:
    """Collect garbage, because scenes that exist at the same time change each other's kernels."""
    gc.collect()


def decided(config: Config, case: SceneCase | None) -> Problem:
    """Return the problem, in the scene of a case if one is given, after all decisions by measurement."""
    problem = assemble_scene(config, None if case is None else load_scene(case.scene()))
    check_step(problem)
    problem = make_targets(problem, lambda line: None)
    return DECIDE["decide"](problem, lambda line: None)


def extreme(case: SceneCase, folder: Path) -> str:
    """Return a configuration for a case. The configuration recovers reflectances from an image of the case, which this
    function writes.
    """
    keys = [key for key in case.keys if "reflectance" in key]
    image = render_image(integrator("reslrb", **case.options), load_scene(case.scene()), 0, 1, 256)
    write_file(folder / "target.exr", np.array(image), linear=True)
    spp = max(PATHS // (image.shape[0] * image.shape[1]), 1)
    options = ", ".join(f"{option}: {value}" for option, value in case.options.items())
    return f"""
scene: {{file: {case.name}.xml}}
target: {{file: {folder}/target.exr}}
parameters: [{", ".join(f"{{key: {key}, initial: 0.3}}" for key in keys)}]
integrator: {{type: reslrb, {options}}}
run: {{spp: {spp}, iterations: 200}}
"""


def config_of(name: str, case: SceneCase | None, folder: Path, *settings: str) -> Config:
    """Return a shipped configuration by its name, or the configuration of a case of the extreme suite."""
    if case is not None:
        return loads(extreme(case, folder), Path(f"{case.name}.yaml"), [*settings])
    target = ["target.render.spp=64"] if name not in PICTURED else []
    return load(FOLDER / f"{name}.yaml", [*target, *SMALLER.get(name, ()), *settings])


@pytest.mark.parametrize("name", [*SHIPPED, *(PREFIX + name for name in EXTREME)])
def test_no_scene_loses(name: str, tmp_path: Path) -> None:
    case = CASES[name.removeprefix(PREFIX)] if name.startswith(PREFIX) else None
    problem = decided(config_of(name, case, tmp_path, *AUTO), case)
    print(name, *(each.line(cost=True) for each in problem.decisions), sep="\n  ")
    guided, values = decision(problem, "guiding"), {each.setting: each.value for each in problem.decisions}
    values.pop("blur", None)  # a setting of the run, which nothing measures
    if guided is None:  # only light paths are guided
        assert problem.integrator.paths == "camera"
        return
    if guided.value != "off":
        if guided.low is None:  # the rule for moving shapes, without a measurement
            assert problem.moves
            assert problem.integrator.paths == "both"
        else:
            assert guided.low > 1
        return
    assert ("sequence" in values) == (problem.integrator.paths != "camera")  # no camera path uses it
    settings = [f"integrator.{setting}={value}" for setting, value in values.items()]
    found = operations(problem)
    del problem
    gc.collect()
    assert found == operations(decided(config_of(name, case, tmp_path, "integrator.estimator=stack", *settings), case))


@pytest.mark.parametrize("fault", ["on whatever is found", "off with a grid"])
def test_losses_are_found(fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene has a third of the efficiency with guided light paths. The test enables guiding there, or leaves the
    decision off while paths start in cells. Both faults are found.
    """
    monkeypatch.setattr(sys.modules[__name__], "AUTO", [*AUTO, "integrator.paths=light"])
    if fault == "on whatever is found":
        run = Turns.run

        def forced(self: Turns) -> Finding:
            return dataclasses.replace(run(self), other=True)

        monkeypatch.setattr(Turns, "run", forced)
    else:

        def wrong(problem: Problem, say: Callable[[str], None]) -> Problem:
            found = decide(problem, say)
            on = is_auto(found.config, "guiding")
            return dataclasses.replace(found, integrator=found.integrator.afresh(guiding="on")) if on else found

        monkeypatch.setitem(DECIDE, "decide", wrong)
    with pytest.raises(AssertionError):
        test_no_scene_loses("stiff/wall", tmp_path)
