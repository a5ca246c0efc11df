"""Tolerances: displaced parts match a scene file with the same displacement, and are put back afterwards."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import done, reslrb, settings
from golden import said
from lens.test_experiment import picture
from skimage.metrics import structural_similarity

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.glasses import find_glass
from reslrb_cli.records.images import luminance, write_file
from reslrb_cli.report.format import number
from reslrb_cli.runs import export, workshop
from reslrb_cli.runs.workshop import OpticalBench, figures, shift_between, tolerances, where_light_goes

PTRACER = {"type": "ptracer", "max_depth": 4}
FLAT = Fabrication(thickness=25.0, ior="PMMA")


def test_a_point_light_says_what_is_left_out() -> None:
    """Only lamps with a surface can be wider or rotated."""
    image = np.pad(np.random.default_rng(0).uniform(0.5, 1, (16, 16)), 4)
    plan = SimpleNamespace(sun=0.53, kind="mirror", glass=None)
    for lamps, count in (([], 1), (["lamp"], 0)):
        bench: Any = SimpleNamespace(
            lamps=lamps, plan=plan, solid_parts=list, farther=lambda part: {}, turned=lambda *_: {},
            image=lambda *_: image, sun=lambda spp: image,
        )  # fmt: skip
        said: list[str] = []
        tolerances(bench, image, image, 1, said.append)
        assert sum("point light: its width (fabrication.sun)" in line for line in said) == count


def test_shift_and_figures_match_a_known_change_of_a_picture() -> None:
    target = np.zeros((48, 48))
    target[8:40, 8:40] = picture(32, 32)
    moved = np.roll(target, (2, -3), axis=(0, 1))
    assert shift_between(moved, target) == pytest.approx([2, -3], abs=0.11)
    inner = picture(32, 32)
    contrast = inner.std() / inner.mean()
    right = {"ssim": 1, "l1": 0, "inside": 1, "contrast": contrast, "target_contrast": contrast}
    assert figures(3 * target, target) == pytest.approx(right)
    worse = figures(moved + 0.1, target)
    assert worse["ssim"] < 0.9
    assert worse["inside"] < 0.9


def bench(lens: Path) -> OpticalBench:
    scene = mi.load_file(str(lens / "out/scene.xml"), optimize=False)
    return OpticalBench(scene, mi.traverse(scene), FLAT, mi.load_dict(PTRACER), 0)


def in_file(lens: Path, id: str, before: str) -> mi.Scene:
    """Return the exported scene with one more transform for the shape or sensor `id`. The transform is added at the end
    of its `to_world`.
    """
    text = (lens / "out/scene.xml").read_text()
    place = re.search(rf'id="{id}">.*?</transform>', text, re.DOTALL)
    assert place is not None
    end = place.end() - len("</transform>")
    (lens / "moved/moved.xml").write_text(text[:end] + before + text[end:])
    return mi.load_file(str(lens / "moved/moved.xml"), optimize=False)


def with_face(lens: Path, heights: Callable[[np.ndarray], np.ndarray]) -> OpticalBench:
    """Return the exported lens with heights of the face that are a function of x."""
    made = bench(lens)
    points = np.array(made.params["face.vertex_positions"]).reshape(-1, 3)
    points[:, 2] = heights(points[:, 0])
    made.params["face.vertex_positions"] = points.astype(np.float32).ravel()
    made.params.update()
    return made


def light_of(made: OpticalBench) -> dict[str, float]:
    target = np.zeros((40, 32))
    target[4:36, 4:28] = 1  # the margin, an eighth of 32 pixels, counts as beside
    return where_light_goes(made.scene, made.scene.sensors()[0], made.plan, target)


def test_light_is_classified_by_its_destination(lens: Path) -> None:
    """In a flat lens, about one seventh of the width at either side deflects light. The deflected light of one side
    lands beside the picture, and that of the other side off the film.
    """
    assert light_of(with_face(lens, np.zeros_like)) == {"inside": 1, "beside": 0, "beyond": 0}
    wide = 75 / 71  # ten of the 71 columns of triangles form a wedge
    near, far = (np.tan(np.arctan(aside / 200) / 0.49) for aside in (8.0, 30.0))

    def wedges(x: np.ndarray) -> np.ndarray:
        return np.maximum(x - (37.5 - 10 * wide), 0) * near + np.maximum(-x - (37.5 - 10 * wide), 0) * far

    found = light_of(with_face(lens, wedges))
    assert sum(found.values()) == pytest.approx(1)
    assert found["beside"] == pytest.approx(8 / 75, abs=3e-3)
    assert found["beyond"] == pytest.approx(10 * wide / 75, abs=3e-3)


@pytest.mark.parametrize(("bounces", "whole"), [(2, 0), (3, 1)])
def test_light_that_has_not_ended_does_not_count(
    lens: Path, monkeypatch: pytest.MonkeyPatch, bounces: int, whole: int
) -> None:
    """Rays meet the back, the face and then the receiver, where they end."""
    monkeypatch.setattr(workshop, "BOUNCES", bounces)
    assert sum(light_of(with_face(lens, np.zeros_like)).values()) == pytest.approx(whole)


@pytest.mark.long
def test_shares_match_a_film_that_sees_the_whole_receiver(lens: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference is Mitsuba's light tracer with as many reflections. The receiver is so dark that no light returns
    from it.
    """
    monkeypatch.setattr(workshop, "SHARE_RAYS", 2**20)  # the error of a share is a quarter of a thousandth
    made = with_face(lens, lambda x: 0.3 * np.sin(x / 3))
    made.params["screen.bsdf.reflectance.value"] = mi.Color3f(1e-3)
    made.params.update()
    found = light_of(made)
    assert found["beside"] > 0.01
    whole = mi.traverse(made.scene.sensors()[0])
    half = 3 * 24 / 32 * np.tan(np.radians(float(np.ravel(whole["x_fov"])[0]) / 2))
    film = {"type": "hdrfilm", "width": 72, "height": 96, "rfilter": {"type": "box"}}
    camera = mi.load_dict({
        "type": "perspective", "fov": float(np.degrees(2 * np.arctan(half))), "film": film, "near_clip": 1.0,
        "to_world": mi.ScalarTransform4f(np.array(made.scene.sensors()[0].world_transform().matrix).reshape(4, 4)),
    })  # fmt: skip
    tracer = mi.load_dict({"type": "ptracer", "max_depth": 9})
    image = luminance(np.array(mi.render(made.scene, sensor=camera, integrator=tracer, spp=256)))
    assert image[32:64, 24:48].sum() / image.sum() == pytest.approx(found["inside"], abs=2e-3)
    film_share = image[28:68, 20:52].sum() / image.sum()
    assert film_share == pytest.approx(found["inside"] + found["beside"], abs=2e-3)


