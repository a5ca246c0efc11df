"""Stock integrators as references: `ptracer`, `path` and `prb` for images, `ptracer` and `prb` for gradients.

Each function that checks a reference returns the reason against it, or None if it is valid. The section Baselines of
docs/method.md explains the reasons. Light tracing loses light along the film's border, from samples just outside of the
film. Images with camera paths lose no light there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config.parameters import tinted_by
from reslrb_cli.measure.gradients import moves_light
from reslrb_cli.optimization.loading import lit_emitters
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.measurements import Reference
from reslrb_cli.scene.catalog import parameter_kind
from reslrb_cli.scene.dispersion import bends_light
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.needs import PrimaryHits, SceneNeeds, look, scene_needs, stock_clip
from reslrb_cli.scene.upsampling import values_of

#: References that trace paths from the sensor.
CAMERA_PATHS = (Reference.PRB, Reference.PATH)

#: Longest paths without roulette; naive AD of stock integrators keeps all segments.
DEEPEST = 64
#: BSDFs whose sampling does not depend on their parameters, except a roughness.
_FIXED_SAMPLING = ("SmoothDiffuse", "TwoSidedBRDF", "SmoothConductor", "RoughConductor", "SmoothDielectric")
_ROUGHNESS = ("alpha", "alpha_u", "alpha_v")


@dataclass(frozen=True)
class Situation:
    """The conditions for references: a scene and a sensor, the maximum depth, and whether emitters are hidden.

    `attached` tells whether derivatives are attached. `moved` has the recovered parameters that move light. `paths`
    (`light`, `camera`, `both`) are the kinds of paths that the estimator traces. `lit` has the indices of the emitters
    that are on, if others are off. A valid reference contains exactly the same light as the estimator.
    """

    scene: Any
    params: Any
    graph: SceneGraph
    needs: SceneNeeds
    view: PrimaryHits
    max_depth: int
    hide_emitters: bool
    attached: bool = False
    moved: tuple[str, ...] = ()
    paths: str = "light"
    lit: tuple[int, ...] | None = None

    @classmethod
    def of(cls, scene: Any, sensor: Any, params: Any, max_depth: int, hide_emitters: bool, **others: Any) -> Situation:
        """Return the `Situation` of a loaded scene. `params` is the result of `mi.traverse` for the scene, and `others`
        are further fields.
        """
        graph, needs, view = SceneGraph.of(scene), scene_needs(scene, sensor, others.get("lit")), look(scene, sensor)
        return cls(scene, params, graph, needs, view, max_depth, hide_emitters, **others)

    @classmethod
    def of_problem(cls, problem: Problem, sensor: int) -> Situation:
        """Return the situation of a problem for the sensor with the index `sensor`."""
        params, options = problem.selection.params, problem.config.integrator.options()
        moved = tuple(key for key in problem.selection.scene_keys if moves_light(params, key))
        attached, seen = options.get("attached") is True or bool(moved), problem.scene.sensors()[sensor]
        depth, hidden = options["max_depth"], options["hide_emitters"]
        # Stock integrators in the problem itself are compared like light paths.
        paths = problem.paths if problem.config.integrator.type == "reslrb" else "light"
        lit = lit_emitters(problem.config, problem.scene).get(sensor)
        others = {"attached": attached, "moved": moved, "paths": paths, "lit": lit}
        return cls.of(problem.scene, seen, params, depth, hidden, **others)

    @property
    def has_pointlike(self) -> bool:
        """Whether any light comes from a point or from a single direction."""
        return any(int(emitter.flags()) & int(mi.EmitterFlags.Delta) for emitter in self.scene.emitters())

    @cached_property
    def has_mirrored(self) -> bool:
        """Whether a mesh is mirrored (`_is_mirrored`)."""
        return any(map(_is_mirrored, self.scene.shapes()))


def choose(reasons: Mapping[Reference, str | None]) -> tuple[Reference | None, str]:
    """Return the first valid reference, or None. Also return a text with the reasons against all invalid references."""
    refused = [f"not {name.value}: {reason}" for name, reason in reasons.items() if reason is not None]
    return next((name for name, reason in reasons.items() if reason is None), None), "; ".join(refused)


def of_image(
    at: Situation, names: Sequence[Reference] = (Reference.PTRACER, Reference.PRB)
) -> dict[Reference, str | None]:
    """Return the reason against the use of each stock integrator as the image's reference. The reason is None for a
    valid reference. Integrators that treat the film's border like the estimator come first, in the order of `names`.
    """
    reasons = {Reference.PTRACER: ptracer_image, Reference.PATH: path_image, Reference.PRB: prb_image}
    ordered = sorted(names, key=lambda name: (name in CAMERA_PATHS) != (at.paths != "light"))
    return {name: reasons[name](at) for name in ordered}


def of_gradient(at: Situation, key: str) -> dict[Reference, str | None]:
    """Return the reason against each stock integrator as reference for the gradient with respect to `key`. The
    integrators have the order of `of_image`. The derivative of a tint is that of its texture.
    """
    key = tinted_by(key) or key
    reasons = {Reference.PTRACER: ptracer_gradient, Reference.PRB: prb_gradient}
    return {name: reasons[name](at, key) for name in of_image(at)}


#: A condition, and the reason against a reference if it is true.
Check = tuple[Any, str]


def _first(*checks: Check) -> str | None:
    """Return the reason of the first check whose condition is true, or None."""
    return next((reason for holds, reason in checks if holds), None)


def ptracer_image(at: Situation) -> str | None:
    """Return the reason against stock light tracing (`ptracer`) without roulette as reference for the image, or
    None.
    """
    seen, clipping = at.paths != "light", stock_clip(at.needs)
    return _first(
        (any(map(_is_turned, at.scene.emitters())), "it has wrong emission from a rotated environment map"),
        *_wrong_everywhere(at),
        (any(sensor.film().class_name() == "SpecFilm" for sensor in at.scene.sensors()),
         "it does not splat on a specfilm"),
        (at.needs.has_null, "it does not connect through masks"),
        (at.has_mirrored, "it renders mirrored meshes black"),
        (at.needs.has_perturbed_normals, "it treats bump and normal maps differently"),
        (clipping, f"it {clipping}"),
        (not ends(at.max_depth), f"without roulette its paths must end at depth {DEEPEST} or before"),
        (seen and at.view.specular > 0, "it does not connect to glass or mirrors, which the sensor sees"),
        (seen and at.hide_emitters and at.view.emission > 0,
         "hidden emitters stop its paths, but not paths from the sensor"),
        (at.paths == "camera" and at.has_pointlike and at.needs.has_delta_lobes,
         "it finds light that paths from the sensor cannot find: point or parallel lights through glass or mirrors"),
    )  # fmt: skip


def ends(max_depth: int) -> bool:
    """Whether all paths end soon without roulette."""
    return 0 <= max_depth <= DEEPEST


def path_image(at: Situation) -> str | None:
    """Return the reason against the integrator `path` as reference for the image, or None."""
    lost = at.needs.has_null and (at.needs.environment is None or at.hide_emitters)
    return _first((lost, "it loses light reflected by masks if nothing is behind them")) or prb_image(at)


def _wrong_everywhere(at: Situation) -> tuple[Check, ...]:
    """Return checks of what all stock integrators render wrongly."""
    return (
        (at.lit is not None, "it cannot switch lamps off"),
        (at.needs.blends, "it renders blends of singular and smooth lobes wrongly"),
        (any(lamp.shared for lamp in at.needs.lamps),
         "it samples only one of the points of a textured lamp that have the same texture coordinates"),
    )  # fmt: skip


def camera_fault(at: Situation) -> str | None:
    """Return a part of the scene that `path` and `prb` render wrongly, as a reason, or None."""
    behind = at.hide_emitters and at.view.emission > 0 and any(not shape.is_mesh() for shape in at.graph.shapes())
    nearer = "it takes spheres, disks and cylinders behind hidden emitters for nearer than they are"
    return _first((behind, nearer), *_wrong_everywhere(at))


def prb_image(at: Situation) -> str | None:
    """Return the reason against the integrator `prb` as reference for the image, or None."""
    light, pointlike = at.paths == "light", at.has_pointlike
    return camera_fault(at) or _first(
        (any(emitter.class_name() == "DirectionalArea" for emitter in at.scene.emitters()),
         "camera paths cannot find a `directionalarea` emitter"),
        (pointlike and at.needs.has_null, "it cannot find point or parallel lights through masks"),
        # Light that glass and mirrors hide from it is hidden from other paths from the sensor, too.
        (pointlike and at.needs.has_delta_lobes and at.paths != "camera",
         "camera paths cannot find point or parallel lights through glass or mirrors"),
        (light and at.view.specular > 0, "the sensor sees glass or mirrors, to which light paths cannot connect"),
        (light and at.hide_emitters and at.view.emission > 0,
         "it sees through hidden emitters, which stop light paths"),
    )  # fmt: skip


def ptracer_gradient(at: Situation, key: str) -> str | None:
    """Return the reason against stock light tracing (`ptracer`) with naive AD as reference for the gradient with
    respect to `key`, or None.
    """
    if (reason := ptracer_image(at)) is not None:
        return reason
    if moves_light(at.params, key):
        return _ptracer_motion(at, (key,) if key in at.params.properties else at.moved)
    value = np.array(values_of(at.params, key))
    if np.any(np.all(value.reshape(-1, value.shape[-1] if value.ndim == 3 else value.size) == 0, axis=1)):
        return "it stops paths with throughput 0"
    if parameter_kind(at.params, key) == "emitter":
        return None if key.endswith(".value") else "it differentiates the sampling of a textured emitter"
    if at.attached and not at.needs.unfollowed:
        return None
    if key.split(".")[-2 if key.endswith((".value", ".data")) else -1] in _ROUGHNESS:
        return "it differentiates the sampling of roughness"
    others = {bsdf.class_name() for bsdf in bsdfs_of(at, key)} - set(_FIXED_SAMPLING)
    return f"it differentiates the sampling of a {sorted(others)[0]}" if others else None


def _ptracer_motion(at: Situation, keys: tuple[str, ...]) -> str | None:
    """Return the reason against stock light tracing (`ptracer`) as reference for the gradient with respect to
    parameters that move light, or None.
    """
    nodes = [at.params.properties[key][2] for key in keys]
    of = "it differentiates the sampling of a"
    return _first(
        (any(bends_light(at.params, key) for key in keys),
         "it draws wavelengths by itself, and keeps one in four behind each refraction"),
        (any(not isinstance(node, mi.Shape) or node.is_emitter() for node in nodes),
         "it does not differentiate the sampling of a moving emitter"),
        *((True, f"{of} {bsdf.class_name()}, but not its choice of a lobe") for bsdf in at.needs.unfollowed),
    )  # fmt: skip


def prb_gradient(at: Situation, key: str) -> str | None:
    """Return the reason against path replay backpropagation (`prb`) as reference for the gradient with respect to
    `key`, or None.
    """
    if moves_light(at.params, key):
        return "it has no derivatives of moving light"
    delta = parameter_kind(at.params, key) != "emitter" and any(
        int(bsdf.flags()) & int(mi.BSDFFlags.Delta) for bsdf in bsdfs_of(at, key)
    )
    return prb_image(at) or _first(
        (np.any(np.array(values_of(at.params, key)) == 0), "it loses derivatives if a channel is exactly 0"),
        (any(lamp.surrounds for lamp in at.needs.lamps),
         "it is some tenths of a percent off inside of an emitting sphere"),
        (delta, "it does not differentiate delta lobes and masks"),
    )  # fmt: skip


def bsdfs_of(at: Situation, key: str) -> list[Any]:
    """Return all BSDFs that a parameter belongs to, including nested and enclosing BSDFs."""
    node = at.params.properties[key][2]
    if isinstance(node, mi.Shape):  # an attribute that a texture of its BSDF reads
        return at.graph.nested_bsdfs(node.bsdf())
    return at.graph.bsdfs_above(node)


def _is_turned(emitter: Any) -> bool:
    """Whether the emitter is an environment map with a transformation other than the identity."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return False
    matrix = np.array(mi.traverse(emitter)["to_world"].matrix, np.float64).reshape(4, 4)
    return not np.allclose(matrix[:3, :3], np.eye(3))


def _is_mirrored(shape: mi.Shape) -> bool:
    """True if most faces of a mesh point against the mesh's vertex normals, as after a mirroring `to_world`."""
    params = mi.traverse(shape)
    if "vertex_normals" not in params or not shape.has_vertex_normals():
        return False
    points, normals = (np.array(params[name]).reshape(-1, 3) for name in ("vertex_positions", "vertex_normals"))
    a, b, c = np.moveaxis(np.array(params["faces"]).reshape(-1, 3), 1, 0)
    across = np.cross(points[b] - points[a], points[c] - points[a])
    return float(np.median(np.sum(across * (normals[a] + normals[b] + normals[c]), axis=1))) < 0
