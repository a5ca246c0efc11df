"""Edges of meshes, and rays beside outlines."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.edge_cases import BEHIND_THE_VEIL, BOTH, OCCLUDERS, SHAPES, SIZE, STEP, VIEW, EdgeCase, split_box
from conformance.moving import Moving

from reslrb_cli.estimators import chain_edges, edges, outline_rays
from reslrb_cli.estimators.stack import StackState
from reslrb_cli.integrators import reslrb
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.measure.gradients import integrator, seeds
from reslrb_cli.measure.scenes.small import load, rectangle, room, transform
from reslrb_cli.scene.edges import SPHERE, _edges_of, edge_normal, welded_edges
from reslrb_cli.scene.rays import is_hidden, ray_offset
from reslrb_cli.transport import jumps
from reslrb_cli.transport.bsdf import Hit, Specular, reflect_or_refract
from reslrb_cli.transport.chains import EVENTS, Chain, Chains, SensorChains, Target
from reslrb_cli.transport.edges import sample_outline, view_from_lamps, view_from_sensor
from reslrb_cli.transport.samples import Samples

pytestmark = pytest.mark.usefixtures("llvm")

# ---- Edges of a mesh ----

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def ends(found: np.ndarray) -> set[tuple[int, ...]]:
    """Return the ends of edges, in ascending order."""
    return {tuple(sorted(edge)) for edge in found[:, :2].tolist()}


def test_a_box_of_split_vertices_has_18_edges():
    """A box has 12 edges, and a diagonal on each of its six sides."""
    points, faces = split_box((0.3, 0, 1), (0.5, 0.4, 0.3))
    found = welded_edges(points, faces)
    assert (len(points), found.shape) == (24, (18, 6))
    a, b, c, d = (points[column] for column in found[:, :4].T)
    first, second = (np.cross(b - a, corner - a) for corner in (c, d))
    cos = np.sum(first * second, 1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
    # The faces of a diagonal lie in one plane, on different sides of it.
    assert np.sort(cos.round(6)).tolist() == [-1.0] * 6 + [0.0] * 12
    assert np.sum(np.linalg.norm(b - a, axis=1)[np.abs(cos) < 0.5]) == pytest.approx(4 * (1.0 + 0.8 + 0.6))


def test_an_open_sheet_has_edges_with_one_face():
    found = welded_edges(SQUARE, HALVES)
    single = found[:, 2] == found[:, 3]
    assert ends(found[single]) == {(0, 1), (1, 2), (2, 3), (0, 3)}
    assert ends(found[~single]) == {(0, 2)}
    assert set(found[~single][0, 2:4].tolist()) == {1, 3}


def test_an_edge_of_three_faces_has_a_row_for_each_pair():
    points = np.concatenate([SQUARE, [[0.5, 0.5, 1]]])
    found = welded_edges(points, np.concatenate([HALVES, [[0, 2, 4]]]))
    shared = found[[tuple(sorted(edge)) == (0, 2) for edge in found[:, :2].tolist()]]
    assert len(shared) == 2
    assert set(shared[:, 2:4].ravel().tolist()) == {1, 3, 4}


def test_a_mesh_without_faces_has_no_edges():
    assert welded_edges(SQUARE, np.zeros((0, 3), int)).shape == (0, 6)


@pytest.mark.parametrize("face", [(1, 1, 2), (1, 1, 1), (1, 4, 2)])
def test_a_face_without_area_adds_no_edge_of_its_own(face: tuple[int, int, int]):
    """Vertex 4 is at the place of vertex 1. The edge from 1 to 2 remains an edge of the sheet."""
    points = np.concatenate([SQUARE, SQUARE[1:2]])
    found = welded_edges(points, np.concatenate([HALVES, [face]]))
    assert ends(found) == ends(welded_edges(SQUARE, HALVES))


# ---- The edge next to an intersection ----

VIEWPOINT = np.array([0.3, -3.0, 2.2])


def seen_near_edges(scene: mi.Scene, shape: mi.Shape, placed: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the normals (N, 3) of edges next to intersections with a shape, the directions of the edges and those of
    the rays, and the distances. `placed` (4, 4) is applied to the shape's own edges.
    """
    numbers, found = np.random.default_rng(1), []
    for part in _edges_of(shape):
        rows = part.rows()
        ends = [np.array(corner).T for corner in (rows.a, rows.b, rows.c)]
        if part.rows().kind[0] == SPHERE:
            continue
        index = numbers.integers(len(ends[0]), size=512)
        a, b, c = (each[index] @ placed[:3, :3].T + placed[:3, 3] for each in ends)
        place = numbers.uniform(0.01, 0.99, (512, 1))
        p, along, radius = a + (b - a) * place, (b - a) / np.linalg.norm(b - a, axis=1)[:, None], float(rows.radius[0])
        if radius:  # the outline of the side of a cylinder
            to_y = VIEWPOINT - a
            to_y -= along * np.sum(along * to_y, 1)[:, None]
            distance = np.linalg.norm(to_y, axis=1)[:, None]
            cos, first = radius / distance, to_y / distance
            p += radius * (cos * first + np.sqrt(1 - cos**2) * np.cross(along, first)) * (1 - 1e-6)
        else:
            p += (c - p) * 1e-5 / np.linalg.norm(c - p, axis=1)[:, None]
        d = p - VIEWPOINT
        found.append((along, d / np.linalg.norm(d, axis=1)[:, None], p))
    along, d, p = (np.concatenate(each) for each in zip(*found, strict=True))
    ray = mi.Ray3f(mi.Point3f(VIEWPOINT.tolist()), mi.Vector3f(d.T.astype(np.float32)))
    pi = scene.ray_intersect_preliminary(ray, False, mi.Bool(True))
    n, distance = edge_normal(pi, ray, has_instances=True, active=pi.is_valid())
    # Edges at the back of the shape are hidden.
    hit = np.linalg.norm(np.array(ray(pi.t)).T - p, axis=1) < 1e-2
    return np.array(n).T[hit], along[hit], d[hit], np.array(distance)[hit]


