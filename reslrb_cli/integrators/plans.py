"""Options of a light tracer, differentiated parameters, and the features of a plan that both need (`scene_rows`).
`autotune/sampling.py` has the features that a run decides.

`SamplingOptions` has the choice of paths. `AttachedOptions` has the options of attached derivatives, and `attach` adds
them to a plan. The values `follow` and `stay` of `attached_sampling` (`estimators/attached.py`) differ only if a
nonspecular surface scatters moving light to another visible surface. `bounces` tests whether this happens. In a caustic
of few segments, moving light does not bounce, because paths end where light first lands.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from reslrb_cli.config.integrators import PLAIN, traced_paths
from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators.base import one_of
from reslrb_cli.scene.catalog import entry_value, parameter_kind
from reslrb_cli.scene.deformation import BEAMS, PLACES, moving_obstacle
from reslrb_cli.scene.dispersion import bends_light
from reslrb_cli.scene.graph import SceneGraph, interpolates_normals, look_up
from reslrb_cli.scene.rays import emitted_rays
from reslrb_cli.transport.bsdf import Scattering, stays_behind
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import passes
from reslrb_cli.transport.walk import Hooks, Vertex, walk

#: Below this value of a BSDF parameter, paths are still followed and chosen.
NEARLY_ZERO = 1e-2

#: Parameters that are factors of a BSDF's value, unlike a roughness.
FACTORS = ("reflectance", "transmittance", "base_color", "opacity", "weight")


#: Spectra whose wavelengths Mitsuba samples in proportion to their values.
SAMPLED_SPECTRA = ("RegularSpectrum", "IrregularSpectrum")


@dataclass(frozen=True)
class Differentiated:
    """Parameters that track derivatives.

    - `bsdf_nodes` are the nodes of BSDFs that have differentiated parameters: textures, nested BSDFs, and meshes whose
        attributes are textures.
    - `emission_nodes` are the nodes of emission: emitters and their textures.
    - `shapes` are moving shapes, and `emitters` are emitters with moving rays. `bends` is true if a parameter changes
        directions of refraction. `moves_light` is true for any of these; derivatives are then attached.
    - `least` has a value for each parameter that is a factor of a path. A parameter up to this value counts as zero.
    - `entries` is the number of differentiated entries for each node.
    - `sampled_spectra` are as in `Plan`.
    """

    bsdf_nodes: tuple[mi.Object, ...]
    emission_nodes: tuple[mi.Object, ...]
    shapes: tuple[mi.Shape, ...]
    emitters: tuple[mi.Emitter, ...]
    least: dict[str, float]
    entries: dict[mi.Object, int]
    sampled_spectra: tuple[tuple[mi.Emitter, mi.Texture], ...] = ()
    bends: bool = False
    moves_light: bool = False

    @staticmethod
    def of(params: mi.SceneParameters, keys: Iterable[str]) -> Differentiated:
        """Return the differentiated parameters among `keys`.

        Raises UnsupportedScene for a parameter whose derivative would silently be zero in light tracing. The message
        gives the reason.
        """
        nodes: dict[mi.Object, None] = {}
        emitting: dict[mi.Object, None] = {}
        shapes: dict[mi.Shape, None] = {}
        emitters: dict[mi.Emitter, None] = {}
        least: dict[str, float] = {}
        entries: dict[mi.Object, int] = {}
        bends = False
        for key in keys:
            kind, node, obstacle = parameter_kind(params, key), params.properties[key][2], None
            entries[node] = entries.get(node, 0) + math.prod(dr.shape(entry_value(params, key)))
            if kind in ("bsdf", "attribute"):
                nodes[node] = None
                bends |= bends_light(params, key)
                dims = kind == "attribute" or any(name in key for name in FACTORS)
                least[key] = NEARLY_ZERO if dims else 0
            elif kind == "shape":
                obstacle = moving_obstacle(node, key)
                shapes[node] = None
                if node.is_emitter():
                    emitters[node.emitter()] = None
            elif kind == "emitter" and key.rpartition(".")[2] in (*PLACES, *BEAMS):
                obstacle = moving_obstacle(node, key)
                emitters[node] = None
            elif kind == "emitter":
                emitting[node] = None
                least[key] = 0
            else:
                obstacle = "light tracing has derivatives of surfaces and emitters, not of the sensor"
            if obstacle is not None:
                raise UnsupportedScene(f"{key}: {obstacle}")
        owners = {node: params.hierarchy[node][0] for node in emitting if node.class_name() in SAMPLED_SPECTRA}
        spectra = tuple((owner, node) for node, owner in owners.items() if isinstance(owner, mi.Emitter))
        return Differentiated(
            tuple(nodes),
            tuple(emitting),
            tuple(shapes),
            tuple(emitters),
            least,
            entries,
            spectra if mi.is_spectral else (),
            bends,
            bool(shapes or emitters or bends),
        )


@dataclass(frozen=True)
class AttachedOptions:
    """Options of attached derivatives.

    `attached` is true, false, or `auto` (true if a parameter moves anything). `filter_normalization` is `attached` or
    `detached`, and `sampling` is `auto`, `follow` or `stay`. Raises ValueError for other values. `obstacle` is the
    reason why an integrator has no attached derivatives.
    """

    attached: bool | str = "auto"
    filter_normalization: str = "attached"
    obstacle: str | None = None
    sampling: str = "follow"

    def __post_init__(self) -> None:
        if self.attached not in (True, False, "auto"):
            raise ValueError('"attached" must be auto, true or false')
        one_of("filter_normalization", self.filter_normalization, ("attached", "detached"))
        one_of("attached_sampling", self.sampling, ("auto", "follow", "stay"))


@dataclass(frozen=True)
class SamplingOptions:
    """Options of a light tracer for its choice of paths. Raises ValueError, which names the option, for a wrong value.

    - `paths` are light paths, camera paths, both, or `auto`: the scene decides (`usual_paths`). `light_share` is the
        share of light paths. With a share of 0 or 1, only one kind of paths remains.
    - `chosen` has the values of the other settings that a run may decide (`AUTO_VALUES`). A setting without an entry is
        plain. Camera paths alone are never guided.
    - If `whole` is true, images of light paths alone have the same film border as images with camera paths.
    - `given` are distributions (H, W) of camera paths over the pixels by sensor, for all scenes with the same sensors.
        Other distributions are stored for each scene and its parameters.
    - `lit` has the indices of the lit emitters by sensor, for sensors with unlit emitters.
    - `expected` is the sample count of the passes that tables learn from. If it is None, each pass uses its own count.
    """

    paths: str = "light"
    light_share: float = PLAIN["light_share"]
    chosen: Mapping[str, str] = field(default_factory=dict)
    whole: bool = False
    given: dict[int, NDArray[np.float32]] = field(default_factory=dict)
    lit: Mapping[int, tuple[int, ...]] = field(default_factory=dict)
    expected: int | None = None

    def __post_init__(self) -> None:
        one_of("paths", self.paths, ("auto", "light", "camera", "both"))
        if not 0 <= self.light_share <= 1:
            raise ValueError(f'"light_share" must lie in [0, 1], not {self.light_share}')
        paths = traced_paths(self.paths, self.light_share)
        # No table has the starts of camera paths, and tables have one emission for all sensors.
        chosen = {**self.chosen, "guiding": "off"} if paths == "camera" or self.lit else self.chosen
        for name, value in {"paths": paths, "whole": self.whole or paths != "light", "chosen": chosen}.items():
            object.__setattr__(self, name, value)

    @property
    def on(self) -> frozenset[str]:
        """Settings in `chosen` that are not plain, as for `Plan.on`."""
        return frozenset(name for name, value in self.chosen.items() if value != PLAIN[name])


def set_up(scene: mi.Scene) -> None:
    """Make textures and emitters set up their data (padded storage, distributions) now instead of at their first use.

    Data set-up during tracing would split the kernels of the first step. The second step would then compile new
    kernels. Camera paths do not need emitters whose rays Mitsuba cannot sample, and `check_paths` refuses light paths.
    """
    with dr.suspend_grad():
        for texture in SceneGraph.of(scene).bitmaps():
            look_up(texture)
        with contextlib.suppress(UnsupportedScene):
            dr.eval(emitted_rays(scene, mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))[1])


def stays(plan: Plan, sampling: str, bsdfs: Iterable[mi.BSDF]) -> tuple[bool, bool]:
    """Return `Plan.stays` and `Plan.glossy_follows` for the BSDFs of a scene's surfaces."""
    smooth = [bsdf.flags() for bsdf in bsdfs if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)]
    glossy = [mi.has_flag(flags, mi.BSDFFlags.Glossy) for flags in smooth]
    if plan.paths == "camera":
        return bool(smooth), False
    if sampling == "follow" or plan.max_depth <= 2 or not glossy:
        return False, False  # no light continues behind a nonspecular vertex
    return (True, False) if sampling == "stay" else (not all(glossy), any(glossy))


