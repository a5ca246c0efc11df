"""`paths: auto`: which paths a run traces, decided on steps of a small scene, and what it makes of its target."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from optimization.deciding import SMALL, begin, fix_times
from runs.going_on import optimize

from reslrb_cli.config.integrators import Reslrb
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.autotune.sampling import FEWER, FIRST_SHARE, MORE, with_sides
from reslrb_cli.optimization.loading import paths_of
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.decisions import PathsRecord
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.scene.needs import light_finds_all

pytestmark = pytest.mark.usefixtures("llvm")

AUTO = ["integrator.paths=auto", "integrator.estimator=stack", *SMALL]
RUN = Path("runs/tiny")
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return begin(tmp_path, monkeypatch)


def decided(
    monkeypatch: pytest.MonkeyPatch, other_ms: float, *settings: str, cache: PilotCache | None = None
) -> Problem:
    """The problem, where steps of another share take so many times as long as those of the best so far."""
    fix_times(monkeypatch, {f"paths {share:g}": other_ms for share in (*FEWER, *MORE)})
    return assemble(load("tiny.yaml", [*AUTO, *settings]), cache=cache)


def share_of(problem: Problem) -> tuple[str, float]:
    return problem.integrator.paths, problem.integrator.light_share


def test_what_is_faster_is_taken_as_far_as_it_goes(monkeypatch: pytest.MonkeyPatch):
    """All surfaces are diffuse: fewer light paths, until there are none."""
    problem = decided(monkeypatch, 0.01)
    assert problem.sides is not None
    assert (problem.sides.paths, problem.sides.light_share) == ("camera", 0.0)
    assert share_of(problem)[0] == "camera"
    assert problem.sides.low > 1


def test_what_is_slower_is_left(monkeypatch: pytest.MonkeyPatch):
    problem = decided(monkeypatch, 100.0)
    assert share_of(problem) == ("both", FIRST_SHARE)
    assert problem.sides.gain < 1


def test_a_share_alone_is_measured_too(monkeypatch: pytest.MonkeyPatch):
    problem = decided(monkeypatch, 100.0, "integrator.paths=both", "integrator.light_share=auto")
    assert share_of(problem) == ("both", FIRST_SHARE)
    assert problem.sides is not None
    problem = decided(monkeypatch, 100.0, "integrator.paths=both", "integrator.light_share=0.25")
    assert share_of(problem) == ("both", 0.25)
    assert problem.sides is None


def test_without_time_half_of_the_paths_are_light_paths(monkeypatch: pytest.MonkeyPatch):
    problem = decided(monkeypatch, 1.0, "run.measuring=0")
    assert share_of(problem) == ("both", FIRST_SHARE)
    assert "not measured" in problem.sides.note


def test_it_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    cache = PilotCache(tmp_path / "kept")
    first, second = (decided(monkeypatch, 0.01, cache=cache) for _ in range(2))
    assert not first.sides.cached
    assert second.sides.cached
    assert share_of(first) == share_of(second)


def test_light_paths_alone_are_what_is_guided_where_they_find_all(monkeypatch: pytest.MonkeyPatch):
    """With the border of both, which the target has; and that is what goes on from a checkpoint."""
    fix_times(monkeypatch, {f"paths {share:g}": 100.0 for share in (*FEWER, *MORE)} | {"guiding": 1e-6})
    problem = assemble(load("tiny.yaml", [*AUTO, "integrator.guiding=auto"]))
    assert problem.guided.guided
    assert (problem.sides.paths, problem.sides.light_share) == ("both", 1.0)
    assert problem.sides.line().startswith("paths both, 100 % light paths: guided, they have ")
    assert problem.integrator.paths == "light"
    assert problem.integrator.preparation.whole
    assert problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).whole
    assert with_sides(problem.integrator, problem.sides).preparation.whole


def test_light_paths_find_all_but_mirrors_and_what_hidden_lamps_cover():
    room: dict[str, Any] = {
        "type": "scene", "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3]).scale(4)},
        "lamp": {"type": "sphere", "radius": 0.2, "center": [0, 0, 1], "emitter": {"type": "area"}},
    }  # fmt: skip
    scene = mi.load_dict(room)
    assert light_finds_all(scene, scene.sensors(), False)
    assert not light_finds_all(scene, scene.sensors(), True)
    room["wall"]["bsdf"] = {"type": "conductor"}
    scene = mi.load_dict(room)
    assert not light_finds_all(scene, scene.sensors(), False)


def test_beams_alone_and_scaled_ones_are_left_to_light_paths():
    def paths(**lights: Any) -> str:
        wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3])}
        scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "wall": wall, **lights})
        return paths_of(Reslrb(), scene, [0])

    def sun(scale: float) -> dict[str, Any]:
        return {"type": "directional", "to_world": mi.ScalarTransform4f().scale(scale)}

    beam = {"type": "rectangle", "emitter": {"type": "directionalarea"}}
    assert paths(beam=beam) == "light"
    assert paths(beam=beam, sun=sun(1)) == "both"
    assert paths(sun=sun(1)) == "both"
    assert paths(sun=sun(2)) == "light"


def test_what_moves_light_has_light_paths():
    problem = assemble_scene(load(ROOT / "configs" / "lens_pose.yaml", ["integrator.paths=both"]))
    assert (problem.paths, problem.moves, problem.integrator.paths) == ("light", True, "light")
    naive = assemble_scene(load(ROOT / "configs" / "lens_pose.yaml", ["integrator={type: walk_ad, paths: both}"]))
    assert (naive.paths, naive.integrator.paths) == ("light", "light")


def test_a_run_goes_on_with_the_paths_that_it_had():
    settings = [word for setting in AUTO for word in ("--set", setting)]
    assert optimize("tiny.yaml", *settings) == 0
    found = read_manifest(RUN)
    assert found["paths"]["paths"] in ("both", "camera")
    assert PathsRecord.from_json(found["paths"]).line() in (RUN / "report.html").read_text()
    assert optimize("--resume", str(RUN), "--set", "run.iterations=4") == 0
    again = read_manifest(RUN)
    assert again["paths"] == found["paths"]
    assert again["plan"] == found["plan"]


@pytest.mark.parametrize(
    "integrator", ["{paths: camera}", "{paths: both}", "{type: walk_ad, paths: both}", "{type: walk_ad, paths: camera}"]
)
def test_targets_and_images_have_the_same_light(integrator: str):
    """At the film's border, too, where light paths alone lack what falls off it."""
    problem = assemble(load("tiny.yaml", [f"integrator={integrator}", "target.render.spp=256", *SMALL]))
    problem.selection.set_arrays(problem.truth)
    [view] = problem.views
    image, target = problem.render(view.sensor, 256, 0, "test"), np.array(view.target)
    border = np.ones(image.shape[:2], bool)
    border[1:-1, 1:-1] = False
    assert image[border].mean() == pytest.approx(target[border].mean(), rel=0.05)
    assert not view.masked.left_out


def test_paths_that_cannot_be_are_located():
    with pytest.raises(ConfigError, match=r"integrator.estimator: `gather` chooses"):
        load("tiny.yaml", ["integrator.paths=camera", "integrator.estimator=gather"])