@pytest.mark.parametrize("name", ["rectangle", "box", "disk", "cylinder", "ball", "instance"])
def test_normals_of_edges(name: str):
    """Mirrors and glass show edges whose direction is exact, however near to a corner."""
    placed = np.eye(4)
    things = {"shape": SHAPES["box" if name == "instance" else name](0.1, -0.1, 0.9)}
    if name == "instance":
        to_world = transform(translate=[0.2, 0.1, 0], rotate=([1, 2, 0], 30), scale=0.7)
        placed = np.array(to_world.matrix)
        group = {"type": "shapegroup", "part": things["shape"]}
        things = {
            "group": group,
            "shape": {"type": "instance", "to_world": to_world, "of": {"type": "ref", "id": "group"}},
        }
    scene = load({"type": "scene"} | things)
    shape = things["group"]["part"] if name == "instance" else scene.shapes()[0]
    n, along, d, distance = seen_near_edges(scene, shape, placed)
    across = np.linalg.norm(np.cross(along, d), axis=1)  # the direction of an edge seen end-on is unknown
    assert len(n) > 200
    limit = 1e-2 if name in ("disk", "cylinder") else 1e-4  # rims have chords
    assert np.percentile(np.abs(np.sum(n * along, 1)) / across, 97) < limit
    assert np.abs(np.sum(n * d, 1)).max() < 1e-5
    assert np.percentile(distance, 99) < 3e-5


def test_normals_of_the_outline_of_a_sphere():
    scene = load({"type": "scene", "shape": SHAPES["sphere"](0.1, -0.1, 0.9)})
    axis = np.array([0.1, -0.1, 0.9]) - VIEWPOINT
    far = np.linalg.norm(axis)
    frame, angle = np.linalg.svd(axis[None])[2][1:], np.linspace(0, 2 * np.pi, 64)
    out = np.cos(angle)[:, None] * frame[0] + np.sin(angle)[:, None] * frame[1]
    sine = 0.4 / far * (1 - 1e-6)
    d = axis / far * np.sqrt(1 - sine**2) + sine * out
    ray = mi.Ray3f(mi.Point3f(VIEWPOINT.tolist()), mi.Vector3f(d.T.astype(np.float32)))
    pi = scene.ray_intersect_preliminary(ray, False, mi.Bool(True))
    n, distance = edge_normal(pi, ray, has_instances=False, active=pi.is_valid())
    hit = np.array(pi.is_valid())
    expected = out * np.sqrt(1 - sine**2) - axis / far * sine
    assert hit.mean() > 0.9
    assert np.abs(np.array(n).T[hit] - expected[hit]).max() < 1e-4
    assert np.array(distance)[hit].max() == 0


