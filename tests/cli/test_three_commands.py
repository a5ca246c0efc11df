"""From somebody's scene, which has no ids, and a photograph to its colours: `init`, an edit, `optimize`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli.calling import done, settings

from reslrb_cli.records.manifest import read_manifest

pytestmark = pytest.mark.usefixtures("llvm")
EXPOSURE = 0.8
#: What the scene file says of these, and what the photograph shows: two walls, and something to sit on.
GUESS = "0.5, 0.5, 0.5"
TRUE = {
    "Rectangle_4.bsdf.reflectance.value": [0.55, 0.25, 0.15],
    "Rectangle_5.bsdf.reflectance.value": [0.2, 0.35, 0.5],
    "Cube_1.bsdf.reflectance.value": [0.6, 0.3, 0.2],
}
#: How wrong a channel may be that is above `BRIGHT`, and the exposure, as a share of the truth.
COLOUR, BRIGHT, FACTOR = 0.1, 0.1, 0.05
#: The same of colours after few iterations; the guesses are up to 230 % off.
SHORT_COLOUR = 0.15
LEFT, RIGHT, SEAT = TRUE.values()


def paint(color: list[float] | str) -> str:
    value = color if isinstance(color, str) else ", ".join(map(str, color))
    return f'<bsdf type="diffuse"><rgb name="reflectance" value="{value}"/></bsdf>'


def wall(place: str, bsdf: str) -> str:
    return f'<shape type="rectangle"><transform name="to_world">{place}</transform>{bsdf}</shape>'


def room(left: list[float] | str, right: list[float] | str, seat: list[float] | str) -> str:
    """A room that is open to the camera, with a mirror and a lamp in view, and no id anywhere."""
    shapes = [
        wall('<rotate x="1" angle="-90"/><translate y="-1"/>', paint("0.5, 0.45, 0.4")),
        wall('<rotate x="1" angle="90"/><translate y="1"/>', paint("0.8, 0.8, 0.8")),
        wall('<translate z="-1"/>', paint("0.7, 0.7, 0.65")),
        wall('<rotate y="1" angle="90"/><translate x="-1"/>', paint(left)),
        wall('<rotate y="1" angle="-90"/><translate x="1"/>', paint(right)),
        wall(
            '<scale x="0.35" y="0.3"/><translate x="0.3" y="0.3" z="-0.99"/>',
            '<bsdf type="conductor"><string name="material" value="none"/></bsdf>',
        ),
        wall(
            '<scale value="0.25"/><rotate x="1" angle="70"/><translate y="0.8" z="-0.3"/>',
            '<emitter type="area"><rgb name="radiance" value="17, 15, 12"/></emitter>',
        ),
        f"""<shape type="cube"><transform name="to_world"><scale x="0.4" y="0.2" z="0.25"/><rotate y="1" angle="-15"/>
            <translate x="-0.3" y="-0.8" z="-0.2"/></transform>{paint(seat)}</shape>""",
    ]
    return "\n".join(
        [
            '<scene version="3.0.0"><integrator type="path"/>',
            '<sensor type="perspective"><float name="fov" value="38"/>',
            '<transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>',
            '<film type="hdrfilm"><integer name="width" value="256"/><integer name="height" value="256"/></film>',
            "</sensor>",
            *shapes,
            "</scene>",
        ]
    )


def write_room(folder: Path, size: int, spp: int) -> None:
    """`room/scene.xml` with the guesses, and `photo.png`, 8 bits of the true room, by a camera's light."""
    (folder / "room").mkdir()
    (folder / "room/scene.xml").write_text(room(GUESS, GUESS, GUESS))
    true = room(LEFT, RIGHT, SEAT).replace('value="256"', f'value="{size}"')
    image = mi.render(mi.load_string(true), integrator=mi.load_dict({"type": "path", "max_depth": -1}), spp=spp)
    bitmap = mi.Bitmap(EXPOSURE * np.array(image)[:, :, :3])
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(folder / "photo.png"))


def keep(file: Path, keys: list[str]) -> None:
    """Take out of a configuration's parameters all but `keys`: the others are known."""
    lines = file.read_text().splitlines()
    entries = [line for line in lines if re.match(r"  - \{key: ", line)]
    assert all(any(key in line for line in entries) for key in keys), entries
    kept = [line for line in lines if line not in entries or any(key in line for key in keys)]
    file.write_text("\n".join(kept) + "\n")


def misses(run: Path, most: float = COLOUR, colours: Mapping[str, list[float]] = TRUE) -> list[str]:
    """What a run missed: true `colours` by more than `most`, and the exposure, relative to the truth."""
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
    """The run: `init`, an edit that leaves what is unknown, and `optimize` with what `init` wrote but for `changes`."""
    done("init", "room/scene.xml", "--target", "photo.png")
    keep(Path("room.yaml"), list(TRUE))
    done("optimize", "room.yaml", *settings(*changes))
    return Path("runs/room")


def check_mask(run: Path) -> None:
    """Lamp and mirror are in view, and left out of the loss."""
    manifest = read_manifest(run)
    assert manifest is not None
    [view] = manifest["views"]
    assert view["kinds"]["clipped"] > 0.01 * view["pixels"]
    assert view["kinds"]["specular"] > 0.01 * view["pixels"]


@pytest.mark.long
def test_colours_and_exposure_from_a_photograph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_room(tmp_path, 64, 1024)
    monkeypatch.chdir(tmp_path)
    run = three_commands()
    check_mask(run)
    assert misses(run) == []
    manifest = read_manifest(run)
    assert manifest is not None
    verdicts = {key: about["verdict"] for key, about in manifest["results"]["certainty"]["parameters"].items()}
    assert set(verdicts.values()) == {"settled"}, verdicts
    without = settings("target.mask=none", "target.exposure=1", "integrator.estimator=stack")
    done("optimize", "room.yaml", "--force", *without)
    assert {"exposure", *TRUE} & set(misses(run)) > {"exposure"}


def test_the_same_in_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of fewer pixels and fewer, larger iterations."""
    write_room(tmp_path, 20, 1024)
    monkeypatch.chdir(tmp_path)
    few = ("run.iterations=60", "run.spp=64", "run.final_spp=8", "run.certainty=false", "integrator.estimator=stack")
    run = three_commands(*few)
    check_mask(run)
    assert misses(run, SHORT_COLOUR) == []