@pytest.mark.parametrize("name", ["lamp", "screen", "index"])
def test_a_displaced_part_matches_a_scene_of_its_own(name: str, lens: Path) -> None:
    made = bench(lens)
    planned = made.render(16)
    if name == "lamp":
        values = made.turned(["lamp"], (0, 1, 0), 1.0)
        other = in_file(lens, "lamp", '<rotate y="1" angle="1"/>')
    elif name == "screen":
        values = made.farther(0.02)
        in_file(lens, "screen", '<translate z="4"/>')
        text = (lens / "moved/moved.xml").read_text()
        place = re.search(r'id="camera">.*?</transform>', text, re.DOTALL)
        assert place is not None
        end = place.end() - len("</transform>")
        (lens / "moved/moved.xml").write_text(text[:end] + '<translate z="4"/>' + text[end:])
        other = mi.load_file(str(lens / "moved/moved.xml"), optimize=False)
    else:
        values = made.denser(0.005)
        text = (lens / "out/scene.xml").read_text()
        index = find_glass("PMMA").nd
        assert f'value="{index:.9g}"' in text
        (lens / "moved/moved.xml").write_text(text.replace(f"{index:.9g}", f"{index + 0.005:.9g}"))
        other = mi.load_file(str(lens / "moved/moved.xml"), optimize=False)
    seen = made.image(values, 16)
    wanted = OpticalBench(other, mi.traverse(other), FLAT, mi.load_dict(PTRACER), 0).render(16)
    assert np.abs(seen - wanted).mean() < 3e-4 * wanted.mean()  # the same light paths
    assert np.abs(seen - planned).mean() > 4e-3 * wanted.mean()
    assert np.array_equal(made.render(16), planned)  # the original state is restored


def test_colours_spread_as_snells_law_says(lens: Path) -> None:
    """Light meets the flat back of a wedge at a right angle. Its direction behind the face depends on the index."""
    tilt, glass = np.arctan(0.2), find_glass("PMMA")
    made = with_face(lens, lambda x: 0.2 * x)
    to = [200 * np.tan(np.arcsin(n * np.sin(tilt)) - tilt) for n in (glass.index(486.1327), glass.index(656.2725))]
    assert 0.2 < to[0] - to[1] < 0.5
    assert made.spread(glass) == pytest.approx(to[0] - to[1], rel=0.01)
    assert float(np.ravel(made.params["glass.eta"])[0]) == pytest.approx(glass.nd)  # restored


