"""`paths: auto`: the paths of a run, decided on steps of a small scene, and the run's target."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from optimization.deciding import SMALL, begin, decision, fix_times
from runs.going_on import optimize

from reslrb_cli.config.integrators import ReslrbConfig
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.autotune import race, sampling
from reslrb_cli.optimization.autotune.sampling import as_decided
from reslrb_cli.optimization.loading import paths_of
from reslrb_cli.optimization.losses import make_loss
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import View
from reslrb_cli.records.decisions import Decision, DecisionCache
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.scene.deformation import Moves
from reslrb_cli.scene.needs import camera_finds_all, light_finds_all, usual_paths

pytestmark = pytest.mark.usefixtures("llvm")

AUTO = ["integrator.paths=auto", "integrator.estimator=stack", *SMALL]
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
    monkeypatch: pytest.MonkeyPatch, camera_ms: float, *settings: str, cache: DecisionCache | None = None
) -> Problem:
    """Return the problem. Steps with camera paths alone take `camera_ms` times as long as steps with both kinds."""
    fix_times(monkeypatch, {"paths": camera_ms})
    return assemble(load("tiny.yaml", [*AUTO, *settings]), cache=cache)


def _put_glass() -> None:
    """Put a glass ball into the scene, and a point emitter in place of the lamp. No camera path finds the light that
    the ball gathers.
    """
    scene = Path("scene.xml")
    scene.write_text(scene.read_text().split('<shape type="rectangle" id="lamp">')[0] + GLASS)


def share_of(problem: Problem) -> tuple[str, float]:
    return problem.integrator.paths, problem.integrator.light_share


def test_camera_paths_are_used_if_they_find_all_light_and_are_faster(monkeypatch: pytest.MonkeyPatch):
    """All surfaces of the scene are diffuse. No camera path uses the sequence, so it is not reported."""
    problem = decided(monkeypatch, 0.01, "integrator.sequence=auto")
    [found] = problem.decisions
    assert (found.setting, found.value, share_of(problem)[0]) == ("paths", "camera", "camera")
    assert found.low is not None
    assert found.low > 1
    assert found.why.startswith(f"camera paths have {found.gain:.2g} times the efficiency here (")


def test_slower_camera_paths_are_dropped(monkeypatch: pytest.MonkeyPatch):
    problem = decided(monkeypatch, 100.0, "integrator.light_share=0.25")
    [found] = problem.decisions
    assert (found.value, *share_of(problem)) == ("both", "both", 0.25)
    assert found.gain is not None
    assert found.gain < 1


def test_nothing_is_measured_if_camera_paths_miss_light_or_paths_are_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(race.Turns, "run", lambda *args: pytest.fail("measured"))
    assert decided(monkeypatch, 0.01, "integrator.paths=both").decisions == []
    monkeypatch.setattr(sampling, "camera_finds_all", lambda *scene: False)
    problem = decided(monkeypatch, 0.01)
    assert [each.line() for each in problem.decisions] == ["paths both: camera paths do not find all light here"]
    assert share_of(problem) == ("both", 0.5)


def test_without_time_half_of_the_paths_are_light_paths(monkeypatch: pytest.MonkeyPatch):
    """With `run.measuring: 0`, not even the two steps that determine the limit are taken."""
    for measuring in ("1e-9", "0"):
        problem = decided(monkeypatch, 0.01, f"run.measuring={measuring}")
        assert share_of(problem) == ("both", 0.5)
        assert "not measured" in problem.decisions[0].why
        monkeypatch.setattr(sampling, "measured_step", lambda *args: pytest.fail("measured"))


def test_the_limit_of_measuring_includes_the_time_limit_of_the_run(monkeypatch: pytest.MonkeyPatch):
    """The race of camera paths needs the time of three iterations. `fix_times` gives them 1 ms or more each."""
    found = [decided(monkeypatch, 0.01, f"run.max_seconds={limit}").decisions[0] for limit in ("1e-7", "1000")]
    assert [each.gain is None for each in found] == [True, False]


def test_all_races_together_keep_the_limit(monkeypatch: pytest.MonkeyPatch):
    """The race of camera paths has taken all the time, so that guiding is not raced."""
    right = sampling.Tuner.race

    def race_slowly(self: sampling.Tuner, *args: Any) -> Decision:
        found = right(self, *args)
        self._spent_s += 1e9
        return found

    monkeypatch.setattr(sampling.Tuner, "race", race_slowly)
    fix_times(monkeypatch, {"paths": 100.0})
    problem = assemble(load("tiny.yaml", [*AUTO, "integrator.guiding=auto"]))
    assert [(each.setting, each.gain is None) for each in problem.decisions] == [("paths", False), ("guiding", True)]


def test_the_decision_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    cache = DecisionCache(tmp_path / "kept")
    first, second = (decided(monkeypatch, 0.01, cache=cache) for _ in range(2))
    assert [each.decisions[0].cached for each in (first, second)] == [False, True]
    assert share_of(first) == share_of(second)


def test_only_light_paths_that_find_everything_are_guided(monkeypatch: pytest.MonkeyPatch):
    """Guided light paths keep the film's border as `paths: both` does, and the target has this border. A resumed run
    keeps the border too. The time of the first race still counts, and nothing is reported of camera paths.
    """
    fix_times(monkeypatch, {"paths": 100.0, "guiding": 1e-6})
    settings = ["integrator.guiding=auto", "integrator.sequence=auto", "integrator.pixels=auto"]
    problem = assemble(load("tiny.yaml", [*AUTO, *settings]))
    values = {each.setting: each.value for each in problem.decisions}
    assert values == {"paths": "light", "guiding": "on", "sequence": "independent"}
    paths, guiding = decision(problem, "paths"), decision(problem, "guiding")
    assert paths is not None
    assert guiding is not None
    assert paths.line().startswith("paths light: guided, they have ")
    assert min(paths.seconds, guiding.seconds) > 0
    assert problem.measured_s == paths.seconds + guiding.seconds
    assert problem.integrator.paths == "light"
    assert problem.integrator.preparation.sampling.whole
    assert problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).whole
    assert as_decided(problem.integrator, problem.decisions).preparation.sampling.whole


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
    assert not camera_finds_all(scene, -1, gloss=True)
    for bsdf, found in (("roughplastic", [False, True]), ("plastic", [False, False]), ("dielectric", [False, False])):
        room["wall"]["bsdf"] = {"type": bsdf}
        scene = mi.load_dict(room)
        assert [camera_finds_all(scene, -1, gloss=gloss) for gloss in (False, True)] == found
    room["wall"]["bsdf"] = {"type": "diffuse"}
    assert camera_finds_all(mi.load_dict(room), -1)
    room["beam"] = {"type": "rectangle", "emitter": {"type": "directionalarea"}}
    assert not camera_finds_all(mi.load_dict(room), 2)


def test_a_short_run_uses_camera_paths_if_they_find_all_light():
    """In the furnace, camera paths have at least a thousand times the efficiency."""
    problem = assemble(load(ROOT / "configs" / "furnace.yaml", ["target.render.spp=64"]))
    assert problem.config.run.measuring == 0.1
    found = decision(problem, "paths")
    assert found is not None
    assert (found.value, problem.integrator.paths) == ("camera", "camera")
    assert found.low is not None
    assert found.low > 10


@pytest.mark.long
@pytest.mark.parametrize("paths", ["auto", "camera"])
def test_camera_paths_of_a_guided_run_are_unchanged(paths: str, monkeypatch: pytest.MonkeyPatch):
    """No table determines where camera paths begin, whether camera paths were found to pay or were requested."""
    fix_times(monkeypatch, {"paths": 0.01})
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
    assert share_of(problem) == ("both", 0.5)


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
    found = race.Turns(take, sizes, 1e-9).run()
    assert len(taken) == 3 + 2 * rounds
    assert found.other


def test_beams_and_scaled_emitters_are_left_to_light_paths():
    def paths(**lights: Any) -> str:
        wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3])}
        scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "wall": wall, **lights})
        return paths_of(ReslrbConfig(), scene, [0])

    def sun(scale: float) -> dict[str, Any]:
        return {"type": "directional", "to_world": mi.ScalarTransform4f().scale(scale)}

    beam = {"type": "rectangle", "emitter": {"type": "directionalarea"}}
    assert paths(beam=beam) == "light"
    assert paths(beam=beam, sun=sun(1)) == "both"
    assert paths(sun=sun(1)) == "both"
    assert paths(sun=sun(2)) == "light"


def test_paths_suit_all_sensors():
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    scene = mi.load_dict({
        "type": "scene", "first": {"type": "perspective"}, "second": {"type": "radiancemeter", "film": film},
        "wall": {"type": "rectangle"}, "lamp": {"type": "point", "position": [0, 0, -3]},
    })  # fmt: skip
    sensors = scene.sensors()
    found = [usual_paths(scene, seen, 4, False, False) for seen in (sensors[:1], sensors[1:], sensors, sensors[::-1])]
    assert found == ["both", "camera", "camera", "camera"]


@pytest.mark.parametrize(("name", "settings", "paths"), [
    ("lens_pose", [], "light"), ("lens_pose", ["integrator.paths=both"], "both"),
    ("lens_pose", ["integrator.attached_sampling=follow"], "light"),
    ("moved_box", [], "camera"), ("moved_box", ["integrator.max_depth=6"], "camera"),
    ("moved_box", ["integrator.paths=light"], "light"), ("table", [], "both"),
])  # fmt: skip
def test_paths_of_runs_that_move_shapes(name: str, settings: list[str], paths: str):
    problem = assemble_scene(load(ROOT / "configs" / f"{name}.yaml", settings))
    assert (problem.paths, problem.moves, problem.integrator.paths) == (paths, Moves.SHAPES, paths)


def test_runs_that_see_moving_glass_use_both_kinds_of_paths(tmp_path: Path):
    text = (ROOT / "scenes" / "moved_box" / "scene.xml").read_text()
    box = text.index('id="box"')
    begin, end = text.index("<bsdf", box), text.index("</bsdf>", box) + len("</bsdf>")
    (tmp_path / "scene.xml").write_text(f'{text[:begin]}<bsdf type="dielectric"/>{text[end:]}')
    words = [f"scene.file={tmp_path / 'scene.xml'}", "integrator.max_depth=6", "target={render: {}}"]
    assert assemble_scene(load(ROOT / "configs" / "moved_box.yaml", words)).paths == "both"


def test_moving_lamps_use_light_paths():
    words = ["parameters=[{motion: {of: lamp}}]", "integrator.paths=both"]
    problem = assemble_scene(load(ROOT / "configs" / "moved_box.yaml", [*words, "target={render: {}}"]))
    assert (problem.paths, problem.moves, problem.integrator.paths) == ("light", Moves.LAMPS, "light")


def test_naive_differentiation_of_moving_shapes_uses_light_paths():
    naive = assemble_scene(load(ROOT / "configs" / "lens_pose.yaml", ["integrator={type: walk_ad, paths: both}"]))
    assert (naive.paths, naive.integrator.paths) == ("light", "light")


@pytest.mark.long
@pytest.mark.parametrize(
    "settings", [pytest.param(AUTO, id="measured at length"), pytest.param(SHORT, id="short", marks=pytest.mark.long)]
)
def test_a_resumed_run_keeps_its_paths(settings: list[str], monkeypatch: pytest.MonkeyPatch):
    words = tiny.settings(*settings)
    assert optimize("tiny.yaml", *words) == 0
    found = read_manifest(RUN)
    [paths] = map(Decision.from_json, found["decisions"])
    assert (paths.setting, paths.gain is None) == ("paths", False)
    assert paths.line() in (RUN / "report.html").read_text()
    # Nothing is measured again.
    monkeypatch.setattr(sampling.Tuner, "race", lambda *given: pytest.fail("measured"))
    iterations = load("tiny.yaml", settings).run.iterations + 2
    assert optimize("--resume", str(RUN), "--set", f"run.iterations={iterations}") == 0
    again = read_manifest(RUN)
    assert again["decisions"] == found["decisions"]
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
        found = decision(problem, "pixels")
        assert (found is None) == (pixels == "measured")
        assert found is None or found.value == ("measured" if shared else "even")
        assert ("pixels" in problem.integrator.preparation.sampling.on) is shared
        densities += [problem.integrator.preparation.sampling.given[0]] if shared else []
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


def test_impossible_paths_are_located():
    with pytest.raises(ConfigError, match=r"integrator.estimator: `gather` needs the connections"):
        load("tiny.yaml", ["integrator.paths=camera", "integrator.estimator=gather"])
