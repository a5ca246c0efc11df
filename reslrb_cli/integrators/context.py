"""Facts about a scene, its sensors and its differentiated parameters. A light tracer determines each fact once and
keeps the result.

`Preparation` has the options and the facts of the last scene. Facts of a scene (`AboutScene`) and of a set of
parameters (`AboutParameters`) are separate objects. A new scene or a new parameter set gets new objects. A reused
tracer therefore gives the results of a new tracer. `Renewal` updates plans after shapes have moved.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.guiding.collect import bsdf_groups
from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.integrators.freezing import Recordings
from reslrb_cli.integrators.plans import (
    AttachedOptions,
    Differentiated,
    SamplingOptions,
    attach,
    bounces,
    set_up,
    with_shading_normals,
)
from reslrb_cli.scene.deformation import Surroundings
from reslrb_cli.scene.edges import EdgeSet, has_edges
from reslrb_cli.scene.graph import SceneGraph, interpolates_normals
from reslrb_cli.scene.load import warn_once
from reslrb_cli.scene.needs import blend_warning, check_paths, is_bent, light_finds_all, scene_needs, usual_paths
from reslrb_cli.scene.upsampling import values_of
from reslrb_cli.transport.aim import film_blocks, worthwhile
from reslrb_cli.transport.densities import EmitterDensities
from reslrb_cli.transport.emission import used_numbers
from reslrb_cli.transport.pixel_shares import PixelShares
from reslrb_cli.transport.plan import Plan, make_plan
from reslrb_cli.transport.samples import Samples, passes, tracked_values
from reslrb_cli.transport.sobol import make_coordinates


def _has_singular(key: str, value: dr.ArrayBase, least: float) -> bool:
    """True if a factor that depends on this parameter is at most `least` for some entry.

    The factor is near 0 if the parameter is near 0. If a parameter x also enters as the factor 1 - x, this factor is
    near 0 at x = 1.
    """
    flat = dr.detach(value.array if dr.is_tensor_v(value) else dr.ravel(value))
    singular = flat <= least
    if {"opacity", "weight"} & set(key.split(".")):
        singular |= flat == 1
    return bool(dr.any(singular))


#: `Plan.near`, relative to the diagonal of the smallest moving shape. tests/conformance/test_edges.py finds no bias.
NEAR = 0.05


class Renewal:
    """Updates of one scene's plans before tracing. Only plans that have changed are updated."""

    def __init__(self, scene: mi.Scene) -> None:
        graph = SceneGraph.of(scene)
        self._surroundings = Surroundings()
        self._infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters())
        self._lamps = [lamp.shape for lamp in graph.find_lamps(scene) if lamp.faces_by_area]
        # Vertices at the last check that meshes are flat, so that interpolated normals need no correction. They are
        # kept alive, so that other arrays do not get their addresses.
        smooth = [shape for shape in graph.shapes() if interpolates_normals(shape)]
        self._before = [(shape, _vertices(shape)) for shape in smooth]
        self._bent = False

    def renew(self, plan: Plan, scene: mi.Scene) -> Plan:
        """Return the current plan of `scene`."""
        for mesh in self._lamps:
            mesh.surface_area()  # otherwise Mitsuba sums the face areas at the first sample, during tracing
        if self._infinite:
            plan = replace(plan, horizon=self._surroundings.follow(scene))
        for number, (shape, before) in enumerate(self._before if not self._bent else []):
            now = _vertices(shape)
            if [array.index for array in now] != [array.index for array in before]:
                # Kept once needed: otherwise a mesh that bends and becomes flat again would recompile kernels each
                # time.
                self._bent = self._bent or is_bent(shape)
                self._before[number] = shape, now
        return with_shading_normals(plan) if self._bent else plan


def _vertices(mesh: mi.Mesh) -> tuple[mi.Float, mi.Float]:
    return mesh.vertex_positions_buffer(), mesh.vertex_normals_buffer()


