"""Scenes of other versions and exporters, and their spectra: repairs, conversions to colours, and refusals."""

from __future__ import annotations

import itertools
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from kit import profile_of

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.catalog import list_parameters
from reslrb_cli.scene.files import file_digests, files_of
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.xml import mend
from reslrb_cli.scene.xml.mend import upsample_bitmaps
from reslrb_cli.scene.xml.read import read_description

pytestmark = pytest.mark.usefixtures("llvm")


# Scenes of other versions and exporters: repairs, omissions, messages about them, and refusals.

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = sorted((ROOT / "scenes").rglob("*.xml"))
#: A scene with parts that can be exchanged one at a time. Each part has its own line.
PARTS = {
    "head": '<scene version="3.0.0">',
    "integrator": '<integrator type="path"/>',
    "sensor": '<sensor type="perspective">',
    "pose": '<transform name="to_world"><lookat origin="1, 2, 4" target="0, 0, 0" up="0, 1, 0"/></transform>',
    "sampler": '<sampler type="independent"/>',
    "film": '<film type="hdrfilm"><rfilter type="box"/>',
    "format": '<integer name="width" value="20"/><integer name="height" value="10"/>',
    "end": "</film></sensor>",
    "light": '<emitter type="constant"><rgb name="radiance" value="0.5, 0.25, 1"/></emitter>',
    "paint": '<bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.5, 0.25, 1"/></bsdf>',
    "shape": '<shape type="sphere"><float name="radius" value="2"/><ref id="paint"/></shape>',
    "tail": "</scene>",
}
LINES = {name: number for number, name in enumerate(PARTS, start=1)}


def write(folder: Path, **changes: str) -> Path:
    file = folder / "scene.xml"
    file.write_text("\n".join((PARTS | changes).values()))
    return file


def values(scene: Any) -> dict[str, Any]:
    """Return every number of a scene by its key."""
    return {
        key: np.array(value.matrix if "AffineTransform" in type(value).__name__ else value)
        for key, value in mi.traverse(scene).items()
    }


def assert_same(found: dict[str, Any], expected: dict[str, Any]) -> None:
    """Assert that both scenes have the same numbers in the same order. Keys must be equal except where Mitsuba makes a
    name from an address.
    """
    assert len(found) == len(expected)
    for (key, value), (other, reference) in zip(found.items(), expected.items(), strict=True):
        parts = slice(1 if other.startswith("object_") else 0, None)
        assert key.split(".")[parts] == other.split(".")[parts]
        np.testing.assert_array_equal(value, reference, err_msg=key)


#: The shipped scenes whose images are also compared.
RENDERED = ("cornell_floor", "grey_room", "caustic_heightmap")

#: Scenes with nothing that the other scenes lack. Their textures take seconds.
SIMILAR = ("lens_pose", "caustic_slab", "caustic_heightmap", "prism")


@pytest.mark.parametrize(
    "file",
    [
        pytest.param(file, id=str(file.relative_to(ROOT / "scenes")),
                     marks=pytest.mark.long if file.parent.name in SIMILAR else ())
        for file in SHIPPED
    ],
)  # fmt: skip
def test_loaded_scenes_equal_those_of_mitsuba(file):
    size = {"resx": 24, "resy": 24} if 'name="resx"' in file.read_text() else {}
    stock, ours = mi.load_file(str(file), optimize=False, **size), load_scene(file, size)
    assert_same(values(ours), values(stock))
    if file.parent.name not in RENDERED:
        return
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    images = [np.array(mi.render(scene, integrator=integrator, spp=2, seed=1)) for scene in (stock, ours)]
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6)


