"""`init --target` fits the photograph, and recovers roughnesses if the photograph asks for them."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli import corners, tiny
from kit import area, diffuse, scene, sensor, shape

from reslrb_cli.config.loader import load
from reslrb_cli.optimization.first_fit import assemble_first_fit
from reslrb_cli.optimization.image_fit import ImageFit, fit_by_differences
from reslrb_cli.optimization.uncertainty.measuring import Budget
from reslrb_cli.scene.response import decode_srgb
from reslrb_cli.scene.visibility import sees_materials

pytestmark = pytest.mark.usefixtures("llvm")

FLOOR, WALL, ALPHA = "floor.bsdf.diffuse_reflectance.value", "wall.bsdf.reflectance.value", "floor.bsdf.alpha"
SIZE = (24, 16)


def filmic(light: np.ndarray) -> np.ndarray:
    """Return the linear values of a filmic curve (Hejl and Burgess-Dawson 2010)."""
    x = np.maximum(0, light - 0.004)
    return decode_srgb(x * (6.2 * x + 0.5) / (x * (6.2 * x + 1.7) + 0.06))


def write_corner(folder: Path, alpha: float, is_filmed: bool = False) -> None:
    """Write `corner.xml`, a grey glossy floor before a wall, and `photo.png`, its picture by `path` with other colours
    and the roughness `alpha`. The file has the roughness 0.3. A filmed picture has a film curve.
    """
    for name, floor, wall, roughness in (
        ("corner", "0.5", "0.5", 0.3),
        ("true", "0.5,0.3,0.15", "0.15,0.3,0.6", alpha),
    ):
        gloss = (f'<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="{floor}"/>'
                 f'<float name="alpha" value="{roughness}"/></bsdf>')  # fmt: skip
        text = scene(
            sensor("0, 1, 3", "0, 0.5, 0", size=SIZE, fov=60, rfilter="gaussian"),
            shape("rectangle", "floor", gloss, place='<rotate x="1" angle="-90"/><scale value="2"/>'),
            shape("rectangle", "wall", diffuse(wall), place='<scale value="2"/><translate y="1" z="-1.5"/>'),
            shape("rectangle", "lamp", diffuse("0"), area("20, 18, 15"),
                  place='<rotate x="1" angle="90"/><scale value="0.4"/><translate y="0.9" z="-1"/>'),
        )  # fmt: skip
        (folder / f"{name}.xml").write_text(text)
    path = mi.load_dict({"type": "path", "max_depth": 8})
    image = np.array(mi.render(mi.load_file(str(folder / "true.xml")), integrator=path, spp=2048))[:, :, :3]
    tiny.write_photo(folder / "photo.png", filmic(image) if is_filmed else 0.4 * image)


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("alpha", "is_filmed", "words"),
    [
        (0.3, False, "the colours explain the photograph"),
        (0.1, False, f"so the run also recovers {ALPHA}"),
        (0.3, True, "so the run also recovers the camera's response"),
        (0.1, True, f"so the run also recovers the camera's response, {ALPHA}"),
    ],
)
def test_a_photograph_asks_for_what_the_colours_do_not_explain(
    tmp_path: Path, alpha: float, is_filmed: bool, words: str
) -> None:
    """A film curve and a wrong roughness each look a little like the other one. Both are told apart."""
    write_corner(tmp_path, alpha, is_filmed)
    done = tiny.done("init", "corner.xml", "--target", "photo.png", "--fit", 120)
    assert f"{words}\n" in done.output
    config = load(tmp_path / "corner.yaml")
    keys = [key for spec in config.parameters for key in spec.keys]
    assert {FLOOR, WALL} <= set(keys)
    assert (ALPHA in keys) == (alpha != 0.3)
    response = config.target.response
    assert (response.recovered if response else "") == ("curve" if is_filmed else "")
    starts = {key: spec.initial for spec in config.parameters for key in spec.keys}
    if is_filmed:  # the curve starts as sRGB, so the values of the fit would not suit it
        assert config.target.exposure == "auto"
        assert set(starts.values()) == {"scene"}
        return
    np.testing.assert_allclose(starts[FLOOR], [0.5, 0.3, 0.15], atol=0.05)
    np.testing.assert_allclose(starts[WALL], [0.15, 0.3, 0.6], atol=0.05)
    np.testing.assert_allclose(config.target.exposure["auto"], 0.4, rtol=0.1)
    if alpha != 0.3:
        assert starts[ALPHA] == pytest.approx(alpha, abs=0.03)


def test_without_a_first_fit_no_roughness_is_recovered(tmp_path: Path) -> None:
    write_corner(tmp_path, 0.1)
    done = tiny.done("init", "corner.xml", "--target", "photo.png", "--fit", 0)
    assert "first fit" not in done.output
    assert ALPHA not in [key for spec in load(tmp_path / "corner.yaml").parameters for key in spec.keys]


def test_a_fit_that_does_not_end_in_time_adds_nothing(tmp_path: Path) -> None:
    write_corner(tmp_path, 0.1)
    done = tiny.done("init", "corner.xml", "--target", "photo.png", "--fit", 0.01)
    assert "not finished; --fit gives it more time" in done.output
    assert ALPHA not in [key for spec in load(tmp_path / "corner.yaml").parameters for key in spec.keys]


def test_steps_by_differences_find_colours_beside_an_unknown_exposure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rendered by the model itself, a photograph of 8 bits gives the colours within 0.03 in a few steps."""
    write_corner(tmp_path, 0.3)
    tiny.done("init", "corner.xml", "--target", "photo.png", "--fit", 0)
    problem = assemble_first_fit(load(tmp_path / "corner.yaml"), SIZE, has_camera=True)
    tries: list[float] = []
    step = ImageFit.step
    monkeypatch.setattr(ImageFit, "step", lambda fit, damping: tries.append(damping) or step(fit, damping))
    problem, is_done = fit_by_differences(problem, problem.config.run.spp, Budget(600, lambda: False))
    assert is_done
    assert len(tries) <= 30, tries
    found = problem.values()
    np.testing.assert_allclose(found[FLOOR], [0.5, 0.3, 0.15], atol=0.03)
    np.testing.assert_allclose(found[WALL], [0.15, 0.3, 0.6], atol=0.03)
    np.testing.assert_allclose(found["exposure"], 0.4, rtol=0.05)


