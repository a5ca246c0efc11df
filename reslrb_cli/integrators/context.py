"""Findings about a scene, its sensors and what is differentiated: what a light tracer finds out once, and keeps.

- `Differentiated`: which parameters of the scene are being differentiated, and what that asks of a walk.
- `bounces`: whether light that moves is scattered by a surface that is not specular, and then comes to be seen from
  another one. Only there do the two ways of `attached_sampling`, `follow` and `stay` (`estimators/kept.py`), differ. In
  a caustic of few segments light ends where it lands first.
- `Renewal`: what was found out about the scene, and is no longer so once shapes have moved.
- `attach`: the plan with attached derivatives, as `Motion` asks for them.
- `Preparation`: all that was found out about one scene, kept while that scene is traced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.integrators.freezing import Recordings
from reslrb_cli.scene.catalog import parameter_kind
from reslrb_cli.scene.deformation import BEAMS, PLACES, Surroundings, moving_emitter_obstacle, moving_shape_obstacle
from reslrb_cli.scene.graph import SceneGraph, emitted_rays, find_lamps
from reslrb_cli.scene.needs import check_supported, interpolates_normals, scene_needs
from reslrb_cli.transport.aim import worthwhile
from reslrb_cli.transport.bsdf import Scattering, stays_behind
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import sample_emission, used_numbers
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.film import film_blocks
from reslrb_cli.transport.plan import Plan, make_plan
from reslrb_cli.transport.random import make_coordinates
from reslrb_cli.transport.samples import Samples, passes
from reslrb_cli.transport.walk import Hooks, Vertex, walk

#: Where a parameter of a BSDF is this small, paths are followed and chosen in spite of it.
NEARLY_ZERO = 1e-2

#: What is a factor of a BSDF's value, where a roughness, say, is none.
FACTORS = ("reflectance", "transmittance", "base_color", "opacity", "weight")


@dataclass(frozen=True)
class Differentiated:
    """What tracks derivatives.

    `bsdf_nodes` are the nodes of BSDFs that have such parameters: textures, nested BSDFs, and meshes whose attributes
    textures read. `emission_nodes` are those of what emitters emit: emitters, and their textures. `zeros` says whether
    any of the parameters is zero, or, of those of BSDFs, nearly so. `shapes` are those that move, `emitters` those
    whose rays do.
    """

    bsdf_nodes: tuple[mi.Object, ...]
    emission_nodes: tuple[mi.Object, ...]
    zeros: bool
    shapes: tuple[mi.Shape, ...]
    emitters: tuple[mi.Emitter, ...]

    @property
    def emission(self) -> bool:
        """Whether what any emitter emits does."""
        return bool(self.emission_nodes)

    @property
    def moves(self) -> bool:
        """Whether anything moves that light leaves from or meets."""
        return bool(self.shapes or self.emitters)


def differentiated(params: mi.SceneParameters) -> Differentiated:
    """Look through a scene's parameters for those with derivatives enabled.

    Raises UnsupportedScene, with the reason, for one that light tracing has no derivative for, and would silently leave
    at zero.
    """
    nodes: dict[mi.Object, None] = {}
    emitting: dict[mi.Object, None] = {}
    shapes: dict[mi.Shape, None] = {}
    emitters: dict[mi.Emitter, None] = {}
    zeros = False
    with dr.resume_grad():  # where gradients are suspended, nothing says that it tracks them
        enabled = {key: value for key, value in params.items() if dr.grad_enabled(value)}
    for key, value in enabled.items():
        kind, node = parameter_kind(params, key), params.properties[key][2]
        if kind in ("bsdf", "attribute"):
            nodes[node] = None
        elif kind == "shape":
            _refuse(key, moving_shape_obstacle(node, key))
            shapes[node] = None
            if node.is_emitter():
                emitters[node.emitter()] = None
        elif kind == "emitter" and key.rpartition(".")[2] in (*PLACES, *BEAMS):
            _refuse(key, moving_emitter_obstacle(node, key))
            emitters[node] = None
            continue  # no factor of a path
        elif kind == "emitter":
            emitting[node] = None
        else:
            _refuse(key, "light tracing has derivatives of what light meets and leaves from, not of the sensor")
        dims = kind == "attribute" or (kind == "bsdf" and any(name in key for name in FACTORS))
        if kind != "shape":
            zeros = zeros or _has_singular(key, value, NEARLY_ZERO if dims else 0)
    return Differentiated(tuple(nodes), tuple(emitting), zeros, tuple(shapes), tuple(emitters))


def _refuse(key: str, reason: str | None) -> None:
    if reason is not None:
        raise UnsupportedScene(f"{key}: {reason}")


def _has_singular(key: str, value: dr.ArrayBase, least: float) -> bool:
    """Whether a factor of this parameter is `least` or less somewhere: near 0, or at 1 where 1 - x is a factor too."""
    flat = dr.detach(value.array if dr.is_tensor_v(value) else dr.ravel(value))
    singular = flat <= least
    if {"opacity", "weight"} & set(key.split(".")):
        singular |= flat == 1
    return bool(dr.any(singular))


#: Light paths that are looked at: of what they do not meet, the part in a derivative is small.
PATHS = 2**16

#: What is found is to be the same for all runs of a scene.
SEED = 0xB0A2CE


def bounces(plan: Plan, scene: mi.Scene, sensor: mi.Sensor) -> bool:
    """Whether any of so many paths is such; `plan` is one with attached derivatives in which vertices stay."""
    width, height = sensor.film().size()
    spp = max(PATHS // int(width * height), 1)
    with dr.suspend_grad():
        [samples, *_] = passes(plan, scene, sensor, dr.opaque(mi.UInt32, SEED), spp, None)
        found: Bounced = walk(samples, BouncedLight(plan, sample_emission(samples, samples.sampler()).emitter))
        return bool(dr.any(found.seen))


@dataclass
class Bounced:
    """Loop state: whether the path has met anything that moves, has then bounced, and has then been seen."""

    moved: mi.Bool
    bounced: mi.Bool
    seen: mi.Bool


class BouncedLight(Hooks):
    """Follow what moves through bounces."""

    def __init__(self, plan: Plan, emitter: mi.EmitterPtr) -> None:
        self.plan, self.emitter = plan, emitter

    def start(self, product: Product) -> Bounced:
        moved = mi.Bool(False)
        for moving in self.plan.moving_emitters:
            moved |= self.emitter == mi.EmitterPtr(moving)
        return Bounced(moved, mi.Bool(False), mi.Bool(False))

    def connection(self, state: Bounced, vertex: Vertex, connection: Connection, numbers: list[mi.Float]) -> Bounced:
        return Bounced(state.moved, state.bounced, state.seen | (connection.active & state.bounced))

    def scattering(self, state: Bounced, vertex: Vertex, connection: Connection, scattering: Scattering) -> Bounced:
        moved = state.moved | self.plan.moves(vertex.si.shape) | self.plan.differentiates(vertex.bsdf)
        staying = scattering.active & stays_behind(self.plan, vertex.bsdf, scattering.is_delta)
        return Bounced(moved, state.bounced | (moved & staying), state.seen)


class Renewal:
    """Brings the plans of one scene up to date, ahead of tracing; no more of them than has changed."""

    def __init__(self, scene: mi.Scene) -> None:
        graph = SceneGraph.of(scene)
        self._surroundings = Surroundings()
        self._infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters())
        self._lamps = [lamp.shape for lamp in find_lamps(scene, graph) if lamp.faces_by_area]
        # Vertices as they were when it was decided that interpolated normals need no correction, because meshes are
        # flat. They are held, so that other arrays do not get their place.
        smooth = [shape for shape in graph.shapes() if interpolates_normals(shape)]
        self._before = [(shape, _vertices(shape)) for shape in smooth]
        self._bent = False

    def renew(self, plan: Plan, scene: mi.Scene) -> Plan:
        """The plan of `scene`, as it is now."""
        for mesh in self._lamps:
            mesh.surface_area()  # else Mitsuba adds up its faces when they are first sampled, in the midst of tracing
        if self._infinite:
            plan = replace(plan, horizon=self._surroundings.follow(scene))
        # Once needed, kept: a mesh that bends and is flat again would have kernels compiled anew each time.
        self._bent = self._bent or any(
            [array.index for array in _vertices(shape)] != [array.index for array in before]
            for shape, before in self._before
        )
        return with_shading_normals(plan) if self._bent else plan


def with_shading_normals(plan: Plan) -> Plan:
    """The plan of a scene whose interpolated normals differ from its geometric ones."""
    return replace(plan, needs=replace(plan.needs, has_shading_normals=True))


def _vertices(mesh: mi.Mesh) -> tuple[mi.Float, mi.Float]:
    return mesh.vertex_positions_buffer(), mesh.vertex_normals_buffer()


@dataclass(frozen=True)
class Motion:
    """How derivatives of what moves light are taken.

    `attached` is `auto` (where a parameter moves anything), or says so; `filter_normalization` is `attached` or
    `detached`, `sampling` one of `auto`, `follow` and `stay`. Raises ValueError for anything else. `obstacle` is the
    reason where an integrator has none.
    """

    attached: bool | str = "auto"
    filter_normalization: str = "attached"
    obstacle: str | None = None
    sampling: str = "follow"

    def __post_init__(self) -> None:
        if self.attached not in (True, False, "auto"):
            raise ValueError('"attached" must be auto, true or false')
        if self.filter_normalization not in ("attached", "detached"):
            raise ValueError('"filter_normalization" must be attached or detached')
        if self.sampling not in ("auto", "follow", "stay"):
            raise ValueError('"attached_sampling" must be auto, follow or stay')


def stays(plan: Plan, sampling: str, bsdfs: Sequence[mi.BSDF]) -> tuple[bool, bool]:
    """`Plan.stays` and `Plan.glossy_follows`, for the BSDFs of a scene's surfaces."""
    smooth = [bsdf.flags() for bsdf in bsdfs if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)]
    glossy = [mi.has_flag(flags, mi.BSDFFlags.Glossy) for flags in smooth]
    if sampling == "follow" or plan.max_depth <= 2 or not glossy:
        return False, False  # no light goes on behind a vertex that is not specular
    return (True, False) if sampling == "stay" else (not all(glossy), any(glossy))


