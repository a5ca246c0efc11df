"""`paths: auto`: the paths of a run, decided on steps of a small scene, and the run's target."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from optimization.deciding import SMALL, begin, fix_times
from runs.going_on import optimize

from reslrb_cli.config.integrators import Reslrb
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.autotune import race, sampling
from reslrb_cli.optimization.autotune.sampling import FEWER, FIRST_SHARE, MORE, CameraPilot, with_sides
from reslrb_cli.optimization.loading import paths_of
from reslrb_cli.optimization.losses import make_loss
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import View
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.decisions import PathsRecord
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.scene.needs import camera_finds_all, light_finds_all
from reslrb_cli.transport.film import PixelShares

pytestmark = pytest.mark.usefixtures("llvm")

AUTO = ["integrator.paths=auto", "integrator.estimator=stack", *SMALL]
OTHERS = (0.0, *FEWER, *MORE)
#: Settings of a run of one second, of which measuring may take a tenth.
SHORT = ["integrator.paths=auto", "integrator.estimator=stack", "scene.size=[32, 32]", "run.spp=16"]
SHORT += ["run.iterations=100", "run.certainty=false"]
#: A glass ball in front of the poster, and a point lamp behind the ball.
GLASS = """<shape type="sphere"><point name="center" value="0.4, 0.3, 1"/><float name="radius" value="0.3"/>
        <bsdf type="dielectric"/></shape>
    <emitter type="point"><point name="position" value="0.6, 0.45, 3"/><rgb name="intensity" value="40"/></emitter>