def test_pixels_that_see_a_material(tmp_path: Path) -> None:
    """The film's filter widens each mask. The wall is above the floor."""
    write_corner(tmp_path, 0.3)
    made = mi.load_file("corner.xml")
    bsdfs = {each.id(): each.bsdf() for each in made.shapes()}
    floor, wall, both = (
        sees_materials(made, made.sensors()[0], [bsdfs[name] for name in names])
        for names in (["floor"], ["wall"], ["floor", "wall"])
    )
    assert floor.shape == (SIZE[1], SIZE[0])
    assert floor[-1].all()
    assert not floor[0].any()
    assert wall[0, 8:16].all()
    assert not wall[-1].any()
    np.testing.assert_array_equal(both, floor | wall)


@pytest.mark.long
@pytest.mark.parametrize("is_filmed", [False, True])
def test_rates_of_the_first_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_filmed: bool) -> None:
    """At most 1 of 14 corners with right roughnesses recovers them, and at least 12 of 14 with wrong ones do. At most 1
    of 14 photographs without a film curve recovers a response, and at least 12 of 14 with one do.
    """
    found: dict[bool, list[str]] = {}
    for is_right in (True, False):
        found[is_right] = []
        for seed in range(14):
            (folder := tmp_path / f"{is_right}-{seed}").mkdir()
            monkeypatch.chdir(folder)
            corners.write_corner(folder, 100 + seed, (64, 40), is_right, filmic if is_filmed else None)
            done = tiny.done("init", "corner.xml", "--target", "photo.png", "--fit", 120)
            found[is_right] += [line for line in done.output.splitlines() if line.startswith("first fit")]
    print("\n".join(line for lines in found.values() for line in lines))
    rough = {is_right: sum("alpha" in line for line in lines) for is_right, lines in found.items()}
    assert rough[True] <= 1
    assert rough[False] >= 12
    for lines in found.values():
        filmed = sum("the camera's response" in line and "also recovers" in line for line in lines)
        assert filmed >= 12 if is_filmed else filmed <= 1
