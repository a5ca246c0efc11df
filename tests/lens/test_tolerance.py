"""Tolerances: displaced parts match a scene file with the same displacement, and are put back afterwards."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import done, reslrb, settings
from lens.test_experiment import picture
from skimage.metrics import structural_similarity

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.records.images import luminance, write_file
from reslrb_cli.report.format import number
from reslrb_cli.runs import export, workshop
from reslrb_cli.runs.workshop import OpticalBench, figures, shift_between, where_light_goes

PTRACER = {"type": "ptracer", "max_depth": 4}
FLAT = Fabrication(thickness=25.0)


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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, llvm: str) -> Path:
    """Folder with a lens at its start, a run of one iteration, and an export of this run with tolerances."""
    folder = tmp_path_factory.mktemp("tolerance")
    write_file(folder / "p.exr", np.repeat(picture(32, 32)[:, :, None], 3, 2).astype(np.float32), linear=True)
    done("lens", folder / "p.exr", "-o", folder / "lens", "--pixels", "32")
    done("optimize", folder / "lens/lens.yaml", "--set", f"run.output={folder}/runs", "--set", "run.iterations=1",
         "--set", "run.spp=4", "--set", "run.final_spp=24", "--set", "run.certainty=false")  # fmt: skip
    said = done("export", folder / "runs/lens", "-o", folder / "out", "--tolerances").output
    (folder / "said.txt").write_text(said)
    return folder


def bench(folder: Path) -> OpticalBench:
    scene = mi.load_file(str(folder / "out/scene.xml"), optimize=False)
    return OpticalBench(scene, mi.traverse(scene), FLAT, mi.load_dict(PTRACER), 0)


def in_file(folder: Path, id: str, before: str) -> mi.Scene:
    """Return the exported scene with one more transform for the shape or sensor `id`. The transform is added at the end
    of its `to_world`.
    """
    text = (folder / "out/scene.xml").read_text()
    place = re.search(rf'id="{id}">.*?</transform>', text, re.DOTALL)
    assert place is not None
    end = place.end() - len("</transform>")
    (folder / "out/moved.xml").write_text(text[:end] + before + text[end:])
    return mi.load_file(str(folder / "out/moved.xml"), optimize=False)


def with_face(folder: Path, heights: Callable[[np.ndarray], np.ndarray]) -> OpticalBench:
    """Return the exported lens with heights of the face that are a function of x."""
    made = bench(folder)
    points = np.array(made.params["face.vertex_positions"]).reshape(-1, 3)
    points[:, 2] = heights(points[:, 0])
    made.params["face.vertex_positions"] = points.astype(np.float32).ravel()
    made.params.update()
    return made


def light_of(made: OpticalBench) -> dict[str, float]:
    target = np.zeros((40, 40))
    target[4:36, 4:36] = 1  # the margin, an eighth of 32 pixels, counts as beside
    return where_light_goes(made.scene, made.scene.sensors()[0], made.plan, target)


def test_light_is_classified_by_its_destination(folder: Path) -> None:
    """In a flat lens, about one tenth of the width at either side deflects light. The deflected light of one side lands
    beside the picture, and that of the other side off the film.
    """
    assert light_of(with_face(folder, np.zeros_like)) == {"inside": 1, "beside": 0, "beyond": 0}
    wide = 100 / 95  # ten of the 95 columns of triangles form a wedge
    near, far = (np.tan(np.arctan(aside / 200) / 0.49) for aside in (8.0, 30.0))

    def wedges(x: np.ndarray) -> np.ndarray:
        return np.maximum(x - (50 - 10 * wide), 0) * near + np.maximum(-x - (50 - 10 * wide), 0) * far

    found = light_of(with_face(folder, wedges))
    assert sum(found.values()) == pytest.approx(1)
    assert found["beside"] == pytest.approx(8 / 100, abs=3e-3)
    assert found["beyond"] == pytest.approx(10 * wide / 100, abs=3e-3)


@pytest.mark.long
def test_shares_match_a_film_that_sees_the_whole_receiver(folder: Path) -> None:
    """The reference is Mitsuba's light tracer with as many reflections. The receiver is so dark that no light returns
    from it.
    """
    made = with_face(folder, lambda x: 0.3 * np.sin(x / 3))
    made.params["screen.bsdf.reflectance.value"] = mi.Color3f(1e-3)
    made.params.update()
    found = light_of(made)
    assert found["beside"] > 0.01
    whole = mi.traverse(made.scene.sensors()[0])
    half = 3 * 32 / 40 * np.tan(np.radians(float(np.ravel(whole["x_fov"])[0]) / 2))
    film = {"type": "hdrfilm", "width": 96, "height": 96, "rfilter": {"type": "box"}}
    camera = mi.load_dict({
        "type": "perspective", "fov": float(np.degrees(2 * np.arctan(half))), "film": film, "near_clip": 1.0,
        "to_world": mi.ScalarTransform4f(np.array(made.scene.sensors()[0].world_transform().matrix).reshape(4, 4)),
    })  # fmt: skip
    tracer = mi.load_dict({"type": "ptracer", "max_depth": 9})
    image = luminance(np.array(mi.render(made.scene, sensor=camera, integrator=tracer, spp=256)))
    assert image[32:64, 32:64].sum() / image.sum() == pytest.approx(found["inside"], abs=2e-3)
    film_share = image[28:68, 28:68].sum() / image.sum()
    assert film_share == pytest.approx(found["inside"] + found["beside"], abs=2e-3)


@pytest.mark.parametrize("name", ["lamp", "screen", "index"])
def test_a_displaced_part_matches_a_scene_of_its_own(name: str, folder: Path) -> None:
    made = bench(folder)
    planned = made.render(16)
    if name == "lamp":
        values = made.turned(["lamp"], (0, 1, 0), 1.0)
        other = in_file(folder, "lamp", '<rotate y="1" angle="1"/>')
    elif name == "screen":
        values = made.farther(0.02)
        in_file(folder, "screen", '<translate z="4"/>')
        text = (folder / "out/moved.xml").read_text()
        (folder / "out/scene2.xml").write_text(text)
        place = re.search(r'id="camera">.*?</transform>', text, re.DOTALL)
        assert place is not None
        end = place.end() - len("</transform>")
        (folder / "out/moved.xml").write_text(text[:end] + '<translate z="4"/>' + text[end:])
        other = mi.load_file(str(folder / "out/moved.xml"), optimize=False)
    else:
        values = made.denser(0.005)
        text = (folder / "out/scene.xml").read_text()
        assert 'value="1.49"' in text
        (folder / "out/moved.xml").write_text(text.replace('value="1.49"', 'value="1.495"'))
        other = mi.load_file(str(folder / "out/moved.xml"), optimize=False)
    seen = made.image(values, 16)
    wanted = OpticalBench(other, mi.traverse(other), FLAT, mi.load_dict(PTRACER), 0).render(16)
    assert np.abs(seen - wanted).mean() < 3e-4 * wanted.mean()  # the same light paths
    assert np.abs(seen - planned).mean() > 4e-3 * wanted.mean()
    assert np.array_equal(made.render(16), planned)  # the original state is restored


def test_a_lens_rotates_with_both_faces_about_the_middle_of_its_front(folder: Path) -> None:
    made = bench(folder)
    points = np.array(made.params["face.vertex_positions"]).reshape(-1, 3)
    values = made.turned(made.solid_parts(), (0, 1, 0), 1.0)
    assert set(values) == {"face.vertex_positions", "back.to_world"}
    turned = np.array(values["face.vertex_positions"]).reshape(-1, 3)
    assert np.linalg.norm(turned, axis=1) == pytest.approx(np.linalg.norm(points, axis=1), abs=1e-4)
    corner = np.argmax(points[:, 0])
    assert turned[corner, 2] - points[corner, 2] == pytest.approx(-np.sin(np.radians(1)) * points[corner, 0], abs=0.01)


@pytest.mark.long
def test_a_wide_light_is_the_mean_of_rotated_ones(folder: Path) -> None:
    made, angles = bench(folder), []
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


def test_the_command_reports_all_figures(folder: Path) -> None:
    told = json.loads((folder / "out/fabrication.json").read_text())["tolerances"]
    assert list(told) == [
        "as planned", "light of 0.53 degrees", "distance +2 %", "distance -2 %", "index +0.005", "index -0.005",
        "light turned by 1 degree about x", "light turned by 1 degree about y", "lens turned by 1 degree about x",
        "lens turned by 1 degree about y",
    ]  # fmt: skip
    said = (folder / "said.txt").read_text()
    light = json.loads((folder / "out/fabrication.json").read_text())["light"]
    assert f"of the light that leaves it, {100 * light['inside']:.4g} % falls in the picture" in said
    assert all(f"{name}: SSIM {entry['ssim']:.3f}, " in said for name, entry in told.items())
    # Turned light shifts the image by the distance times the angle. The distance is 200 mm, and a pixel has 100 / 32
    # mm.
    for axis in "xy":
        shift = told[f"light turned by {workshop.TURN:g} degree about {axis}"]["shift"]
        assert np.hypot(*shift) == pytest.approx(200 * np.tan(np.radians(1)) / (100 / 32), abs=0.15)
    bare = ("--set", "fabrication=null")
    result = reslrb("export", folder / "runs/lens", "-o", folder / "bare", "--tolerances", *bare)
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
        4, 3, 2,
    ]  # fmt: skip
    assert f"<td>{number(thrown['ssim_of_picture'], 3)} with the original picture" in page
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