OLD = """<scene version="0.6.0">
<default name="angle" value="30"/><default name="width" value="8"/><default name="w" value="9"/>
<bsdf type="diffuse" id="costs \\$5"/>
<include filename="parts/materials.xml"/>
<sensor type="perspective"><float name="fov" value="$angle"/><string name="fovAxis" value="smaller"/>
<transform name="toWorld"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="$width"/><integer name="height" value="$width"/></film></sensor>
<emitter type="constant"/><path value="parts"/>
<bsdf type="roughplastic" id="floor"><float name="intIOR" value="1.4"/>
<texture type="bitmap" name="diffuseReflectance"><string name="filename" value="t.exr"/>
<float name="uscale" value="2"/><float name="voffset" value="0.5"/></texture></bsdf>
<alias id="shiny" as="mirror"/>
<shape type="rectangle"><ref id="floor"/></shape><shape type="sphere"><ref name="bsdf" id="mirror"/></shape>
<shape type="sphere"><boolean name="flipNormals" value="true"/><include filename="bsdf.xml" name="bsdf"/></shape>
</scene>"""


def test_variables_includes_and_folders_work_as_in_mitsuba(tmp_path):
    (tmp_path / "parts").mkdir()
    for factor, folder in ((1, "parts"), (0.5, ".")):
        texels = factor * np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3)
        mi.Bitmap(texels).write(str(tmp_path / folder / "t.exr"))
    (tmp_path / "parts" / "materials.xml").write_text(
        '<scene version="2.0.0"><default name="rough" value="0.$digit"/>\n<bsdf type="roughconductor" id="shiny">'
        '<float name="alpha" value="$rough"/><string name="material" value="none"/></bsdf></scene>'
    )
    (tmp_path / "bsdf.xml").write_text('<bsdf version="0.5.0" type="plastic"><float name="intIOR" value="1.3"/></bsdf>')
    file = tmp_path / "scene.xml"
    file.write_text(OLD)
    options = {"angle": "45", "digit": "25"}
    assert_same(values(load_scene(file, options)), values(mi.load_file(str(file), optimize=False, **options)))


@pytest.mark.parametrize("name", ["path", "parallel", "optimize", "file", "options", "self", "kwargs"])
def test_any_name_is_a_variable(tmp_path, name):
    file = write(tmp_path, shape=f'<shape type="sphere"><float name="radius" value="${name}"/></shape>')
    assert values(load_scene(file, {name: 3}))["Sphere_1.to_world"][0, 0, 0] == 3


# Part of the scene and its replacement, which means the same
CONVERTED = [
    ("head", "<scene>"),
    ("head", '<scene version="3">'),
    ("pose", PARTS["pose"].replace("lookat", "lookAt")),
    ("pose", PARTS["pose"].replace("to_w", "toW")),
    ("film", PARTS["film"].replace("hdr", "ldr")),
    ("format", PARTS["format"] + '<string name="file_format" value="png"/>'),
    ("format", PARTS["format"] + '<string name="pixel_format" value="rgb, luminance"/>'),
    ("sampler", '<sampler type="sobol"/>'),
    ("shape", PARTS["shape"].replace("sphere", "Sphere")),
    ("light", PARTS["light"].replace("<rgb", "<spectrum")),
    ("paint", PARTS["paint"].replace("reflectance", "diffuseReflectance")),
    ("paint", PARTS["paint"].replace("<rgb", "<srgb").replace("0.5, 0.25, 1", "0.735356983, 0.537098729, 1")),
]
# Part of the scene, its replacement, and the message after file and line
LEFT_OUT = [
    ("head", '<scene version="3.0.0" xmlns="x">', "<scene> has no attribute `xmlns` in Mitsuba 3"),
    (
        "light",
        PARTS["light"].replace("<emitter", '<emitter version="3.0.0"'),
        "<emitter> has no attribute `version` in Mitsuba 3",
    ),
    (
        "film",
        PARTS["film"] + '<float name="exposure" value="2"/>',
        "hdrfilm has no parameter `exposure` in Mitsuba 3",
    ),
    (
        "film",
        PARTS["film"] + '<boolean name="highQualityEdges" value="true"/>',
        "hdrfilm has no parameter `highQualityEdges` in Mitsuba 3",  # as in the file
    ),
    ("format", '<integer name="width" value="99"/>' + PARTS["format"], "`width` is given again in line 7"),
    ("format", '<texture type="bitmap" name="width"/>' + PARTS["format"], "`width` is given again in line 7"),
    (
        "shape",
        PARTS["shape"].replace("<ref", '<float name="radios" value="3"/><ref'),
        "sphere has no parameter `radios` in Mitsuba 3 (did you mean `radius`?)",
    ),
    (
        "shape",
        PARTS["shape"].replace("<ref", '<sampler type="independent"/><ref'),
        "sphere does not use a <sampler> in Mitsuba 3",
    ),
    ("shape", PARTS["shape"] + "<comment>mine</comment>", "`<comment>` is unknown to Mitsuba 3"),
    (
        "light",
        PARTS["light"].replace('value="0.5', 'intent="illuminant" value="0.5'),
        "<rgb> has no attribute `intent` in Mitsuba 3",
    ),
]


