"""Scenes and photographs from other sources, through the commands that a user would try on them."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.tiny import done, reslrb, settings
from kit import area, diffuse, scene, sensor, shape

from reslrb_cli.records.manifest import read_manifest

pytestmark = pytest.mark.usefixtures("compared")

# A scene whose objects have no ids, from `inspect` to the report page. The keys are the same everywhere.

#: A corner scene as Mitsuba 0.6 wrote it. Its light comes from a separate file.
CORNER = """<scene version="0.6.0">
<integrator type="bdpt"/>
<sensor type="perspective"><float name="fov" value="50"/><sampler type="halton"/>
<transform name="toWorld"><lookAt origin="0, 1, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
<film type="ldrfilm"><integer name="width" value="10"/><integer name="height" value="10"/></film></sensor>
<include filename="light.xml"/>
<shape type="rectangle"><transform name="toWorld"><scale value="3"/><translate z="-1"/></transform>
<bsdf type="diffuse"><srgb name="reflectance" value="#c08040"/></bsdf></shape>
<shape type="rectangle"><transform name="toWorld"><rotate x="1" angle="-90"/><scale value="3"/><translate y="-1"/>
</transform>
<bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.2, 0.4, 0.6"/></bsdf></bsdf></shape>
</scene>
"""
LIGHT = """<scene version="0.6.0"><shape type="rectangle">
<transform name="toWorld"><rotate x="1" angle="90"/><translate y="3"/></transform>
<emitter type="area"><rgb name="radiance" value="10"/></emitter></shape></scene>
"""
#: Keys of the lamp and of the walls, which a run recovers.
LAMP = "Rectangle_1.emitter.radiance.value"
WALLS = ["Rectangle_3.bsdf.brdf_0.reflectance.value", "Rectangle_2.bsdf.reflectance.value"]


def keys_of_run(folder: Path) -> dict[str, list[str]]:
    """Return the keys in each of a run's records, in their order."""
    with (
        np.load(folder / "checkpoint" / "state.npz") as state,
        np.load(folder / "parameters" / "parameters.npz") as found,
    ):
        checkpoint = [name.removeprefix("parameter/") for name in state if name.startswith("parameter/")]
        arrays = list(found)
    return {
        "parameters.json": list(json.loads((folder / "parameters" / "parameters.json").read_text())),
        "parameters.npz": arrays,
        "checkpoint": checkpoint,
    }


@pytest.mark.usefixtures("llvm")
def test_keys_are_the_same_from_inspect_to_the_page(tmp_path, monkeypatch):
    """Each conversion of the old spelling is a line."""
    for name, text in {"corner": CORNER, "light": LIGHT}.items():
        (tmp_path / f"{name}.xml").write_text(text)
    mi.Bitmap(np.full((10, 10, 3), 0.2, np.float32)).write(str(tmp_path / "corner.exr"))
    monkeypatch.chdir(tmp_path)
    listed = done("inspect", "corner.xml", "--json")
    repairs = [line for line in listed.stderr.splitlines() if not line.startswith("variant ")]
    found = [re.sub(r"^.*/(\w+\.xml):\d+: ", r"\1: ", line) for line in repairs]
    assert sorted(found) == [
        "corner.xml: <lookAt> is an element of Mitsuba 0.6: read as <lookat>",
        "corner.xml: <srgb> is an element of Mitsuba 0.6: read as <rgb>",
        "corner.xml: `toWorld` is a name of Mitsuba 0.6: read as `to_world`",
        "corner.xml: a <spectrum> of three numbers: read as <rgb>",
        "corner.xml: film `ldrfilm` is a plugin of Mitsuba 0.6: read as `hdrfilm`",
        "corner.xml: sampler `halton`: read as `independent`",
        "light.xml: `toWorld` is a name of Mitsuba 0.6: read as `to_world`",
    ]
    entries = json.loads(listed.stdout)["parameters"]
    assert {entry["key"] for entry in entries if entry["obstacle"] is None} >= {LAMP, *WALLS}
    assert not [entry["key"] for entry in entries if entry["key"].startswith("object_")]
    (tmp_path / "corner.yaml").write_text(
        "scene: {file: corner.xml}\ntarget: {render: {spp: 8}}\n"
        f"parameters: [{{key: Rectangle_3.*, initial: 0.5}}, {{key: {WALLS[1]}, initial: 0.5}}]\n"
        "integrator: {type: ptracer, max_depth: 2}\nrun: {iterations: 1, spp: 2}\n"
    )
    for name, sets in (("corner", ()), ("corner-2", settings("target={file: corner.exr}"))):
        done("optimize", "corner.yaml", "--quiet", *sets)
        for record, found in keys_of_run(tmp_path / "runs" / name).items():
            assert found == WALLS, record
        page = (tmp_path / "runs" / name / "report.html").read_text()
        assert "object_" not in page
        assert WALLS[0] in page.replace("<wbr>", "")
    # The true values have the same names
    assert set(read_manifest(tmp_path / "runs/corner")["results"]["parameter_rmse"]) == set(WALLS)
    assert json.loads((tmp_path / "runs/corner/parameters/true/parameters.json").read_text()).keys() == set(WALLS)