</scene>
"""
RUN = Path("runs/tiny")
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return begin(tmp_path, monkeypatch)


def decided(
    monkeypatch: pytest.MonkeyPatch, other_ms: float, *settings: str, cache: PilotCache | None = None,
    apart: dict[float, float] | None = None,
) -> Problem:  # fmt: skip
    """Return the problem with given step times. Steps of another share take `other_ms` times as long as steps of the
    best share so far. `apart` gives separate times for some shares.
    """
    fix_times(monkeypatch, {f"paths {share:g}": (apart or {}).get(share, other_ms) for share in OTHERS})
    return assemble(load("tiny.yaml", [*AUTO, *settings]), cache=cache)


def _put_glass() -> None:
    """Put a glass ball into the scene, and a point emitter in place of the lamp. No camera path finds the light that
    the ball gathers.
    """
    scene = Path("scene.xml")
    scene.write_text(scene.read_text().split('<shape type="rectangle" id="lamp">')[0] + GLASS)


def share_of(problem: Problem) -> tuple[str, float]:
    return problem.integrator.paths, problem.integrator.light_share


def test_camera_paths_are_tried_first_if_they_find_all_light(monkeypatch: pytest.MonkeyPatch):
    """All surfaces of the scene are diffuse."""
    problem = decided(monkeypatch, 100.0, apart={0.0: 0.01})
    assert problem.sides is not None
    assert (problem.sides.paths, problem.sides.light_share) == ("camera", 0.0)
    assert share_of(problem)[0] == "camera"
    assert problem.sides.low > 1


def test_a_faster_share_is_pursued_to_the_end(monkeypatch: pytest.MonkeyPatch):
    """The trials add a few light paths to camera paths alone, and then more. Where light paths are better or necessary,
    trials start from a half and take fewer.
    """
    assert share_of(decided(monkeypatch, 0.01)) == ("both", FEWER[0])
    assert share_of(decided(monkeypatch, 0.01, apart={FEWER[0]: 100.0})) == ("both", FEWER[1])
    assert share_of(decided(monkeypatch, 0.01, apart={0.0: 100.0})) == ("both", FEWER[1])
    monkeypatch.setattr(sampling, "camera_finds_all", lambda *scene: False)
    assert share_of(decided(monkeypatch, 0.01)) == ("both", FEWER[1])


def test_a_slower_share_is_dropped(monkeypatch: pytest.MonkeyPatch):
    problem = decided(monkeypatch, 100.0)
    assert share_of(problem) == ("both", FIRST_SHARE)
    assert problem.sides.gain < 1


def test_a_share_is_measured_with_fixed_paths(monkeypatch: pytest.MonkeyPatch):
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


def test_the_decision_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    cache = PilotCache(tmp_path / "kept")
    first, second = (decided(monkeypatch, 0.01, cache=cache) for _ in range(2))
    assert not first.sides.cached
    assert second.sides.cached
    assert share_of(first) == share_of(second)


def test_only_light_paths_that_find_everything_are_guided(monkeypatch: pytest.MonkeyPatch):
    """Guided light paths keep the film's border as `paths: both` does, and the target has this border. A resumed run
    keeps the border too.
    """
    fix_times(monkeypatch, {f"paths {share:g}": 100.0 for share in OTHERS} | {"guiding": 1e-6})
    problem = assemble(load("tiny.yaml", [*AUTO, "integrator.guiding=auto"]))
    assert problem.guided.guided
    assert (problem.sides.paths, problem.sides.light_share) == ("both", 1.0)
    assert problem.sides.line().startswith("paths both, 100 % light paths: guided, they have ")
    assert problem.integrator.paths == "light"
    assert problem.integrator.preparation.whole
    assert problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).whole
    assert with_sides(problem.integrator, problem.sides).preparation.whole


def test_light_paths_find_all_except_mirrors_and_light_hidden_by_lamps():
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


def test_camera_paths_find_all_except_light_from_gloss_and_glass():
    """At depth 2, all light comes straight from the lamps. Camera paths then find all light."""
    room: dict[str, Any] = {
        "type": "scene", "wall": {"type": "rectangle", "bsdf": {"type": "roughconductor"}},
        "lamp": {"type": "sphere", "center": [0, 0, 1], "radius": 0.2, "emitter": {"type": "area"}},
    }  # fmt: skip
    scene = mi.load_dict(room)
    assert [camera_finds_all(scene, depth) for depth in (-1, 3, 2)] == [False, False, True]
    room["wall"]["bsdf"] = {"type": "diffuse"}
    assert camera_finds_all(mi.load_dict(room), -1)
    room["beam"] = {"type": "rectangle", "emitter": {"type": "directionalarea"}}
    assert not camera_finds_all(mi.load_dict(room), 2)


def test_a_short_run_uses_camera_paths_if_they_find_all_light():
    """In the furnace, camera paths have at least a thousand times the efficiency."""
    problem = assemble(load(ROOT / "configs" / "furnace.yaml", ["target.render.spp=64"]))
    assert problem.config.run.measuring == 0.1
    assert (problem.sides.paths, problem.integrator.paths) == ("camera", "camera")
    assert problem.sides.low > 10


@pytest.mark.parametrize("paths", ["auto", "camera"])
def test_camera_paths_of_a_guided_run_are_unchanged(paths: str, monkeypatch: pytest.MonkeyPatch):
    """No table determines where camera paths begin, whether camera paths were found to pay or were requested."""
    fix_times(monkeypatch, {f"paths {share:g}": 0.01 if share == 0 else 100.0 for share in OTHERS})
    words = [*SMALL, "integrator.guiding=on", "integrator.estimator=stack", f"integrator.paths={paths}"]
    assert optimize("tiny.yaml", *tiny.settings(*words)) == 0
    rows = {row["feature"]: row for row in read_manifest(RUN)["plan"]["rows"]}
    assert rows["camera paths"]["needed"]
    assert not rows["guided emission"]["needed"]
    assert optimize("--resume", str(RUN), "--set", "run.iterations=3") == 0


def test_a_short_run_keeps_its_caustic():
    """No camera path finds the caustic. Camera paths therefore seem to have hardly any noise."""
    _put_glass()
    problem = assemble(load("tiny.yaml", [*SHORT, "integrator.max_depth=6"]))
    assert problem.sides.paths == "both"
    assert problem.integrator.light_share >= min(FEWER)


@pytest.mark.parametrize(("spp", "rounds"), [(1, race.LEAST_ROUNDS), (8, 8), (16, 16), (1024, 16)])
def test_the_decision_for_camera_paths_uses_all_rounds_without_python_time(spp: int, rounds: int):
    """The rounds use the samples of three iterations. If these samples allow too few rounds for a result, the minimum
    number of rounds applies.
    """
    taken: list[race.Step] = []

    def take(other: bool, round: int, samples: int) -> race.Step:
        random = np.random.default_rng([round, other])
        gradient = {"a": 1 + random.normal(size=3) * (0.1 if other else 1)}
        taken.append(race.Step(gradient, {"0": gradient["a"]}, kernel_ms=0.01 * samples, wall_ms=100.0 * len(taken)))
        return taken[-1]

    sizes = race.Sizes(spp, spp, spp, False, 16, 0.0, 2.0, planned=1.2)
    found = CameraPilot(take, sizes, 1.0, share=1e-9).run()
    assert found.rounds == rounds
    assert found.paths == "other"


def test_beams_and_scaled_emitters_are_left_to_light_paths():
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


def test_moving_light_uses_light_paths():
    problem = assemble_scene(load(ROOT / "configs" / "lens_pose.yaml", ["integrator.paths=both"]))
    assert (problem.paths, problem.moves, problem.integrator.paths) == ("light", True, "light")
    naive = assemble_scene(load(ROOT / "configs" / "lens_pose.yaml", ["integrator={type: walk_ad, paths: both}"]))
    assert (naive.paths, naive.integrator.paths) == ("light", "light")


@pytest.mark.parametrize("settings", [AUTO, SHORT], ids=["measured at length", "short"])
def test_a_resumed_run_keeps_its_paths(settings: list[str], monkeypatch: pytest.MonkeyPatch):
    words = tiny.settings(*settings)
    assert optimize("tiny.yaml", *words) == 0
    found = read_manifest(RUN)
    assert found["paths"]["paths"] in ("both", "camera")
    assert "not measured" not in found["paths"]["note"]
    assert PathsRecord.from_json(found["paths"]).line() in (RUN / "report.html").read_text()
    for decision in ("decide", "allowance"):  # nothing is measured again

        def refuse(*given: Any, **options: Any) -> Any:
            raise AssertionError("measured")

        monkeypatch.setattr(race.Tuner, decision, refuse)
    iterations = load("tiny.yaml", settings).run.iterations + 2
    assert optimize("--resume", str(RUN), "--set", f"run.iterations={iterations}") == 0
    again = read_manifest(RUN)
    assert again["paths"] == found["paths"]
    assert again["plan"] == found["plan"]


@pytest.mark.parametrize(
    "integrator", ["{paths: camera}", "{paths: both}", "{type: walk_ad, paths: both}", "{type: walk_ad, paths: camera}"]
)
def test_targets_and_images_have_the_same_light(integrator: str):
    """This also holds at the film's border, where light paths alone lack the light that falls off the film."""
    problem = assemble(load("tiny.yaml", [f"integrator={integrator}", "target.render.spp=256", *SMALL]))
    problem.selection.set_arrays(problem.truth)
    [view] = problem.views
    image, target = problem.render(view.sensor, 256, 0, "test"), np.array(view.target)
    border = np.ones(image.shape[:2], bool)
    border[1:-1, 1:-1] = False
    assert image[border].mean() == pytest.approx(target[border].mean(), rel=0.05)
    assert not view.masked.left_out