@pytest.mark.parametrize(("part", "text", "said"), [*((*each, None) for each in CONVERTED), *LEFT_OUT])
def test_conversions_are_silent_and_omissions_are_reported_with_their_line(tmp_path, caplog, part, text, said):
    expected = values(load_scene(write(tmp_path)))
    assert not caplog.records
    file = write(tmp_path, **{part: text})
    before = file.read_bytes()
    found = values(load_scene(file))
    lines = [] if said is None else [f"{file}:{LINES[part]}: {said}: left out"]
    assert [record.getMessage() for record in caplog.records] == lines
    assert list(found) == list(expected)
    for key, value in expected.items():
        np.testing.assert_allclose(found[key], value, atol=1e-6, err_msg=key)
    assert file.read_bytes() == before


def test_similar_omissions_are_one_line(tmp_path, caplog):
    shape = PARTS["shape"].replace("<ref", '<float name="weight" value="3"/><ref')
    file = write(tmp_path, shape="\n".join([shape] * 9))
    load_scene(file)
    load_scene(file)  # as for a rendered target
    [record] = caplog.records
    said = "sphere has no parameter `weight` in Mitsuba 3: left out (also 8 more)"
    assert record.getMessage() == f"{file}:11: {said}"


def test_scaled_texture_coordinates(tmp_path, caplog):
    texture = '<texture type="checkerboard" name="reflectance"><float name="uscale" value="3"/></texture>'
    file = write(tmp_path, paint=f'<bsdf type="diffuse" id="paint">{texture}</bsdf>')
    assert values(load_scene(file))["paint.reflectance.to_uv"].ravel()[[0, 4]].tolist() == [3, 1]
    assert not caplog.records


def test_colours_in_hexadecimal(tmp_path):
    file = write(tmp_path, paint=PARTS["paint"].replace("0.5, 0.25, 1", "#80ff00"))
    np.testing.assert_allclose(
        values(load_scene(file))["paint.reflectance.value"].ravel(), [128 / 255, 1, 0], atol=1e-6
    )


def test_the_scenes_own_integrator_is_not_loaded(tmp_path, caplog):
    file = write(tmp_path, integrator='<integrator type="guided_path"><integrator type="nonsense"/></integrator>')
    assert load_scene(file).integrator() is None
    assert not caplog.records


def test_objects_with_one_name_are_all_kept(tmp_path):
    # Mitsuba drops the first object, because it takes a name for that of a parameter
    shape = PARTS["shape"].replace("<shape", '<shape name="mesh"')
    assert len(load_scene(write(tmp_path, shape=shape + shape)).shapes()) == 2


def test_paths_with_backslashes_are_found(tmp_path):
    (tmp_path / "textures").mkdir()
    file = tmp_path / "scene.xml"
    mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write(str(tmp_path / "textures" / "t.exr"))
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="textures\\t.exr"/></texture>'
    scene = load_scene(write(tmp_path, paint=f'<bsdf type="diffuse" id="paint">{texture}</bsdf>'))
    assert values(scene)["paint.reflectance.data"].shape == (2, 2, 3)
    config = tmp_path / "a.yaml"
    config.write_text("scene: {file: scene.xml}\ntarget: {render: {}}\nparameters: [{key: paint.reflectance.data}]")
    before = file_digests(files_of(load(config)))
    assert "scene.file (textures/t.exr)" in before
    mi.Bitmap(np.full((2, 2, 3), 0.25, np.float32)).write(str(tmp_path / "textures" / "t.exr"))
    after = file_digests(files_of(load(config)))
    assert {key for key in before if before[key] != after[key]} == {"scene.file (textures/t.exr)"}
    assert file.is_file()


