"""Users' own integrators, which are checked against all references."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli.tiny import ended
from kit import area, diffuse, scene, sensor, shape

from reslrb_cli.errors import ExitCode

FILE = Path(__file__).with_name("own_replay.py")

#: A floor of two materials that a texture mixes.
MIXED = """<bsdf type="blendbsdf" id="mixed"><texture type="checkerboard" name="weight">
<float name="color0" value="0.3"/><float name="color1" value="0.7"/></texture>
<bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.6, 0.3"/></bsdf>
<bsdf type="roughconductor"><float name="alpha" value="0.5"/></bsdf></bsdf>"""


def room(floor: str) -> str:
    """Return a scene of a floor, a wall beside it, and two lamps."""
    return scene(
        sensor("0, 1.2, 3.2", "0, 0.6, 0", size=16, fov=60, id="camera", rfilter="gaussian", pixels="rgba"),
        shape("rectangle", "floor", floor, place='<scale value="1.5"/><rotate x="1" angle="-90"/>'),
        shape("rectangle", "wall", diffuse("0.5, 0.7, 0.6", "paint"),
              place='<scale value="1.5"/><translate y="1.5" z="-1.5"/>'),
        shape("rectangle", "left", diffuse("0.7, 0.7, 0.7"),
              place='<scale value="1.5"/><rotate y="1" angle="90"/><translate x="-1.5" y="1.5"/>'),
        shape("rectangle", "lamp", area("6, 5, 4"),
              place='<scale value="0.5"/><rotate x="1" angle="90"/><translate y="2.6"/>'),
        shape("rectangle", "small", area("9, 9, 12"),
              place='<scale value="0.2"/><rotate y="1" angle="-90"/><translate x="1.4" y="0.8"/>'),
    )  # fmt: skip


CONFIG = """
scene: {file: scene.xml}
target: {render: {spp: 16}}
parameters:
  - {key: wall.bsdf.reflectance.value, initial: [0.5, 0.7, 0.6]}