def attach(plan: Plan, which: Differentiated, motion: AttachedOptions, scene: mi.Scene, sensor: mi.Sensor) -> Plan:
    """Return the plan with attached derivatives if requested. Raises UnsupportedScene if attached derivatives are
    requested but do not exist.
    """
    moves = which.moves_light
    if motion.attached is False and moves:
        raise UnsupportedScene(
            "attached: false leaves out the derivatives of parameters that move light; use auto", "attached"
        )
    if not (moves or (motion.attached is True and (which.bsdf_nodes or which.emission_nodes))):
        return plan
    if motion.obstacle is not None:
        raise UnsupportedScene(motion.obstacle, "estimator")
    if plan.needs.has_null:
        raise UnsupportedScene("attached derivatives do not support masks and other surfaces with null lobes")
    if plan.paths != "camera" and sensor.film().rfilter().is_box_filter():
        raise UnsupportedScene(
            f"sensor {sensor.id()} has a box filter, whose splats do not change while they move within a pixel; use a "
            "smooth filter, such as gaussian, for derivatives of moving light"
        )
    if any(interpolates_normals(shape) for shape in which.shapes):
        plan = with_shading_normals(plan)  # a flat mesh is about to bend
    staying, glossy_follows = stays(plan, motion.sampling, SceneGraph.of(scene).surface_bsdfs())
    return replace(
        plan,
        attached=True,
        stays=staying,
        glossy_follows=glossy_follows,
        moving_shapes=which.shapes,
        moving_emitters=which.emitters,
        attached_normalization=motion.filter_normalization == "attached",
    )


