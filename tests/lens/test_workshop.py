"""Workshop sheet: its figures are compared with closed forms, and its set-ups with the scenes from `lens`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import done, settings
from lens.test_experiment import picture
from skimage.metrics import structural_similarity
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.lens.solid import SCALLOP, cutter, stepover
from reslrb_cli.optimization.loading import load_configured
from reslrb_cli.records.images import luminance, write_file
from reslrb_cli.report.format import number
from reslrb_cli.report.page.workshop import material, setup_facts
from reslrb_cli.runs import export
from reslrb_cli.runs.export import read_solid
from reslrb_cli.runs.workshop import figures, setup_of, where_light_goes


def test_the_step_of_a_ball_leaves_scallops_of_the_given_height() -> None:
    step = stepover(3.0)
    assert 3.0 - np.sqrt(3.0**2 - (step / 2) ** 2) == pytest.approx(SCALLOP)


def test_the_largest_ball_fits_into_all_hollows_but_the_sharpest_hundredth() -> None:
    curvature = np.concatenate([np.full(995, 0.1), np.full(5, 5.0)])
    found = cutter(curvature)
    assert found["largest_radius"] == pytest.approx(10)
    assert found["stepover"] == pytest.approx(stepover(10.0))
    assert cutter(np.concatenate([curvature, np.full(20, 5.0)]))["largest_radius"] == pytest.approx(0.2)
    assert cutter(np.full(9, -0.1))["largest_radius"] is None


def test_figures_match_a_known_change_of_a_picture() -> None:
    target = np.zeros((48, 48))
    target[8:40, 8:40] = inner = picture(32, 32)
    contrast = inner.std() / inner.mean()
    right = {"ssim": 1, "l1": 0, "inside": 1, "contrast": contrast, "target_contrast": contrast}
    assert figures(3 * target, target) == pytest.approx(right)
    worse = figures(np.roll(target, (2, -3), axis=(0, 1)) + 0.1, target)
    assert worse["ssim"] < 0.9
    assert worse["inside"] < 0.9


# --- where the light goes ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lens(tmp_path_factory: pytest.TempPathFactory, llvm: str) -> Config:
    """Experiment of a lens, as the command writes it."""
    folder = tmp_path_factory.mktemp("workshop")
    write_file(folder / "p.exr", np.repeat(picture(32, 32)[:, :, None], 3, 2).astype(np.float32), linear=True)
    done("lens", folder / "p.exr", "-o", folder / "lens", "--pixels", "32")
    return load(folder / "lens/lens.yaml")


def with_face(lens: Config, heights: Callable[[np.ndarray], np.ndarray]) -> mi.Scene:
    """Return the scene of the lens with heights of the face that are a function of x."""
    scene = load_configured(lens)
    params = mi.traverse(scene)
    points = np.array(params["face.vertex_positions"]).reshape(-1, 3)
    points[:, 2] = heights(points[:, 0])
    params["face.vertex_positions"] = points.astype(np.float32).ravel()
    params.update()
    return scene


def light_of(lens: Config, scene: mi.Scene) -> dict[str, float]:
    target = np.zeros((40, 40))
    target[4:36, 4:36] = 1  # the margin, an eighth of 32 pixels, counts as beside
    assert lens.fabrication is not None
    return where_light_goes(scene, scene.sensors()[0], lens.fabrication, target)


def test_light_is_classified_by_its_destination(lens: Config) -> None:
    """In a flat lens, about one tenth of the width at either side deflects light. The deflected light of one side lands
    beside the picture, and that of the other side off the film.
    """
    assert light_of(lens, with_face(lens, np.zeros_like)) == {"inside": 1, "beside": 0, "beyond": 0}
    wide = 100 / 95  # ten of the 95 columns of triangles form a wedge
    near, far = (np.tan(np.arctan(aside / 200) / 0.49) for aside in (8.0, 30.0))

    def wedges(x: np.ndarray) -> np.ndarray:
        return np.maximum(x - (50 - 10 * wide), 0) * near + np.maximum(-x - (50 - 10 * wide), 0) * far

    found = light_of(lens, with_face(lens, wedges))
    assert sum(found.values()) == pytest.approx(1)
    assert found["beside"] == pytest.approx(8 / 100, abs=3e-3)
    assert found["beyond"] == pytest.approx(10 * wide / 100, abs=3e-3)


@pytest.mark.long
def test_shares_match_a_film_that_sees_the_whole_receiver(lens: Config) -> None:
    """The reference is Mitsuba's light tracer with as many reflections. The receiver is so dark that no light returns
    from it.
    """
    scene = with_face(lens, lambda x: 0.3 * np.sin(x / 3))
    params = mi.traverse(scene)
    params["screen.bsdf.reflectance.value"] = mi.Color3f(1e-3)
    params.update()
    found = light_of(lens, scene)
    assert found["beside"] > 0.01
    whole = mi.traverse(scene.sensors()[0])
    half = 3 * 32 / 40 * np.tan(np.radians(float(np.ravel(whole["x_fov"])[0]) / 2))
    film = {"type": "hdrfilm", "width": 96, "height": 96, "rfilter": {"type": "box"}}
    camera = mi.load_dict({
        "type": "perspective", "fov": float(np.degrees(2 * np.arctan(half))), "film": film, "near_clip": 1.0,
        "to_world": mi.ScalarTransform4f(np.array(scene.sensors()[0].world_transform().matrix).reshape(4, 4)),
    })  # fmt: skip
    tracer = mi.load_dict({"type": "ptracer", "max_depth": 9})
    image = luminance(np.array(mi.render(scene, sensor=camera, integrator=tracer, spp=256)))
    assert image[32:64, 32:64].sum() / image.sum() == pytest.approx(found["inside"], abs=2e-3)
    film_share = image[28:68, 28:68].sum() / image.sum()
    assert film_share == pytest.approx(found["inside"] + found["beside"], abs=2e-3)


@pytest.mark.long
def test_the_page_of_a_run_has_the_figures_for_the_maker(
    tmp_path: Path, llvm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page has the figures at the end of the run. `export` measures the same figures."""
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
    read, render, called = export.read_photo, mi.render, []
    monkeypatch.setattr(export, "read_photo", lambda file: (called.append(file), read(file))[1])
    monkeypatch.setattr(mi, "render", lambda *given, **how: (called.append("image"), render(*given, **how))[1])
    result = done("export", run, "-o", tmp_path / "made", *settings("run.final_spp=8"))
    light = json.loads((tmp_path / "made/fabrication.json").read_text())["light"]
    assert f"of the light that leaves it, {100 * light['inside']:.4g} % falls in the picture" in result.output
    images = 1 + len(export.DIRECTIONS)  # views of the solid
    assert called == [tmp_path / "l/target.exr", *["image"] * images]  # nothing is read or rendered twice
    assert json.loads((run / "fabrication.json").read_text()) == numbers  # the run is left as it was


