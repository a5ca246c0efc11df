"""A scene that exists as a Mitsuba dictionary or as an `mi.Scene` gives the results of a scene file."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from runs.going_on import work_alone

import reslrb_cli as rl
from reslrb_cli.config.loader import load
from reslrb_cli.scene.images import read_stored
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.xml import dictionary
from reslrb_cli.scene.xml.dictionary import write_dictionary

TEXTURE, BALL = "floor.bsdf.reflectance.data", "ball.bsdf.reflectance.value"


@pytest.fixture
def folder(llvm: str, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    work_alone(monkeypatch)
    return workplace


def bitmap(kind: type = np.float32, width: int = 4) -> mi.Bitmap:
    values = np.random.default_rng(1).uniform(0.1, 0.9, (4, width, 3))
    return mi.Bitmap((255 * values).astype(kind) if kind is np.uint8 else values.astype(kind))


def room(**more: Any) -> dict[str, Any]:
    """Return a dictionary of a textured floor, a red ball and a lamp."""
    move = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 12, "height": 10, "filter": {"type": "gaussian"}}
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.array(bitmap()))}
    return {
        "type": "scene",
        "integrator": {"type": "path"},
        "camera": {"type": "perspective", "fov": 40.5, "film": film,
                   "to_world": move.translate([0, 0, 5]).scale([-1, 1, -1])},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "ball": {"type": "sphere", "radius": 0.3, "center": [0.0, 0, 0.5],
                 "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.2, 0.2]}}},
        "lamp": {"type": "point", "position": [1, 1, 3.0], "intensity": 3.0},
    } | more  # fmt: skip


def experiment(**run: Any) -> dict[str, Any]:
    return {
        "target": {"render": {"spp": 16}},
        "parameters": [
            {"key": TEXTURE, "initial": 0.5, "bounds": (0, 1)},
            {"key": BALL, "initial": 0.4, "bounds": (0, 1)},
        ],
        "integrator": {"type": "reslrb", "max_depth": 3, "estimator": "stack"},
        "run": {"iterations": 3, "spp": 4, "measuring": 0, "certainty": False, **run},
    }


def losses(run: rl.Run) -> list[float]:
    return [record.loss for record in run]


# --- the written file -------------------------------------------------------------------------------------------------


def test_a_dictionary_is_written_with_its_ids_and_values(folder: Path) -> None:
    bitmap(np.uint8).write("wood.png")
    turn = mi.ScalarTransform4f().translate([1, 2, 3]) @ mi.ScalarTransform4f().rotate([0, 1, 0], 33)
    wood = {"type": "bitmap", "filename": "wood.png", "to_uv": mi.ScalarTransform3f().scale([2, 3])}
    shown = room(
        grey={"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.3}},
        box={"type": "cube", "to_world": turn, "own": {"type": "ref", "id": "grey"}},
        plate={"type": "disk", "id": "other", "flip_normals": True, "two": {"type": "twosided", "id": "both",
               "inner": {"type": "roughplastic", "alpha": np.float32(0.123), "diffuse_reflectance": wood}}},
        bytes={"type": "sphere", "center": np.array([1.0, 2, 3]), "bsdf": {"type": "diffuse", "reflectance": {
               "type": "bitmap", "bitmap": bitmap(np.uint8)}}},
        sky={"type": "envmap", "bitmap": bitmap(width=8)},
        glow={"type": "rectangle", "e": {"type": "area", "radiance": {
              "type": "spectrum", "value": [(400, 0.1), (700, 0.9)]}}},
    )  # fmt: skip
    ours = mi.traverse(load_scene(write_dictionary(shown, "<dict>", folder)))
    its = mi.traverse(mi.load_dict(shown, optimize=False))
    assert set(ours.properties) == set(its.properties)
    for key in ours.properties:
        one, other = (np.array(getattr(each, "matrix", each)) if "Transform" in type(each).__name__ else np.array(each)
                      for each in (ours[key], its[key]))  # fmt: skip
        if key == "bytes.bsdf.reflectance.data":  # Mitsuba stores bytes, and decodes them at each lookup
            assert other.dtype == np.uint8
            other = np.array(bitmap(np.uint8).convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False))
        np.testing.assert_array_equal(one, other, key)


def test_equal_dictionaries_share_a_file(folder: Path) -> None:
    first, second = (rl.load({"scene": room(), **experiment()}).scene.file for _ in range(2))
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(1 - np.array(bitmap()))}
    third = rl.load(experiment(), scene=room(floor={"type": "rectangle", "bsdf": {
        "type": "diffuse", "reflectance": texture}})).scene.file  # fmt: skip
    assert first == second
    assert first.parent.parent == third.parent.parent == folder / "cache" / "scenes"
    assert first.read_text() == third.read_text()  # only the pixels differ
    assert first != third


def test_dictionaries_with_equal_bytes_in_other_shapes_are_apart(folder: Path) -> None:
    """Each shape of the same 192 numbers is a scene of its own, and is read back as it was given."""
    values = np.linspace(0, 1, 192, dtype=np.float32)
    shapes = [(h, 192 // h // c, c) for c in (1, 3) for h in range(1, 65) if 192 % (h * c) == 0]
    files = {}
    for shape in shapes:
        paint = {"type": "diffuse", "reflectance": {"type": "bitmap", "raw": True, "data": mi.TensorXf(values, shape)}}
        files[shape] = write_dictionary(room(floor={"type": "rectangle", "bsdf": paint}), "<dict>", folder)
    assert len({*files.values()}) == len(shapes) > 10
    for shape, file in files.items():
        [image] = file.parent.glob("*.exr")
        assert read_stored(image).pixels.shape == shape


def test_a_dictionary_that_is_nested_too_deeply_is_one_line(folder: Path) -> None:
    bsdf: dict[str, Any] = {"type": "diffuse"}
    for _ in range(2000):
        bsdf = {"type": "twosided", "inside": bsdf}
    with pytest.raises(rl.ConfigError, match=r"^<dict>: scene: is nested too deeply$"):
        write_dictionary(room(floor={"type": "rectangle", "bsdf": bsdf}), "<dict>", folder)


def test_writing_a_scene_removes_old_ones(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def written(radius: float) -> Path:
        return write_dictionary(room(ball={"type": "sphere", "radius": radius}), "<dict>", folder).parent

    def age(place: Path, days: float) -> None:
        os.utime(place, (time.time() - 86400 * days,) * 2)

    old, used, young = written(1), written(2), written(3)
    stale = old.with_name(".reslrb-0123")  # of a process that was killed
    stale.mkdir()
    for place, days in ((old, 91), (used, 91), (young, 89), (stale, 91)):
        age(place, days)
    assert written(2) == used  # now needed again
    assert old.is_dir()  # nothing was written
    written(4)
    assert [each.is_dir() for each in (old, used, young, stale)] == [False, True, True, False]
    size = sum(each.stat().st_size for each in used.iterdir())
    monkeypatch.setattr(dictionary, "KEPT_BYTES", int(2.5 * size))
    age(used, 3)
    age(young, 2)
    new = [written(4), written(5)]  # the oldest of three goes
    assert [each.is_dir() for each in (used, young, *new)] == [False, True, True, True]
    monkeypatch.setattr(dictionary, "KEPT_BYTES", 0)
    written(5.5)  # those of today stay
    assert [each.is_dir() for each in (young, *new)] == [False, True, True]
    monkeypatch.setattr(shutil, "rmtree", lambda path, ignore_errors: None)  # a folder of another user
    assert (written(6) / "scene.xml").is_file()


# --- equal results ----------------------------------------------------------------------------------------------------


def test_a_file_a_dictionary_and_a_scene_give_equal_results(folder: Path) -> None:
    file = write_dictionary(room(), "<dict>", folder)
    shutil.copytree(file.parent, "written")
    file = Path("written") / file.name
    runs = [rl.optimize({**experiment(), "scene": each}) for each in ({"file": file}, room())]
    scene = rl.load_scene(room())
    runs.append(rl.optimize(experiment(), scene=scene))
    expected, *others = (losses(run) for run in runs)
    assert others == [expected, expected]
    # Mitsuba keeps other values as literals, so other kernels round differently.
    its = losses(rl.optimize(experiment(), scene=mi.load_dict(room(), optimize=False)))
    np.testing.assert_allclose(its, expected, rtol=1e-4)
    for key, values in runs[0].parameters.items():
        np.testing.assert_array_equal(runs[1].parameters[key], values)
        np.testing.assert_array_equal(runs[2].parameters[key], values)
        np.testing.assert_array_equal(runs[2].truth[key], runs[0].truth[key])
    # The caller's scene has the recovered values.
    params = mi.traverse(scene)
    np.testing.assert_array_equal(np.array(params[TEXTURE]), runs[0].parameters[TEXTURE])
    assert not dr.grad_enabled(params[TEXTURE])


def test_moving_parameters_of_a_scene_in_memory(folder: Path) -> None:
    """The check of the missing share moves the object before the run, and so does the rendering of the target."""
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0.4, 0.3, 0.3]).scale(0.2)}
    moving = experiment(iterations=8, measuring=1.0, spp=16) | {"parameters": [BOX | MOVED]}
    runs = [rl.optimize(moving, scene=each) for each in (room(box=box), rl.load_scene(room(box=box)))]
    expected, found = (losses(run) for run in runs)
    assert found == expected
    np.testing.assert_array_equal(runs[1].parameters["box.translation"], runs[0].parameters["box.translation"])
    np.testing.assert_array_equal(runs[1].truth["box.translation"], np.zeros(3))


def test_single_calls_leave_the_scene_as_it_was(folder: Path) -> None:
    scene = rl.load_scene(room())
    before = {key: np.array(mi.traverse(scene)[key]) for key in (TEXTURE, BALL, "camera.film.size")}
    by_scene, by_file = rl.load(experiment(), scene=scene), rl.load({**experiment(), "scene": room()})
    for initial in (True, False):
        np.testing.assert_array_equal(rl.render(by_scene, initial=initial)[0], rl.render(by_file, initial=initial)[0])
    (loss, gradient), (expected, its) = (rl.gradient(each, spp=8, seed=3) for each in (by_scene, by_file))
    assert loss == expected
    for key in its:
        np.testing.assert_array_equal(gradient[key], its[key])
    assert len(rl.gradcheck(by_scene, "reslrb:stack", seeds=3, spp=2)) > 3
    for key, value in before.items():
        np.testing.assert_array_equal(np.array(mi.traverse(scene)[key]), value)
        assert not dr.grad_enabled(mi.traverse(scene)[key])


def test_a_scene_in_memory_writes_a_folder_and_continues(folder: Path) -> None:
    expected = losses(rl.optimize({**experiment(), "scene": room()}))
    run = rl.optimize(experiment(), folder="runs/a", scene=rl.load_scene(room()))
    found = []
    for record in run:
        found.append(record.loss)
        if record.iteration == 1:
            break
    found += losses(run)
    assert found == expected
    assert run.status == "finished"


def test_runs_of_a_dictionary_are_resumed_and_exported(folder: Path) -> None:
    run = rl.optimize(experiment(), folder="runs/a", scene=room())
    list(run)
    assert len(losses(rl.optimize(resume="runs/a", overrides={"run.iterations": 5}))) == 2
    made = mi.traverse(mi.load_file(str(rl.export("runs/a", "made"))))
    assert {TEXTURE, BALL} <= set(made.properties)
    assert load("runs/a/config.yaml").scene.file.is_file()


def test_a_scene_completes_or_replaces_that_of_a_file(folder: Path) -> None:
    Path("room.yaml").write_text("parameters: [{key: ball.bsdf.reflectance.value}]\ntarget: {render: {spp: 4}}\n")
    expected = rl.render({"scene": room(), **experiment(), "parameters": [{"key": BALL}]}, spp=4)[0].shape
    for scene in (room(), loaded()):
        config = rl.load("room.yaml", scene=scene)
        assert rl.render(config, spp=4)[0].shape == expected
        assert rl.render(rl.load(config, {"run.spp": 8}), spp=4)[0].shape == expected
        assert rl.load(rl.load("room.yaml", scene=loaded()), scene=scene).scene.file == config.scene.file
    assert rl.render(rl.load("room.yaml", {"scene.size": [6, 5]}, scene=room()), spp=4)[0].shape == (5, 6, 3)
    with pytest.raises(rl.ConfigError, match=r"room\.yaml: scene: missing"):
        rl.load("room.yaml")


def test_load_scene_takes_a_dictionary(folder: Path) -> None:
    assert {TEXTURE, BALL} <= set(mi.traverse(rl.load_scene(room())).properties)


# --- errors -----------------------------------------------------------------------------------------------------------

MOVED = {"initial": {"translation": [0.1, 0, 0]}}
BOX = {"motion": {"of": "box", "free": ["translation"]}}
FAULTS: list[tuple[Callable[[], Any], str]] = [
    (lambda: rl.load({**experiment(), "scene": {"type": "sphere"}}), '<dict>: scene: has type `sphere`; it must be "s'),
    (lambda: rl.load(experiment(), scene=room(a={"type": "diffuze"})), "scene: scene.a: there is no plugin `diffuze` "
     "in Mitsuba 3; did you mean `diffuse`?"),
    (lambda: rl.load(experiment(), scene=room(a={"b": 1})), "scene: scene.a: has no `type`"),
    (lambda: rl.load(experiment() | {"scene": {"a": {"type": "sphere"}}}), "<dict>: scene: has no `type`; each object"),
    (lambda: rl.load(experiment(), scene=room(a=None)), "scene: scene.a: is None; leave it out"),
    (lambda: rl.load(experiment(), scene=room(a=mi.load_dict({"type": "sphere"}))), "scene: scene.a: is an object of "
     "Mitsuba (Shape); give its dictionary, or load the scene with `mi.load_dict(..., optimize=False)`"),
    (lambda: rl.load(experiment(), scene=room(a={"type": "ply", "filename": "no.ply"})), "scene: scene.a.filename: "
     "`no.ply`: no such file; searched in "),
    (lambda: rl.load(experiment(), scene=room(a={"type": "sphere", "to_world": np.eye(4)})), "scene: scene.a.to_world: "
     "is array("),
    (lambda: rl.load(experiment(), scene=room(a={"type": "sphere", "center": [1, [2, 3]]})), "scene: scene.a.center: "
     "is [1, [2, 3]], which a scene file cannot express"),
    (lambda: rl.load(experiment(), scene=paint({"type": "rgb", "colour": 1})), "scene: scene.a.reflectance.colour: rgb "
     "has only `value` or `filename`"),
    (lambda: rl.load(experiment(), scene=paint({"type": "rgb", "value": [1, 2]})), "scene: scene.a.reflectance.value: "
     "is [1, 2]; rgb needs one number or three"),
    (lambda: rl.load(experiment(), scene=paint({"type": "bitmap", "raw": True, "data": np.zeros(3)})), "scene: scene.a."
     "reflectance.data: has shape (3,); it must be (height, width, channels)"),
    (lambda: rl.load(experiment(), scene=room(a=room())), "scene: scene.a: is a scene within a scene"),
    (lambda: rl.load(experiment(), scene=3), "scene: must be a Mitsuba dictionary or an mi.Scene, not 3"),
    (lambda: rl.load(experiment(), {"scene.file": "x.xml"}, scene=room()), "overrides: scene.file: is given besides"),
    (lambda: rl.render({**experiment(), "scene": dark()}), "scene.xml: the scene has no emitters"),
    (lambda: rl.load(experiment(), scene=mi.load_dict(dark())), "scene: the scene has no emitters"),
    (lambda: rl.render(rl.load(experiment(), {"scene.size": [8, 8]}, scene=loaded())), "scene.size: cannot change an "
     "mi.Scene; give the scene as a file or as a Mitsuba dictionary"),
    (lambda: rl.convergence(rl.load(experiment(), scene=loaded())), "scene: is an mi.Scene, which the processes"),
    (lambda: rl.optimize(resume="x", scene=loaded()), "scene: cannot be given with resume"),
    (lambda: rl.optimize(experiment(), scene=loaded(twin={"type": "sphere", "bsdf": room()["ball"]["bsdf"]},
                                                    optimize=True)),
     "scene: has one material for ball, twin; Mitsuba merges shapes and materials as it loads a scene, unless"),
    (lambda: rl.optimize({**experiment(), "parameters": [BOX]}, scene=loaded(
        paint={"type": "diffuse"}, optimize=True,
        **{name: {"type": "cube", "own": {"type": "ref", "id": "paint"}} for name in ("box", "other")})),
     "scene: has no `box`, but shapes without ids; Mitsuba merges shapes"),
    (lambda: rl.optimize(experiment(), scene=loaded(floor={"type": "rectangle", "bsdf": {"type": "diffuse",
        "reflectance": {"type": "bitmap", "bitmap": bitmap(np.uint8)}}})), "is stored with 8 bits per channel"),
]  # fmt: skip


def paint(reflectance: dict[str, Any]) -> dict[str, Any]:
    return room(a={"type": "diffuse", "reflectance": reflectance})


def dark() -> dict[str, Any]:
    return {name: item for name, item in room().items() if name != "lamp"}


def loaded(optimize: bool = False, **more: Any) -> mi.Scene:
    return mi.load_dict(room(**more), optimize=optimize)


@pytest.mark.parametrize(("call", "message"), FAULTS, ids=[message[:40] for _, message in FAULTS])
def test_what_cannot_be_used_is_refused_in_one_line(folder: Path, call: Callable[[], Any], message: str) -> None:
    with pytest.raises(rl.ConfigError) as caught:
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_cache_that_cannot_be_written_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("taken").write_text("")
    monkeypatch.setenv("RESLRB_CACHE", str(folder / "taken"))
    with pytest.raises(rl.ReslrbError, match=r"taken/scenes/.*: cannot write the scene: .*; set RESLRB_CACHE"):
        rl.load(experiment(), scene=room())


def test_folders_of_a_scene_in_memory_are_refused_later(folder: Path) -> None:
    list(rl.optimize(experiment(), folder="runs/a", scene=loaded()))
    for call in (
        lambda: rl.optimize(resume="runs/a", overrides={"run.iterations": 5}),
        lambda: rl.export("runs/a", "made"),
        lambda: rl.render("runs/a"),
    ):
        with pytest.raises(rl.ConfigError, match=r"scene\.file: was an mi\.Scene in the memory of another process; "):
            call()


def test_two_runs_of_one_scene_do_not_mix(folder: Path) -> None:
    scene = loaded()
    first, second = (rl.optimize(experiment(), scene=scene) for _ in range(2))
    with pytest.raises(rl.ConfigError, match="used by another run or call since; load it once for each run"):
        list(first)
    assert len(losses(second)) == 3