integrator: {type: reslrb, max_depth: 5, rr_depth: 1, paths: camera, estimator: stack}
run: {iterations: 2, spp: 64}
"""

#: Options that are enough to find large faults.
FEW = ["--seeds", "12", "--spp", "32", "--set", "integrator.max_depth=4"]

#: Setting that recovers both parameters.
TWO = "parameters=[{key: floor.bsdf.weight.color0.value, initial: 0.3}, {key: wall.bsdf.reflectance.value}]"


@pytest.fixture(autouse=True)
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(room(diffuse("0.8, 0.6, 0.3")))
    Path("room.yaml").write_text(CONFIG)
    Path("own_replay.py").write_text(FILE.read_text())
    return tmp_path


def checked(options: str, *more: str) -> int:
    """Check the integrator with these options, and return the exit code."""
    name = f"own_replay.py:Replay({options})" if options else "own_replay.py:Replay"
    words = ("gradcheck", "room.yaml", "--integrators", name, "--allow-code", "--seeds", "24", "--spp", "64", *more)
    return ended(*words)


@pytest.mark.long
def test_a_correct_integrator_holds() -> None:
    assert checked("", *FEW) == 0


#: Faults that `own_replay.py` plants.
FAULTS = ("fault=cosine", "fault=replay", "fault=roulette", "fault=lobe", "fault=kept", "fault=emitters", "fault=twice",
          "fault=first", "fault=sign", "fault=depth", "primal_fault=emitters")  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found(fault: str) -> None:
    more = ["--set", TWO] if fault == "fault=lobe" else []
    Path("scene.xml").write_text(room(MIXED))
    assert checked(fault, *more) == ExitCode.CHECK_FAILED


#: Integrators of Mitsuba, imported as in users' files, and the configuration that checks them.
MITSUBAS = """from mitsuba.ad.integrators.direct_projective import DirectProjectiveIntegrator
from mitsuba.ad.integrators.prb_basic import BasicPRBIntegrator
"""
FURNACE = str(Path(__file__).parents[2] / "configs/furnace.yaml")


@pytest.mark.long
def test_correct_integrators_of_mitsuba_hold() -> None:
    Path("mine.py").write_text(MITSUBAS)
    Path("scene.xml").write_text(room(MIXED))

    def check(config: str, name: str, *settings: str) -> int:
        sets = [word for each in settings for word in ("--set", each)]
        words = ["gradcheck", config, "--integrators", f"mine.py:{name}", "--allow-code", *sets]
        return ended(*words, "--seeds", "24", "--spp", "64")

    assert check(FURNACE, "BasicPRBIntegrator") == 0
    assert check("room.yaml", "DirectProjectiveIntegrator", "integrator.max_depth=2") == 0


#: A scene with an object that moves in view, over a floor below a lamp. The objects are given by the corners of
#: triangles.
MOVING_SCENE = scene(
    sensor("0, 2.5, 4", "0, 0.4, 0", size=16, fov=45, rfilter="gaussian", pixels="rgba"),
    shape("rectangle", "", diffuse("0.8, 0.6, 0.3"), place='<scale value="4"/><rotate x="1" angle="-90"/>'),
    shape("obj", "thing", '<string name="filename" value="thing.obj"/><boolean name="face_normals" value="true"/>',
          '<bsdf type="twosided">', diffuse("0.1, 0.3, 0.6"), "</bsdf>",
          place='<scale value="0.4"/><rotate x="1" angle="-60"/><translate y="0.8"/>'),
    shape("rectangle", "", area("6, 5, 4"),
          place='<scale value="0.5"/><rotate x="1" angle="90"/><translate x="0.5" y="3.5"/>'),
)  # fmt: skip
SHEET = ["1 2 3", "1 3 4"]
BOX = ["1 3 2", "1 4 3", "5 6 7", "5 7 8", "1 2 6", "1 6 5", "2 3 7", "2 7 6", "3 4 8", "3 8 7", "4 1 5", "4 5 8"]
MOVING = """
scene: {file: moving.xml}
target: {render: {spp: 16}}
parameters: [{motion: {of: [thing], free: [translation]}}]
integrator: {type: reslrb, max_depth: 2}
run: {iterations: 2, spp: 64}
"""


@pytest.mark.long
@pytest.mark.parametrize(("triangles", "projective_holds"), [(SHEET, True), (BOX, False)], ids=["sheet", "box"])
def test_silhouettes_are_compared_with_differences(triangles: list[str], projective_holds: bool) -> None:
    """`direct_projective` has the silhouette derivatives of a sheet, and `prb_basic` lacks them. At the edges of a
    box, the derivatives of Mitsuba 3.9 are wrong (docs/your_integrator.md).
    """
    corners = [f"v {x} {y} {z}" for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    Path("thing.obj").write_text("\n".join([*corners, *(f"f {each}" for each in triangles)]))
    Path("moving.xml").write_text(MOVING_SCENE)
    Path("moving.yaml").write_text(MOVING)
    Path("mine.py").write_text(MITSUBAS)
    names = [f"mine.py:{each}Integrator" for each in ("DirectProjective", "BasicPRB")]
    words = ["gradcheck", "moving.yaml", "--integrators", ",".join(names), "--allow-code", "--json", "found.jsonl"]
    assert ended(*words, "--seeds", "24", "--spp", "1024") == ExitCode.CHECK_FAILED
    found = [json.loads(line) for line in Path("found.jsonl").read_text().splitlines()]
    holds = {each["integrator"]: each["holds"] for each in found if each.get("parameter") == "thing.translation"}
    assert holds == {names[0]: projective_holds, names[1]: False}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("own_replay.py:Replay", "would run with all your rights; --allow-code permits it"),
        ("missing.py:Replay", "no such file"),
        ("own_replay.py:Other", "has nothing of the name `Other`"),
        ("own_replay.py:NONE", "has a int, not a function, of the name"),
        ("own_replay.py:makes_none", "is not a Mitsuba integrator, but creates a str"),
        ("own_replay.py:Replay(falt=cosine)", "has no option falt"),
        ("own_replay.py:Replay(fault=raises)", "making it raises in line 25 RuntimeError: of all things"),
        ("own_replay.py:Black(what=raises)", "its render raises in line"),
        ("own_replay.py:Black(what=list)", "its render returns list, not mi.TensorXf"),
        ("own_replay.py:Black(what=wide)", "its image is 16x17x3, not 16x16 (height, width) with channels"),
        ("own_replay:Replay", "integrator.type: must be one of reslrb, ptracer"),
        ("own_replay.py", "is not an integrator; write TYPE[:ESTIMATOR][(OPTION=VALUE,...)] or FILE.py:CLASS"),
    ],
)
def test_invalid_integrators_are_one_line(capsys: pytest.CaptureFixture[str], name: str, said: str) -> None:
    allowed = [] if "would run" in said else ["--allow-code"]
    code = ended("gradcheck", "room.yaml", "--integrators", name, *allowed, "--seeds", "3", "--spp", "4")
    error = capsys.readouterr().err
    assert code == ExitCode.USAGE, error
    assert said in error
    assert "Traceback" not in error


@pytest.mark.long
def test_a_nan_image_fails(capsys: pytest.CaptureFixture[str]) -> None:
    code = ended("gradcheck", "room.yaml", "--integrators", "own_replay.py:Replay(primal_fault=nan)", "--allow-code",
                 "--seeds", "3", "--spp", "4", "--set", "integrator.max_depth=2")  # fmt: skip
    said = capsys.readouterr().out
    assert code == ExitCode.CHECK_FAILED
    assert "image: own_replay.py:Replay(primal_fault=nan)" in said


def test_own_integrators_need_permission_and_unchanged_files(capsys: pytest.CaptureFixture[str]) -> None:
    """A run with `integrator.type: custom` needs `--allow-code` to start and to resume. After a change of the
    integrator's file, the run does not resume.
    """
    own = "integrator={type: custom, file: own_replay.py:Replay, max_depth: 3}"
    words = ["optimize", "room.yaml", "--set", own, "--set", "run.name=own", "--set", "run.certainty=false"]
    words += ["--set", "target.render.integrator={type: prb, max_depth: 3}"]
    assert ended(*words) == ExitCode.USAGE
    assert "--allow-code permits it" in capsys.readouterr().err
    assert ended(*words, "--allow-code") == 0
    capsys.readouterr()
    assert ended("optimize", "--resume", "runs/own", "--set", "run.iterations=3") == ExitCode.USAGE
    assert "--allow-code permits it" in capsys.readouterr().err
    assert ended("optimize", "--resume", "runs/own", "--set", "run.iterations=3", "--allow-code") == 0
    assert ended("report", "runs/own") == 0
    with Path("own_replay.py").open("a") as file:
        file.write("\n# changed\n")
    assert ended("optimize", "--resume", "runs/own", "--set", "run.iterations=4", "--allow-code") == ExitCode.USAGE
    assert "own_replay.py has changed since runs/own began" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(("bench", "--values", "3", "--rounds", "2"), marks=pytest.mark.long),
        pytest.param(("convergence", "--rounds", "4", "--set", "run.spp=8"), marks=pytest.mark.long),
    ],
    ids=lambda words: words[0],
)
def test_bench_and_convergence_accept_one(capsys: pytest.CaptureFixture[str], words: tuple[str, ...]) -> None:
    name = "own_replay.py:Replay"
    code = ended(words[0], "room.yaml", "--integrators", name, "--allow-code", *words[1:])
    said = capsys.readouterr().out
    assert code == 0, said
    assert name in said