def test_auto_distributes_paths_only_for_l2(monkeypatch: pytest.MonkeyPatch):
    """`pixels: auto` distributes paths for `l2` only, also with a mask. Masked pixels get no extra paths, even if the
    user requests `measured` for another loss.
    """
    monkeypatch.setattr(sampling, "noted_part", lambda paths, spp: 0.01)
    weights = np.ones((32, 32, 3), np.float32)
    weights[:4] = 0
    mi.Bitmap(weights).write("weights.exr")
    mask, relative, densities = "target.mask={file: weights.exr}", "loss={type: relative_l2}", []
    for pixels, settings, shared in (
        ("auto", [], True), ("auto", [mask], True), ("measured", [relative, mask], True), ("auto", [relative], False),
        ("auto", ["loss=[{type: l2}, {type: ssim, weight: 0.1}]"], False),
    ):  # fmt: skip
        integrator = f"integrator={{estimator: stack, paths: both, pixels: {pixels}}}"
        problem = assemble(load("tiny.yaml", [integrator, *SMALL, *settings]))
        assert (problem.pixels is None) == (pixels == "measured")
        assert problem.pixels is None or problem.pixels.measured is shared
        assert problem.integrator.preparation.shares_out is shared
        densities += [problem.integrator.preparation.given[0]] if shared else []
        assert not shared or bool(densities[-1][:4].any()) == (mask not in settings)
    assert not np.allclose(densities[1], densities[2], rtol=0.1)


@pytest.mark.parametrize("epsilon", [0.01, 0.3])
def test_the_curvature_of_relative_l2_is_the_inverse_squared_target(epsilon: float):
    """The equality holds for a grey target. In coloured targets, bright channels count, because they have most of the
    noise.
    """
    view = View(0, make_loss("relative_l2", epsilon=epsilon))
    target, weights = np.geomspace(0.01, 1e8, 24).reshape(4, 6, 1).repeat(3, 2), np.ones((4, 6))
    weights[1, :3] = 0
    view.see(target, weights)
    expected = weights / (np.square(target[:, :, 0]) + epsilon)
    np.testing.assert_allclose(view.curvature(True), expected / expected.mean(), rtol=1e-4)
    np.testing.assert_allclose(view.curvature(False), weights / weights.mean(), rtol=1e-4)


def test_a_memory_budget_includes_the_distribution_of_paths():
    """The film is so large that other allocations count little."""

    def expected(pixels: str) -> int:
        integrator = f"integrator={{estimator: stack, paths: both, pixels: {pixels}}}"
        settings = [integrator, "run.memory_budget=256", "run.spp=4", "scene.size=[256, 256]"]
        problem = assemble(load("tiny.yaml", settings))
        assert problem.memory is not None
        return problem.memory.expected_bytes.total

    expected("even")  # creates everything that is made once
    more = expected("measured") - expected("even")
    assert more == pytest.approx(PixelShares.bytes(256 * 256), rel=0.1)


def test_impossible_paths_are_located():
    with pytest.raises(ConfigError, match=r"integrator.estimator: `gather` needs the connections"):
        load("tiny.yaml", ["integrator.paths=camera", "integrator.estimator=gather"])
