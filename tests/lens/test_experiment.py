"""Output of `reslrb lens`: the scene casts the picture upright, with the brightness of the target."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import done
from click.testing import CliRunner
from PIL import Image
from skimage.metrics import structural_similarity
from turns import a_few

from reslrb_cli.cli.lens import command, read_luminance, show_stages
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.lens import transport
from reslrb_cli.lens.experiment import lamps
from reslrb_cli.lens.surface import Setting, Surface
from reslrb_cli.optimization.loading import load_configured
from reslrb_cli.records.images import write_file
from reslrb_cli.scene.images import read_image

pytestmark = pytest.mark.usefixtures("compared")

OPTIONS = {
    "lens": [],
    "mirror": ["--mirror", "30"],
    "portrait": [],
    "round": ["--outline", "round"],
    "tilt": ["--tilt", "10", "20"],
    "point": ["--light-distance", "300", "--thickness", "50"],
    "round_point": ["--light-distance", "300", "--thickness", "50", "--outline", "round"],
    "sun": ["--sun", "0.53"],
    "mirror_point": ["--mirror", "30", "--light-distance", "300"],
    "mirror_tilt": ["--mirror", "30", "--tilt", "0", "15"],
}


def picture(rows: int, columns: int) -> np.ndarray:
    """Return a picture that no rotation and no reflection maps to itself. It has a bright blob in the upper left and a
    weaker blob on the right.
    """
    y, x = np.mgrid[:rows, :columns] / np.array([rows, columns])[:, None, None]
    blob = np.exp(-((x - 0.25) ** 2 + (y - 0.2) ** 2) / 0.02) + 0.5 * np.exp(-((x - 0.8) ** 2 + (y - 0.4) ** 2) / 0.02)
    return 0.3 + 0.7 * blob


def flattened(heights: np.ndarray, folder: Path) -> mi.Scene:
    """Return the scene in `folder` with `heights` (ny, nx) as the heights of its face."""
    scene = mi.load_file(str(folder / "scene.xml"), optimize=False)
    params = mi.traverse(scene)
    at = np.array(params["face.vertex_positions"]).reshape(-1, 3)
    at[:, 2] = heights.ravel()
    params["face.vertex_positions"] = at.ravel()
    params.update()
    return scene


def drawn(shape: str, side: int) -> np.ndarray:
    """Return a picture (side, side) of 0 and 255."""
    at = np.arange(side)
    disc = np.hypot(*np.meshgrid(at - side / 2, at - side / 2)) < 0.4 * side
    shapes = {"logo": ~disc, "inverse": disc, "line": at[:, None] != at, "pixel": np.outer(at == side // 3, at == 9)}
    return (255 * shapes[shape]).astype(np.uint8)


@pytest.mark.parametrize(
    ("shape", "side", "mode", "pixels"),
    [
        pytest.param("logo", 400, "L", 128, marks=pytest.mark.long),
        pytest.param("inverse", 500, "P", 33, marks=pytest.mark.long),
        ("pixel", 150, "L", 50),
        ("logo", 16, "I;16", 32),
        ("inverse", 90, "light", 32),
    ],
)
def test_a_black_and_white_picture_becomes_a_lens(
    shape: str, side: int, mode: str, pixels: int, tmp_path: Path, llvm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = drawn(shape, side)
    if mode in ("ink", "light"):  # opaque black or opaque white on a transparent ground
        alpha, colour = (255 - values, 0) if mode == "ink" else (values, 255)
        image = Image.fromarray(np.stack([np.full_like(values, colour), alpha], axis=-1))
    else:
        image = Image.fromarray(values.astype(np.uint16) * 257 if mode == "I;16" else values)
        image = image if mode == "I;16" else image.convert(mode)
    image.save(tmp_path / "p.png")
    light = read_luminance(tmp_path / "p.png")
    assert light == pytest.approx(values / 255, abs=1e-6)
    monkeypatch.setattr(transport, "STEPS", 0)  # tests below check the face itself
    monkeypatch.setattr(transport, "GOOD", np.inf)
    done("lens", tmp_path / "p.png", "-o", tmp_path / "lens", "--pixels", pixels, "--floor", 0.3)
    seen = read_image(tmp_path / "lens" / "picture.exr")[:, :, 0]
    margin = (seen.shape[0] - min(side, pixels)) // 2
    assert seen[margin:-margin, margin:-margin].mean() == pytest.approx(1, rel=1e-5)
    assert seen.min() == 0


def test_the_bar_of_the_stages_begins_at_0_and_stays_within_100_percent(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", terminal)
    with show_stages(3) as tell:
        for stage in range(6):
            tell(f"stage {stage}")
    shares = [int(share) for share in re.findall(r"(\d+)%\|.*?stage", terminal.getvalue())]
    assert shares == [0, 33, 67, 100, 100, 100]


def test_long_stages_are_lines_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, clock = io.StringIO(), iter([100.0, 104.0, 106.0, 106.0, 108.0])
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("reslrb_cli.cli.lens.time", SimpleNamespace(monotonic=lambda: next(clock)))
    with show_stages(3) as tell:
        for stage in ("floor", "grid", "solid"):
            tell(stage)
    assert stream.getvalue() == "grid ...\n"


def test_transparent_parts_of_a_picture_of_floats_are_white(tmp_path: Path) -> None:
    """Files of floats store colours that are multiplied by alpha."""
    alpha = np.array([[0.0, 0.5], [0.75, 1.0]], np.float32)
    pixels = np.stack([0.2 * alpha] * 3 + [alpha], axis=-1)
    mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGBA).write(str(tmp_path / "p.exr"))
    assert read_luminance(tmp_path / "p.exr") == pytest.approx(0.2 * alpha + 1 - alpha, rel=1e-3)


def test_a_pattern_finer_than_the_pixels_is_named(tmp_path: Path) -> None:
    Image.fromarray((255 * (np.indices((64, 64)).sum(axis=0) % 2)).astype(np.uint8)).save(tmp_path / "p.png")
    result = CliRunner().invoke(command, [str(tmp_path / "p.png"), "-o", str(tmp_path / "lens"), "--pixels", "32"])
    assert str(result.exception).startswith(f"--pixels: is 32, too few for the fine pattern of {tmp_path}/p.png")
    assert not (tmp_path / "lens").exists()


@pytest.mark.parametrize("kind", a_few(OPTIONS, ["lens", "round_point", "mirror_tilt"]))
def test_the_start_casts_the_picture_upright_with_the_right_brightness(kind: str, tmp_path: Path) -> None:
    wanted = picture(32, 24 if kind == "portrait" else 32)
    write_file(tmp_path / "p.exr", np.repeat(wanted[:, :, None], 3, 2).astype(np.float32), linear=True)
    folder = tmp_path / "lens"
    args = [str(tmp_path / "p.exr"), "-o", str(folder), "--pixels", "32", "--floor", "0.2", *OPTIONS[kind]]
    result = CliRunner().invoke(command, args, catch_exceptions=False)
    assert result.exit_code == 0
    assert " mm deep; nothing darker" in result.output
    assert re.search(r" x .* mm, .* cm\^3, least thickness .* mm; \d+ triangles\nface: .*cutter", result.output)
    preview = np.asarray(Image.open(folder / "preview.png").convert("L"), float)
    assert np.corrcoef(preview.ravel(), wanted.ravel())[0, 1] > 0.8, "another picture, or turned"
    assert "contrast of at most" not in result.output  # nothing of the picture is below the floor
    likeness = re.search(r"preview.png: the caustic at the start; SSIM with the target (\d\.\d\d)\n", result.output)
    assert likeness is not None
    assert float(likeness[1]) > 0.8
    heights = read_image(folder / "start.exr", "linear", signed=True)[:, :, 0]
    image = np.array(mi.render(flattened(heights, folder), spp=256, seed=1))[:, :, 1]
    target = read_image(folder / "target.exr")[:, :, 1]
    rows, columns = wanted.shape
    beside = 4
    seen = image[beside : beside + rows, beside : beside + columns]
    turns = [wanted, wanted[::-1], wanted[:, ::-1], wanted[::-1, ::-1]]
    likeness = [np.corrcoef(seen.ravel(), turned.ravel())[0, 1] for turned in turns]
    assert likeness[0] > 0.85
    assert max(likeness[1:]) < 0.7
    assert image.sum() == pytest.approx(target.sum(), rel=0.03)  # brightness matches by itself
    assert load_configured(load(folder / "lens.yaml")) is not None


@pytest.mark.parametrize("is_white", [True, False])
def test_the_command_tells_how_much_of_the_contrast_a_lens_can_show(is_white: bool, tmp_path: Path) -> None:
    """The ground of a white logo becomes grey: the target, and a perfect lens, hardly resemble the picture."""
    word = np.zeros((24, 24), bool)
    word[6:18, 9:12] = word[14:18, 9:18] = True
    Image.fromarray(np.where(word == is_white, 255, 0).astype(np.uint8)).save(tmp_path / "p.png")
    args = [str(tmp_path / "p.png"), "-o", str(tmp_path / "lens"), "--pixels", "24", "--floor", "0.2"]
    result = CliRunner().invoke(command, args, catch_exceptions=False)
    told = re.search(r"\ncontrast of at most 5 to 1: (\S+) % of the picture is darker, and becomes grey; "
                     r"the target has an SSIM of (\S+) with the picture(.*)\n", result.output)  # fmt: skip
    assert told is not None
    assert float(told[1]) == pytest.approx(100 * np.mean(word != is_white), rel=0.06)
    assert (told[3] != "") == is_white
    target, shown = (read_image(tmp_path / f"lens/{name}.exr")[3:-3, 3:-3, 1] for name in ("target", "picture"))
    alike = structural_similarity(target, shown, data_range=shown.max())
    assert float(told[2]) == pytest.approx(alike, abs=0.006)
    assert (alike < 0.5) == is_white


BAD = {
    "distance": (
        ["--distance", "50", "--picture-size", "400"],
        "--distance: at 50 mm light cannot reach the whole picture",
    ),
    "index": (["--ior", "1"], "--ior: is 1; glass and plastics"),
    "incidence": (["--mirror", "0"], "--mirror: at 0 degrees the receiver blocks the mirror's"),
    "size": (["--size", "nan"], "--size: is nan mm; it must be above 0"),
    "thickness": (["--thickness", "0.5"], "--thickness: the relief is"),
    "thin mirror": (["--mirror", "30", "--thickness", "0.01"], "mm into the mirror; thickness must be above"),
    "light": (["--light-distance", "20"], "--light-distance: is 20 mm, at which no lens was found"),
    "sun of a point": (["--sun", "0.5", "--light-distance", "300"], "--sun: needs parallel light"),
    "round": (["--mirror", "30", "--outline", "round", "--light-distance", "300"], "--outline: round needs parallel"),
    "one colour": ([], "p.exr: has only one colour"),
    "dithered": ([], "p.exr: has only one colour"),
    "one pixel": ([], "p.exr: is 1 x 1"),
    "no picture": ([], "p.exr: no such file"),
    "no image": ([], "p.exr: is not a readable image"),
    "too large": ([], "p.exr: is 40000x30000 pixels; an image has at most 134217728 pixels"),
    "not finite": ([], "p.exr: pixel ("),
    "no distance": (["--distance", "0"], "--distance: is 0 mm; it must be above 0"),
    "behind": (["--distance", "-5"], "--distance: is -5 mm; it must be above 0"),
    "not a number": (["--distance", "nan"], "--distance: is nan mm; it must be above 0"),
    "far too large": (["--size", "1e7"], "--size: is 1e+07 mm; it must be above 0"),
    "no picture size": (["--picture-size", "0"], "--picture-size: is 0 mm; it must be above 0"),
    "no glass": (["--ior", "9"], "--ior: is 9; glass and plastics"),
    "tilt": (["--tilt", "0", "85"], "--tilt: is 0 and 85 degrees; both must be between"),
    "grazing": (["--mirror", "85"], "--mirror: is 85 degrees; it must be between"),
    "total reflection": (
        ["--ior", "1.1", "--distance", "60", "--picture-size", "200"],
        "bends light by at most 25 degrees before total",
    ),
}


@pytest.mark.parametrize("name", a_few(BAD, [name for name in BAD if name != "light"]))
def test_invalid_input_is_refused_in_one_line_without_output(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options, line = BAD[name]
    monkeypatch.setattr(transport, "TRIAL", 12)  # what has no face fails on a coarse grid too
    noise = 1 - 0.01 * np.random.default_rng(0).integers(0, 2, (16, 16))
    flat = {"one colour": np.ones((16, 16)), "one pixel": np.ones((1, 1)), "dithered": noise}
    wanted = flat.get(name, picture(16, 16))
    if name == "not finite":
        wanted = np.where(wanted > 0.9, np.inf, wanted)
    if name == "no image":
        (tmp_path / "p.exr").write_text("a picture")
    elif name == "too large":  # according to the file's own header
        (tmp_path / "p.exr").write_bytes(b"P6 40000 30000 255\n" + bytes(range(256)))
    elif name != "no picture":
        write_file(tmp_path / "p.exr", np.repeat(wanted[:, :, None], 3, 2).astype(np.float32), linear=True)
    args = [str(tmp_path / "p.exr"), "-o", str(tmp_path / "lens"), "--pixels", "16", *options]
    error = CliRunner().invoke(command, args).exception
    assert isinstance(error, ConfigError)
    assert line in str(error)
    assert "\n" not in str(error)
    assert not (tmp_path / "lens").exists()


@pytest.mark.long
def test_a_run_continues_with_its_momentum_and_measured_steepness(tmp_path: Path, llvm: str) -> None:
    """Momentum and steepness refer to the optimiser's variable, which is rougher than the heights. A resumed run keeps
    the measured rate.
    """
    write_file(tmp_path / "p.exr", np.repeat(picture(16, 16)[:, :, None], 3, 2).astype(np.float32), linear=True)
    done("lens", tmp_path / "p.exr", "-o", tmp_path / "lens", "--pixels", "16")
    sets = [f"run.output={tmp_path}/runs", "run.spp=4", "run.final_spp=4", "optimizer.schedule=constant"]

    def words(name: str, iterations: int) -> list[str]:
        lines = [*sets, f"run.name={name}", f"run.iterations={iterations}"]
        return [word for line in lines for word in ("--set", line)]

    said = done("optimize", tmp_path / "lens/lens.yaml", *words("part", 2)).output
    assert "scale curvature: face.heightmap moves by" in said
    done("optimize", tmp_path / "lens/lens.yaml", *words("whole", 4))
    done("optimize", "--resume", tmp_path / "runs/part", "--set", "run.iterations=4")
    start, *ends = (
        read_image(path, "linear", signed=True)
        for path in (tmp_path / "lens/start.exr", *(tmp_path / "runs" / name / "parameters/face.heightmap.exr"
                                                    for name in ("part", "whole")))
    )  # fmt: skip
    moved = np.abs(ends[1] - start).max()
    assert moved > 0
    assert np.abs(ends[0] - ends[1]).max() < 0.02 * moved


def test_the_lamp_of_a_lens_in_oblique_light_is_beside_the_lens() -> None:
    """No corner of the lamp is inside the lens, and its central ray is refracted to the centre of the face."""
    setting = Setting(incidence=30.0, thickness=20.0)
    surface = Surface(setting, np.zeros((8, 8)), np.ones((8, 8), bool), 0.0, 0.0, None)  # type: ignore[arg-type]
    found = re.search(r'matrix value="([^"]*)"', lamps(surface, 1.0, 0.0))
    assert found is not None
    matrix = np.array(found[1].split(), float).reshape(4, 4)
    corners = matrix[:3, 3] + np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]) @ matrix[:3, :2].T
    assert corners[:, 2].max() == pytest.approx(-20 - np.cos(np.radians(30)), abs=1e-6)  # by 1 mm along the beam
    toward, middle = matrix[:3, 2], matrix[:3, 3]
    entry = middle - toward * (middle[2] + 20) / toward[2]
    sine = np.sin(np.radians(30)) / setting.ior
    assert entry == pytest.approx([-20 * sine / np.sqrt(1 - sine**2), 0, -20], abs=1e-6)
