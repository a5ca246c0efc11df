"""Workshop sheet: its figures are compared with closed forms, and its set-ups with the scenes from `lens`."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import done
from lens.test_experiment import picture
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.lens.solid import SCALLOP, cutter, stepover, summary
from reslrb_cli.optimization.loading import load_configured
from reslrb_cli.records.images import luminance, write_file
from reslrb_cli.report.page.layout import lay_out
from reslrb_cli.report.page.workshop import material, setup_facts
from reslrb_cli.runs.export import read_solid
from reslrb_cli.runs.workshop import allowed_errors, setup_of

pytestmark = pytest.mark.usefixtures("compared")


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
    face = {"smallest_concave_radius": 0.2, "steepest_slope_degrees": 9.0, "relief": 4.0, "cutter": found}
    [_, line] = summary({"extent": (9.0, 9.0, 9.0), "volume_mm3": 9.0, "least_thickness": 9.0, "triangles": 9,
                         "faces": {"face": face}, "warnings": []})  # fmt: skip
    assert line.endswith("hollows with radii from 0.2 mm; ball cutter: with a radius up to 10 mm, for 99 % of the face")


def test_an_error_is_allowed_until_ssim_has_fallen_by_a_twentieth() -> None:
    found = {
        "as planned": {"ssim": 0.9}, "distance +2 %": {"ssim": 0.88}, "distance -2 %": {"ssim": 0.8},
        "light turned by 1 degree about x": {"ssim": 0.89},
        "lens turned by 1 degree about y": {"ssim": 0.5},
    }  # fmt: skip
    allowed = allowed_errors(found, "lens", {"turn": 1.0, "index": 0.005, "distance": 4.0})
    assert allowed.keys() == {"distance", "light turned", "solid turned"}
    assert (allowed["distance"]["value"], allowed["distance"]["passes"]) == (pytest.approx(2.0), True)
    assert (allowed["light turned"]["value"], allowed["light turned"]["at_least"]) == (1.0, True)
    assert (allowed["solid turned"]["value"], allowed["solid turned"]["passes"]) == (pytest.approx(0.125), False)


@pytest.mark.parametrize("of_target", [None, 0.42])
def test_the_sheet_tells_the_ssim_that_a_perfect_lens_would_have(of_target: float | None) -> None:
    """An SSIM of 0.41 with a white logo on black says nothing about the lens: the target itself has 0.42."""
    thrown = {"ssim": 0.991, "contrast": 1.0, "target_contrast": 1.0, "inside": 1.0}
    if of_target is not None:
        thrown |= {"ssim_of_picture": 0.414, "ssim_of_target": of_target}
    page = str(lay_out("workshop.quality", {"thrown": thrown}))
    assert "<td>0.991: 1 for equal pictures" in page
    assert ("0.414; the target, with dark parts raised, has 0.42" in page) == (of_target is not None)


SETUPS = {
    "lens": ((), "back", "parallel", False, "the flat back"),
    "lamp": (("--light-distance", 400, "--thickness", 60), "back", 400, False, "a small lamp, 400 mm from the flat"),
    "mirror": (("--mirror", 30), "front", "parallel", False, "30° from the perpendicular"),
    "tilted": (("--tilt", 20, 0), "back", "parallel", False, "tilted by 20°"),
}


@pytest.mark.parametrize("name", a_few(SETUPS, ["lens"]))
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
    assert "PMMA" in material("lens", 1.49)["material"]
    assert "such as" not in material("lens", 2.4)["material"]
    assert "reflect" in material("mirror", None)["finish"]
