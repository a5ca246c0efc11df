"""Derivatives of outlines and shadows of moving shapes, against finite differences of images by Mitsuba's `path`.

The images come from another integrator and from other seeds. `edge_cases.py` has the scenes. Finite differences of the
default suite are on file (edge_values.json), because they take minutes. The long suite takes them again.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import Agreement, compare
from conformance import test_edge_geometry
from conformance.edge_cases import (
    BEHIND_THE_VEIL,
    CAMERA,
    CASES,
    HIDDEN,
    LIGHT,
    RECORDED,
    SHARE,
    SIZE,
    VIEWS,
    EdgeCase,
    recorded,
    standing,
)
from conformance.moving import Moving
from conformance.test_kernels import Kernels
from measure.faults import Fault, assert_found, plant, planted
from scipy.spatial.transform import Rotation
from turns import a_few

from reslrb_cli import register
from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators import edges, outline_rays
from reslrb_cli.estimators.base import Pass
from reslrb_cli.integrators import context, reslrb
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.protocol import Job, StepIntegrator
from reslrb_cli.integrators.step import StepResult, gradient_step
from reslrb_cli.measure.gradients import integrator, relative, seeds
from reslrb_cli.scene.edges import EdgeSet
from reslrb_cli.transport.edges import Chances, sample_outline, view_from_lamps, view_from_sensor
from reslrb_cli.transport.samples import Samples

pytestmark = pytest.mark.usefixtures("llvm")
BY_NAME = {case.name: case for case in CASES}

# ---- Against finite differences ----

#: Largest standard error of a gradient and its reference, relative to the norm of the reference.
RESOLUTION = 0.02
#: The same for light of more than two segments, for shapes with light at grazing angles, and for cases without
#: differences on file. They have more noise.
NOISY = 0.07
GRAZED, ON_FILE = ("bumpy", "cylinder"), [case.name for case in RECORDED]
#: Factors of the samples of light paths, by case. Camera paths need no more.
MORE_SAMPLES = {"box-sphere_lamp-2": 5, "sphere-point-2": 4, "standing-front-2": 2, "flat-area-2": 2}  # fmt: skip


def check(case: EdgeCase, reference: np.ndarray, count: int = 8, **options: Any) -> Agreement:
    """Return the comparison of a gradient from `count` seeds with its reference, after a check that their noise is
    small enough. `options` are options of `reslrb`.
    """
    found = case.gradients(count, **options)
    noise = np.sqrt(sum(samples.var(0, ddof=1).sum() / len(samples) for samples in (found, reference)))
    size = np.linalg.norm(reference.mean(0))
    agreement = compare(found, reference, block=None)
    print(f"{case.name}: {agreement}; standard error {noise / size:.1%} of the gradient")
    bounces = case.depth > 2 and case.lamp not in VIEWS and case.occluder != "two"
    noisy = bounces or case.occluder in GRAZED or case.name not in ON_FILE
    assert noise < (NOISY if noisy else RESOLUTION) * size, (
        f"{case.name}: standard error {noise / size:.1%} of the gradient"
    )
    return agreement


#: Cases that need `-m long`: each resembles another case.
SIMILAR = (
    "standing-room-3",
    "sphere-room-5",
    "cylinder-directional-2",
    "rectangle-spot-2",
    "sphere-point-2",
    "box-moving_area-2",
    "box-moving_spot-2",
    "flat-area-2",  # no planted fault needs these two: those of edges between surfaces show in two-area-3 as well
    "box-indirect-3",
    "reflected-area-3",  # the slab has edges and shadows of both kinds of chains
    "mirror-constant-3",
    "smooth-front-2",
    "square_0.3-paned-4",
    "standing-area-3",
    "bumpy-area-2",  # the test of light at grazing angles has this case
    "glazed-area-4",  # the comparison with and without a clear pane finds its fault
)


@pytest.mark.usefixtures("registers")
@pytest.mark.parametrize("case", a_few(RECORDED, [case.name for case in RECORDED if case.name not in SIMILAR]))
def test_gradient(case: EdgeCase):
    agreement = check(replace(case, spp=case.spp * MORE_SAMPLES.get(case.name, 1)), recorded(case))
    assert agreement, agreement


#: Cases of camera paths. In the other case, a box as small as two pixels moves by more than a pixel in the differences
#: on file. The film's filter has ripples of this period in images of camera paths.
SEEN = [case for case in RECORDED if not (case.lamp_moves or case.options) and case.occluder != "two"]
FEW_SEEN = ("box-sphere_lamp-2", "shaded-point-2")


@pytest.mark.parametrize("case", a_few(SEEN, FEW_SEEN))
def test_gradient_of_camera_paths(case: EdgeCase):
    noisy = case.name == "box-indirect-3"  # only indirect light arrives
    agreement = check(replace(case, spp=case.spp * (2 if noisy else 1)), recorded(case), paths="camera")
    assert agreement, agreement


@pytest.mark.long
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_gradient_with_new_differences(case: EdgeCase):
    """The differences on file agree with new ones of the scenes as they are now."""
    differences = case.differences(block=2)
    noisy = {"glazed": 4, "slab": 6}  # light through glass has more noise
    spp = case.spp * noisy.get(case.occluder, MORE_SAMPLES.get(case.name, 1))
    agreement = check(replace(case, spp=spp), differences)
    assert agreement, agreement
    if case in RECORDED:
        on_file = compare(recorded(case), differences, block=None)
        assert on_file, on_file


FAULTS = [
    Fault("cosine_for_sine", "standing-front-2", "transport.edges:sample_outline",
          "dr.select(active, sine / (density * probability), 0)",
          "dr.select(active, dr.safe_sqrt(1 - dr.square(sine)) / (density * probability), 0)"),
    Fault("sides_exchanged", "sphere-point-2", "estimators.edges:_from_lamps",
          "dr.select(over, beside.over, beside.past)", "dr.select(over, beside.past, beside.over)"),
    Fault("edge_without_its_probability", "box-sphere_lamp-2", "transport.edges:sample_outline",
          "sine / (density * probability)", "sine / density"),
    Fault("every_edge_counts", "points", "transport.edges:sample_outline",
          "(side * across_it > 0)", "mi.Bool(True)"),
    Fault("creases_left_out", "box-sphere_lamp-2", "transport.edges:sample_outline", "if creases:", "if False:"),
    Fault("shadow_rays_start_above_the_surface", "grazing", "scene.rays:shadow_ray",
          "if not has_edges:", "if True:"),
    Fault("contact_counted_twice", "standing-front-2", "estimators.edges:_from_sensor",
          "beside.active & ~touches", "beside.active"),
    Fault("point_behind_not_scaled", "two-area-3", "estimators.edges:_from_sensor",
          "(s * size) * n", "size * n"),
    Fault("point_behind_does_not_slide", "two-area-3", "estimators.edges:_moved_by_light",
          "light.segments == 1, slid", "light.segments == 0, slid"),
    Fault("first_depth_between_surfaces", "depth", "estimators.edges:_between",
          "light.segments + 1", "light.segments"),
    Fault("light_from_near_does_not_slide", "contact", "estimators.edges:_moved_by_light",
          "light.near * (adjoint", "0 * (adjoint"),
    Fault("near_light_slides_only_at_its_end", "contact", "estimators.edges:_moved_by_light",
          "active & follows & light.pi_z.is_valid()", "active & False"),
    Fault("fixed_directions_see_no_edge", "contact", "estimators.outline_rays:Between.side",
          "numbers.next_float32() * both < share", "mi.Bool(False)"),
    Fault("fixed_directions_see_no_crease", "contact", "estimators.outline_rays:sample_between",
          "chances_of(samples, numbers), creases=True", "chances_of(samples, numbers), creases=False"),
    Fault("light_is_seen_by_a_point_at_rest", "camera_contact", "estimators.camera_edges:Importance.moved",
          "active & self.pi_z.is_valid()", "active & False"),
    Fault("fixed_directions_see_no_edge_before_the_sky", "camera_contact", "estimators.outline_rays:sample_between",
          "y, s, beside.active)", "y, s, beside.active & beside.x.is_valid())"),
    Fault("directions_of_camera_paths_are_not_fixed", "camera_contact", "estimators.camera_edges:_between",
          "dr.select(side.over, -p.scale, p.scale)", "dr.select(side.over, 0, p.scale)"),
    Fault("still_shapes_hide_nothing", "hidden-point-2", "transport.edges:weigh_edges",
          "sensor *= dr.select(table.moves | hides, 1, 0)", "sensor *= dr.select(table.moves, 1, 0)"),
    Fault("light_comes_from_one_side_only", "reflector-upward-3", "transport.edges:_towards_balls",
          "dr.select(backward, -to_y, to_y)", "to_y"),
    Fault("rays_of_a_moving_lamp_stay", "box-moving_area-2", "estimators.edges:_from_lamps",
          "moved -= _carried(", "_carried("),
    Fault("light_does_not_slide_with_a_lamp", "box-moving_spot-2", "estimators.edges:_moved_by_light",
          "if samples.plan.moving_emission:", "if False:"),
    Fault("corners_counted_twice", "none-moving_room-3", "estimators.outline_rays:share_of",
          "touches & ~(", "mi.Bool(False) & ~("),
    Fault("share_of_near_light_is_constant", "none-moving_room-3", "estimators.attached:reach",
          " + (shares[1] - shares[0])", ""),
    Fault("solid_angle_of_a_lamp_left_out", "sphere-near-2", "transport.edges:_from",
          "first.weight * solid", "first.weight"),
    Fault("light_through_glass_counted_twice", "clear_pane", "estimators.edges:_from_sensor",
          "excludes=excludes", "excludes=False"),
    Fault("edges_in_glass_left_out", "slab-area-4", "estimators.chain_edges:has_edges_behind_chains",
          "bool(plan.needs.has_delta_lobes)", "not plan.camera"),
    Fault("edges_behind_glass_left_out", "slab-area-4", "estimators.chain_edges:has_edges_behind_chains",
          "plan.camera or not plan.moving_emission", "plan.camera"),
    Fault("shadows_in_mirrors_left_out", "reflected-area-3", "transport.jumps:_compare",
          "dr.select(hides, ~lit[1][1], lit[1][1])", "mi.Bool(False)"),
    Fault("chain_does_not_move", "slab-area-4", "estimators.chain_edges:differentiate_edges_behind_chains",
          "dr.select(shadow, origin, -at_p), 0)", "dr.select(shadow, origin, 0), 0)"),
    Fault("grazing_light_behind_chains_is_corrected", "clear_pane", "estimators.chain_edges:_light",
          "on_smooth(edge.over.pi.shape, p.plan.edged + p.plan.occluders, over)", "None"),
    Fault("sides_exchanged_behind_chains", "reflected-area-3", "estimators.chain_edges:_light",
          "dr.select(over, edge.over.ray, edge.past.ray)", "dr.select(over, edge.past.ray, edge.over.ray)"),
    Fault("every_interval_counts_alike", "mirror-constant-3", "transport.jumps:sample_edge",
          "jump.places * line.chance", "line.chance"),
    Fault("choice_of_a_lobe_left_out", "slab-area-4", "transport.bsdf:reflect_or_refract",
          "weight / chance", "weight"),
    Fault("only_the_first_lobe_of_a_blend", "blended_mirror", "transport.bsdf:_delta_lobes",
          "and flag & int(side)", "and flag & int(side) and number == 0"),
    Fault("edges_of_rectangles_exchanged", "square_0.1-mirrored-3", "scene.edges:edge_normal",
          "(si.dp_du * u, si.dp_dv, is_flat)", "(si.dp_du * u, si.dp_du, is_flat)"),
    Fault("hidden_lamps_block_the_view", "hidden_lamp", "estimators.outline_rays:both_sides",
          "if view.passes_lamps else ray", "if False else ray"),
    Fault("things_before_the_clip_plane_block_the_view", "hidden_lamp", "estimators.outline_rays:both_sides",
          " - view.clip", ""),
    Fault("mirrors_show_no_hidden_lamp", "lamp_in_a_mirror", "transport.camera:camera_walk",
          "plan.sees_through_lamps and first.begins_path", "plan.sees_through_lamps"),
    Fault("chains_meet_hidden_lamps", "lamp_before_a_mirror", "transport.chains:SensorChains.sees_through_lamps",
          "self.samples.plan.sees_through_lamps", "False"),
    Fault("points_of_a_flat_lamp_light_each_other", "lamp_in_a_moved_mirror", "transport.chains:Chains.lit",
          " & (height > ray_offset(hit.si.p))", ""),
    Fault("parallel_light_has_no_edges", "parallel_light", "transport.plan:Plan.finding_beams",
          "beams = not self.camera and any(", "beams = False and any("),
]  # fmt: skip


FAULTS_OF_CAMERA_PATHS = [
    Fault("rays_far_from_the_edge", "bumpy-area-2", "estimators.outline_rays:both_sides",
          "ray(-BESIDE), ray(BESIDE)", "ray(-1), ray(1)"),
    Fault("sides_exchanged", "box-sphere_lamp-2", "estimators.camera_edges:_from_sensor",
          "dr.select(over, beside.over, beside.past)", "dr.select(over, beside.past, beside.over)"),
    Fault("creases_left_out", "box-sphere_lamp-2", "estimators.camera_edges:_from_sensor",
          "view, chances, creases=True)", "view, chances)"),
    Fault("contact_counted_twice", "standing-front-2", "estimators.camera_edges:_from_lamps",
          " & ~touches_behind(outline, beside)", ""),
    Fault("shaded_point_does_not_move", "shaded-point-2", "estimators.camera_edges:_from_lamps",
          "moved += W.moved(", "W.moved("),
    Fault("shaded_point_keeps_its_place", "shaded-point-2", "estimators.camera_edges:Importance.moved",
          "seen * slid(adjoint, self.n, self.to_sensor)", "seen * adjoint"),
    Fault("resting_shapes_cast_no_shadow", "shaded-point-2", "transport.edges:weigh_edges",
          "dr.select(table.moves | hides, 1, dr.max", "dr.select(table.moves, 1, 0 * dr.max"),
    Fault("nothing_between_surfaces", "box-indirect-3", "estimators.camera_edges:_between",
          "-size * n", "0 * size * n"),
    Fault("no_sky_behind_resting_shapes", "standing-constant-3", "scene.edges:_sky_before",
          "-ball.frame", "ball.frame"),
    Fault("density_on_a_horizon_left_out", "smooth-area-2", "estimators.horizons:_horizons",
          "(side * 2 * dr.two_pi)", "side"),
    Fault("planes_of_faces_turn_the_wrong_way", "smooth-area-2", "estimators.horizons:_horizons",
          "dr.dot(face.n, d) * size", "-dr.dot(face.n, d) * size"),
    Fault("planes_of_faces_do_not_move", "smooth-area-2", "estimators.horizons:_horizons",
          "(1 - share) * size / y.t", "mi.Float(0)"),
    Fault("wedge_has_half_its_size", "smooth-area-2", "estimators.horizons:_folds", "4 * angle", "2 * angle"),
    Fault("faces_of_a_fold_exchanged", "smooth-area-2", "estimators.horizons:_folds",
          "dr.select(over, one, other)", "dr.select(over, other, one)"),
    Fault("sides_of_rims_exchanged", "smooth-area-2", "estimators.horizons:_rims",
          "dr.select(over, beside.over, beside.past)", "dr.select(over, beside.past, beside.over)"),
    Fault("rims_have_another_density", "smooth-area-2", "transport.faces:sample_rim", "count * share", "count"),
    Fault("sky_has_another_density", "standing-constant-3", "transport.edges:_past_balls",
          "dr.rcp(dr.two_pi", "dr.rcp(dr.pi"),
]  # fmt: skip


@planted(FAULTS_OF_CAMERA_PATHS)
def test_fault_of_camera_paths(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    case = BY_NAME[fault.check]
    assert_found(fault, monkeypatch, lambda: compare(case.gradients(paths="camera"), recorded(case), block=None))


@planted(FAULTS)
def test_fault(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    if fault.check in EXACT:
        plant(fault, monkeypatch)
        with pytest.raises(AssertionError):
            EXACT[fault.check](monkeypatch)
        return
    case = BY_NAME[fault.check]
    assert_found(fault, monkeypatch, lambda: compare(case.gradients(), recorded(case), block=None))


def check_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that light past an edge between two surfaces has three segments at least."""

    def between(p: Pass) -> None:
        samples = outline_rays.edge_samples(p.samples, edges.OTHER_EDGES)
        edges._between(Pass(samples, None, p.adjoint), samples.stream(edges.OTHER_EDGES))

    monkeypatch.setattr(reslrb, "differentiate_edges", between)
    for depth, has_any in ((2, False), (3, True)):
        case = EdgeCase("box", "room", depth, spp=64)
        on, off = (case.gradients(1, edges=value) for value in ("on", "off"))
        assert (np.abs(on - off).max() > 0.01) == has_any