# ---- Rays beside an outline ----


def outline_samples(moving: Moving, key: str, depth: int) -> Samples:
    """Return samples of outlines in a step that differentiates the parameter `key`."""
    dr.enable_grad(moving.params[key])
    moving.params.update()
    job = Job(moving.loaded, moving.loaded.sensors()[0], dr.opaque(mi.UInt32, 1), 16, moving.params)
    tracer = integrator("reslrb", depth, estimator="stack", edges="on")
    return outline_rays.edge_samples(tracer.passes(job)[0], edges.LAMP_EDGES)


def rays_beside_outlines(shape: str, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays for outlines of a shape in the light of a directional lamp. The first has the distances between
    an outline and the place beside it where the shape is hit, in ray offsets. The second is true where the ray that
    should miss the shape hits it.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(OCCLUDERS, "shape", lambda: {"shape": SHAPES[shape](0.1, -0.1, 0.9, size)})
        moving = EdgeCase("shape", "directional").moving()
    samples = outline_samples(moving, "shape.to_world", 2)
    chances = outline_rays.chances_of(samples, samples.stream(edges.LAMP_EDGES))
    assert samples.edges is not None
    outline = sample_outline(samples, samples.edges.lamp, view_from_lamps(samples, chances.viewpoint), chances)
    beside = outline_rays.both_sides(samples, outline)
    far = dr.norm(beside.over(beside.pi.t) - outline.p) / ray_offset(outline.p)
    active = np.array(beside.active)
    assert active.mean() > 0.7
    return np.array(far)[active], np.array(beside.x.is_valid() & (beside.x.shape == outline.shape))[active]


@pytest.mark.parametrize(("shape", "size"), [("disk", 8.0), ("sphere", 1.0), ("cylinder", 1.0)])
def test_rays_pass_an_outline_nearby(shape: str, size: float):
    """One of the two rays hits the shape near the outline, and the other ray misses the shape. If the outline is the
    rim of a cylinder, the other ray may hit the inside.
    """
    far, hits = rays_beside_outlines(shape, size)
    assert np.percentile(far, 90) < 1
    assert shape == "cylinder" or not hits.any()


@pytest.mark.parametrize("has_edges", [False, True])
def test_no_light_passes_a_corner_of_two_sheets(has_edges: bool):
    """Points of the floor lie nearer to the wall than the start of a shadow ray. The wall hides a target behind it."""
    floor, wall = {"type": "rectangle"}, {"type": "rectangle"}
    wall["to_world"] = transform(translate=[0, 0, 1], rotate=([1, 0, 0], 90))
    scene = load({"type": "scene", "floor": floor, "wall": wall})
    point = dr.zeros(mi.SurfaceInteraction3f, 64)
    point.p, point.n = mi.Point3f(dr.linspace(mi.Float, -0.9, 0.9, 64), 0, 0), mi.Normal3f(0, 0, 1)
    point.p.y = -outline_rays.BESIDE * ray_offset(point.p)
    assert dr.all(is_hidden(scene, point, mi.Point3f(0, 3, 1), has_edges, mi.Bool(True)))
    assert dr.none(is_hidden(scene, point, mi.Point3f(0, -3, 1), has_edges, mi.Bool(True)))


def test_light_from_other_surfaces_reaches_a_contact():
    """A box stands on the floor. Light from the room passes its lower edges, and arrives at the floor next to them."""
    moving = EdgeCase("standing", "room", 3).moving()
    samples = outline_samples(moving, "shape.vertex_positions", 3)
    between = outline_rays.sample_between(samples, samples.stream(edges.OTHER_EDGES))
    from_above = np.array((between.outline.p.z < 1e-4) & (between.outline.view.to_y.z > 0))
    assert np.mean(np.array(between.active)[from_above]) > 0.6


def test_things_before_the_clip_plane_hide_no_outline():
    """A lamp hangs between the sensor and the box."""
    seen = []
    for clip in (0.01, BEHIND_THE_VEIL):
        samples = outline_samples(EdgeCase("box", "veil", near_clip=clip).moving(), "shape.vertex_positions", 3)
        samples = outline_rays.for_camera(samples)
        chances = outline_rays.chances_of(samples, samples.stream(edges.SENSOR_EDGES))
        view = view_from_sensor(samples, chances.viewpoint)
        beside = outline_rays.both_sides(samples, sample_outline(samples, samples.edges.sensor, view, chances))
        seen.append(np.mean(np.array(beside.active)))
    print(seen)
    assert seen[1] > 2 * seen[0]
    assert seen[1] > 0.3


# ---- Edges behind chains ----


def test_every_number_selects_a_delta_lobe():
    """A blend of glass and a mirror has three lobes on its front side. Together they lose no light."""
    blend = {"type": "blendbsdf", "weight": 0.4, "glass": {"type": "dielectric"}, "mirror": {"type": "conductor"}}
    scene = load(room(pane={"type": "rectangle", "to_world": transform(translate=[0, 0, 2]), "bsdf": blend}))
    job = Job(scene, scene.sensors()[0], dr.opaque(mi.UInt32, 1), 16, None)
    plan = integrator("reslrb", 4, estimator="stack", paths="light").passes(job)[0].plan
    number = (dr.arange(mi.Float, 1000) + 0.5) / 1000
    ray = mi.Ray3f(mi.Point3f(number - 0.5, 0, 2.5), dr.normalize(mi.Vector3f(0.3, 0.2, -1)))
    si = scene.ray_intersect(ray)
    event = reflect_or_refract(plan, Hit(si, si.bsdf(), ray), number, mi.Bool(True))
    assert dr.all(event.active)
    assert np.mean(np.array(event.s)) == pytest.approx(1, abs=2e-3)


def test_choices_at_the_vertices_of_a_chain_are_independent():
    keys = mi.sample_tea_32(dr.arange(mi.UInt32, 1 << 17), mi.UInt32(77))[0]
    chain: Any = SensorChains(None, keys)  # type: ignore[arg-type]
    numbers = [np.array(chain.random(mi.UInt32(vertex), EVENTS).x) for vertex in range(4)]
    assert np.abs(np.corrcoef(numbers) - np.eye(4)).max() < 0.015
    assert np.abs(np.mean(numbers, 1) - 0.5).max() < 0.005


def test_the_outline_of_a_lamp_in_a_moved_mirror():
    """The image of the lamp is a square of `width` pixels. Its distance changes twice as fast as that of the mirror. At
    depth 3, points of the lamp have points y on the same lamp.
    """
    moving, distance, speed = EdgeCase("facing", "glowing", motion=("y",)).moving(), 4.2, 2
    moving.weigh(np.ones((SIZE, SIZE, 3)))
    width = 0.5 / distance * SIZE / (2 * np.tan(np.deg2rad(VIEW / 2)))
    tracer = integrator("reslrb", 3, estimator="stack", edges="on", paths="camera")
    found = [moving.gradient(tracer, seed, 64)["shape.y"][0] for seed in seeds(4)]
    assert np.mean(found) == pytest.approx(3 * 4 * width**2 * (-2 / distance) * speed, rel=0.03)


class OverMirror(Chains):
    """Chains from a pinhole over the mirror in the plane y = 0. There is no light."""

    cells, has_targets, passes_lamps, most = (4, 4), False, False, 1  # type: ignore[assignment]

    def begin(self, u: mi.Point2f) -> tuple[mi.Ray3f, mi.Spectrum]:
        way = dr.normalize(mi.Vector3f(0.4 * (u.x / 4 - 0.5), 1, 0.4 * (u.y / 4 - 0.5)))
        return mi.Ray3f(mi.Point3f(0, -4, 0), way), mi.Spectrum(1)

    def event(self, chain: Chain, active: mi.Bool) -> tuple[Hit, Specular]:
        d, passes = chain.ray.d, active & (chain.count == 0) & chain.pi.is_valid()
        return chain.vertex(active), Specular(mi.Vector3f(d.x, -d.y, d.z), mi.Spectrum(1), mi.Float(0), passes)

    def target(self, hit: Hit, count: mi.UInt32, active: mi.Bool) -> Target:
        return dr.zeros(Target)


@pytest.mark.parametrize("scale", [0.8, 200])
def test_a_curve_in_which_two_surfaces_intersect_is_no_edge(scale: float):
    """A mirror shows two sheets that intersect. If they are large, their outlines are out of view, and the only jumps
    are at the curve of the intersection.
    """
    sheets = {str(angle): rectangle({"type": "diffuse"}, transform(translate=[0.1, -8, 0.2],
                                                                  rotate=([1, 0.2, 0], angle), scale=scale))
              for angle in (-75, -105)}  # fmt: skip
    scene = load({"type": "scene", "mirror": rectangle({"type": "conductor"}, rotate=([1, 0, 0], 90)), **sheets})
    needs = SimpleNamespace(has_instances=False)
    samples: Any = SimpleNamespace(seed=mi.UInt32(3), scene=scene, plan=SimpleNamespace(has_edges=False, needs=needs))
    number, count, cells = dr.arange(mi.UInt32, 512), dr.opaque(mi.UInt32, 512), dr.opaque(mi.Float, 1, 16)
    chains = OverMirror(samples, mi.sample_tea_32(number, samples.seed)[0])
    line = jumps.random_lines(chains, dr.cumsum(cells), number, count)
    found, edge = (np.array(each) for each in (jumps.random_interval(chains, line).differs,
                                               jumps.sample_edge(chains, line).active))  # fmt: skip
    assert found.sum() > 10
    assert edge.any() == (scale < 1)


def test_edges_whose_chain_ends_early_do_not_count(monkeypatch: pytest.MonkeyPatch):
    """The chain from the middle of a jump may have fewer vertices than the chain beside the jump. Its stack then lacks
    vertices, whose memory is undefined.
    """
    case, stack_of = EdgeCase("slab", "area", 4, spp=64, options=BOTH), chain_edges._stack_of
    whole = case.gradients(1)

    def ends_at_once(p: Any, chains: Any, edge: Any, ring: Any) -> StackState:
        return stack_of(p, chains, replace(edge, active=edge.active & False), ring)

    with monkeypatch.context() as patch:
        patch.setattr(chain_edges, "_stack_of", ends_at_once)
        found = case.gradients(1)
    monkeypatch.setattr(reslrb, "has_edges_behind_chains", lambda plan: False)
    without = case.gradients(1)
    np.testing.assert_allclose(found, without, rtol=1e-4, atol=1e-5)
    assert np.abs(whole - without).max() > 0.01


# ---- Scenes of finite differences ----


def faces_towards_the_sensor(moving: Moving, **shifts: float) -> np.ndarray:
    """Return which faces of the shape have the sensor on their outer side, with some of the latents shifted."""
    moving.set({name: value + shifts.get(name, 0) for name, value in moving.start.items()})
    [shape] = [shape for shape in moving.loaded.shapes() if shape.id() == "shape"]
    view = np.array(moving.loaded.sensors()[0].world_transform() @ mi.Point3f(0)).ravel()
    corners = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)[np.array(shape.faces_buffer()).reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.sum(normals * (view - corners[:, 0]), 1) > 0


@pytest.mark.parametrize("occluder", ["ball", "smooth"])
def test_no_face_turns_edge_on_in_a_step_of_the_differences(occluder: str):
    """Where the sensor sees a face edge-on, the derivative jumps. It is that of one side, but central differences are
    the mean of both sides.
    """
    moving = EdgeCase(occluder, "area").moving()
    before = faces_towards_the_sensor(moving)
    assert 0.2 < before.mean() < 0.6
    for name in moving.start:
        for step in (STEP, -STEP):
            assert (faces_towards_the_sensor(moving, **{name: step}) == before).all(), (name, step)
