"""The share of a derivative that attached gradients lack, and comparisons of these gradients with finite
differences.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from cli.tiny import ended
from measure.analytic_motion import centre_of_gravity, parallel
from measure.differenced import Differenced, attached, compare_with_differences
from measure.faults import checked, room
from measure.moving_light import ROOMS_SCENES as ROOMS
from measure.moving_light import SCENES, setting

from reslrb_cli.config.loader import load
from reslrb_cli.measure import missing as missing_check
from reslrb_cli.measure.gradients import integrator, seeds
from reslrb_cli.measure.missing import LineSegment, MissingCheck, Tracing, _ratio, missing_record
from reslrb_cli.measure.scenes.analytic import fresnel
from reslrb_cli.measure.scenes.case import SceneCase
from reslrb_cli.measure.scenes.moving import Move, displacement, pose, smooth_fields, vertices
from reslrb_cli.measure.scenes.small import transform
from reslrb_cli.optimization import targets
from reslrb_cli.records.measurements import LEAST, MissingRecord, Reference, Verdict
from reslrb_cli.transport import bsdf, connection
from reslrb_cli.transport.film import AdjointImage
from reslrb_cli.transport.walk import Segment

# The share of a derivative that attached gradients lack, in scenes where this share is known.

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
HALF, EDGE, HEIGHT, TILT, IOR, SLAB = 0.6, 0.2, 1.4, 0.5, 1.5, 0.3
SPP, SEEDS, REACH = 64, 24, 0.02


def share(scene: SceneCase, count: int = SEEDS) -> tuple[float, float]:
    """Return the missing share and its error for the centre of gravity of the landing light, along the scene's only
    amplitude.
    """
    case, options = scene.setup(), scene.options
    tracer = integrator("reslrb", **options, estimator="stack")
    tracing = Tracing([case], integrator("walk_ad", **options), tracer, SPP)
    segment = LineSegment(np.ones(1), -REACH, REACH, [centre_of_gravity()])
    record = missing_record("", "", tracing.samples([segment], seeds(count)))
    assert record.share is not None
    assert record.standard_error is not None
    print(scene.name, record)
    return record.share, record.standard_error


def half_covered(moved: str) -> SceneCase:
    """Return a scene with a black sheet over a part of a parallel beam. The beam covers -HALF to HALF in x, and the
    sheet covers -HALF to EDGE. Either can move.
    """
    cover = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.0},
             "to_world": transform(translate=[EDGE - 1, HEIGHT, 0], rotate=([1, 0, 0], -90), scale=1)}  # fmt: skip
    return attached(
        f"half_covered, {moved}", "a black sheet in a parallel beam",
        lambda: setting(lamp=parallel(HALF, 0, 3, 10.0), cover=cover),
        lambda scene: [pose(f"{moved}.to_world", ("tx",), (0, 0, 0))], options={"max_depth": 2},
    )  # fmt: skip


def slab_in_a_beam() -> SceneCase:
    """Return a scene with a tilted glass surface narrower than the beam, above a receiver in the glass. Light passes by
    the surface's edges.
    """
    glass = {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0}
    place = transform(translate=[0, HEIGHT, 0]) @ transform(rotate=([0, 0, 1], float(np.rad2deg(TILT))))
    size = transform(rotate=([1, 0, 0], -90), scale=[SLAB, 2, 1])
    return attached(
        "slab_in_a_beam", "a beam on a narrower surface of glass",
        lambda: setting(lamp=parallel(HALF, 0, 3, 10.0),
                        top={"type": "rectangle", "bsdf": glass, "to_world": place @ size}),
        lambda scene: [pose("top.to_world", ("rz",), (0, HEIGHT, 0))], options={"max_depth": 3},
    )  # fmt: skip


def slab_share() -> float:
    """Return the known share for the slab. The surface receives light over SLAB cos(tilt) on each side of its middle.
    The part (1 - R) passes, displaced by H tan(a).
    """

    def displaced(tilt: float) -> float:
        away = tilt - np.arcsin(np.sin(tilt) / IOR)
        return float((1 - fresnel(np.array(tilt), IOR)) * HEIGHT * np.tan(away))

    h = 1e-5
    inside = np.cos(TILT) * (displaced(TILT + h) - displaced(TILT - h)) / (2 * h)
    border = -np.sin(TILT) * displaced(TILT)
    return float(abs(border / (inside + border)))


@pytest.mark.long
def test_a_texture_has_a_complete_derivative():
    """Colours are complete, because nothing moves."""
    config = room("lamp_over_floor.xml", "floor.bsdf.reflectance.value")
    check = MissingCheck.of_config(config, 16)
    record = check.measured(check.keys[0], lambda samples: True, 6)
    print(record)
    assert record.share is not None
    assert record.standard_error is not None
    assert record.share <= max(record.margin, LEAST)
    assert record.standard_error < 1e-3
    assert "detect no missing part" in record.line()


@pytest.mark.long
@pytest.mark.parametrize(
    ("scene", "known", "count"),
    [
        # The beam's right end contributes HALF to the derivative. Attached gradients contain the width of the landing
        # light.
        (lambda: half_covered("lamp"), EDGE / HALF, SEEDS // 2),
        pytest.param(lambda: half_covered("cover"), 1.0, SEEDS, marks=pytest.mark.long),
        pytest.param(slab_in_a_beam, slab_share(), SEEDS, marks=pytest.mark.long),
    ],
    ids=["lamp", "cover", "slab"],
)
def test_known_shares(scene: Callable[[], SceneCase], known: float, count: int):
    found, error = share(scene(), count)
    assert error < 0.03 * known, "too noisy to see a fault"
    assert abs(found - known) < 4 * error + 1e-9


@pytest.mark.long
def test_a_fault_is_found(monkeypatch: pytest.MonkeyPatch):
    """The check finds a gradient that also lacks the light's shift to other positions."""
    right = AdjointImage.lookup
    monkeypatch.setattr(AdjointImage, "lookup", lambda self, u, *a, **k: right(self, dr.detach(u), *a, **k))
    found, error = share(half_covered("lamp"), SEEDS // 3)
    assert abs(found - EDGE / HALF) > 10 * error


def test_a_part_lost_in_noise_has_no_share():
    record = missing_record("a.yaml", "lamp.position", np.random.default_rng(0).normal(size=(16, 2, 2)))
    assert record == MissingRecord("a.yaml", "lamp.position", None, None, 2, 16)
    assert record.line() == "lamp.position: 16 seeds cannot distinguish the derivative from 0"


def test_errors_are_correct():
    """Over many simulated measurements, the deviation from the known share is about as large as the stated error."""
    random, z = np.random.default_rng(1), []
    for _ in range(300):
        common = random.normal(scale=0.3, size=(12, 3))
        ours, whole = np.array([1.0, 2.0, 0.5]) + common, np.array([1.5, 2.0, 1.0]) + common
        record = missing_record("a.yaml", "x", np.stack([whole + random.normal(scale=0.05, size=(12, 3)), ours], 2))
        z.append(((record.share or 0) - np.sqrt(0.5 / 7.25)) / (record.standard_error or 1))
    assert abs(np.mean(z)) < 0.3
    assert 0.8 < np.std(z) < 1.3


def test_noise_does_not_enlarge_a_share():
    """For two seeds, the square of the mean without its noise is the product of both samples."""
    part, whole = np.array([[1.0], [4.0]]), np.array([[4.0], [4.0]])
    assert _ratio(part, whole) == pytest.approx(0.5)


call = partial(ended, "gradcheck")


LAMP = """
scene: {{file: {folder}/lamp_over_floor.xml}}
target: {{render: {{spp: 64, parameters: {{lamp.position: [0.2, 0.9, 0.1]}}}}}}
parameters: [{{key: lamp.position}}]
integrator: {{type: reslrb, max_depth: 2}}
optimizer: {{type: adam, learning_rate: 0.01}}
run: {{iterations: 3, spp: 16}}
"""


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(missing_check, "IMAGE_PATHS", 2**16)  # noisier dL/dI, which is the same for all
    config = tmp_path / "lamp.yaml"
    config.write_text(LAMP.format(folder=Path(__file__).parent))
    part = tmp_path / "part.jsonl"
    assert call(str(config), "--missing", "--spp", "4", "--seeds", "3", "--json", str(part)) == 0
    origin, row = map(json.loads, part.read_text().splitlines())
    assert origin["kind"] == "origin"
    assert (row["kind"], row["parameter"], row["directions"], row["seeds"]) == ("missing", "lamp.position", 3, 3)
    shown = capsys.readouterr().out.splitlines()
    assert shown[-1].startswith("lamp.position: ")
    assert "dL/dI of the loss beside the initial values" in shown[-2]


def test_a_loss_without_a_derivative(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Without a segment to the floor, all images are black, including the target. The earlier check for black targets
    is disabled here.
    """
    monkeypatch.setattr(targets, "_check_light", lambda problem, say: None)
    config = tmp_path / "lamp.yaml"
    config.write_text(LAMP.format(folder=Path(__file__).parent))
    assert call(str(config), "--missing", "--spp", "4", "--seeds", "3", "--set", "integrator.max_depth=1") == 2
    assert "has no derivative beside the initial value of lamp.position" in capsys.readouterr().err


# Derivatives of parameters that move light, compared with finite differences. A few scenes run by default, and all with
# `-m long`.

#: Limits relative to the root mean square of the derivatives.
ERROR, STANDARD_ERROR = 5e-3, 1e-3


#: Scenes without the rooms, in which bouncing light is too noisy for these limits.
STEADY = [name for name in SCENES if name not in {room.name for room in ROOMS}]


@pytest.mark.long
@pytest.mark.parametrize("name", STEADY)
def test_every_scene(name: str):
    found = compare_with_differences(SCENES[name])
    print(name, found)
    assert found.error < ERROR, found
    assert found.standard_error < STANDARD_ERROR, found


def beam(only: tuple[float, float, float], seeds: int = 2) -> Differenced:
    """Compare with differences for a slab in parallel light, of which the coordinates `only` move along a few
    directions.
    """

    def moves(scene: Any) -> list[Move]:
        return [displacement("top.vertex_positions", smooth_fields(vertices(scene, "top"), 3, 1.0) * np.array(only))]

    return compare_with_differences(replace(SCENES["slab_beam"], moves=moves), count=seeds)


@pytest.mark.long
def test_slopes_of_the_shading_correction_without_its_jumps(monkeypatch: pytest.MonkeyPatch):
    """Faces slide through the light. Within each face the shading correction has a slope, and at the face's edges the
    correction jumps back.
    """
    right = bsdf.shading_correction

    def tracked(plan: Any, *rest: Any) -> Any:
        return right(replace(plan, attached_normalization=False), *rest)

    slides = (1, 0, 1)
    assert beam(slides).error < ERROR
    for module in (bsdf, connection):
        monkeypatch.setattr(module, "shading_correction", tracked)
    assert beam(slides).error > 2 * ERROR


def test_a_ray_that_does_not_follow_its_surface(monkeypatch: pytest.MonkeyPatch):
    right = Segment.next_ray
    monkeypatch.setattr(Segment, "next_ray", lambda self, attached=False: dr.detach(right(self, attached)))
    assert beam((0, 1, 0)).error > 10 * ERROR


@pytest.mark.long
@pytest.mark.parametrize("edges", ["auto", "off"])
def test_gradcheck_compares_differences_with_edges(edges: str) -> None:
    """Silhouette and shadow of a box make the derivative of its place. Without them, it has the opposite sign."""
    config = load(CONFIGS / "moved_box.yaml", [f"integrator.edges={edges}"])
    of = {(row.parameter, row.reference): row for row in checked(config, "stack", 8)}
    place = of["box.translation", Reference.FINITE_DIFFERENCE]
    print(place)
    assert place.verdict is (Verdict.HOLDS if edges == "auto" else Verdict.FAILS)
    assert of["box.translation", Reference.WALK_AD].verdict is Verdict.HOLDS