def attach(plan: Plan, which: Differentiated, motion: Motion, sensor: mi.Sensor, bsdfs: Sequence[mi.BSDF]) -> Plan:
    """The plan with attached derivatives, where they are asked for. Raises UnsupportedScene where there are none."""
    if motion.attached is False and which.moves:
        raise UnsupportedScene(
            "attached: false leaves out the derivatives of parameters that move light; leave it at auto", "attached"
        )
    if not (which.moves or (motion.attached is True and (which.bsdf_nodes or which.emission))):
        return plan
    if motion.obstacle is not None:
        raise UnsupportedScene(motion.obstacle, "estimator")
    if plan.needs.has_null:
        raise UnsupportedScene("attached derivatives do not go through masks and other surfaces with null lobes")
    if sensor.film().rfilter().is_box_filter():
        raise UnsupportedScene(
            f"sensor {sensor.id()} has a box filter, whose splats do not change while they move inside of a pixel; "
            "take a smooth one, such as gaussian, for derivatives of what moves light"
        )
    if any(interpolates_normals(shape) for shape in which.shapes):
        plan = with_shading_normals(plan)  # a flat mesh is about to bend
    staying, glossy_follows = stays(plan, motion.sampling, bsdfs)
    return replace(
        plan,
        attached=True,
        stays=staying,
        glossy_follows=glossy_follows,
        moving_shapes=which.shapes,
        moving_emitters=which.emitters,
        attached_normalization=motion.filter_normalization == "attached",
    )


