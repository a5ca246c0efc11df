"""Selection of parameters: their initial values, and refusals located in the configuration."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.config.parameters import ImageFile, ParameterSpec, RunValue
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene import parameters, upsampling, values
from reslrb_cli.scene.catalog import list_parameters
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.parameters import select_parameters

TEXTURE = "floor.reflectance.data"
LAMP = "lamp.intensity.value"


def select(scene, *specs: dict):
    return select_parameters(scene, [ParameterSpec(**spec) for spec in specs], "c.yaml")


def write(path, array):
    mi.Bitmap(np.ascontiguousarray(array)).write(str(path))
    return ImageFile(file=path)


def envmap(height=4, width=8):
    pixels = np.arange(height * width * 3, dtype=np.float32).reshape(height, width, 3)
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels)}


def test_scene_value_is_kept(make_scene):
    selection = select(make_scene(), {"key": TEXTURE, "bounds": [0.1, 0.9]})
    assert selection.keys == [TEXTURE]
    assert selection.specs[TEXTURE].bounds == (0.1, 0.9)
    assert selection.array(TEXTURE)[0, 0, 0] == pytest.approx(0.1)


def test_numbers_and_colours(make_scene):
    selection = select(make_scene(), {"key": TEXTURE, "initial": [0.1, 0.2, 0.3]}, {"key": LAMP, "initial": 2.0})
    assert selection.array(TEXTURE).shape == (4, 6, 3)
    assert np.allclose(selection.array(TEXTURE), [0.1, 0.2, 0.3])
    assert np.allclose(selection.array(LAMP), 2)
    assert np.allclose(select(make_scene(), {"key": LAMP, "initial": [3, 2, 1]}).array(LAMP), [3, 2, 1])


def test_values_reach_the_scene(make_scene):
    dark, bright = make_scene(), make_scene()
    select(dark, {"key": TEXTURE, "initial": 0.0})
    select(bright, {"key": TEXTURE, "initial": 0.8})
    assert np.max(mi.render(dark, spp=1, integrator=mi.load_dict({"type": "direct"}))) == 0
    assert np.max(mi.render(bright, spp=1, integrator=mi.load_dict({"type": "direct"}))) > 0


def test_resolution_resamples(make_scene):
    ramp = np.tile(np.linspace(0, 1, 6, dtype=np.float32)[None, :, None], (4, 1, 3))
    scene = make_scene()
    params = mi.traverse(scene)
    params[TEXTURE] = mi.TensorXf(ramp)
    params.update()
    finer = select(scene, {"key": TEXTURE, "resolution": [12, 8]}).array(TEXTURE)
    assert finer.shape == (8, 12, 3)
    assert np.all(np.diff(finer[0, :, 0]) >= 0)
    assert select(make_scene(), {"key": TEXTURE, "resolution": [4, 6]}).array(TEXTURE).shape == (6, 4, 3)
    assert finer.mean() == pytest.approx(0.5, abs=1e-3)


def test_file_fills_a_texture(make_scene, tmp_path):
    values = np.linspace(0, 1, 4 * 6 * 3, dtype=np.float32).reshape(4, 6, 3)
    selection = select(make_scene(), {"key": TEXTURE, "initial": write(tmp_path / "t.exr", values)})
    assert np.array_equal(selection.array(TEXTURE), values)


@pytest.mark.parametrize(("color_space", "expected"), [("auto", 0.2140), ("linear", 127 / 255)])
def test_a_file_of_8_bits_is_decoded_as_its_color_space_says(make_scene, tmp_path, color_space, expected):
    """Files of roughness and other data that are no colours hold linear values."""
    file = write(tmp_path / "t.png", np.full((4, 6, 3), 127, np.uint8)).model_copy(update={"color_space": color_space})
    assert np.allclose(select(make_scene(), {"key": TEXTURE, "initial": file}).array(TEXTURE), expected, atol=2e-3)


@pytest.mark.parametrize("raw", [True, False])
@pytest.mark.parametrize("color_space", ["auto", "srgb", "linear"])
def test_a_file_for_a_raw_texture_is_linear_unless_it_says_otherwise(raw, color_space, llvm, tmp_path):
    """The scene reads the same file with the same values."""
    file = write(tmp_path / "t.png", np.full((4, 6, 1), 128, np.uint8)).model_copy(update={"color_space": color_space})
    roughness = f"""<texture type="bitmap" name="alpha"><string name="filename" value="t.png"/>
        <boolean name="raw" value="{str(raw).lower()}"/><string name="format" value="variant"/></texture>"""
    (
        tmp_path / "scene.xml"
    ).write_text(f"""<scene version="3.0.0"><emitter type="constant"/><sensor type="perspective"/>
        <shape type="sphere" id="ball"><bsdf type="roughconductor">{roughness}</bsdf></shape></scene>""")
    scene, key = load_scene(tmp_path / "scene.xml"), "ball.bsdf.alpha.data"
    expected = {"auto": np.array(mi.traverse(scene)[key])[0, 0, 0], "srgb": 0.2158605, "linear": 128 / 255}[color_space]
    assert np.allclose(select(scene, {"key": key, "initial": file}).array(key), expected, atol=1e-5)


def test_globs_match_recoverable_parameters(make_scene):
    selection = select(make_scene(), {"key": "floor.*"})  # excludes `to_uv`
    assert selection.keys == [TEXTURE]


def test_environment_map_has_no_halo(make_scene):
    scene = make_scene(sky=envmap())
    selection = select(scene, {"key": "sky.data"})
    assert selection.params["sky.data"].shape == (4, 10, 3)
    assert selection.array("sky.data").shape == (4, 8, 3)
    finer = select(scene, {"key": "sky.data", "resolution": [16, 8]})
    tensor = np.array(finer.params["sky.data"])
    assert tensor.shape == (8, 18, 3)
    assert np.array_equal(tensor[:, 0], tensor[:, -2])
    assert np.array_equal(tensor[:, -1], tensor[:, 1])


def test_the_smallest_textures_have_two_texels_on_each_side(make_scene):
    """Those of an environment map have three rows."""
    for key, least in ((TEXTURE, [2, 2]), ("sky.data", [2, 3])):
        for resolution in (least, [least[0] - 1, least[1]], [least[0], least[1] - 1]):
            spec = {"key": key, "resolution": resolution}
            if resolution == least:
                assert select(make_scene(sky=envmap()), spec).array(key).shape[:2] == tuple(least[::-1])
            else:
                with pytest.raises(ConfigError, match=re.escape(f"must be at least {least}")):
                    select(make_scene(sky=envmap()), spec)


def test_mesh_attributes(make_scene):
    mesh = mi.load_dict({"type": "cube", "bsdf": {"type": "diffuse"}})
    mesh.add_attribute("vertex_color", 3, np.zeros(3 * mesh.vertex_count(), np.float32))
    scene = make_scene(box=mesh)
    key = next(info.key for info in list_parameters(mi.traverse(scene)) if info.kind == "attribute")
    selection = select(scene, {"key": key, "initial": [1, 2, 3]})
    assert np.array_equal(selection.array(key)[:6], [1, 2, 3, 1, 2, 3])


def test_bounds_hold_for_the_nearest_float(make_scene):
    select(make_scene(), {"key": TEXTURE, "initial": 0.1, "bounds": [0, 0.1]})


@pytest.mark.parametrize(
    ("specs", "where", "what"),
    [
        ([{"key": "flor.reflectance.data"}], "key", f"matches no parameter of the scene; did you mean `{TEXTURE}`"),
        (
            [{"key": "lamp.sampling"}],
            "key",
            "did you mean `lamp.position`?",
        ),  # `lamp.sampling_weight` cannot be recovered
        ([{"key": "zzz*"}], "key", "matches no parameter"),
        ([{"key": "plane.to_world"}], "key", "is recovered as a motion"),
        ([{"key": "camera.x_fov"}], "key", "belongs to the sensor"),
        ([{"key": "camera.film.size"}], "key", "belongs to the film"),
        ([{"key": "lamp.sampling_weight"}], "key", "is not differentiable"),
        ([{"key": "floor.reflectance.to_uv"}], "key", "is not differentiable"),
        ([{"key": "plane.*"}], "key", "matches nothing that can be recovered"),
        ([{"key": "allow_thread_reordering"}], "key", "not a property of a material or a light"),
        ([{"key": TEXTURE, "initial": [0.1, 0.2]}], "initial", "has 2 numbers"),
        ([{"key": LAMP, "initial": [1.0]}], "initial", "takes 3 numbers"),
        ([{"key": LAMP, "resolution": [4, 4]}], "resolution", "is not a texture"),
        ([{"key": TEXTURE, "resolution": [1, 4]}], "resolution", "at least [2, 2]"),
        (
            [{"key": TEXTURE, "bounds": [0.5, 1]}],
            "bounds",
            "exclude the initial value of `floor.reflectance.data`, 0.1",
        ),
        ([{"key": LAMP, "bounds": [0, 2.5]}], "bounds", "lamp.intensity.value`, 3 at entry 2"),
        (
            [{"key": LAMP, "initial": [1, 0, 1], "transform": "log"}],
            "initial",
            "0 at entry 1; transform: log yields only pos",
        ),
        ([{"key": LAMP, "initial": -2.0, "transform": "log"}], "initial", "starts at -2 at entry 0"),
        (
            [{"key": LAMP, "bounds": [0, 3], "transform": "sigmoid"}],
            "initial",
            "starts at 3 at entry 2; transform: sigmoid yields only values between its bounds, 0 and 3",
        ),
        ([{"key": LAMP, "initial": ImageFile(file="/none.exr")}], "initial", "is not a texture; give a number"),
        ([{"key": TEXTURE, "initial": ImageFile(file="/none.exr")}], "initial.file", "/none.exr: no such file"),
    ],
)
def test_refused(make_scene, specs, where, what):
    with pytest.raises(ConfigError) as error:
        select(make_scene(), *specs)
    assert error.value.key == f"parameters[0].{where}"
    assert what in str(error.value)


def test_overlapping_specs(make_scene):
    with pytest.raises(ConfigError) as error:
        select(make_scene(), {"key": "floor.*"}, {"key": TEXTURE})
    assert str(error.value) == f"c.yaml: parameters[1].key: `{TEXTURE}` is already matched by parameters[0]"


@pytest.mark.parametrize(
    ("array", "what"),
    [
        (np.full((3, 3, 3), 0.5, np.float32), "is 3x3, the texture 6x4; give `resolution"),
        (np.full((4, 6, 3), np.nan, np.float32), "pixel (0, 0), channel R, is nan"),
        (np.full((4, 6, 3), -1.0, np.float32), "is -1: negative"),
        (np.full((4, 6, 5), 0.5, np.float32), "has the channels ch0, ch1, "),
    ],
)
def test_refused_files(make_scene, tmp_path, array, what):
    with pytest.raises(ConfigError) as error:
        select(make_scene(), {"key": TEXTURE, "initial": write(tmp_path / "t.exr", array)})
    assert error.value.key == "parameters[0].initial.file"
    assert what in str(error.value)


def test_colour_for_a_grey_texture(make_scene, tmp_path):
    grey = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((4, 6, 1), 0.5, np.float32))}
    scene = make_scene(floor={"type": "diffuse", "reflectance": grey})
    colour = np.tile(np.float32([0.1, 0.2, 0.3]), (4, 6, 1))
    with pytest.raises(ConfigError, match="is coloured, but"):
        select(scene, {"key": TEXTURE, "initial": write(tmp_path / "t.exr", colour)})
    flat = np.full((4, 6, 3), 0.25, np.float32)
    assert select(scene, {"key": TEXTURE, "initial": write(tmp_path / "t.exr", flat)}).array(TEXTURE).max() == 0.25


def test_nan_in_the_scene_itself(make_scene):
    values = np.full((4, 6, 3), 0.5, np.float32)
    values[2, 1, 0] = np.nan
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(values)}
    scene = make_scene(floor={"type": "diffuse", "reflectance": texture})
    with pytest.raises(ConfigError, match=r"has nan at texel \(1, 2\), channel 0"):
        select(scene, {"key": TEXTURE})


@pytest.mark.parametrize(("type_", "bits"), [(np.uint8, 8), (np.float16, 16)])
def test_textures_with_few_bits(make_scene, type_, bits):
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.ones((4, 6, 3), type_))}
    scene = make_scene(floor={"type": "diffuse", "reflectance": texture})
    with pytest.raises(ConfigError, match=f'stored with {bits} bits.*name="format" value="variant"'):
        select(scene, {"key": TEXTURE})


def test_parameters_that_shape_a_beam_are_refused(make_scene):
    scene = make_scene(lamp={"type": "spot"})
    for name in ("cutoff_angle", "beam_width"):
        with pytest.raises(ConfigError, match="shapes the beam"):
            select(scene, {"key": f"lamp.{name}"})


def test_index_of_refraction(make_scene):
    scene = make_scene(glass={"type": "dielectric"}, ball={"type": "sphere", "bsdf": {"type": "ref", "id": "glass"}})
    with pytest.raises(ConfigError, match=r"`glass.eta` is not differentiable \(SmoothDielectric\)"):
        select(scene, {"key": "glass.eta"})


# Values at which Mitsuba leaves out a lobe.


def with_bsdf(make_scene, **bsdf):
    return make_scene(plane={"type": "rectangle", "bsdf": {**bsdf, "id": "floor"}}, floor=None)


@pytest.mark.parametrize(("bsdf", "key", "given", "starts"), [
    ({"type": "principled"}, "spec_trans.value", None, 0.001),
    ({"type": "principled"}, "metallic.value", 1.0, 0.999),
    ({"type": "principled"}, "metallic.value", 0.0, 0.0),
    ({"type": "principled", "specular": 0.5}, "specular", 0.0, 0.001),
    ({"type": "principledthin"}, "diff_trans.value", 2.0, 1.999),
    ({"type": "principledthin"}, "diff_trans.value", 0.4, 0.4),
    ({"type": "roughconductor"}, "eta.value", None, 0.001),
    ({"type": "hair"}, "longitudinal_roughness", 0.0, 0.001),
    ({"type": "hair"}, "azimuthal_roughness", 0.0, 0.001),
    ({"type": "mask", "opacity": 1.0, "inside": {"type": "diffuse"}}, "opacity.value", None, 0.999),
])  # fmt: skip
def test_starts_and_bounds_are_where_a_derivative_exists(make_scene, caplog, bsdf, key, given, starts):
    caplog.set_level("INFO", "reslrb_cli")
    spec = {"key": f"plane.bsdf.{key}"} | ({} if given is None else {"initial": given})
    selection = select(with_bsdf(make_scene, **bsdf), spec)
    assert selection.array(spec["key"]) == pytest.approx(starts)
    low, high = selection.specs[spec["key"]].bounds
    assert (low if starts < 0.5 else high) == pytest.approx(starts) or starts in (0.0, 0.4)
    moved = "c.yaml: parameters[0]: `plane.bsdf" in caplog.text
    assert moved == (starts not in (0.0, 0.4))


def test_bounds_of_the_user_stay_inside(make_scene):
    scene = with_bsdf(make_scene, type="principled", sheen=0.5)
    key = "plane.bsdf.sheen.value"
    assert select(scene, {"key": key, "bounds": [0, 0.7]}).specs[key].bounds == (0.001, 0.7)
    assert select(scene, {"key": key, "bounds": [0.2, 0.7]}).specs[key].bounds == (0.2, 0.7)
    for end in (0.0005, 0.001):  # no room is left inside
        narrow = select(scene, {"key": key, "initial": 0.0004, "bounds": [0, end]})
        assert narrow.specs[key].bounds == (0, end)
        assert narrow.array(key) == pytest.approx(0.0004)


UNUSED = [
    ("principled", "clearcoat_gloss", "clearcoat"),
    ("principled", "sheen_tint", "sheen"),
    ("principledthin", "sheen_tint", "sheen"),
    ("principledthin", "eta", "spec_trans"),
    ("principledthin", "anisotropic", "spec_trans"),
    ("principledthin", "spec_tint", "spec_trans"),
    ("conductor", "k", "eta"),
    ("roughconductor", "k", "eta"),
]


@pytest.mark.parametrize(("kind", "name", "weight"), UNUSED)
def test_a_parameter_without_effect_is_refused(make_scene, kind, name, weight):
    key, other = f"plane.bsdf.{name}.value", f"plane.bsdf.{weight}.value"
    scene = with_bsdf(make_scene, type=kind)
    why = rf"parameters\[0\].key: `{key}` has no effect while `plane.bsdf.{weight}` is 0"
    with pytest.raises(ConfigError, match=why):
        select(scene, {"key": key})
    listed = {info.key: info.obstacle for info in list_parameters(mi.traverse(scene))}
    assert "has no effect" in listed[key]
    assert listed[other] is None
    assert select(scene, {"key": key}, {"key": other}).keys == [key, other]
    positive = with_bsdf(make_scene, type=kind, **{weight: 0.5})
    assert select(positive, {"key": key}).keys == [key]


def test_only_an_image_shapes_the_light_of_a_spot(make_scene):
    even = make_scene(lamp={"type": "spot"})
    with pytest.raises(ConfigError, match=r"`lamp.texture.value` has no effect.*; recover `lamp.intensity` instead"):
        select(even, {"key": "lamp.texture.value"})
    data = mi.TensorXf(np.full((2, 2, 3), 0.5, np.float32))
    image = make_scene(lamp={"type": "spot", "texture": {"type": "bitmap", "data": data, "raw": True}})
    assert select(image, {"key": "lamp.texture.data"}).keys == ["lamp.texture.data"]


@pytest.mark.parametrize("name", ["eumelanin", "pheomelanin"])
def test_an_absorption_replaces_the_pigments_of_hair(make_scene, name):
    key = f"plane.bsdf.{name}"
    assert select(with_bsdf(make_scene, type="hair", **{name: 0.3}), {"key": key}).keys == [key]
    with pytest.raises(ConfigError, match=rf"`{key}` has no effect.*; recover `plane.bsdf.sigma_a` instead"):
        select(with_bsdf(make_scene, type="hair", sigma_a={"type": "rgb", "value": [0.2, 0.3, 0.4]}), {"key": key})


def test_a_glob_leaves_out_parameters_without_effect(make_scene):
    both = select(with_bsdf(make_scene, type="principled"), {"key": "plane.bsdf.*clearcoat*.value"}).keys
    assert both == ["plane.bsdf.clearcoat.value", "plane.bsdf.clearcoat_gloss.value"]
    others = select(with_bsdf(make_scene, type="principled"), {"key": "plane.bsdf.*ss*.value"}).keys
    assert others == ["plane.bsdf.roughness.value", "plane.bsdf.flatness.value"]
    with pytest.raises(ConfigError, match=r"parameters\[0\].key: `plane.bsdf.clearcoat_gloss.value` has no effect"):
        select(with_bsdf(make_scene, type="principled"), {"key": "plane.bsdf.*gloss*"})


@pytest.mark.parametrize(("kind", "name"), [("polarizer", "theta"), ("retarder", "theta"), ("retarder", "delta")])
def test_polarisation_is_refused_without_polarised_light(make_scene, kind, name):
    with pytest.raises(ConfigError, match="only changes polarised light"):
        select(with_bsdf(make_scene, type=kind), {"key": f"plane.bsdf.{name}.value"})


def test_light_through_a_twosided_bsdf_is_refused(make_scene):
    scene = with_bsdf(make_scene, type="twosided", inside={"type": "principled"})
    with pytest.raises(ConfigError, match="lets light through a `twosided` BSDF"):
        select(scene, {"key": "plane.bsdf.brdf_0.spec_trans.value"})


@pytest.mark.parametrize(
    ("word", "names", "is_point", "is_shape", "pivot", "said"),
    [
        (
            "translation",
            ["DirectionalEmitter"],
            False,
            False,
            False,
            "translation does not move `a`, which is a direction",
        ),
        ("rotation", ["DirectionalEmitter"], False, False, False, None),
        ("x", ["DirectionalEmitter", "Mesh"], False, True, False, None),
        (
            "rotation.x",
            ["PointLight"],
            True,
            False,
            False,
            "rotation.x about itself does not move `a`, which is a point",
        ),
        ("scale", ["PointLight"], True, False, False, "scale about itself does not move `a`, which is a point"),
        ("translation", ["PointLight"], True, False, False, None),
        ("rotation", ["PointLight"], True, False, True, None),
        ("rotation", ["PointLight", "Mesh"], True, False, False, None),
        ("scale", ["SpotLight"], False, False, False, "scale about itself does not move `a`, which has no size"),
        ("scale", ["Mesh"], False, True, False, None),
        ("rotation", ["SpotLight"], False, False, False, None),
    ],
)
def test_motions_without_an_effect(
    word: str, names: list[str], is_point: bool, is_shape: bool, pivot: bool, said: str | None
) -> None:
    nodes = [SimpleNamespace(class_name=lambda name=name: name) for name in names]
    items = [SimpleNamespace(id="a", node=node, is_point=is_point, is_shape=is_shape) for node in nodes]
    place = parameters.Place("a.yaml", "parameters[0]", lambda key: key)
    if said is None:
        parameters._check_effect(items, word, pivot, place)
    else:
        with pytest.raises(ConfigError, match=re.escape(said)):
            parameters._check_effect(items, word, pivot, place)


@pytest.mark.parametrize(
    ("shape", "at", "words"),
    [
        ((), (), "2.5"),
        ((3,), (1,), "2.5 at entry 1"),
        ((2, 3), (1, 2), "2.5 at entry [1, 2]"),
        ((2, 3, 3), (1, 2, 0), "2.5 at texel (2, 1), channel 0"),
        ((2,), None, None),
    ],
)
def test_the_first_entry_is_named(shape: tuple[int, ...], at: tuple[int, ...] | None, words: str | None) -> None:
    array = np.zeros(shape, np.float32)
    if at is not None:
        array[at] = 2.5
    assert values.first_entry(array, array > 1) == words


@pytest.mark.parametrize(
    ("transform", "of_run", "value", "is_valid"),
    [
        ("none", False, -9.0, True),
        ("sigmoid", False, 0.25, False),
        ("sigmoid", False, 0.26, True),
        ("sigmoid", False, 0.75, False),
        ("sigmoid", True, 0.25, True),
        ("sigmoid", True, 0.75, True),
        ("sigmoid", True, 0.24, False),
        ("sigmoid", True, 0.76, False),
        ("log", False, 0.0, False),
        ("log", True, 0.0, False),
        ("log", False, 1e-9, True),
    ],
)
def test_a_start_lies_in_the_range_of_its_transform(transform: str, of_run: bool, value: float, is_valid: bool) -> None:
    start = RunValue(run=Path("run")) if of_run else value
    spec: Any = SimpleNamespace(transform=transform, bounds=(0.25, 0.75), initial=start)
    slot: Any = SimpleNamespace(key="a.b")
    place = values.Place("a.yaml", "parameters[0]")
    if is_valid:
        values.check_transform(slot, np.float32([value]), spec, place)
    else:
        with pytest.raises(ConfigError, match=rf"parameters\[0\]\.initial: `a\.b` starts at {value:g} at entry 0; "):
            values.check_transform(slot, np.float32([value]), spec, place)
    if transform == "sigmoid":
        refused = pytest.raises(ConfigError, match="bounds: exclude the initial value")
        with contextlib.nullcontext() if 0.25 <= value <= 0.75 else refused:
            values.check_bounds(slot, np.float32([value]), (0.25, 0.75), place)


def test_tied_colours_have_one_spectrum(llvm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Params(dict[str, Any]):
        properties = property(lambda self: self)

    monkeypatch.setattr(upsampling, "is_upsampled", lambda params, key: key != "number")
    monkeypatch.setattr(upsampling, "colour_in_scene", lambda params, key: np.array(params[key]).ravel())
    monkeypatch.setattr(upsampling, "coefficients", lambda rgb: 2 * rgb)
    params = Params({name: mi.Color3f(1, 2, 3) for name in "abc"}, number=mi.Float(1))
    colours = upsampling.Upsampling(params)
    for key, others in (("c", []), ("a", ["b"]), ("a", ["c"]), ("number", []), ("gone", [])):
        colours.add(key, others)
    assert ("a" in colours, "b" in colours, colours.keys) == (True, False, ["c", "a", "b"])
    colours["a"] = mi.Color3f(4, 5, 6)
    assert len(colours.place()) == 3
    shown = {name: np.array(value).ravel().tolist() for name, value in params.items()}
    assert shown == {"a": [8, 10, 12], "b": [8, 10, 12], "c": [2, 4, 6], "number": [1]}
