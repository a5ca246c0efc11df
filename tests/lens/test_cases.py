"""Results of functions about the sheet for the workshop and the exported solid, as a table of cases (`said.check`)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from golden.cases import Cases, ending

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.lens.solid import Sheet
from reslrb_cli.runs import export, workshop

pytestmark = pytest.mark.usefixtures("combined")
Patch = pytest.MonkeyPatch
case = Cases()
SPOT = np.exp(-((np.indices((16, 16)) - 7.0) ** 2).sum(0) / 9)


def set_up(lamp: dict[str, Any], middle: float = 9, behind: bool = False, **more: Any) -> Any:
    """Return a scene of a face, a screen behind it and a camera before the screen. The screen is not at its middle."""
    move = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}}
    eye = [1, 0.5, 40 if behind else 5]
    screen = move.translate([1, 0.5, 20]).rotate([1, 0, 0], 180).rotate([0, 1, 0], 10).scale(8)
    return mi.load_dict({
        "type": "scene", "lamp": lamp, **more,
        "face": {"type": "rectangle", "to_world": move.scale(2), "bsdf": {"type": "dielectric"}},
        "screen": {"type": "rectangle", "to_world": screen},
        "cover": {"type": "rectangle", "to_world": move.translate([middle, 0.5, 10]).scale([7.5, 9, 1])},
        "camera": {"type": "perspective", "fov": 40, "film": film,
                   "to_world": move.look_at(origin=eye, target=[1, 0.5, 20], up=[0, 1, 0])},
    }, optimize=False)  # fmt: skip


POINT = {"type": "point", "position": [0.5, 0, -6]}
SUN = {"type": "directional", "direction": [0.1, 0, 1]}


@case
def normals_of_the_receiver(patch: Patch) -> Any:
    """The camera sees the screen in the middle of its film, or a cover there, or the screen all over."""
    found = []
    for middle in (9, 1, 90):
        scene = set_up(POINT, middle)
        shapes = {shape.id(): shape for shape in scene.shapes()}
        found.append(workshop._normal(scene, scene.sensors()[0], shapes["screen"]))
    return found


@case
def set_ups_in_scenes(patch: Patch) -> Any:
    target = np.pad(np.ones((3, 4)), ((1, 2), (3, 1)))
    sheet: Any = SimpleNamespace(half=(2.0, 2.0), name="face")
    found = []
    for lamp in (POINT, SUN, {"type": "point", "position": [0.5, 0, 15]}):
        for behind in (False, True):
            for kind in ("lens", "mirror"):
                scene = set_up(lamp, 90, behind)
                plan = Fabrication(kind=kind, thickness=3)
                found.append(workshop.setup_of(scene, scene.sensors()[0], plan, sheet, target))
    return found


class Bench:
    """Stand-in of an `OpticalBench` that notes what is changed. Its image is a spot that the change moves."""

    def __init__(self, **plan: Any) -> None:
        self.plan, self.lamps, self.seen = Fabrication(thickness=3, **plan), ["lamp"], list[Any]()

    def __getattr__(self, name: str) -> Any:
        return lambda *given: self.seen.append([name, *given]) or len(self.seen)

    def solid_parts(self) -> list[str]:
        return ["face", "back"]

    def sun(self, spp: int) -> Any:
        return SPOT + 0.01 * spp

    def image(self, values: Any, spp: int) -> Any:
        return np.roll(SPOT, (values % 3, -values % 2), (0, 1)) + 0.001 * spp

    def spread(self, glass: Any) -> float:
        return 0.25


@case
def measured_tolerances(patch: Patch) -> Any:
    found = []
    for plan in ({}, {"kind": "mirror", "ior": "PMMA"}, {"ior": "PMMA", "sun": 0}):
        bench: Any = Bench(**plan)
        numbers: dict[str, Any] = {"setup": {"receiver_distance": 200.0} if plan else None}
        told: list[str] = []
        pictures = workshop.add_tolerances(numbers, bench, SPOT, SPOT + 0.1, 4, told.append)
        found.append([numbers, sorted(pictures), [float(each.sum()) for each in pictures.values()], told, bench.seen])
    bench = Bench()
    bench.lamps = []
    told = []
    return [*found, [*workshop.tolerances(bench, SPOT, SPOT + 0.1, 4, told.append)], told]


@case
def changed_parts(patch: Patch) -> Any:
    """Parts that are moved, turned and denser, and their values after a rendering."""
    scene = set_up({"type": "point", "position": [0, 0, -30]})
    params = mi.traverse(scene)
    bench = workshop.OpticalBench(scene, params, Fabrication(thickness=3, ior=1.5046), None, 0)  # type: ignore[arg-type]
    changes = {"farther": bench.farther(0.1), "turned": bench.turned(["face", "screen"], (0, 0, 1), 90),
               "denser": bench.denser(0.01), "gone": bench.moved(["gone"], mi.ScalarTransform4f())}  # fmt: skip
    before = {key: np.array(params[key].matrix) for key in ("screen.to_world", "camera.to_world")}
    with bench._changed(changes["farther"]):
        during = {key: np.array(params[key].matrix) for key in before}
    after = [bool((np.array(params[key].matrix) == value).all()) for key, value in before.items()]
    shown = {name: {key: np.array(getattr(value, "matrix", value)) for key, value in each.items()}
             for name, each in changes.items()}  # fmt: skip
    missing = ending(workshop.OpticalBench, scene, SimpleNamespace(properties={}), Fabrication(thickness=3), None, 0)
    return shown, during, after, bench.camera, bench.lamps, missing


@case
def pictures_before_they_were_lifted(patch: Patch) -> Any:
    for name, shape in (("a.exr", (4, 5)), ("b.exr", (4, 4))):
        mi.Bitmap(np.linspace(0, 1, shape[0] * shape[1] * 3, dtype=np.float32).reshape(*shape, 3)).write(name)
    wanted = np.pad(np.ones((2, 3)), 1)
    plans = [Fabrication(thickness=3, picture=each and Path(each).absolute()) for each in (None, "a.exr", "b.exr")]
    return [workshop.original_of(plan, wanted) for plan in plans]


@case
def targets_of_exports(patch: Patch) -> Any:
    mi.Bitmap(np.ones((4, 6, 3), np.float32)).write("a.exr")
    found = []
    for size in ((6, 4), (4, 6), (3, 2)):
        sensor: Any = SimpleNamespace(film=lambda size=size: SimpleNamespace(crop_size=lambda: size))
        for file in (None, Path("a.exr")):
            for needed in (False, True):
                config: Any = SimpleNamespace(target=SimpleNamespace(file=file))
                image = ending(export.read_target, config, sensor, needed)
                found.append(image if image is None or isinstance(image, str) else image.shape)
    return found


@case
def exposures_of_exports(patch: Patch) -> Any:
    one, grey, colour = np.float32(1), np.float32(2.00004), np.float32([1, 2, 3.25])
    rows: list[dict[int, Any]] = [{}, {0: one}, {0: one, 1: one}, {0: grey}, {0: grey, 2: grey}, {0: one, 2: colour}]
    found = []
    for row in rows:
        patch.setattr(export, "exposures", lambda run, row=row: row)
        found.append(export.exposure_line(Path("run")))
    return found


@case
def files_of_solids(patch: Patch) -> Any:
    patch.setattr(
        "reslrb_cli.report.page.workshop.sheet", lambda numbers, pictures, title: f"{title}: {sorted(pictures)}"
    )
    patch.setattr(export, "WRITERS", {".stl": lambda solid: b"stl", ".3mf": lambda solid: b"3mf"})
    patch.setattr(export, "within", lambda sheet, plan: np.ones((2, 3), bool))
    points = np.array([[x, y, 2.0 * x + y] for y in (0, 2) for x in (0, 1, 2)])
    sheet = Sheet("face", points, np.array([[0, 1, 3]]), np.array([0.0, 1, 2]), np.array([0.0, 2]))
    found = []
    for has in (False, True):
        patch.setattr(export, "_writes_3mf", lambda has=has: has)
        numbers: dict[str, Any] = {"faces": {"face": {}}, "x": float("inf")}
        plan = Fabrication(thickness=3, kind="mirror")
        files = export.solid_files(plan, sheet, None, numbers, {"p": SPOT})  # type: ignore[arg-type]
        for name, write in files.items():
            write(Path(name))
        texts = {name: Path(name).read_text() for name in files if not name.startswith("heights")}
        heights = [np.array(mi.Bitmap(f"heights.{kind}")) for kind in ("exr", "png")]
        found.append([numbers, texts, heights])
    patch.setattr(export, "summary", lambda numbers: ["first", "second", "third"])
    told: list[str] = []
    export.tell_solid(Path("a/b.stl"), {}, told.append)
    return found, told


test_cases = pytest.mark.usefixtures("llvm")(case.test())