def sensor_number(scene: mi.Scene, sensor: mi.Sensor) -> int:
    """The number of a sensor among those of a scene; of one that is none of them, the number after theirs."""
    known = [one.ptr for one in scene.sensors()]
    return known.index(sensor.ptr) if sensor.ptr in known else len(known)


class Preparation:
    """Plans by sensor, owners of parameters, and recordings of one scene: the last that was asked for."""

    def __init__(
        self, max_depth: int, rr_depth: int, hide_emitters: bool, motion: Motion, guided: bool = False,
        low_discrepancy: bool = False,
    ) -> None:  # fmt: skip
        self.guiding = Guiding() if guided else None
        #: Samples per pixel of the passes that tables learn from, where somebody said; else as passes come.
        self.expected: int | None = None
        self._met = 0
        self._low_discrepancy = low_discrepancy
        self._depths, self._hide_emitters, self._motion = (max_depth, rr_depth), hide_emitters, motion
        self._scene: tuple[int, mi.Scene | None] | None = None  # its address, and, so that it is not used again, itself
        self._plans: dict[int, Plan] = {}
        # BSDFs of its surfaces that use a node, and under None all of them.
        self._owners: dict[mi.Object | None, list[mi.BSDF]] = {}
        self._bounce: dict[int, bool] = {}  # by sensor
        self._track_zeros = False
        self._renewal: Renewal | None = None
        self.recordings = Recordings()

    def afresh(self, guided: bool | None, images: bool | None, low_discrepancy: bool | None) -> Preparation:
        """A new one with the same options, guided or not; `images`: samples of images alone, too. None: as this is."""
        own = self.guiding
        guided = own is not None if guided is None else guided
        low_discrepancy = self._low_discrepancy if low_discrepancy is None else low_discrepancy
        made = Preparation(*self._depths, self._hide_emitters, self._motion, guided, low_discrepancy)
        if made.guiding is not None:
            made.guiding.images = (own is None or own.images) if images is None else images
        made.expected = self.expected
        return made

    def draw_from(self, guiding: Guiding, scene: mi.Scene) -> None:
        """Draw guided samples of this scene from tables that others may draw from, too."""
        self._turn_to(scene)  # at first sight of a scene all is forgotten
        self.guiding = guiding

    def plan(
        self, scene: mi.Scene, sensor: mi.Sensor, params: mi.SceneParameters | None = None, spp: int | None = None
    ) -> Plan:
        """What a walk of this scene needs; `params` are those to look for derivatives in, and `spp` are the samples per
        pixel of a pass, where it is one that is asked for.

        Raises UnsupportedScene for what cannot work.
        """
        self._turn_to(scene)
        if self.guiding is not None and spp is not None:
            self._meet(spp, params is not None)
        if sensor.ptr not in self._plans:
            check_supported(scene, sensor, self._hide_emitters)
            needs = scene_needs(scene, sensor)
            self._renewal = self._renewal or Renewal(scene)
            settle(scene)
            self._plans[sensor.ptr] = make_plan(needs, *self._depths, self._hide_emitters)
            if self.guiding is not None or self._low_discrepancy:
                made = self._renewal.renew(self._plans[sensor.ptr], scene)
                [samples] = passes(made, scene, sensor, dr.opaque(mi.UInt32, 0), 1, None)
                self._plans[sensor.ptr] = self._with_numbers(self._plans[sensor.ptr], samples)
        assert self._renewal is not None
        plan = self._renewal.renew(self._plans[sensor.ptr], scene)
        if params is None:
            return plan
        which = differentiated(params)
        # Once needed, kept: otherwise kernels would be compiled anew whenever a texel enters or leaves zero.
        self._track_zeros |= which.zeros
        only = self._bsdfs(scene, which.bsdf_nodes)
        plan = plan.differentiating(bool(which.bsdf_nodes), which.emission, self._track_zeros, only)
        drawn = tuple(lamp for lamp in plan.needs.lamps if lamp.texture in which.emission_nodes)
        plan = attach(
            replace(plan, evened_lamps=drawn), which, self._motion, sensor, SceneGraph.of(scene).surface_bsdfs()
        )
        if plan.stays and self._motion.sampling == "auto" and not self._bounces_in(plan, scene, sensor):
            return replace(plan, stays=False, glossy_follows=False)
        return plan

    def _with_numbers(self, plan: Plan, samples: Samples) -> Plan:
        """The plan with what says how the numbers of its paths are drawn."""
        grid, aims = None, False
        if self.guiding is not None:
            spp, sensors = self.expected or self._met, samples.scene.sensors()
            pixels = max((int(dr.prod(one.film().size())) for one in sensors), default=samples.width)
            grid = self.guiding.grid_of(samples, spp * pixels or None)
            if worthwhile(plan.needs, plan.max_depth):
                number = sensor_number(samples.scene, samples.sensor)
                aims = self.guiding.aims(number, film_blocks(samples.sensor))
        plan = replace(plan, aims=aims)
        if not self._low_discrepancy:
            return replace(plan, grid=grid)
        sequence = make_coordinates(used_numbers(samples), len(plan.needs.emitters), plan.max_depth)
        return replace(plan, grid=grid, sequence=sequence)

    def _meet(self, spp: int, differentiated: bool) -> None:
        """Have cells so fine as passes of so many samples per pixel can tell: those of the first pass, whatever it is
        for, and of gradients that have more. An image that has more paths teaches the tables nothing."""
        if self.expected is None and (self._met == 0 or (differentiated and spp > self._met)):
            self._met = spp
            self._plans.clear()  # they have the grid

    def _bounces_in(self, plan: Plan, scene: mi.Scene, sensor: mi.Sensor) -> bool:
        """Whether vertices have to stay. Asked once, since kernels would be compiled anew for another answer."""
        if sensor.ptr not in self._bounce:
            self._bounce[sensor.ptr] = bounces(plan, scene, sensor)
        return self._bounce[sensor.ptr]

    def _turn_to(self, scene: mi.Scene) -> None:
        """Forget what was found out about another scene."""
        if self._scene is None or self._scene[0] != scene.ptr:
            # The scene's own integrator does not hold the scene: neither would ever be freed.
            tracer = getattr(scene.integrator(), "tracer", None)
            own = getattr(tracer, "preparation", None) is self
            self._scene = (scene.ptr, None if own else scene)
            self._plans.clear()
            self._owners.clear()
            self._bounce.clear()
            self._met = 0
            self._renewal = None
            self.recordings.clear()
            if self.guiding is not None:
                self.guiding.clear()

    def _bsdfs(self, scene: mi.Scene, nodes: tuple[mi.Object, ...]) -> tuple[mi.BSDF, ...]:
        """The surfaces' BSDFs that use any of these nodes; empty where that is all of them."""
        if any(node not in self._owners for node in nodes):
            graph = SceneGraph.of(scene)
            owners = {n: [n.bsdf()] if isinstance(n, mi.Shape) else graph.owning_bsdfs(n) for n in nodes}
            self._owners |= owners | {None: graph.surface_bsdfs()}
        used = {bsdf: None for node in nodes for bsdf in self._owners[node]}
        return () if all(bsdf in used for bsdf in self._owners.get(None, [])) else tuple(used)


def settle(scene: mi.Scene) -> None:
    """Have textures and emitters set up now what they set up when they are first used (padded storage, distributions).

    In the midst of tracing this would cut the first step's kernels in two, and the second would compile them anew.
    Raises UnsupportedScene where there is an emitter that Mitsuba cannot sample, such as a spot with a checkerboard.
    """
    with dr.suspend_grad():
        for texture in SceneGraph.of(scene).of_type(mi.Texture):
            if texture.class_name().startswith("BitmapTexture"):
                texture.eval(dr.zeros(mi.SurfaceInteraction3f))
        _, weight = emitted_rays(scene, mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
        dr.eval(weight)