# --- the set-up -------------------------------------------------------------------------------------------------------

SETUPS = {
    "lens": ((), "back", "parallel", False, "the flat back"),
    "lamp": (("--light-distance", 400, "--thickness", 60), "back", 400, False, "a small lamp, 400 mm from the flat"),
    "mirror": (("--mirror", 30), "front", "parallel", False, "30° from the perpendicular"),
    "tilted": (("--tilt", 20, 0), "back", "parallel", False, "tilted by 20°"),
}


@pytest.mark.parametrize("name", a_few(SETUPS, ["lens", "mirror"]))
def test_a_set_up_matches_the_options_of_the_command(name: str, tmp_path: Path, llvm: str) -> None:
    options, side, light, through, words = SETUPS[name]
    write_file(tmp_path / "p.exr", np.repeat(picture(24, 16)[:, :, None], 3, 2).astype(np.float32), linear=True)
    done("lens", tmp_path / "p.exr", "--pixels", 24, "--distance", 300, "--size", 60, "-o", tmp_path / "l", *options)
    config = load(tmp_path / "l/lens.yaml")
    assert config.fabrication is not None
    scene = load_configured(config)
    sheet, _ = read_solid(config, config.fabrication, mi.traverse(scene))
    target = luminance(np.array(mi.Bitmap(str(tmp_path / "l/target.exr")))[:, :, :3])
    setup = setup_of(scene, scene.sensors()[0], config.fabrication, sheet, target)
    assert setup is not None
    far = setup["light_distance"]
    assert (setup["lit_side"], far if light == "parallel" else round(far), setup["through"]) == (side, light, through)
    assert setup["receiver_distance"] == pytest.approx(300, rel=1e-3)
    assert setup["picture_size"] == pytest.approx([40, 60], rel=2e-3)
    assert words in " ".join(setup_facts(setup).values())
    assert setup["picture_up"][1] > 0.9


def test_a_material_is_named_by_its_index() -> None:
    assert "acrylic" in material("lens", 1.49)["material"]
    assert "such as" not in material("lens", 2.4)["material"]
    assert "reflect" in material("mirror", None)["finish"]