def test_includes_and_folders_with_backslashes_are_found(tmp_path):
    (tmp_path / "parts" / "images").mkdir(parents=True)
    mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write(str(tmp_path / "parts" / "images" / "t.exr"))
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="t.exr"/></texture>'
    paint = f'<scene version="3.0.0"><bsdf type="diffuse" id="paint">{texture}</bsdf></scene>'
    (tmp_path / "parts" / "paint.xml").write_text(paint)
    include = '<path value="parts\\images"/><include filename="parts\\paint.xml"/>'
    assert values(load_scene(write(tmp_path, paint=include)))["paint.reflectance.data"].shape == (2, 2, 3)


@pytest.mark.parametrize("word", ["".join(letters) for letters in itertools.product("tT", "rR", "uU", "eE")])
def test_booleans_may_have_any_case(word, tmp_path):
    integrator = f'<integrator type="path"><boolean name="hide_emitters" value="{word}"/></integrator>'
    assert read_description(write(tmp_path, integrator=integrator), {}).hides_emitters


def test_raw_bitmaps_are_found_with_any_case(tmp_path):
    mi.Bitmap(np.full((2, 2, 3), 100, np.uint8)).write(str(tmp_path / "t.png"))
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="t.png"/>{}</texture>'
    for word in ("true", "True", "TRUE"):
        paint = texture.format(f'<boolean name="raw" value="{word}"/>')
        description = read_description(write(tmp_path, paint=f'<bsdf type="diffuse" id="paint">{paint}</bsdf>'), {})
        with pytest.raises(ConfigError, match="is not a file of linear colours; remove `raw`"):
            upsample_bitmaps(description)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("palette.bmp", "`palette.bmp` has a palette, which Mitsuba's textures ignore; save it as PNG"),
        ("deep.ppm", "`deep.ppm` is no binary PPM file with a maximum of 255"),
    ],
)
def test_images_that_mitsuba_misreads_are_refused(name, reason, tmp_path):
    from PIL import Image

    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).quantize(4).save(tmp_path / "palette.bmp")
    (tmp_path / "deep.ppm").write_bytes(b"P6 1 1 65535\n" + bytes(6))
    texture = f'<texture type="bitmap" name="reflectance"><string name="filename" value="{name}"/></texture>'
    file = write(tmp_path, paint=f'<bsdf type="diffuse" id="paint">{texture}</bsdf>')
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:{LINES['paint']}: filename: {reason}")


def test_a_colour_profile_of_a_texture_is_named(tmp_path, caplog):
    from PIL import Image

    Image.new("RGB", (2, 2), "red").save(tmp_path / "t.png", icc_profile=profile_of("Display P3", 2.2))
    name, raw = '<string name="filename" value="t.png"/>', '<boolean name="raw" value="true"/>'
    for more in (raw, ""):  # a line is only logged once
        caplog.clear()
        texture = f'<texture type="bitmap" name="reflectance">{name}{more}</texture>'
        load_scene(write(tmp_path, paint=f'<bsdf type="diffuse" id="paint">{texture}</bsdf>'))
        line = "`t.png` has the colour profile `Display P3`, which Mitsuba's textures ignore: read as sRGB; convert"
        assert (line in caplog.text) is (more == "")


@pytest.mark.parametrize("text", ["<!-- - -- what a -- rule -->", "<!-- \n -->", "<!DOCTYPE scene>"])
def test_input_tolerated_by_the_parser_of_mitsuba(tmp_path, text, caplog):
    head = text + PARTS["head"] if "DOCTYPE" in text else PARTS["head"] + text
    load_scene(write(tmp_path, head=head))
    assert not caplog.records


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_encodings(tmp_path, encoding):
    file = tmp_path / "scene.xml"
    file.write_bytes("\n".join((PARTS | {"shape": PARTS["shape"] + "<!-- Ä -->"}).values()).encode(encoding))
    assert "Sphere_1.to_world" in values(load_scene(file))