def with_shading_normals(plan: Plan) -> Plan:
    """Return the plan of a scene whose interpolated normals differ from its geometric normals."""
    return replace(plan, needs=replace(plan.needs, has_shading_normals=True))


#: Light paths for the check; surfaces that they miss contribute little to a derivative.
PATHS = 2**16

#: Fixed seed: all runs of a scene must find the same.
SEED = 0xB0A2CE


def bounces(plan: Plan, scene: mi.Scene, sensor: mi.Sensor) -> bool:
    """True if at least one of a fixed number of light paths bounces. `plan` has attached derivatives, and its vertices
    stay at their places.
    """
    width, height = sensor.film().size()
    spp = max(PATHS // int(width * height), 1)
    with dr.suspend_grad():
        [samples, *_] = passes(plan, scene, sensor, dr.opaque(mi.UInt32, SEED), spp, None)
        found: Bounced = walk(samples, BouncedLight(plan, sample_emission(samples, samples.sampler()).emitter))
        return bool(dr.any(found.seen))


@dataclass
class Bounced:
    """Loop state of a path, in three flags. The path has met something that moves, has bounced afterwards, and has been
    seen after the bounce.
    """

    moved: mi.Bool
    bounced: mi.Bool
    seen: mi.Bool


class BouncedLight(Hooks):
    """Hooks that follow moving light through bounces."""

    def __init__(self, plan: Plan, emitter: mi.EmitterPtr) -> None:
        self.plan, self.emitter = plan, emitter

    def start(self, product: Product) -> Bounced:
        moved = mi.Bool(False)
        for moving in self.plan.moving_emitters:
            moved |= self.emitter == mi.EmitterPtr(moving)
        return Bounced(moved, mi.Bool(False), mi.Bool(False))

    def vertex(
        self, state: Bounced, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Bounced:  # fmt: skip
        seen = state.seen | (connection.active & state.bounced)
        moved = state.moved | self.plan.moves(vertex.si.shape) | self.plan.differentiates(vertex.bsdf)
        staying = scattering.active & stays_behind(self.plan, vertex.bsdf, scattering.is_delta)
        return Bounced(moved, state.bounced | (moved & staying), seen)


# --- the features of a plan, in words ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlanRow:
    """Feature of a plan. `needed` is true if the scene and its parameters need the feature, and `reason`
    explains why.
    """

    feature: str
    needed: bool
    reason: str

    @staticmethod
    def of(feature: str, needed: bool, present: str, absent: str) -> PlanRow:
        """Return the row with the reason `present` if the feature is needed, otherwise with `absent`."""
        return PlanRow(feature, needed, present if needed else absent)


def without_light(plan: Plan) -> str | None:
    """Return why a plan leaves out features of light paths, or None if it has light paths."""
    return "no path starts at a light" if plan.paths == "camera" else None


def scene_rows(plan: Plan) -> list[PlanRow]:
    """Return the features that the scene and its parameters decide, including those that the plan leaves out. The
    scene's own needs are not in the list.
    """
    no_start = without_light(plan)
    rows = (
        ("visible emitters", plan.visible_emission, "an emitter may be directly visible",
         "hidden, or only points and directions"),
        ("several emitters", len(plan.needs.emitters) > 1, "each path chooses one", "the only one is sampled"),
        ("environment map", plan.environment_map, "the walk places its rays", "none emits"),
        ("roulette", plan.roulette, "rr_depth is below max_depth", "max_depth ends paths earlier"),
        ("derivatives of emission", plan.differentiate_emission, "parameters of emitters",
         "no parameter of an emitter"),
        ("derivatives of BSDFs", plan.differentiate_bsdfs, "parameters of BSDFs",
         "no parameter of a BSDF: no path is replayed"),
        ("derivatives of all BSDFs", plan.differentiate_bsdfs and not plan.only_bsdfs, "each has a parameter",
         "others have no parameter"),
        ("derivatives of delta lobes", plan.differentiate_delta, "a BSDF with parameters has such lobes",
         "no BSDF with parameters has any"),
        ("derivatives of null surfaces", plan.differentiate_null, "a BSDF with parameters is transparent",
         "no BSDF with parameters is transparent"),
        ("attached derivatives", plan.attached, "a parameter moves surfaces, emitters or refracted light",
         "nothing moves: directions and film positions are constants"),
        ("vertices that stay", plan.attached and plan.stays,
         "after diffuse bounces light goes on to the same point, so edges at rest count",
         "all follow: no moving object is seen after a diffuse bounce, or attached_sampling: follow"),
        ("moving emitters", plan.moving_emission, "rays include the derivative of their origins",
         "emitters are at rest"),
        ("moving lamps in view", bool(plan.visible_moving_lamps),
         "their outlines move in the image", "no moving lamp is in view"),
        ("small lamps in view", bool(plan.small_lamps), "found by points on them instead of rays through pixels",
         "no lamp in view is smaller than a pixel"),
        ("placed lamps", bool(plan.placed_lamps) and no_start is None,
         "spheres, parallel lamps and moving meshes: by the walk", no_start or "Mitsuba samples all emitters"),
        ("black texels of lamps", bool(plan.evened_lamps), "sampled too, since their derivatives count",
         "no texture of a lamp is differentiated: texels are sampled by radiance"),
        ("aimed scattering", plan.aimed, "a quarter of scattered paths go where the sensor looks",
         "only guided paths do, in scenes with glossy surfaces and without motion"),
        ("derivative of the filter's normalization", plan.attached and plan.attached_normalization,
         "as in finite differences", "nothing moves, or it is detached"),
        ("zero-factor bookkeeping", plan.track_zeros, "a parameter is zero or nearly zero somewhere",
         "no parameter is nearly zero"),
    )  # fmt: skip
    return [PlanRow.of(*row) for row in rows]