def check_grazing() -> None:
    """Assert that the derivative by the height of a vertex is right. The sensor sees the faces around it at grazing
    angles.
    """
    case = BY_NAME["bumpy-area-2"]
    column = case.motion.index("seen")
    # Many seeds of few samples know their noise better than few seeds of many samples.
    found = replace(case, spp=192).gradients(32)
    agreement = compare(found[:, [column]], recorded(case)[:, [column]], block=None)
    assert agreement, agreement


def check_clear_pane(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that edges of a smooth mesh behind a pane that does not change light are those without the pane."""

    def terms(case: EdgeCase) -> np.ndarray:
        return case.gradients(edges="on") - case.gradients(edges="off")

    without, behind = (EdgeCase(name, "area", depth, options=LIGHT) for name, depth in (("smooth", 2), ("cleared", 4)))
    agreement = compare(terms(behind), terms(without), block=None)
    assert agreement, agreement


def check_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the derivative of a box that stands in a room is right. Here, fixed directions have a large share of
    the light between the box and the floor, so that a fault of their edges shows.
    """
    monkeypatch.setattr(context, "NEAR", 1.0)
    case = replace(BY_NAME["standing-room-3"], spp=512)
    agreement = check(case, recorded(case))
    assert agreement, agreement


def check_camera_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the derivative of camera paths is right if almost all light has fixed directions."""
    monkeypatch.setattr(context, "NEAR", 1.0)
    case = replace(BY_NAME["standing-area-3"], spp=120)
    agreement = check(case, recorded(case), 32, paths="camera")
    assert agreement, agreement
    assert agreement.relative_error < 0.03


# ---- Equal derivatives of scenes that look alike ----


def check_alike(one: np.ndarray, other: np.ndarray, limit: float = 2e-3) -> None:
    """Assert that two gradients at equal seeds are equal up to rounding, and not 0."""
    assert np.abs(one).min() > 0
    assert relative(one, other) < limit


def check_hidden_lamp() -> None:
    """Assert that a hidden lamp does not hide what is behind it. A clip plane behind the lamp hides it, too. Rays that
    start there are rounded in another way, so that a few of them meet something else.
    """
    hidden = EdgeCase("box", "veil", spp=16, options=CAMERA | HIDDEN)
    clipped = replace(hidden, near_clip=BEHIND_THE_VEIL, options=CAMERA)
    check_alike(hidden.gradients(1), clipped.gradients(1), limit=0.02)


def check_lamp_before_a_mirror() -> None:
    """Assert that a hidden lamp does not hide what a mirror behind it shows."""
    hidden = EdgeCase("square_0.3", "covered", 3, ("x", "z"), spp=16, options=CAMERA | HIDDEN)
    check_alike(hidden.gradients(1), replace(hidden, near_clip=0.3, options=CAMERA).gradients(1), limit=0.02)


def check_lamp_in_a_mirror() -> None:
    """Assert that a mirror shows a hidden lamp."""
    hidden = EdgeCase("facing", "glowing", motion=("y", "turn"), spp=16, options=CAMERA | HIDDEN)
    check_alike(hidden.gradients(1), replace(hidden, options=CAMERA).gradients(1))


def edge_terms(case: EdgeCase) -> np.ndarray:
    """Return the part of a gradient that edges contribute."""
    return case.gradients(1) - case.gradients(1, edges="off")


def check_parallel_light() -> None:
    """Assert that a lamp of parallel light that covers the sky has the edges of a directional lamp."""
    cases = (EdgeCase("flat", lamp, spp=16, options=LIGHT) for lamp in ("wide_beam", "directional"))
    check_alike(*(edge_terms(case) for case in cases))


def check_blended_mirror() -> None:
    """Assert that a blended mirror has its share of the edges of a mirror, in both orders of the blend."""
    mirror, *blends = (
        EdgeCase("square_0.3", view, 3, ("x", "z"), spp=16, options=CAMERA).gradients(1)
        for view in ("mirrored", "blended", "blended_last")
    )
    for found in blends:
        check_alike(found, SHARE * mirror)


def check_mapped_mirror(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that light over a mirror with a normal map has edges."""
    monkeypatch.setattr(reslrb, "differentiate_edges", lambda p: None)
    cases = (EdgeCase(name, "point", 3, spp=64, options=LIGHT) for name in ("mapped", "reflected"))
    check_alike(*(edge_terms(case) for case in cases))


@pytest.mark.long
def test_edges_in_light_of_a_mirror_with_a_normal_map(monkeypatch: pytest.MonkeyPatch):
    check_mapped_mirror(monkeypatch)


#: Checks of faults that hardly change an expectation, or that the test of a case has too much noise for.
EXACT: dict[str, Callable[[pytest.MonkeyPatch], None]] = {
    "depth": check_depth, "grazing": lambda monkeypatch: check_grazing(), "contact": check_contact,
    "camera_contact": check_camera_contact, "clear_pane": check_clear_pane,
    "points": lambda monkeypatch: check_points("sensor", False),
    "hidden_lamp": lambda monkeypatch: check_hidden_lamp(),
    "lamp_in_a_mirror": lambda monkeypatch: check_lamp_in_a_mirror(),
    "lamp_before_a_mirror": lambda monkeypatch: check_lamp_before_a_mirror(),
    "lamp_in_a_moved_mirror": lambda monkeypatch: test_edge_geometry.test_the_outline_of_a_lamp_in_a_moved_mirror(),
    "parallel_light": lambda monkeypatch: check_parallel_light(),
    "blended_mirror": lambda monkeypatch: check_blended_mirror(),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [name for name in EXACT if name not in ("points", "lamp_in_a_moved_mirror")]
)  # these have tests of their own
def test_edges(name: str, monkeypatch: pytest.MonkeyPatch):
    EXACT[name](monkeypatch)


# ---- Points of outlines ----

SMALL = standing("area", 2, spp=32)


def tracer(**options: Any) -> StepIntegrator:
    """Return `reslrb` with derivatives of edges."""
    return integrator("reslrb", options.pop("max_depth", 2), estimator="stack", **{"edges": "on"} | options)


def passes(moving: Moving, value: str, key: str) -> list[Samples]:
    """Return the samples of a step that differentiates the parameter `key`."""
    dr.enable_grad(moving.params[key])
    moving.params.update()
    job = Job(moving.loaded, moving.loaded.sensors()[0], dr.opaque(mi.UInt32, 1), 4, moving.params)
    return tracer(edges=value).passes(job)


def check_points(viewpoint: str, creases: bool) -> None:
    """Assert that points lie on edges of a box, not on diagonals. Without creases, the viewpoint sees one face of the
    edge, and the normal points away from the box.
    """
    moving, half, degrees = SMALL.moving(), np.array([0.3, 0.25, 0.3]), 23.0
    part = passes(moving, "on", "shape.vertex_positions")[0]
    numbers = mi.PCG32(1 << 12, initstate=3)
    chances = Chances.spread(numbers, part.seed, dr.arange(mi.UInt32, 1 << 12), mi.UInt32(1 << 12))
    assert part.edges is not None
    view = {"lamp": view_from_lamps, "sensor": view_from_sensor}.get(viewpoint, lambda *_: None)(
        part, chances.viewpoint
    )
    outline = sample_outline(part, getattr(part.edges, viewpoint), view, chances, creases)
    active, back = np.array(outline.active), Rotation.from_euler("z", -degrees, degrees=True)
    p, to_y, n = (back.apply(np.array(v).T[active]) for v in (outline.p, outline.view.to_y, outline.normal))
    p -= back.apply([0.1, -0.1, 0.3])  # its centre
    on = np.abs(np.abs(p) - half) < 1e-5
    assert (on.sum(1) >= 2).all()
    assert len(np.unique(np.sign(p) * on, axis=0)) > 3  # several edges
    assert np.abs(np.sum(n * to_y, 1)).max() < 1e-4
    if not creases:
        facing = np.where(on, np.sign(p) * to_y, 0)
        assert ((facing > 0).sum(1) == 1)[on.sum(1) == 2].all()
        assert (np.sum(n * p, 1) > 0).all()


@pytest.mark.parametrize(("viewpoint", "creases"), [("lamp", True), ("sensor", False), ("anywhere", False)])
def test_sampled_points_lie_on_outlines(viewpoint: str, creases: bool):
    check_points(viewpoint, creases)


# ---- Plans and options ----


@pytest.mark.parametrize(("value", "moves"), [("on", True), ("off", True), ("on", False)])
def test_only_moving_shapes_have_edges(value: str, moves: bool):
    parts = passes(SMALL.moving(), value, "shape.vertex_positions" if moves else "floor.bsdf.reflectance.value")
    has = value == "on" and moves
    assert [shape.id() for shape in parts[0].plan.edged] == (["shape"] if has else [])
    assert all((part.edges is not None) == has for part in parts)


@pytest.mark.parametrize(("occluder", "lamp", "names"), [("box", "indirect", set()), ("box", "area", set()),
                                                         ("hidden", "point", {"sheet", "ball", "tube"})])  # fmt: skip
def test_only_shapes_that_can_hide_something_are_occluders(occluder: str, lamp: str, names: set[str]):
    """No light passes the edges of a room's walls, of the floor, or of the lamp above everything."""
    scene = EdgeCase(occluder, lamp).moving().loaded
    [moving] = [shape for shape in scene.shapes() if shape.id() == "shape"]
    assert {shape.id() for shape in EdgeSet((moving,), scene).occluders} == names


def test_an_image_has_no_edges():
    moving = SMALL.moving()
    job = Job(moving.loaded, moving.loaded.sensors()[0], dr.opaque(mi.UInt32, 1), 4)
    assert all(part.edges is None and not part.plan.edged for part in tracer().passes(job))


def test_the_plugin_takes_the_option():
    register()
    chosen = mi.load_dict({"type": "reslrb", "estimator": "stack", "edges": "on"})
    assert "edges" in chosen.tracer.preparation.sampling.on
    assert "edges" not in mi.load_dict({"type": "reslrb", "estimator": "stack"}).tracer.preparation.sampling.on


def test_forward_mode_and_follow_refuse_edges():
    moving = SMALL.moving()
    dr.enable_grad(moving.params["shape.vertex_positions"])
    job = Job(moving.loaded, moving.loaded.sensors()[0], dr.opaque(mi.UInt32, 1), 4, moving.params)
    with pytest.raises(UnsupportedScene, match="forward mode has no derivatives of edges; use reverse mode"):
        tracer().tangent(job)
    with pytest.raises(UnsupportedScene, match="attached_sampling: follow has no derivatives of edges"):
        moving.gradient(tracer(attached_sampling="follow"), 1, 4)


@pytest.mark.parametrize("value", ["maybe", True])
def test_other_values_are_refused_in_one_line(value: Any):
    register()
    with pytest.raises(ValueError, match=r'^"edges" must be one of auto, off, on, not .*$'):
        make_integrator("reslrb", edges=value)
    with pytest.raises(RuntimeError, match='"edges" must be one of auto, off, on, not'):
        mi.load_dict({"type": "reslrb", "edges": value})


# ---- Recordings, kernels, memory and passes ----


def moved(step: int, **options: Any) -> tuple[list[np.ndarray], list[dict[str, int]]]:
    """Return the gradients of `step` steps, and the counts of recordings after each. The shape moves between steps."""
    moving, chosen = SMALL.moving(), tracer(**options)
    found, counts = [], []
    for number in range(step):
        moving.start["shape.x"] = np.float64(0.05 * number)
        found.append(np.concatenate([*moving.gradient(chosen, 5 + number, 16).values()]))
        counts.append(chosen.preparation.recordings.counts())
    return found, counts


def test_recorded_steps_equal_plain_steps():
    expected, none = moved(4, freeze=False)
    gc.collect()
    found, counts = moved(4, freeze=True)
    for a, b in zip(found, expected, strict=True):
        assert relative(a, b) < 1e-4
    assert none[-1] == {}
    assert counts[-1] == counts[-2] != {}


@pytest.mark.parametrize("freeze", a_few([False, True], ["True"]))
def test_later_steps_compile_nothing(freeze: bool):
    moving, chosen, kernels = SMALL.moving(), tracer(freeze=freeze), Kernels()
    for seed in range(1, 6):
        moving.start["shape.x"] = np.float64(0.01 * seed)
        found = kernels.new(lambda: moving.gradient(chosen, seed, 16))  # noqa: B023
        # A recording is made in the second step at the latest.
        assert seed <= 1 + 2 * freeze or not found, f"step {seed} compiled {len(found)} kernels"


SPP = 512


def peak(max_depth: int, paths: str) -> int:
    """Return the peak memory of a second step, in bytes beyond the memory before the step. Paths reach the maximum
    depth, without roulette.
    """
    moving, chosen = EdgeCase("box", "room").moving(), tracer(max_depth=max_depth, rr_depth=1000, paths=paths)
    moving.gradient(chosen, 1, SPP)
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
    moving.gradient(chosen, 2, SPP)
    dr.sync_thread()
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float)) - before