@pytest.mark.parametrize(
    ("part", "text", "said"),
    [
        ("paint", '<bsdf type="phong" id="paint"/>', "bsdf `phong` is a plugin of Mitsuba 0.6 that Mitsuba 3 does not"),
        ("shape", '<camera type="perspective"/>', "<camera> is an element of Mitsuba before 0.4"),
        ("shape", '<shape type="spere"/>', "there is no shape `spere` in Mitsuba 3; did you mean `sphere`?"),
        ("shape", '<shape type="difuse"/>', "no shape `difuse` in Mitsuba 3; did you mean `disk`?"),
        ("shape", '<shape type="blender"/>', "shape `blender` reads the memory of a running Blender"),
        ("shape", "<shape/>", "<shape> has no type"),
        ("paint", PARTS["paint"].replace("0.5, 0.25, 1", "#12345"), "must be a colour such as #80ff00, not `#12345`"),
        ("light", '<include filename="none.xml"/>', "included file `none.xml` not found"),
        ("light", '<path value="none"/>', "<path>: folder `none` not found"),
    ],
)
def test_irreparable_scenes_are_refused(tmp_path, part, text, said):
    file = write(tmp_path, **{part: text})
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:{LINES[part]}: ")
    assert said in str(error.value)


# Spectra by wavelength, which RGB variants cannot evaluate: converted to their colours, or refused.

SCENE = """<scene version="3.0.0">
<sensor type="perspective"/>
<shape type="sphere" id="thing"><bsdf type="diffuse" id="paint">{paint}</bsdf></shape>
<emitter type="constant" id="sky">{light}</emitter>
{more}
</scene>"""
IRREGULAR = """<spectrum type="irregular" {}><string name="wavelengths" value="400, 500 700"/>
<string name="values" value="0.1, 0.5 0.8"/></spectrum>"""
REGULAR = """<spectrum type="regular" {}><integer name="wavelength_min" value="420"/>
<float name="wavelength_max" value="680"/><string name="values" value="0.1, 0.5, 0.8"/></spectrum>"""
#: Constants of Planck's law, from CODATA.
PLANCK, LIGHT, BOLTZMANN = 6.62607015e-34, 299792458.0, 1.380649e-23


def write_spectrum(folder: Path, paint: str = "", light: str = "", more: str = "") -> Path:
    (folder / "scene.xml").write_text(SCENE.format(paint=paint, light=light, more=more))
    return folder / "scene.xml"


def value(scene: mi.Scene, key: str) -> np.ndarray:
    return np.array(mi.traverse(scene)[key], dtype=np.float64).ravel()