def test_a_lens_rotates_with_both_faces_about_the_middle_of_its_front(lens: Path) -> None:
    made = bench(lens)
    points = np.array(made.params["face.vertex_positions"]).reshape(-1, 3)
    values = made.turned(made.solid_parts(), (0, 1, 0), 1.0)
    assert set(values) == {"face.vertex_positions", "back.to_world"}
    turned = np.array(values["face.vertex_positions"]).reshape(-1, 3)
    assert np.linalg.norm(turned, axis=1) == pytest.approx(np.linalg.norm(points, axis=1), abs=1e-4)
    corner = np.argmax(points[:, 0])
    assert turned[corner, 2] - points[corner, 2] == pytest.approx(-np.sin(np.radians(1)) * points[corner, 0], abs=0.01)


@pytest.mark.long
def test_a_wide_light_is_the_mean_of_rotated_ones(lens: Path) -> None:
    made, angles = bench(lens), []
    turned = made.turned
    made.turned = lambda ids, axis, degrees: (angles.append((axis, degrees)), turned(ids, axis, degrees))[1]  # type: ignore
    made.plan = Fabrication(thickness=25.0, sun=4.0)
    wide, planned = made.sun(56), made.render(56)
    assert all(np.linalg.norm(axis) == pytest.approx(1) for axis, _ in angles)
    # In a disc of radius R, the mean squared distance from the centre is R^2 / 2.
    assert sum(degrees**2 for _, degrees in angles) / (len(angles) + 1) == pytest.approx(2.0**2 / 2)
    assert sum(np.array(axis) * degrees for axis, degrees in angles) == pytest.approx(0, abs=1e-9)
    assert wide.std() < planned.std()  # blurred
    # The noise is as low as this number of samples allows: a sun of no width has about the noise of an ordinary image.
    made.plan = Fabrication(thickness=25.0, sun=1e-6)
    exact = made.render(512, seed=99)
    noise = [float(np.mean((image - exact) ** 2)) for image in (made.sun(56), planned)]
    assert noise[0] < 2.5 * noise[1]  # with equal seeds it is about seven times as large
    assert wide.sum() == pytest.approx(planned.sum(), rel=0.05)


def test_the_command_reports_all_figures(lens: Path) -> None:
    assert json.loads((lens / "runs/lens/manifest.json").read_text())["results"]["is_design"] is True
    told = json.loads((lens / "out/fabrication.json").read_text())["tolerances"]
    assert list(told) == [
        "as planned", "light of 0.53 degrees", "distance +2 %", "distance -2 %", "index +0.005", "index -0.005",
        "blue light (486 nm)", "red light (656 nm)",
        "light turned by 1 degree about x", "light turned by 1 degree about y", "lens turned by 1 degree about x",
        "lens turned by 1 degree about y",
    ]  # fmt: skip
    said = (lens / "said.txt").read_text()
    spread = json.loads((lens / "out/fabrication.json").read_text())["colour_spread"]
    assert f"colour: blue and red light land {spread:.2g} mm apart on average" in said
    light = json.loads((lens / "out/fabrication.json").read_text())["light"]
    assert f"of the light that leaves it, {100 * light['inside']:.4g} % falls in the picture" in said
    assert all(f"{name}: SSIM {entry['ssim']:.3f}, " in said for name, entry in told.items())
    # Turned light shifts the image by the distance times the angle. The distance is 200 mm, and a pixel has 100 / 32
    # mm.
    for axis in "xy":
        shift = told[f"light turned by {workshop.TURN:g} degree about {axis}"]["shift"]
        assert np.hypot(*shift) == pytest.approx(200 * np.tan(np.radians(1)) / (100 / 32), abs=0.15)
    bare = ("--set", "fabrication=null")
    result = reslrb("export", lens / "runs/lens", "-o", lens / "bare", "--tolerances", *bare)
    assert "needs a configuration with a section `fabrication`" in f"{result.output}{result.exception}"