def resolve_sensor(scene: mi.Scene, sensor: mi.Sensor | int) -> mi.Sensor:
    """Return a sensor of the scene. `sensor` is the sensor itself or its index. Raises ValueError for an invalid
    index.
    """
    if not isinstance(sensor, Integral):
        return sensor
    index, count = int(sensor), len(scene.sensors())
    if not 0 <= index < count:
        raise ValueError(f'"sensor" is {index}, but the scene has {sensors_in_words(count)}')
    return scene.sensors()[index]


def sensors_in_words(count: int) -> str:
    """Return a text with a scene's sensor count and sensor indices."""
    return "one sensor, index 0" if count == 1 else f"{count} sensors, indices 0 to {count - 1}"


@dataclass
class AboutParameters:
    """Facts of parameters that are differentiated together."""

    which: Differentiated
    track_zeros: bool = False
    #: `Plan.near`, or 0 while it is unknown.
    near: float = 0.0
    #: Whether vertices stay, by sensor.
    stays: dict[mi.Sensor, bool] = field(default_factory=dict)
    #: Distribution of camera paths over the pixels (H, W), by the number of the sensor.
    noted: dict[int, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def only_shapes_move(self) -> bool:
        """True if the parameters move shapes, but no lamps and no refracted light."""
        return bool(self.which.shapes) and not (self.which.emitters or self.which.bends)


@dataclass
class AboutScene:
    """Facts of one scene. The object holds the sensors, so no other sensor gets the address of a freed sensor."""

    sensors: list[mi.Sensor]
    #: Sensors that are not part of the scene, in the order in which they were used.
    others: list[mi.Sensor] = field(default_factory=list)
    #: Plans of images, by sensor, kind of paths, and whether something moves.
    plans: dict[tuple[mi.Sensor, str, bool], Plan] = field(default_factory=dict)
    #: The paths for `paths: auto`, by sensor, whether anything moves, and whether only light paths have the derivative.
    usual: dict[tuple[mi.Sensor, bool, bool], str] = field(default_factory=dict)
    #: BSDFs of its surfaces that use a node; the entry None has all of them.
    owners: dict[mi.Object | None, list[mi.BSDF]] = field(default_factory=dict)
    #: By parameters and the objects that have them.
    parameters: dict[tuple[tuple[str, mi.Object], ...], AboutParameters] = field(default_factory=dict)
    renewal: Renewal | None = None
    #: The densities of emitters, by their sources.
    emitters: dict[tuple[Any, ...], EmitterDensities] = field(default_factory=dict)
    recordings: Recordings = field(default_factory=Recordings)
    #: By the shapes that have them.
    edges: dict[tuple[Any, ...], EdgeSet] = field(default_factory=dict)
    #: By density and number of paths.
    shares: dict[tuple[int, int], PixelShares | None] = field(default_factory=dict)
    #: Samples per pixel for which the cells of guided emission are made.
    met: int = 0


class Preparation:
    """Options of a light tracer, and facts about the last scene."""

    def __init__(
        self, max_depth: int, rr_depth: int, hide_emitters: bool, motion: AttachedOptions, sampling: SamplingOptions
    ) -> None:  # fmt: skip
        self.sampling = sampling
        self.guiding = Guiding() if "guiding" in sampling.on else None
        self._depths, self._hide_emitters, self._motion = (max_depth, rr_depth), hide_emitters, motion
        self._scene: tuple[int, mi.Scene | None] | None = None  # its address, and, so that it is not used again, itself
        self._found = AboutScene([])

    @property
    def recordings(self) -> Recordings:
        """Recordings of launches on the scene."""
        return self._found.recordings

    def afresh(self, **changes: Any) -> Preparation:
        """Return a new object with the same options, except for changes of its `sampling`."""
        return Preparation(*self._depths, self._hide_emitters, self._motion, replace(self.sampling, **changes))

    def draw_from(self, guiding: Guiding, scene: mi.Scene) -> None:
        """Sample guided paths of this scene from shared tables."""
        self._turn_to(scene)  # a new scene forgets everything
        self.guiding = guiding

    def plan(
        self, scene: mi.Scene, sensor: mi.Sensor, params: mi.SceneParameters | None = None, spp: int | None = None,
        image: bool = False, forward: bool = False,
    ) -> Plan:  # fmt: skip
        """Return the plan to differentiate `params` in this scene. For None, nothing is differentiated.

        `spp` is the number of samples per pixel of one pass, if the plan is for a pass. With `image`, the plan is for
        the image of a step that differentiates `params`. The image's plan has the gradient's paths, but no derivatives.
        `forward` tells whether the plan is for forward mode. Raises UnsupportedScene.
        """
        self._turn_to(scene)
        if self.guiding is not None and spp is not None:
            self._meet(spp, params is not None and not image)
        about = None if params is None else self._look_through(params)
        moves = about is not None and (about.which.moves_light or self._motion.attached is True)
        paths, whole = self.sampling.paths, self.sampling.whole
        if paths == "auto":
            paths = self._usual_paths(scene, sensor, about, forward)
        if about is not None and moves and (self._motion.sampling == "follow" or not about.only_shapes_move):
            paths, whole = "light", whole and paths == "light"
        key = sensor, paths, moves
        if key not in self._found.plans:
            self._found.plans[key] = self._first_plan(*key, scene, whole)
        assert self._found.renewal is not None
        plan = self._found.renewal.renew(self._found.plans[key], scene)
        if about is None or image:
            return plan
        which = about.which
        only = self._bsdfs(scene, which.bsdf_nodes)
        plan = plan.differentiating(bool(which.bsdf_nodes), bool(which.emission_nodes), about.track_zeros, only)
        drawn = tuple(lamp for lamp in plan.needs.lamps if lamp.texture in which.emission_nodes)
        plan = replace(plan, evened_lamps=drawn, sampled_spectra=about.which.sampled_spectra)
        if moves:
            edged, motion = self._edges(which, scene) if "edges" in self.sampling.on else None, self._motion
            if edged is not None and self.sampling.chosen["edges"] == "auto":
                edged = self._possible_edges(edged, forward)
            if edged is not None:
                if motion.sampling == "follow":
                    why = "follow has no derivatives of edges between two surfaces; use auto, or edges: off"
                    raise UnsupportedScene(f"attached_sampling: {why}", "attached_sampling")
                if motion.sampling == "auto":
                    motion = replace(motion, sampling="stay")  # as in the terms of the edges
                if not about.near:  # once, because another number would recompile kernels
                    near = edged.moving or edged.occluders
                    about.near = NEAR * min(float(dr.norm(shape.bbox().extents())) for shape in near)
            plan = attach(plan, which, motion, scene, sensor)
            if edged is not None:
                plan = replace(plan, edged=edged.moving, occluders=edged.occluders, near=about.near)
        if plan.stays and plan.paths == "light" and self._motion.sampling == "auto" and not plan.has_edges:
            if sensor not in about.stays:  # once, because another answer would recompile kernels
                about.stays[sensor] = bounces(plan, scene, sensor)
            if not about.stays[sensor]:
                return replace(plan, stays=False, glossy_follows=False)
        return plan

    def noted(self, params: mi.SceneParameters) -> dict[int, NDArray[np.float32]]:
        """For each sensor, return the density of camera paths for the derivatives of `params`. The caller may add
        densities.
        """
        return self._look_through(params).noted

    def shares(self, known: NDArray[np.float32], paths: int) -> PixelShares | None:
        """Return the distribution of camera paths over the pixels, in proportion to the `known` density (H, W)."""
        made, key = self._found.shares, (id(known), paths)  # held by `SamplingOptions.given` or `AboutParameters`
        if key not in made:
            made[key] = PixelShares.of(known.ravel(), paths)
        return made[key]

    def sensor_number(self, scene: mi.Scene, sensor: mi.Sensor) -> int:
        """Return a sensor's number in the last scene. Sensors that are not part of it have the numbers that follow."""
        self._turn_to(scene)
        known = self._found.sensors + self._found.others
        if sensor not in known:
            self._found.others.append(sensor)
            return len(known)
        return known.index(sensor)

    def entries(self, plan: Plan, params: mi.SceneParameters) -> list[int]:
        """Return the number of differentiated entries of each group of BSDFs (`bsdf_groups`) and of emission."""
        which = self._look_through(params).which
        owners = self._found.owners
        nodes = [
            [node for node in which.bsdf_nodes if not group or any(bsdf in group for bsdf in owners[node])]
            for group in bsdf_groups(plan)
        ]
        nodes += [list(which.emission_nodes)] if plan.differentiate_emission else []
        return [sum(which.entries[node] for node in each) for each in nodes]

    def edges(self, plan: Plan) -> EdgeSet:
        """Return the edges of a plan."""
        return self._found.edges[plan.edged, plan.moving_emitters]

    def _edges(self, which: Differentiated, scene: mi.Scene) -> EdgeSet | None:
        """Return the edges that matter if `which` parameters change. Return None if there are none."""
        moving = tuple(shape for shape in which.shapes if has_edges(shape))
        if not moving and not which.emitters:
            return None
        made, key = self._found.edges, (moving, which.emitters)
        if key not in made:
            made[key] = EdgeSet(moving, scene, lamps_move=bool(which.emitters))
        return made[key] if moving or made[key].occluders else None

    def _possible_edges(self, edged: EdgeSet, forward: bool) -> EdgeSet | None:
        """Return the edges for `edges: auto`: all that are supported. Warn, once, if none are."""
        if not forward and self._motion.sampling != "follow":
            return edged
        lacking = "forward mode" if forward else "attached_sampling: follow"
        warnings.warn(
            f"reslrb: {lacking} has no derivatives of edges, so the light that moving outlines and shadows cover and "
            "uncover is missing (edges: auto); edges: off silences this line",
            stacklevel=2,
        )
        return None

    def emitters(self, plan: Plan, scene: mi.Scene) -> EmitterDensities:
        """Return the current densities of the scene's emitters, for a plan of the scene."""
        made, weights = self._found.emitters, tuple(float(emitter.sampling_weight()) for emitter in scene.emitters())
        key = weights, plan.horizon, plan.lit
        for old in [old for old in made if old[:2] != key[:2]]:
            del made[old]
        if key not in made:
            made[key] = EmitterDensities.of(plan, scene)
        return made[key]

    def _usual_paths(
        self, scene: mi.Scene, sensor: mi.Sensor, about: AboutParameters | None, forward: bool
    ) -> str:  # fmt: skip
        """Return the kinds of paths for `paths: auto`: those of a run that measures nothing. Warn, once, if the
        derivative lacks light that the image has.
        """
        moves = about is not None and about.which.moves_light
        alone = about is not None and moves and (forward or not about.only_shapes_move)
        made, key = self._found.usual, (sensor, moves, alone)
        if key in made:
            return made[key]
        if not alone:
            made[key] = usual_paths(scene, [sensor], self._depths[0], self._hide_emitters, moves)
            return made[key]
        made[key] = "light"
        if not light_finds_all(scene, [sensor], self._hide_emitters):
            what = "forward mode of moving shapes" if forward else "moving lamps"
            warnings.warn(
                f"reslrb: only light paths have derivatives for {what}, so these lack the light that the sensor sees "
                "in mirrors, through clear glass and past hidden lamps (paths: auto); paths: light silences this line",
                stacklevel=2,
            )
        return made[key]

    def _first_plan(self, sensor: mi.Sensor, paths: str, moves: bool, scene: mi.Scene, whole: bool) -> Plan:
        """Return the first image plan for a sensor and a kind of paths. `moves` is true if something moves."""
        check_paths(scene, sensor, paths, self._hide_emitters)
        lit = self.sampling.lit.get(self.sensor_number(scene, sensor))
        needs = scene_needs(scene, sensor, lit)
        if not self._found.plans and (warning := blend_warning(SceneGraph.of(scene), needs.blends)) is not None:
            warn_once(warning)
        renewal = self._found.renewal = self._found.renewal or Renewal(scene)
        set_up(scene)
        plan = make_plan(needs, *self._depths, self._hide_emitters)
        on = self.sampling.on - {"pixels"} if moves or paths == "light" else self.sampling.on
        plan = replace(plan, paths=paths, whole=whole, by_class=moves and paths == "both", on=on, lit=lit)
        hidden = self._hide_emitters and any(shape.is_emitter() for shape in scene.shapes())
        plan = replace(plan, sees_through_lamps=hidden and paths != "light")
        if plan.weighs:
            plan = renewal.renew(plan, scene)  # the horizon
        if plan.paths == "camera" or (self.guiding is None and "sequence" not in on):
            return plan
        [samples] = passes(renewal.renew(plan, scene), scene, sensor, dr.opaque(mi.UInt32, 0), 1, None)
        return self._with_numbers(plan, samples)

    def _look_through(self, params: mi.SceneParameters) -> AboutParameters:
        """Return the facts about the currently differentiated parameters, including whether zeros must be tracked.

        The owner of a parameter never changes. A parameter may start or stop tracking derivatives, and may become zero
        or nonzero.
        """
        enabled = tracked_values(params)
        these = tuple((key, params.properties[key][2]) for key in enabled)
        known = self._found.parameters
        if these not in known:
            known[these] = AboutParameters(Differentiated.of(params, enabled))
        about = known[these]
        # Kept once needed: otherwise kernels would be recompiled whenever a texel becomes or stops being zero.
        for key, value in about.which.least.items():
            own = values_of(params, key) if mi.is_spectral else enabled[key]
            about.track_zeros = about.track_zeros or _has_singular(key, own, value)
        return about

    def _with_numbers(self, plan: Plan, samples: Samples) -> Plan:
        """Return the plan after setting its kind of random numbers."""
        grid, aims = None, False
        if self.guiding is not None:
            spp, sensors = self.sampling.expected or self._found.met, samples.scene.sensors()
            pixels = max((int(dr.prod(one.film().size())) for one in sensors), default=samples.width)
            grid = self.guiding.grid_of(samples, spp * pixels or None)
            if worthwhile(plan.needs, plan.max_depth):
                number = self.sensor_number(samples.scene, samples.sensor)
                aims = self.guiding.aims(number, film_blocks(samples.sensor))
        plan = replace(plan, aims=aims)
        if "sequence" not in plan.on:
            return replace(plan, grid=grid)
        sequence = make_coordinates(used_numbers(samples), len(plan.needs.emitters), plan.max_depth)
        return replace(plan, grid=grid, sequence=sequence)

    def _meet(self, spp: int, differentiated: bool) -> None:
        """Make the cells as fine as passes of `spp` samples per pixel can resolve.

        The first pass, and gradients with more samples, refine the cells. Images with more paths do not refine the
        cells, because tables do not learn from images.
        """
        if self.sampling.expected is None and (self._found.met == 0 or (differentiated and spp > self._found.met)):
            self._found.met = spp
            self._found.plans.clear()  # they contain the grid

    def _turn_to(self, scene: mi.Scene) -> None:
        """Start new facts if `scene` differs from the last scene."""
        sensors = scene.sensors()
        if self._scene is None or self._scene[0] != scene.ptr or self._found.sensors != sensors:
            # The scene's own integrator does not hold the scene, because neither would be freed. It holds the scene's
            # sensors, because another scene at the same address has other sensors.
            tracer = getattr(scene.integrator(), "tracer", None)
            own = getattr(tracer, "preparation", None) is self
            self._scene = (scene.ptr, None if own else scene)
            self._found = AboutScene(sensors)
            if self.guiding is not None:
                self.guiding.clear()

    def _bsdfs(self, scene: mi.Scene, nodes: tuple[mi.Object, ...]) -> tuple[mi.BSDF, ...]:
        """Return the BSDFs of surfaces that use any of these nodes. The result is empty if all BSDFs do."""
        owners = self._found.owners
        if any(node not in owners for node in nodes):
            graph = SceneGraph.of(scene)
            owners |= {n: [n.bsdf()] if isinstance(n, mi.Shape) else graph.owning_bsdfs(n) for n in nodes}
            owners[None] = graph.surface_bsdfs()
        used = {bsdf: None for node in nodes for bsdf in owners[node]}
        return () if all(bsdf in used for bsdf in owners.get(None, [])) else tuple(used)