def colour(wavelengths: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the colour of light with the given spectrum, as Mitsuba's spectral variants compute the colour."""
    fine = np.linspace(wavelengths[0], wavelengths[-1], 20001)
    matching = np.array(mi.cie1931_xyz(mi.Float(fine.astype(np.float32))), dtype=np.float64)
    heights = matching * np.interp(fine, wavelengths, values)
    area = (heights[:, 1:] + heights[:, :-1]).sum(axis=1) / 2 * (fine[1] - fine[0])
    return np.array(mi.xyz_to_srgb(mi.Color3f((area * mi.MI_CIE_Y_NORMALIZATION).tolist()))).ravel()


def black_body(temperature: float, low: float = 360, high: float = 830) -> tuple[np.ndarray, np.ndarray]:
    """Return wavelengths in nm and the radiance in W/(m^2 sr nm)."""
    nm = np.linspace(low, high, 5001)
    metres = 1e-9 * nm
    exponent = PLANCK * LIGHT / (metres * BOLTZMANN * temperature)
    return nm, 1e-9 * 2 * PLANCK * LIGHT**2 / metres**5 / np.expm1(exponent)


@pytest.mark.parametrize("temperature", [2200, 3000, 6500, 12000])
def test_a_black_body_has_its_colour(tmp_path: Path, temperature: int) -> None:
    light = f'<spectrum type="blackbody" name="radiance"><float name="temperature" value="{temperature}"/></spectrum>'
    found = value(load_scene(write_spectrum(tmp_path, light=light)), "sky.radiance.value")
    np.testing.assert_allclose(found, colour(*black_body(temperature)), rtol=3e-3)


def test_a_black_body_within_a_range(tmp_path: Path) -> None:
    light = """<spectrum type="blackbody" name="radiance"><float name="temperature" value="4000"/>
    <float name="wavelength_min" value="400"/><float name="wavelength_max" value="650"/></spectrum>"""
    found = value(load_scene(write_spectrum(tmp_path, light=light)), "sky.radiance.value")
    np.testing.assert_allclose(found, colour(*black_body(4000, 400, 650)), rtol=3e-3)


@pytest.mark.parametrize(
    ("xml", "wavelengths"), [(IRREGULAR, (400, 500, 700)), (REGULAR, (420, 550, 680))], ids=["irregular", "regular"]
)
def test_light_by_wavelength_has_its_colour(tmp_path: Path, xml: str, wavelengths: tuple[float, ...]) -> None:
    found = value(load_scene(write_spectrum(tmp_path, light=xml.format('name="radiance"'))), "sky.radiance.value")
    np.testing.assert_allclose(found, colour(np.array(wavelengths), np.array([0.1, 0.5, 0.8])), rtol=3e-3)


INLINE = '<spectrum name="{}" value="400:0.1, 500:0.5, 700:0.8"/>'


@pytest.mark.parametrize(
    ("paint", "more"),
    [
        (IRREGULAR.format('name="reflectance"'), ""),
        (IRREGULAR.format('name="reflectance"').replace("spectrum", "texture"), ""),
        ('<ref id="s" name="reflectance"/>', IRREGULAR.format('id="s"')),
        ('<ref id="t" name="reflectance"/>', IRREGULAR.format('id="s"') + '<alias id="s" as="t"/>'),
        (f'<spectrum type="irregular" name="reflectance">{INLINE.format("value")}</spectrum>', ""),
    ],
    ids=["spectrum", "texture", "referred to", "by an alias", "value"],
)  # fmt: skip
def test_a_material_has_the_colour_of_the_same_spectrum_written_inline(tmp_path: Path, paint: str, more: str) -> None:
    found = value(load_scene(write_spectrum(tmp_path, paint, more=more)), "thing.bsdf.reflectance.value")
    inline = value(load_scene(write_spectrum(tmp_path, INLINE.format("reflectance"))), "thing.bsdf.reflectance.value")
    assert len(set(inline)) == 3
    np.testing.assert_array_equal(found, inline)


def test_a_repaired_spectrum_is_named_with_its_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = write_spectrum(tmp_path, IRREGULAR.format('name="reflectance"'))
    with caplog.at_level(logging.WARNING):
        load_scene(file)
    line = f"{file}:3: RGB variants have no spectrum `irregular`: read as its colour"
    assert [record.getMessage() for record in caplog.records] == [line]


@pytest.mark.parametrize(
    ("xml", "reason"),
    [
        (IRREGULAR.replace("500 ", ""), "scene.xml:3: irregular has 2 wavelengths and 3 values"),
        (IRREGULAR.replace("400, 500", "500, 400"), "irregular needs two wavelengths or more, in ascending order"),
        (REGULAR.replace("0.1, 0.5, 0.8", "0.1"), "regular needs two wavelengths or more"),
        (REGULAR.replace("680", "420"), "regular: wavelength_max must be above wavelength_min"),
        (REGULAR.replace("wavelength_min", "lambda_min"), "regular needs a parameter `wavelength_min`"),
        (IRREGULAR.replace('"0.1, ', '"-0.1, '), r"values: must be numbers of at least 0, not `-0\.1, 0\.5 0\.8`"),
        (IRREGULAR.replace('"0.1, ', '"x, '), "values: must be numbers of at least 0"),
        (IRREGULAR.replace('name="wavelengths"', 'name="lambdas"'), "irregular needs a parameter `wavelengths`"),
        (IRREGULAR.replace("{}", ""), "<spectrum> `irregular` needs a name, that of a parameter"),
        ('<spectrum type="blackbody" {}><float name="temperature" value="3000"/></spectrum>',
         "only emitters can have a blackbody; a bsdf can have <rgb>"),
    ],
)  # fmt: skip
def test_an_invalid_spectrum_is_one_located_line(tmp_path: Path, xml: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        load_scene(write_spectrum(tmp_path, xml.format('name="reflectance"')))


@pytest.mark.parametrize("temperature", ["0", "-3", "warm", "3000 4000"])
def test_a_missing_temperature_is_one_located_line(tmp_path: Path, temperature: str) -> None:
    light = f'<spectrum type="blackbody" name="radiance"><float name="temperature" value="{temperature}"/></spectrum>'
    with pytest.raises(ConfigError, match=r"scene\.xml:4: temperature: must be"):
        load_scene(write_spectrum(tmp_path, light=light))


def test_constants_of_spectra_are_no_parameters() -> None:
    spectra = {
        "a": {"type": "irregular", "wavelengths": "400, 700", "values": "0.1, 0.9"},
        "b": {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 700.0, "values": "0.1, 0.9"},
        "c": {"type": "blackbody", "temperature": 3000.0},
    }
    shapes = {
        name: {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": one}} for name, one in spectra.items()
    }
    infos = list_parameters(mi.traverse(mi.load_dict({"type": "scene", **shapes}, optimize=False)))
    constants = [info for info in infos if ".reflectance." in info.key]
    assert len(constants) >= 5
    assert all(info.obstacle == "is a constant of a spectrum; give the colour as <rgb>" for info in constants)


def test_missing_options_of_a_hair_are_no_parameters() -> None:
    scene = mi.load_dict({"type": "scene", "a": {"type": "sphere", "bsdf": {"type": "hair"}}}, optimize=False)
    infos = {info.key.rpartition(".")[2]: info for info in list_parameters(mi.traverse(scene), values=True)}
    assert (infos["sigma_a"].obstacle, infos["sigma_a"].value) == ("is not in the scene file", None)
    assert infos["eumelanin"].obstacle is None


# Scenes of Mitsuba 0.6: their light stays, and every change is a line.


def old(tmp_path, **changes):
    return write(tmp_path, head='<scene version="0.6.0">', **changes)


def lines(caplog):
    return [record.getMessage().partition("scene.xml:")[2] for record in caplog.records]


@pytest.mark.parametrize("value", ["10", "0.25", "10, "])
@pytest.mark.parametrize(
    ("light", "key"),
    [
        ('<emitter type="constant" id="l"><spectrum name="radiance" value="{}"/></emitter>', "l.radiance.value"),
        ('<emitter type="point" id="l"><spectrum name="intensity" value="{}"/></emitter>', "l.intensity.value"),
        ('<shape type="sphere" id="l"><emitter type="area"><spectrum name="radiance" value="{}"/></emitter></shape>',
         "l.emitter.radiance.value"),
    ],
)  # fmt: skip
def test_grey_light_of_old_scenes_is_grey(light, key, value, tmp_path, caplog):
    found = values(load_scene(old(tmp_path, light=light.format(value))))[key]
    np.testing.assert_allclose(found.ravel(), 3 * [float(value.strip(", "))], rtol=1e-5)
    assert (
        "9: one number as the <spectrum> of an emitter is grey in Mitsuba 0.6: read as grey <rgb>" in lines(caplog)[0]
    )
    caplog.clear()
    new = values(load_scene(write(tmp_path, light=light.format(value))))[key].ravel()
    assert (np.ptp(new) > 0.1 * new.mean(), lines(caplog)) == (True, [])  # the same power at all wavelengths


@pytest.mark.parametrize("type_", ["conductor", "roughconductor"])
@pytest.mark.parametrize("given", ["", '<string name="material" value="Au"/>', '<spectrum name="eta" value="1.5"/>'])
def test_old_conductors_without_a_material_are_copper(type_, given, tmp_path, caplog):
    paint = f'<bsdf type="{type_}" id="paint">{{}}</bsdf>'
    copper = '<string name="material" value="Cu"/>'
    found = values(load_scene(old(tmp_path, paint=paint.format(given))))
    warned = any("without a material is copper in Mitsuba 0.6" in line for line in lines(caplog))
    assert warned is (given == "")
    assert_same(found, values(load_scene(write(tmp_path, paint=paint.format(given or copper)))))


def test_old_skies_are_refused(tmp_path):
    light = '<emitter type="sunsky"/>'
    with pytest.raises(
        ConfigError, match=r"scene.xml:9: `sunsky` had y as its up axis, .* in Mitsuba 0.6; write it for"
    ):
        load_scene(old(tmp_path, light=light))
    load_scene(write(tmp_path, light=light))


def test_every_conversion_of_an_old_scene_is_a_line(tmp_path, caplog):
    caplog.set_level(logging.INFO, logger="reslrb_cli")
    mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write(str(tmp_path / "t.exr"))
    texture = """<texture type="bitmap" name="reflectance"><string name="filename" value="t.exr"/>
<string name="filterType" value="trilinear"/><float name="uscale" value="2"/></texture>"""
    changes = {
        "pose": '<transform name="toWorld"><lookAt origin="1, 2, 4" target="0, 0, 0" up="0, 1, 0"/></transform>',
        "sampler": '<sampler type="halton"/>',
        "film": '<film type="ldrfilm"><string name="pixelFormat" value="spectrum"/><rfilter type="box"/>',
        "light": '<emitter type="constant"><spectrum name="radiance" value="0.5, 0.25, 1"/></emitter>',
        "paint": f'<bsdf type="diffuse" id="paint">{texture}</bsdf>',
    }
    load_scene(old(tmp_path, **changes))
    said = "\n".join(lines(caplog))
    for part in ("`toWorld` is a name of Mitsuba 0.6: read as `to_world`, and 2 other names likewise",
                 "<lookAt> is an element of Mitsuba 0.6: read as <lookat>", "sampler `halton`: read as `independent`",
                 "film `ldrfilm` is a plugin of Mitsuba 0.6: read as `hdrfilm`",
                 "`pixel_format` `spectrum`: read as `rgb`", "a <spectrum> of three numbers: read as <rgb>",
                 "`filter_type` `trilinear`: read as `bilinear`",
                 "scale and offset of a texture: read as `to_uv`"):  # fmt: skip
        assert part in said, said
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.mark.parametrize(("uses", "warned"), [(["a", "b", "a"], True), (["a", "a"], False), ([], False)])
def test_an_obj_file_with_several_materials_is_named(uses, warned, tmp_path, caplog):
    faces = "".join(f"usemtl {name}\nf 1 2 3\n" for name in uses) or "f 1 2 3\n"
    (tmp_path / "m.obj").write_text(f"mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n{faces}")
    load_scene(write(tmp_path, shape='<shape type="obj"><string name="filename" value="m.obj"/></shape>'))
    line = "`m.obj` has the materials `a`, `b`, and Mitsuba ignores `usemtl` and .mtl files: read as one surface"
    assert (line in caplog.text) is warned


@pytest.mark.parametrize(("names", "more"), [
    ([], None), (["a"], ""), (["a", "a"], ""), (["a", "b"], ", and 1 other names likewise"),
    (["a", "b", "c"], ", and 2 other names likewise"),
])  # fmt: skip
def test_other_renamed_parameters_are_counted(names: list[str], more: str | None) -> None:
    description: Any = SimpleNamespace(files={"old.xml": "0.6.0", "new.xml": "3.0.0", "older.xml": "0.5.0"})
    mended = mend._Mender(description)
    mended._renamed = [
        SimpleNamespace(written=name, name=f"new_{name}", file=file) for file in mended.old[:1] for name in names
    ]  # type: ignore[misc]
    assert mended.old == ["old.xml", "older.xml"]
    assert [note.done for note in mended.renamed()] == ([] if more is None else [f"read as `new_a`{more}"])