@pytest.mark.long
@pytest.mark.usefixtures("llvm")
def test_invisible_texels_are_told_from_settled_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No true value is known. Invisible texels light the lamp's face, and so the visible texels. They have a gradient,
    but their colours remain unknown.
    """
    monkeypatch.chdir(tmp_path)
    tiny.write_experiment(tmp_path)
    scene = tiny.SCENE.replace('name="fov" value="50"', 'name="fov" value="14.25"')  # the middle 2 x 2 of 4 x 4 texels
    (tmp_path / "scene.xml").write_text(scene)
    image = mi.render(mi.load_file("scene.xml"), spp=1024, integrator=mi.load_dict({"type": "path", "max_depth": 3}))
    mi.Bitmap(image).write("photo.exr")
    sets = ("target={file: photo.exr}", "run.iterations=80", "run.spp=2048", "loss.type=relative_l2",
            "optimizer={learning_rate: 0.05, schedule: cosine}")  # fmt: skip
    done = reslrb("optimize", "tiny.yaml", *settings(*sets))
    assert done.exit_code == 0, done.output
    about = read_manifest(Path("runs/tiny"))["results"]["certainty"]["parameters"][tiny.KEY]
    assert about["shares"]["not seen"] == 0.75
    assert about["verdict"] == "settled"
    assert about["shares"]["settled"] > 0.2
    values, true = np.load("runs/tiny/parameters/parameters.npz")[tiny.KEY], np.array(mi.Bitmap("poster.exr"))
    errors = np.sqrt(np.mean(np.square(values - true), axis=2))
    shown = np.zeros((4, 4), dtype=bool)
    shown[1:3, 1:3] = True
    assert errors[shown].max() < 4 * about["spread"][0] < errors[~shown].mean()
    assert "settled (" in done.output
    assert ", 75 % not seen" in done.output
    np.testing.assert_array_equal(np.load(f"runs/tiny/parameters/{tiny.KEY}.mask.npy"), shown)
    page = Path("runs/tiny/report.html").read_text()
    assert "75 % not seen" in page
    assert "<b>reached</b> by light and sensor (white): 25 %" in page
    assert "does not include the noise of the target" in page


# From a user's scene without ids and a photograph to the colours of the scene, by `init`, an edit and `optimize`.

EXPOSURE = 0.8
#: Reflectances in the scene file, and the true ones in the photograph, of two walls and a seat.
GUESS = "0.5, 0.5, 0.5"
TRUE = {
    "Rectangle_4.bsdf.reflectance.value": [0.55, 0.25, 0.15],
    "Rectangle_5.bsdf.reflectance.value": [0.2, 0.35, 0.5],
    "Cube_1.bsdf.reflectance.value": [0.6, 0.3, 0.2],
}
#: Largest error of a colour channel above `BRIGHT`, that limit, and the largest error of the exposure. Errors are
#: shares of the true value.
COLOUR, BRIGHT, FACTOR = 0.1, 0.1, 0.05


def room(left: str, right: str, seat: str, size: int) -> str:
    """Return a room that is open to the camera. A mirror and a lamp are in view, and no element has an id."""
    mirror = '<bsdf type="conductor"><string name="material" value="none"/></bsdf>'
    seat_place = '<scale x="0.4" y="0.2" z="0.25"/><rotate y="1" angle="-15"/><translate x="-0.3" y="-0.8" z="-0.2"/>'
    lamp_place = '<scale value="0.25"/><rotate x="1" angle="70"/><translate y="0.8" z="-0.3"/>'
    return scene(
        '<integrator type="path"/>', sensor(size=size, fov=38, rfilter="gaussian"),
        shape("rectangle", "", diffuse("0.5, 0.45, 0.4"), place='<rotate x="1" angle="-90"/><translate y="-1"/>'),
        shape("rectangle", "", diffuse("0.8, 0.8, 0.8"), place='<rotate x="1" angle="90"/><translate y="1"/>'),
        shape("rectangle", "", diffuse("0.7, 0.7, 0.65"), place='<translate z="-1"/>'),
        shape("rectangle", "", diffuse(left), place='<rotate y="1" angle="90"/><translate x="-1"/>'),
        shape("rectangle", "", diffuse(right), place='<rotate y="1" angle="-90"/><translate x="1"/>'),
        shape("rectangle", "", mirror, place='<scale x="0.35" y="0.3"/><translate x="0.3" y="0.3" z="-0.99"/>'),
        shape("rectangle", "", area("17, 15, 12"), place=lamp_place),
        shape("cube", "", diffuse(seat), place=seat_place),
    )  # fmt: skip


def write_room(folder: Path, size: int, spp: int) -> None:
    """Write `room/scene.xml` with the guesses, and `photo.png`, an 8-bit image of the true room rendered by `path`."""
    (folder / "room").mkdir()
    (folder / "room/scene.xml").write_text(room(GUESS, GUESS, GUESS, 256))
    true = room(*(", ".join(map(str, color)) for color in TRUE.values()), size)
    image = mi.render(mi.load_string(true), integrator=mi.load_dict({"type": "path", "max_depth": -1}), spp=spp)
    tiny.write_photo(folder / "photo.png", EXPOSURE * np.array(image))


def keep(file: Path, keys: list[str]) -> None:
    """Remove all parameters except `keys` from a configuration. The other values are known."""
    lines = file.read_text().splitlines()
    entries = [line for line in lines if re.match(r"  - \{key: ", line)]
    assert all(any(key in line for line in entries) for key in keys), entries
    kept = [line for line in lines if line not in entries or any(key in line for key in keys)]
    file.write_text("\n".join(kept) + "\n")


def misses(run: Path, most: float = COLOUR, colours: Mapping[str, list[float]] = TRUE) -> list[str]:
    """Return the keys whose colours miss the true `colours` by more than `most`, and a wrong exposure. Errors are
    relative to the truth.
    """
    recovered = json.loads((run / "parameters/parameters.json").read_text())
    found = []
    for key, true in colours.items():
        color = np.array(recovered[key]["value"])
        bright = np.array(true) > BRIGHT
        off = color / true - 1
        worst = float(np.max(np.abs(off)[bright]))
        print(f"{key}: {color.round(3)}, off by {', '.join(f'{share:+.1%}' for share in off)}")
        found += [key] if worst > most else []
    exposure = np.array(recovered["exposure"]["value"]).item() if "exposure" in recovered else 1.0
    print(f"exposure {exposure:.4f}")
    return found + (["exposure"] if abs(exposure / EXPOSURE - 1) > FACTOR else [])


def three_commands(*changes: str) -> Path:
    """Run `init`, remove the known parameters, and run `optimize` with `changes` to the generated configuration. Return
    the run's folder.
    """
    done("init", "room/scene.xml", "--target", "photo.png")
    keep(Path("room.yaml"), list(TRUE))
    done("optimize", "room.yaml", *settings(*changes))
    return Path("runs/room")


def check_mask(run: Path, mirror: bool) -> None:
    """Check that the mask leaves out the lamp in view, and the mirror or glass only if `mirror` is true."""
    manifest = read_manifest(run)
    assert manifest is not None
    [view] = manifest["views"]
    assert view["kinds"]["clipped"] > 0.01 * view["pixels"]
    assert (view["kinds"].get("specular", 0) > 0.01 * view["pixels"]) == mirror


@pytest.mark.usefixtures("llvm")
@pytest.mark.long
def test_colours_and_exposure_from_a_photograph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_room(tmp_path, 64, 1024)
    monkeypatch.chdir(tmp_path)
    run = three_commands()
    check_mask(run, mirror=False)  # camera paths find the light of the mirror
    assert misses(run) == []
    manifest = read_manifest(run)
    assert manifest is not None
    verdicts = {key: about["verdict"] for key, about in manifest["results"]["certainty"]["parameters"].items()}
    assert set(verdicts.values()) == {"settled"}, verdicts
    without = settings("target.mask=none", "target.exposure=1", "integrator.estimator=stack")
    shutil.rmtree("runs/room")
    done("optimize", "room.yaml", *without)
    assert {"exposure", *TRUE} & set(misses(run)) > {"exposure"}
