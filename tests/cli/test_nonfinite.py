"""Planted faults that give non-finite values: the behaviour of the run, and of `inspect --nonfinite` on the run."""

from __future__ import annotations

import functools
import json
import re
import shlex
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from cli.tiny import done, manifest, outcome, settings
from kit import TEXTURE, area, ref, scene, sensor, shape
from turns import a_few

from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.integrators import reslrb
from reslrb_cli.measure import nonfinite_trace
from reslrb_cli.optimization import losses, state
from reslrb_cli.runs.resume import problem_before_nonfinite

# Planted faults. The tests check how a run reacts, and whether the command that the run prints finds the fault.

SCENE = scene(
    '<default name="format" value="rgb"/> <default name="power" value="8"/> <default name="wall" value="wall.exr"/>',
    sensor(id="camera", pixels="$format"), '<bsdf type="diffuse" id="poster">REFLECTANCE</bsdf>',
    f'<bsdf type="diffuse" id="wall">{TEXTURE.format("$wall")}</bsdf>',
    shape("rectangle", "poster_shape", ref("poster"), place='<translate z="0"/>'),
    shape("rectangle", "wall_shape", ref("wall"), place='<scale value="4"/><translate z="-1"/>'),
    shape("rectangle", "lamp", area("$power, $power, $power", "light"),
          place='<rotate x="1" angle="180"/><translate z="5"/>'),
)  # fmt: skip
PLAIN = '<rgb name="reflectance" value="0.6, 0.5, 0.4"/>'

CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {file: target.exr}
parameters: [{key: poster.reflectance.value, initial: 0.5, bounds: [0, 1]}]
integrator: {type: reslrb, max_depth: 4, estimator: stack}
optimizer: {learning_rate: 0.01}
run: {iterations: 3, spp: 16, seed: 5, adjoint: correlated}
"""
KEY = "poster.reflectance.value"


def write_spoilt(folder):
    """Write a scene, textures, a target and a configuration."""
    import mitsuba as mi

    wall = np.full((8, 8, 3), 0.5, np.float32)
    mi.Bitmap(wall).write(str(folder / "wall.exr"))
    wall[4, 1, 1] = np.nan
    mi.Bitmap(wall).write(str(folder / "spoilt.exr"))
    mi.Bitmap(np.full((8, 8, 3), 0.2, np.float32)).write(str(folder / "target.exr"))
    (folder / "scene.xml").write_text(SCENE.replace("REFLECTANCE", PLAIN))
    (folder / "config.yaml").write_text(CONFIG)


@pytest.fixture
def spoilt_experiment(llvm, tmp_path, monkeypatch):
    """Working directory with a scene, textures, a target and a configuration."""
    write_spoilt(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def optimize(*sets, code=5):
    """Run `optimize`, check the exit code, and return its output and errors."""
    found, out, err = outcome("optimize", "config.yaml", *settings(*sets))
    assert found == code, err
    assert "Traceback" not in err
    return out, err


def inspect(err):
    """Run the `inspect` command in `err`, and return iteration and offenders."""
    report = json.loads(done(*command_in(err), "--json").stdout)
    return report["iteration"], report["offenders"]


def command_in(err):
    """Return the words of the `inspect` command in `err`."""
    [command] = set(re.findall(r"where: (reslrb inspect .* --nonfinite)", err))
    program, *arguments = shlex.split(command)
    assert program == "reslrb"
    return arguments


STOP = "run.on_nonfinite=stop"


def test_a_nan_texel(spoilt_experiment):
    _, err = optimize(STOP, "scene.options={wall: spoilt.exr, format: rgba}")
    assert "not finite in iteration 0" in err.splitlines()[-1]
    iteration, [offender] = inspect(err)
    text = done(*command_in(err)).stdout
    assert text.startswith("iteration 0, sensor 0, pixel")
    assert iteration == 0
    assert offender["value"][1] == "nan"
    assert all(isinstance(value, float) for value in offender["value"][::2])
    assert f"the first at pixel ({', '.join(map(str, offender['pixel']))})" in err
    at = offender["where"]
    assert at["surface"] == "wall_shape"
    assert offender["quantity"].startswith(("scattering weight", "connection factor"))
    x, y, z = at["position"]  # the wall is [-4, 4]^2 at z = -1, and texel (1, 4) of 8x8 is spoilt
    assert (int(x + 4), int(y + 4)) == (1, 4)
    assert z == pytest.approx(-1)
    assert f"path {at['path']} of 1024" in text


def test_an_overflowing_light(spoilt_experiment):
    _, err = optimize(STOP, "scene.options={power: 3e38}")
    _, [offender] = inspect(err)
    assert offender["quantity"] == "emission E"
    assert (offender["value"], offender["where"]["vertex"]) == (["inf"] * 3, 0)


def test_an_overflowing_sum(spoilt_experiment):
    _, err = optimize(STOP, "scene.options={power: 2e36}")
    _, [offender] = inspect(err)
    assert "(each path is finite; their sum overflows" in offender["quantity"]
    assert offender["where"] is None


def test_a_non_finite_derivative(spoilt_experiment):
    """The reflectance is 0.5 + sqrt(x), and x is 0."""
    _register_root()
    Path("scene.xml").write_text(SCENE.replace("REFLECTANCE", '<texture type="root" name="reflectance"/>'))
    _, err = optimize(STOP, "parameters=[{key: poster.reflectance.x, initial: 0.0, bounds: [0, 1]}]")
    assert "the gradient of poster.reflectance.x in 1 entry" in err
    _, [offender] = inspect(err)
    assert offender["quantity"].startswith("derivative of the")
    assert offender["where"]["surface"] == "poster_shape"


def test_the_replay_uses_the_parameters_of_that_iteration(spoilt_experiment):
    """The reflectance is NaN once x has moved by more than 0.015, which happens in iteration 2."""
    import drjit as dr

    _register_root(lambda x: dr.select(dr.abs(x - 0.5) > 0.015, dr.nan, x))
    Path("scene.xml").write_text(SCENE.replace("REFLECTANCE", '<texture type="root" name="reflectance"/>'))
    _, err = optimize(STOP, "parameters=[{key: poster.reflectance.x, initial: 0.5, bounds: [0, 1]}]")
    iteration, [offender] = inspect(err)
    assert iteration == 2
    assert offender["where"]["surface"] == "poster_shape"


def _register_root(function=None):
    import drjit as dr
    import mitsuba as mi

    function = function or (lambda x: 0.5 + dr.sqrt(x))

    class Root(mi.Texture):
        def __init__(self, props):
            super().__init__(props)
            self.x = mi.Float(0)

        def eval(self, si, active=True):
            return mi.Color3f(function(self.x))

        def traverse(self, callback):
            callback.put("x", self.x, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys):
            pass

        def mean(self):
            return mi.Float(0.5)

    mi.register_texture("root", Root)


def root_of_pixel(image, target, weights=None):
    """Return a loss with a finite value. One entry of its derivative is not finite."""
    import drjit as dr

    index = (3 * 8 + 5) * 3 + 1
    entry = dr.gather(type(image.array), image.array, index, True, dr.ReduceMode.Permute)
    return losses.l2(image, target) + dr.sum(dr.sqrt(entry - dr.detach(entry)))


@pytest.mark.parametrize("kind", ["stop", "skip", "zero"])
def test_a_loss_with_a_non_finite_derivative(spoilt_experiment, monkeypatch, kind):
    monkeypatch.setitem(losses.LOSSES, "l2", root_of_pixel)
    out, err = optimize(f"run.on_nonfinite={kind}", code=5 if kind == "stop" else 0)
    assert "dL/dI in 1 entry, the first at pixel (5, 3), channel 1, of sensor 0" in err
    _, [offender] = inspect(err)
    assert (offender["pixel"], offender["where"]) == ([5, 3], None)
    assert offender["quantity"].endswith("dL/dI, channel 1")
    assert offender["target"] == pytest.approx([0.2] * 3)
    assert kind != "stop" or "target (0.2, 0.2, 0.2)" in done(*command_in(err)).stdout
    assert kind == "stop" or "3 values not finite in 3 iterations" in out.splitlines()[-1]
    assert err.count("--nonfinite") == 1, "the first says where to look"
    moved = np.load("runs/config/parameters/parameters.npz")[KEY] != 0.5
    assert moved.all() if kind == "zero" else not moved.any()


def test_finished_work_is_kept(spoilt_experiment, monkeypatch):
    """After a fault in the second iteration, the run folder is complete and holds the parameters of that iteration."""
    calls = []

    def sometimes(image, target, weights=None):
        calls.append(1)
        # The first call is for the saved initial image, and the third for a black image.
        return root_of_pixel(image, target) if len(calls) == 4 else losses.l2(image, target)

    monkeypatch.setitem(losses.LOSSES, "l2", sometimes)
    out, err = optimize(STOP)
    folder = Path("runs/config")
    result = manifest("runs/config")
    assert (result["status"], result["results"]["iterations"]) == ("failed", 2)
    assert result["error"] == err.splitlines()[-1]
    assert result["results"]["nonfinite"] == {"iterations": 1, "values": 1, "by_parameter": {}}
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [record["nonfinite"] for record in records] == [0, 1]
    with np.load(folder / "checkpoint/nonfinite.npz") as saved, np.load(folder / "parameters/parameters.npz") as last:
        assert int(saved["iteration"]) == 1
        np.testing.assert_array_equal(saved[f"parameter/{KEY}"], last[KEY])
        assert (last[KEY] != 0.5).all()
    assert "1 values were not finite" in (folder / "report.html").read_text()
    calls.clear()
    monkeypatch.setitem(losses.LOSSES, "l2", losses.l2)
    code, out, _ = outcome("inspect", "runs/config/config.yaml", "--nonfinite")
    assert (code, out) == (1, "iteration 1: all values are finite now\n")


@pytest.mark.parametrize("sets", ["run={adjoint: batched}", "run={shards: 2}"])
def test_each_set_of_samples_is_checked(spoilt_experiment, sets):
    _, err = optimize("scene.options={wall: spoilt.exr}", sets, "run.iterations=3", "run.spp=16", STOP)
    _, [offender] = inspect(err)
    assert re.fullmatch(r"batch [1-4]|shard [12], image and gradient", offender["where"]["samples"])
    assert f"the first at pixel ({', '.join(map(str, offender['pixel']))})" in err


def test_without_a_fault_there_is_nothing_to_show(spoilt_experiment):
    code, _, err = outcome("inspect", "config.yaml", "--nonfinite")
    assert (code, len(err.splitlines())) == (2, 1)
    assert "is not in a run folder" in err
    optimize(code=0)
    code, _, err = outcome("inspect", "runs/config/config.yaml", "--nonfinite")
    assert code == 2
    assert "all values of this run were finite" in err


def test_the_step_of_the_run_is_traced_again(spoilt_experiment):
    """The replay needs the files and the complete state of the run. The replay uses the run's own settings and refuses
    `--set`.
    """
    optimize(STOP, "scene.options={wall: spoilt.exr}")
    command = ("inspect", "runs/config/config.yaml", "--nonfinite")
    code, _, err = outcome(*command, "--set", "run.spp=4")
    assert (code, err) == (2, "--set: has no effect with --nonfinite, which repeats a step of the run\n")
    wall = Path("spoilt.exr").read_bytes()
    Path("spoilt.exr").write_bytes(Path("wall.exr").read_bytes())
    code, _, err = outcome(*command)
    assert code == 2
    assert "has changed since runs/config began; put it back" in err
    Path("spoilt.exr").write_bytes(wall)
    file = Path("runs/config/checkpoint/nonfinite.npz")
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    code, _, err = outcome(*command)
    assert (code, len(err.splitlines())) == (2, 1)
    assert err.startswith(f"{file}: is damaged, cut off, or not written by reslrb")


@pytest.mark.parametrize("sequence", a_few(["low_discrepancy", "auto"], ["auto"]))
def test_paths_use_the_sequence_of_the_run(spoilt_experiment, monkeypatch, sequence):
    """If the sequence is `auto`, the paths use the sequence that the run chose."""
    sets = ("scene.options={wall: spoilt.exr}", f"integrator.sequence={sequence}", "run.measuring=1000")
    optimize(STOP, *sets)
    problem, _ = problem_before_nonfinite(Path("runs/config"), print)
    own = problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).sequence
    chosen = {each["setting"]: each["value"] for each in manifest("runs/config")["decisions"]}.get("sequence", sequence)
    assert (own is not None) == (chosen == "low_discrepancy")
    parts, searched = [], nonfinite_trace.search_paths

    def noting(samples, *rest):
        parts.append(samples)
        return searched(samples, *rest)

    monkeypatch.setattr(nonfinite_trace, "search_paths", noting)
    nonfinite_trace.find_offenders(problem, 0)
    assert {samples.plan.sequence for samples in parts} == {own}


@pytest.mark.parametrize("paths", a_few(["camera", "both, light_share: 0.02", "auto"], ["camera"]))
def test_camera_paths_are_checked(spoilt_experiment, paths):
    ours = f"integrator={{type: reslrb, max_depth: 4, estimator: stack, paths: {paths}}}"
    _, err = optimize(STOP, "scene.options={wall: spoilt.exr}", ours)
    _, [offender] = inspect(err)
    where = offender["where"]
    assert offender["quantity"] in ("connection factor c", "scattering weight s")
    assert offender["value"][1] == "nan"
    assert where["surface"] == "wall_shape"
    if paths == "camera":
        assert where["samples"].endswith(", camera paths")
        assert where["vertex"] >= 1
        assert f"the first at pixel ({', '.join(map(str, offender['pixel']))})" in err


def test_lamps_hit_by_camera_paths_are_checked(spoilt_experiment):
    ours = "integrator={type: reslrb, max_depth: 4, estimator: stack, paths: camera}"
    _, err = optimize(STOP, "scene.options={power: 3.4028236e38}", ours)
    _, [offender] = inspect(err)
    assert offender["quantity"] in ("incident radiance, or radiance of a sampled emitter", "connection factor c")
    assert offender["where"]["samples"].endswith(", camera paths")


@pytest.mark.parametrize("integrator", a_few(["prb", "walk_ad"], ["prb"]))
def test_paths_of_other_integrators_are_not_checked(spoilt_experiment, integrator):
    _, err = optimize(STOP, "scene.options={wall: spoilt.exr}", f"integrator={{type: {integrator}, max_depth: 4}}")
    _, [offender] = inspect(err)
    assert offender["quantity"] == "image (the paths of this integrator are not checked)"
    assert offender["image"][1] in ("nan", "inf")
    assert offender["where"] is None


def test_visible_emitters_are_named_by_their_pixel(spoilt_experiment):
    """The lamp in front of the poster faces the camera. At a depth of 1 there are no light paths."""
    at_camera = SCENE.replace('<rotate x="1" angle="180"/><translate z="5"/>', '<scale value="0.1"/>')
    Path("scene.xml").write_text(
        at_camera.replace("REFLECTANCE", PLAIN).replace('<translate z="0"/>', '<translate z="-0.5"/>')
    )
    _, err = optimize(STOP, "scene.options={power: 3.4028236e38}", "integrator.max_depth=1")
    _, [offender] = inspect(err)
    assert offender["quantity"].startswith("image (")
    assert "the sensor sees a non-finite emitter" in offender["quantity"]
    assert f"the first at pixel ({', '.join(map(str, offender['pixel']))})" in err


@pytest.mark.parametrize("estimator", a_few(["reservoir", "event"], ["event"]))
def test_other_estimators_have_the_same_paths(spoilt_experiment, estimator):
    found = []
    for name in (estimator, "gather"):
        chosen = f"integrator={{type: reslrb, estimator: {name}, max_depth: 4}}"
        _, err = optimize(STOP, "scene.options={wall: spoilt.exr}", chosen, f"run.name={name}")
        found.append(inspect(err))
    assert found[0] == found[1]


def test_passes_are_replayed(spoilt_experiment):
    sets = (STOP, "scene.options={wall: spoilt.exr}", "run.spp=1024", "integrator.estimator=reservoir")
    _, err = optimize(*sets, "integrator.samples_per_pass=64")
    _, [offender] = inspect(err)
    assert f"the first at pixel ({', '.join(map(str, offender['pixel']))})" in err
    assert ", pass " in offender["where"]["samples"]
    assert offender["quantity"] == "connection factor c"


# `inspect --nonfinite` of guided runs. Paths of the inspected step start as the tables of that time sent them.

#: Settings with so few paths that a path first meets the spoilt texel after many iterations.
SETTINGS = ["integrator.guiding=on", "scene.options={wall: spoilt.exr}", "run.iterations=60", "run.on_nonfinite=stop"]
#: Kinds of steps. With `batches`, the tables learn between the batches of a step.
WAYS = {
    "correlated": ["run.adjoint=correlated", "run.spp=2"],
    "batches": ["run.adjoint=batched", "run.batches=8", "run.spp=8"],
}
#: Seeds that are tried in turn, until a run meets the texel after its tables have learned. Any change of the tables
#: also changes which texels a seed meets.
SEEDS = range(1, 9)
Drawn = list[tuple[int, dict[str, np.ndarray] | None]]


def note(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    """Return a list that records each later sampling: the seed, and the table for drawing the samples, if any."""
    drawn: Drawn = []
    passes = reslrb.passes

    def noting(plan, scene, sensor, seed, spp, samples_per_pass, table=None, *sides):
        entries = {} if table is None else {name: value for name, value in vars(table).items() if dr.is_array_v(value)}
        held = None if table is None else {name: np.array(value) for name, value in entries.items()}
        drawn.append((int(seed[0]), held))
        return passes(plan, scene, sensor, seed, spp, samples_per_pass, table, *sides)

    monkeypatch.setattr(reslrb, "passes", noting)
    return drawn


#: The line with which a run stops, and in it the iteration and the first pixel.
TOLD = re.compile(r"not finite in iteration (\d+): .*the first at pixel \((\d+), (\d+)\)")


@pytest.fixture(scope="module")
def guided(llvm, tmp_path_factory):
    """Function that makes a guided run once, and returns its folder, its errors, and the samplings of its steps."""

    @functools.cache
    def made(way: str) -> tuple[Path, str, Drawn]:
        folder = tmp_path_factory.mktemp(way)
        write_spoilt(folder)
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            taken = note(patch)
            for seed in SEEDS:
                taken.clear()
                _, err = optimize(*SETTINGS, *WAYS[way], f"run.seed={seed}")
                told = TOLD.search(err)
                if told is not None and int(told[1]) > 0:  # the tables have learned
                    return folder, err, taken
        raise AssertionError(err)

    return made


def differences(monkeypatch: pytest.MonkeyPatch, made: tuple[Path, str, Drawn]) -> list[str]:
    """Return the differences between the run's last step and the step that its replay examines."""
    folder, err, run = made
    monkeypatch.chdir(folder)
    told, looked_at = TOLD.search(err), note(monkeypatch)
    iteration, offenders = inspect(err)
    assert iteration == int(told[1])
    seeds = list(dict.fromkeys(seed for seed, _ in looked_at))
    found = [] if len(seeds) == len({seed for seed, _ in run if seed in seeds}) > 0 else ["other seeds"]
    for seed in seeds:
        own, there = ([table for number, table in drawn if number == seed] for drawn in (run, looked_at))
        found += [] if len(there) == len(own) else [f"{len(there)} sets in place of {len(own)}"]
        for one, other in zip(own, there, strict=False):
            assert one
            if other is None or any(not np.array_equal(other[name], value) for name, value in one.items()):
                found.append("another table")
    for each in offenders:
        x, y, _ = each["where"]["position"]
        spoilt = each["where"]["surface"] == "wall_shape" and (int(x + 4), int(y + 4)) == (1, 4)
        found += [] if spoilt and each["pixel"] == [int(told[2]), int(told[3])] else ["another vertex"]
    return found


@pytest.mark.parametrize("way", a_few(WAYS, ["correlated"]))
def test_it_is_the_step_of_the_run(guided, monkeypatch, way):
    assert differences(monkeypatch, guided(way)) == []


@pytest.mark.parametrize("fault", ["untaught", "not learned on"])
def test_differing_tables_are_detected(guided, fault, monkeypatch):
    """The replay's tables were not restored, or do not learn between a step's batches."""
    run = guided("batches")
    if fault == "untaught":
        monkeypatch.setattr(state, "restore_tables", lambda problem, calls, learned: None)
    else:
        monkeypatch.setattr(Guiding, "learn", lambda self, number, paths, said: None)
    assert "another table" in differences(monkeypatch, run)