@pytest.mark.long
def test_the_page_of_a_run_has_the_figures_for_the_maker(
    tmp_path: Path, llvm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page has the figures at the end of the run. The sheet of `export --tolerances` adds further figures."""
    tones = np.kron(np.random.default_rng(2).uniform(0, 1, (4, 4)), np.ones((4, 4)))
    write_file(tmp_path / "p.exr", np.repeat(tones[:, :, None], 3, 2).astype(np.float32), linear=True)
    done("lens", tmp_path / "p.exr", "--pixels", 16, "--floor", 0.2, "-o", tmp_path / "l")
    small = settings("run.iterations=2", "run.spp=8", "run.final_spp=32", "run.measuring=1000")
    done("optimize", tmp_path / "l/lens.yaml", *small, *settings(f"run.output={tmp_path}"))
    run = tmp_path / "lens"
    numbers = json.loads((run / "fabrication.json").read_text())
    final, target = (np.array(mi.Bitmap(str(run / f"images/{name}.exr")))[:, :, :3] for name in ("final", "target"))
    weights = np.array([0.212671, 0.715160, 0.072169])
    inside = slice(2, 18), slice(2, 18)  # each margin has 2 pixels, an eighth of 16
    seen, wanted = (image @ weights for image in (final, target))
    divided = [image[inside] / image[inside].mean() for image in (seen, wanted)]
    thrown = numbers["thrown"]
    assert thrown["ssim"] == pytest.approx(structural_similarity(*divided, data_range=divided[1].max()), abs=1e-6)
    assert thrown["inside"] == pytest.approx(seen[inside].sum() / seen.sum(), rel=1e-6)
    assert thrown["contrast"] == pytest.approx(divided[0].std(), rel=1e-6)
    picture = tones / tones.mean()  # original picture, darker than the floor
    with_it = structural_similarity(divided[0], picture, data_range=picture.max())
    assert thrown["ssim_of_picture"] == pytest.approx(with_it, abs=1e-5)
    assert abs(thrown["ssim_of_picture"] - thrown["ssim"]) > 1e-3
    assert sum(numbers["light"].values()) == pytest.approx(1)
    assert numbers["light"]["inside"] == pytest.approx(thrown["inside"], abs=0.05)
    assert numbers["volume_mm3"] == pytest.approx(2.5e5, rel=0.5)
    page = (run / "report.html").read_text()
    assert "<h2>Fabrication</h2>" in page
    assert f"{100 * numbers['light']['inside']:.4g} % of the light that leaves the face" in page
    assert [page.count(words) for words in ("the lens, seen from", "the original picture", "the caustic, as")] == [
        4, 2, 2,
    ]  # fmt: skip
    with_target = structural_similarity(divided[1], picture, data_range=picture.max())
    assert thrown["ssim_of_target"] == pytest.approx(with_target, abs=1e-5)
    assert f"<td>{number(thrown['ssim'], 3)}: 1 for equal pictures" in page
    shown = [number(thrown[f"ssim_of_{name}"], 3) for name in ("picture", "target")]
    assert f"<td>{shown[0]}; the target, with dark parts raised, has {shown[1]}" in page
    setup = numbers["setup"]
    assert (setup["lit_side"], setup["light_distance"], setup["through"]) == ("back", "parallel", False)
    assert setup["receiver_distance"] == pytest.approx(200, rel=1e-4)
    assert setup["picture_size"] == pytest.approx([100, 100], rel=1e-3)
    assert "the flat back" in page
    assert "200 mm from the middle of the relief, perpendicular" in page
    assert "mean |image − target|" not in page
    read, render, called = export.read_photo, mi.render, []
    monkeypatch.setattr(export, "read_photo", lambda file: (called.append(file), read(file))[1])
    monkeypatch.setattr(mi, "render", lambda *given, **how: (called.append("image"), render(*given, **how))[1])
    result = done("export", run, "-o", tmp_path / "made", "--tolerances", *settings("run.final_spp=8"))
    assert "distance +2 %: SSIM" in result.output
    found = json.loads((tmp_path / "made/fabrication.json").read_text())
    off, allowed = found["tolerances"], found["allowed_errors"]
    assert allowed.keys() == {"distance", "light turned", "solid turned", "index"}
    assert off.keys() >= {"as planned", "distance +2 %", "index -0.005"}
    images = len(off) - 1 + len(workshop._DIRECTIONS)  # a wide light averages these directions
    images += len(export.DIRECTIONS)  # views of the solid
    assert called == [tmp_path / "l/target.exr", *["image"] * images]  # nothing is read or rendered twice
    assert json.loads((run / "fabrication.json").read_text()) == numbers  # the run is left as it was
    text = (tmp_path / "made/sheet.html").read_text()
    assert "distance +2 %: SSIM" in text
    assert f"±{number(allowed['distance']['value'], 2)} mm" in text


def test_everything_that_a_lens_writes(lens: Path) -> None:
    """The experiment, the solid in the run folder, and the export with tolerances."""
    for part in ("lens", "runs/lens/fabrication.json", "runs/lens/images", "out"):
        place = lens / part
        files = sorted(place.rglob("*")) if place.is_dir() else [place]
        found = {str(file.relative_to(lens)): said.content(file, lens) for file in files if file.is_file()}
        said.check(f"lens: {part}", found)
    said.check("lens: output", said.masked((lens / "said.txt").read_text().splitlines(), lens))
