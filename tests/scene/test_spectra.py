"""Spectra by wavelength, which RGB variants cannot evaluate: read as the colours that they have, or refused."""

from __future__ import annotations

import logging
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.catalog import list_parameters
from reslrb_cli.scene.load import load_scene

pytestmark = pytest.mark.usefixtures("llvm")

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
#: Planck's law, of CODATA's constants.
PLANCK, LIGHT, BOLTZMANN = 6.62607015e-34, 299792458.0, 1.380649e-23


def write(folder: Path, paint: str = "", light: str = "", more: str = "") -> Path:
    (folder / "scene.xml").write_text(SCENE.format(paint=paint, light=light, more=more))
    return folder / "scene.xml"


def value(scene: mi.Scene, key: str) -> np.ndarray:
    return np.array(mi.traverse(scene)[key], dtype=np.float64).ravel()


def colour(wavelengths: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The colour of light of that spectrum: what Mitsuba's spectral variants make of it."""
    fine = np.linspace(wavelengths[0], wavelengths[-1], 20001)
    matching = np.array(mi.cie1931_xyz(mi.Float(fine.astype(np.float32))), dtype=np.float64)
    heights = matching * np.interp(fine, wavelengths, values)
    area = (heights[:, 1:] + heights[:, :-1]).sum(axis=1) / 2 * (fine[1] - fine[0])
    return np.array(mi.xyz_to_srgb(mi.Color3f((area * mi.MI_CIE_Y_NORMALIZATION).tolist()))).ravel()


def black_body(temperature: float, low: float = 360, high: float = 830) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths in nm, and radiance in W/(m^2 sr nm)."""
    nm = np.linspace(low, high, 5001)
    metres = 1e-9 * nm
    exponent = PLANCK * LIGHT / (metres * BOLTZMANN * temperature)
    return nm, 1e-9 * 2 * PLANCK * LIGHT**2 / metres**5 / np.expm1(exponent)


@pytest.mark.parametrize("temperature", [2200, 3000, 6500, 12000])
def test_a_black_body_has_its_colour(tmp_path: Path, temperature: int) -> None:
    light = f'<spectrum type="blackbody" name="radiance"><float name="temperature" value="{temperature}"/></spectrum>'
    found = value(load_scene(write(tmp_path, light=light)), "sky.radiance.value")
    np.testing.assert_allclose(found, colour(*black_body(temperature)), rtol=3e-3)


def test_a_black_body_within_a_range(tmp_path: Path) -> None:
    light = """<spectrum type="blackbody" name="radiance"><float name="temperature" value="4000"/>
    <float name="wavelength_min" value="400"/><float name="wavelength_max" value="650"/></spectrum>"""
    found = value(load_scene(write(tmp_path, light=light)), "sky.radiance.value")
    np.testing.assert_allclose(found, colour(*black_body(4000, 400, 650)), rtol=3e-3)


@pytest.mark.parametrize(
    ("xml", "wavelengths"), [(IRREGULAR, (400, 500, 700)), (REGULAR, (420, 550, 680))], ids=["irregular", "regular"]
)
def test_light_by_wavelength_has_its_colour(tmp_path: Path, xml: str, wavelengths: tuple[float, ...]) -> None:
    found = value(load_scene(write(tmp_path, light=xml.format('name="radiance"'))), "sky.radiance.value")
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
    found = value(load_scene(write(tmp_path, paint, more=more)), "thing.bsdf.reflectance.value")
    inline = value(load_scene(write(tmp_path, INLINE.format("reflectance"))), "thing.bsdf.reflectance.value")
    assert len(set(inline)) == 3
    np.testing.assert_array_equal(found, inline)


def test_it_is_said_where_and_refused_where_nothing_is_to_be_mended(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = write(tmp_path, IRREGULAR.format('name="reflectance"'))
    with caplog.at_level(logging.WARNING):
        load_scene(file)
    line = f"{file}:3: RGB variants have no spectrum `irregular`: read as the colour of it"
    assert [record.getMessage() for record in caplog.records] == [line]
    with pytest.raises(ConfigError, match="RGB variants have no spectrum `irregular`"):
        load_scene(file, strict=True)


@pytest.mark.parametrize(
    ("xml", "reason"),
    [
        (IRREGULAR.replace("500 ", ""), "scene.xml:3: irregular has 2 wavelengths and 3 values"),
        (IRREGULAR.replace("400, 500", "500, 400"), "irregular needs two wavelengths or more, in ascending order"),
        (REGULAR.replace("0.1, 0.5, 0.8", "0.1"), "regular needs two wavelengths or more"),
        (REGULAR.replace("680", "420"), "regular: wavelength_max must be above wavelength_min"),
        (REGULAR.replace("wavelength_min", "lambda_min"), "regular needs a parameter `wavelength_min`"),
        (IRREGULAR.replace('"0.1, ', '"-0.1, '), r"values: must be numbers from 0 on, not `-0\.1, 0\.5 0\.8`"),
        (IRREGULAR.replace('"0.1, ', '"x, '), "values: must be numbers from 0 on"),
        (IRREGULAR.replace('name="wavelengths"', 'name="lambdas"'), "irregular needs a parameter `wavelengths`"),
        (IRREGULAR.replace("{}", ""), "<spectrum> `irregular` needs a name: that of what it is for"),
        ('<spectrum type="blackbody" {}><float name="temperature" value="3000"/></spectrum>',
         "a blackbody is what an emitter emits; a bsdf can have <rgb>"),
    ],
)  # fmt: skip
def test_what_is_no_spectrum_is_one_located_line(tmp_path: Path, xml: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        load_scene(write(tmp_path, xml.format('name="reflectance"')))


@pytest.mark.parametrize("temperature", ["0", "-3", "warm", "3000 4000"])
def test_no_temperature_is_one_located_line(tmp_path: Path, temperature: str) -> None:
    light = f'<spectrum type="blackbody" name="radiance"><float name="temperature" value="{temperature}"/></spectrum>'
    with pytest.raises(ConfigError, match=r"scene\.xml:4: temperature: must be"):
        load_scene(write(tmp_path, light=light))


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


def test_what_a_hair_is_not_given_is_no_parameter() -> None:
    scene = mi.load_dict({"type": "scene", "a": {"type": "sphere", "bsdf": {"type": "hair"}}}, optimize=False)
    infos = {info.key.rpartition(".")[2]: info for info in list_parameters(mi.traverse(scene), values=True)}
    assert (infos["sigma_a"].obstacle, infos["sigma_a"].value) == ("is not given in the scene file", None)
    assert infos["eumelanin"].obstacle is None


def test_a_black_body_of_an_endless_range_takes_no_time(tmp_path: Path) -> None:
    light = """<spectrum type="blackbody" name="radiance"><float name="temperature" value="4000"/>
    <float name="wavelength_max" value="1e30"/></spectrum>"""
    assert np.isfinite(value(load_scene(write(tmp_path, light=light)), "sky.radiance.value")).all()