@pytest.mark.long
@pytest.mark.parametrize(("paths", "share"), [("light", 1 / 3), ("camera", 1 / 3), ("both", 0.6)])
def test_memory_is_flat_in_depth(paths: str, share: float):
    """The peak is that of a few images. Both kinds of paths together need about five more images than one."""
    peaks = {depth: peak(depth, paths) for depth in (4, 64)}
    print(peaks)
    count = SPP * SIZE**2
    assert max(peaks.values()) < share * count
    assert max(peaks.values()) - min(peaks.values()) < count / 30, peaks  # less than a bit for a path


@pytest.mark.long
def test_passes_agree_in_expectation():
    moving = SMALL.moving()
    one, several = (
        np.array([np.concatenate([*moving.gradient(chosen, seed, 512).values()]) for seed in seeds(12, block)])
        for block, chosen in enumerate((tracer(), tracer(samples_per_pass=128)))
    )
    agreement = compare(one, several, block=None)
    assert agreement, agreement
    assert agreement.relative_error < 0.07


@cache
def by_known_steps() -> np.ndarray:
    """Return gradients of steps with a known dL/dI."""
    moving = SMALL.moving()
    return np.array([np.concatenate([*moving.gradient(tracer(), seed, 256).values()]) for seed in seeds(8)])


@pytest.mark.parametrize("adjoint", a_few(["correlated", "independent", "batched"], ()))
def test_every_kind_of_step_contains_edges(adjoint: str):
    """dL/dI of a linear objective is the same for all kinds of steps."""
    moving = SMALL.moving()

    def step(chosen: StepIntegrator, scene: mi.Scene, sensor: int, weights: mi.TensorXf, **given: Any) -> StepResult:
        return gradient_step(chosen, scene, sensor, lambda image: dr.sum(image * weights, axis=None), adjoint=adjoint,
                             **given)  # fmt: skip

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("conformance.moving.known_step", step)
        found = np.array([np.concatenate([*moving.gradient(tracer(), seed, 256).values()]) for seed in seeds(8, 1)])
    agreement = compare(found, by_known_steps(), block=None)
    assert agreement, agreement
    assert agreement.relative_error < 0.15
