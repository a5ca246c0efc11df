"""The plan of a step, feature by feature: what calls for each, and what it costs in operations of the step's kernels.

A `Feature` says whether the scene and its parameters call for it, and has the same plan with the feature the other way
round. `report_plan` counts how many operations the kernels have with each feature, and how many without.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.guiding.tables import grid_for, sensor_bytes
from reslrb_cli.integrators import reslrb as lt
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.scene.catalog import list_parameters
from reslrb_cli.transport.film import film_blocks
from reslrb_cli.transport.guide import even_table
from reslrb_cli.transport.plan import UNBOUNDED, Plan
from reslrb_cli.transport.samples import passes
from reslrb_cli.transport.sobol import make_coordinates

#: The features that paths from the sensor, guiding, evenly spread numbers, and paths that are shared out are.
PATHS_FROM = "camera paths"
GUIDED = "guided emission"
SEQUENCE = "low-discrepancy numbers"
PIXELS = "camera paths by pixel"

#: Why camera paths alone have no use for what says where paths start at the lights.
NO_START = "no path begins at a light"

#: Kinds of parameters that features come with.
EMITTERS, BSDFS = "emitter", "bsdf"


@dataclass(frozen=True)
class Feature:
    """One feature of a plan.

    `needed(plan)` says whether it is part of it; `present` (of a plan that has it) and `absent` (of one that has not)
    say why. `toggle(plan)` is the plan without it, or with it, or the reason why there is no such plan; None: the step
    has it once all `parameters` of that kind are differentiated.
    """

    name: str
    needed: Callable[[Plan], bool]
    present: str | Callable[[Plan], str]
    absent: str | Callable[[Plan], str]
    toggle: Callable[[Plan], Plan | str | None]
    parameters: str | None = None


def _needs(member: str, **along: Any) -> Callable[[Plan], Plan]:
    """Toggle one of the scene's needs; `along` are members of the plan that go with it when it is left out."""

    def toggle(plan: Plan) -> Plan:
        change: dict[str, Any] = {member: not getattr(plan.needs, member)}
        return replace(plan, needs=replace(plan.needs, **change), **({} if change[member] else along))

    return toggle


def _visible(plan: Plan) -> Plan | str:
    if plan.visible_emission:
        return replace(plan, hide_emitters=True)
    if plan.max_depth == 0:
        return "paths have no edge"
    return replace(plan, hide_emitters=False, needs=replace(plan.needs, has_visible_emitters=True))


def _roulette(plan: Plan) -> Plan | str:
    if plan.roulette:
        return replace(plan, rr_depth=UNBOUNDED)
    return replace(plan, rr_depth=1) if plan.max_depth > 2 else "paths are too short for it"


def _environment(plan: Plan) -> Plan | str:
    if plan.environment_map:
        return replace(plan, needs=replace(plan.needs, environment=None))
    return "there is no environment map to place rays of"


def _zeros(plan: Plan) -> Plan | str:
    if not (plan.differentiate_bsdfs or plan.differentiate_emission):
        return "nothing is differentiated"
    return replace(plan, track_zeros=not plan.track_zeros)


def _derivatives(need: str, member: str, absent: str) -> Callable[[Plan], Plan | str]:
    """Toggle the derivatives of BSDFs with a property that the scene has to need; `absent` names what is missing."""

    def toggle(plan: Plan) -> Plan | str:
        if not (getattr(plan.needs, need) and plan.differentiate_bsdfs):
            return f"there are no {absent}, or no BSDF is differentiated"
        change: dict[str, Any] = {member: not getattr(plan, member)}
        return replace(plan, **change)

    return toggle


def _at_rest(plan: Plan) -> Plan | str:
    return replace(plan, moving_emitters=()) if plan.moving_emission else "no emitter has a parameter that moves it"


def _small(plan: Plan) -> Plan | str:
    if plan.small_lamps:
        return replace(plan, needs=replace(plan.needs, small_lamps=()))
    lamps = tuple(lamp for lamp in plan.needs.lamps if not lamp.parallel)
    if not (lamps and plan.visible_emission):
        return "no lamp is to be seen"
    if plan.differentiate_null:
        return "masks have derivatives, which rays through the pixels take"
    return replace(plan, needs=replace(plan.needs, small_lamps=lamps))


def _evened(plan: Plan) -> Plan | str:
    if plan.evened_lamps:
        return replace(plan, evened_lamps=())
    textured = tuple(lamp for lamp in plan.needs.lamps if lamp.texture is not None)
    return replace(plan, evened_lamps=textured) if textured else "no lamp has a texture"


def _normalization(plan: Plan) -> Plan | str:
    if not plan.attached:
        return "nothing moves"
    return replace(plan, attached_normalization=not plan.attached_normalization)


def _staying(plan: Plan) -> Plan | str:
    if not plan.attached:
        return "nothing moves"
    if plan.stays:
        return replace(plan, stays=False, glossy_follows=False)
    return "all follow" if plan.max_depth <= 2 else replace(plan, stays=True)


def _tables(plan: Plan) -> str:
    assert plan.grid is not None
    size = f"{plan.grid.cells} cells, {sensor_bytes(plan.grid, plan.aims) / 2**20:.1f} MiB of tables"
    return f"light paths start, and go on, where earlier ones had something to say: {size}"


def _aimed(plan: Plan) -> Plan | str:
    if plan.grid is None:
        return "emission is not guided"
    return replace(plan, aims=not plan.aims) if not plan.attached else "something moves"


def _guided(plan: Plan) -> Plan | str:
    if plan.paths == "camera":
        return NO_START
    if plan.grid is not None:
        return replace(plan, grid=None, aims=False)
    return replace(plan, grid=grid_for([True] * 4, [1.0] * len(plan.needs.emitters), 1))


def _paths(plan: Plan) -> Plan | str:
    if plan.attached:
        return "what moves light has light paths alone"
    if plan.paths == "camera":
        return "they take the place of light paths"
    return replace(plan, paths="light" if plan.weighs else "both", whole=not plan.weighs)


def _sequence(plan: Plan) -> Plan | str:
    if plan.paths == "camera":
        return NO_START
    if plan.sequence is not None:
        return replace(plan, sequence=None)
    return replace(plan, sequence=make_coordinates([True] * 4, len(plan.needs.emitters), plan.max_depth))


def _of_lights(plan: Plan, why: str) -> str:
    """Why the plan lacks a feature of paths that begin at the lights: there are none of these, or `why`."""
    return NO_START if plan.paths == "camera" else why


def _bsdfs(plan: Plan) -> Plan | None:
    if plan.differentiate_bsdfs:
        return plan.differentiating(False, plan.differentiate_emission, plan.track_zeros)
    return None


def _all_bsdfs(plan: Plan) -> str | None:
    if not plan.differentiate_bsdfs:
        return "no BSDF is differentiated"
    return None if plan.only_bsdfs else "all are asked for"


FEATURES = (
    Feature("visible emitters", lambda p: p.visible_emission, "an emitter may be seen directly",
            "hidden, or points and directions alone", _visible),
    Feature("several emitters", lambda p: len(p.needs.emitters) > 1, "one is drawn for each path",
            "the only one is sampled", lambda p: "follows from the number of emitters, in Mitsuba itself"),
    Feature("environment map", lambda p: p.environment_map, "its rays are placed by the walk",
            "none emits", _environment),
    Feature("roulette", lambda p: p.roulette, "rr_depth is below max_depth", "max_depth ends paths first", _roulette),
    Feature("shading-normal correction", lambda p: p.needs.has_shading_normals,
            "shapes have interpolated normals", "all normals are geometric", _needs("has_shading_normals")),
    Feature("bump and normal maps", lambda p: p.needs.has_perturbed_normals,
            "smooth lobes are evaluated with exchanged directions", "no BSDF perturbs normals",
            _needs("has_perturbed_normals")),
    Feature("delta lobes", lambda p: p.needs.has_delta_lobes, "mirrors or clear glass", "no BSDF has any",
            _needs("has_delta_lobes", differentiate_delta=False)),
    Feature("null surfaces", lambda p: p.needs.has_null, "shadow rays pass through masks",
            "every surface stops a shadow ray", _needs("has_null", differentiate_null=False)),
    Feature("instances", lambda p: p.needs.has_instances, "shapes are instanced", "no shape is instanced",
            _needs("has_instances")),
    Feature("lens sampling", lambda p: p.needs.thin_lens, "the aperture has a size", "the sensor is a pinhole",
            _needs("thin_lens")),
    Feature("time sampling", lambda p: p.needs.moving_shutter, "the shutter is open for some time",
            "the shutter opens for an instant", _needs("moving_shutter")),
    Feature("shifted principal point", lambda p: p.needs.principal_point, "the film is off the axis",
            "the film is on the axis", _needs("principal_point")),
    Feature("near clip plane", lambda p: p.needs.near_clip, "shadow rays end there: something may stand before it",
            "nothing stands before it", _needs("near_clip")),
    Feature("clip planes of a thin lens", lambda p: p.needs.lens_clip,
            "something may stand outside of them, or it focuses there", "the scene is between them, or none is a lens",
            _needs("lens_clip")),
    Feature("derivatives of emission", lambda p: p.differentiate_emission, "parameters of emitters",
            "no parameter of an emitter",
            lambda p: replace(p, differentiate_emission=False) if p.differentiate_emission else None, EMITTERS),
    Feature("derivatives of BSDFs", lambda p: p.differentiate_bsdfs, "parameters of BSDFs",
            "no parameter of a BSDF: no path is replayed", _bsdfs, BSDFS),
    Feature("derivatives of all BSDFs", lambda p: p.differentiate_bsdfs and not p.only_bsdfs,
            "each has a parameter", "others have no parameter", _all_bsdfs, BSDFS),
    Feature("derivatives of delta lobes", lambda p: p.differentiate_delta, "a BSDF with parameters has such lobes",
            "no BSDF with parameters has any", _derivatives("has_delta_lobes", "differentiate_delta", "delta lobes")),
    Feature("derivatives of null surfaces", lambda p: p.differentiate_null, "a BSDF with parameters is see-through",
            "no BSDF with parameters is", _derivatives("has_null", "differentiate_null", "such surfaces")),
    Feature("attached derivatives", lambda p: p.attached, "a parameter moves what light leaves from or meets",
            "nothing moves: directions and film positions are constants",
            lambda p: "without them parameters that move light have no derivative" if p.attached else "nothing moves"),
    Feature("vertices that stay", lambda p: p.attached and p.stays,
            "behind diffuse bounces light goes on to the same place, so that edges at rest count",
            "all follow: nothing that moves is seen behind a diffuse bounce, or attached_sampling: follow", _staying),
    Feature("moving emitters", lambda p: p.moving_emission, "rays have the derivative of where they start",
            "emitters are at rest", _at_rest),
    Feature("moving lamps in view", lambda p: bool(p.visible_moving_lamps),
            "their outline moves in the image; what they cover, and shadows, do not", "no lamp that moves is seen",
            lambda p: "goes with visible emitters, and with moving ones" if p.visible_moving_lamps
            else "no lamp moves, or none is to be seen"),
    Feature("small lamps in view", lambda p: bool(p.small_lamps), "found by points on them, not by rays through pixels",
            "no lamp in view is smaller than a pixel", _small),
    Feature("placed lamps", lambda p: bool(p.placed_lamps) and p.paths != "camera",
            "spheres, parallel lamps, meshes that move: by the walk",
            lambda p: _of_lights(p, "Mitsuba samples all emitters"),
            lambda p: _of_lights(p, "what Mitsuba makes of them is wrong" if p.placed_lamps else "there are none")),
    Feature("black texels of lamps", lambda p: bool(p.evened_lamps), "drawn too, since their derivative counts",
            "no texture of a lamp is differentiated: texels are drawn by their radiance", _evened),
    Feature(PATHS_FROM, lambda p: p.paths != "light", lambda p: f"paths: {p.paths}", "paths: light", _paths),
    Feature(PIXELS, lambda p: p.shares_out, "most where their noise weighs most in the gradient",
            lambda p: "no camera paths" if p.paths == "light" else "pixels: even",
            lambda p: "a run finds out which pixels need how many"),
    Feature(GUIDED, lambda p: p.grid is not None, _tables, lambda p: _of_lights(p, "guiding: off"), _guided),
    Feature("aimed scattering", lambda p: p.aimed, "a quarter of scattered paths go where the sensor looks",
            "only guided paths are, in scenes with glossy surfaces, where nothing moves", _aimed),
    Feature(SEQUENCE, lambda p: p.sequence is not None,
            "where paths start, and how they first scatter, is evenly spread",
            lambda p: _of_lights(p, "sequence: independent"), _sequence),
    Feature("derivative of the filter's normalization", lambda p: p.attached and p.attached_normalization,
            "as finite differences have it", "nothing moves, or it is detached", _normalization),
    Feature("zero-factor bookkeeping", lambda p: p.track_zeros, "a parameter is zero somewhere, or nearly so",
            "no parameter is nearly zero", _zeros),
    Feature("geometry read by BSDFs", lambda p: p.needs.bsdfs_read_geometry,
            "kept vertices are found again on their surface", "texture coordinates and directions are enough",
            _needs("bsdfs_read_geometry")),
)  # fmt: skip

PATHS = 64  # traced to have kernels compiled
LARGE = 100  # operations; smaller kernels develop images and prepare textures


@dataclass(frozen=True)
class PlanRow:
    """One feature: whether the plan has it and why, and the operations of the step's large kernels with and without it.

    Counts are None where there is none; `note` says why.
    """

    feature: str
    needed: bool
    reason: str
    operations_with: int | None = None
    operations_without: int | None = None
    note: str = ""


@dataclass(frozen=True)
class PlanReport:
    """A plan, feature by feature; `kernels` are the operations of each large kernel of the step as it is."""

    estimator: str
    kernels: list[int] | None
    rows: list[PlanRow]


def report_plan(integrator: Reslrb, scene: mi.Scene, sensor: mi.Sensor, params: mi.SceneParameters,
                keys: Iterable[str], *, known: bool, counts: bool = True, limit_s: float = 20.0
                ) -> PlanReport:  # fmt: skip
    """What a step of `integrator` (`reslrb`) has to do to differentiate the parameters `keys` of `params`.

    `known`: dL/dI is known before the paths are traced. With `counts`, every feature is compiled both ways, until
    `limit_s` seconds have passed.
    """
    keys, start = list(keys), time.perf_counter()
    with tracking(params, keys):
        plan = integrator.plan(scene, sensor, params)
        estimator = type(integrator.estimator).__name__.removesuffix("Estimator").lower()
        if not counts:
            return PlanReport(estimator, None, plan_rows(plan))
        kernels = count(integrator, plan, scene, sensor, known)
    rows = []
    for feature in FEATURES:
        row = _row(feature, plan)
        if time.perf_counter() - start > limit_s:
            rows.append(replace(row, note=f"not counted: {limit_s:.0f} s have passed"))
            continue
        other = _toggled(integrator, feature, plan, scene, sensor, params, keys, known)
        if isinstance(other, str):
            rows.append(replace(row, note=f"cannot be {'left out' if row.needed else 'forced'}: {other}"))
            continue
        here, there = sum(kernels), sum(other)
        both = (here, there) if row.needed else (there, here)
        rows.append(replace(row, operations_with=both[0], operations_without=both[1]))
    return PlanReport(estimator, kernels, rows)


def with_reason(rows: Iterable[PlanRow], feature: str, reason: str) -> list[PlanRow]:
    """The rows with a reason of one's own for a feature; beside that of the plan where it has it."""
    return [
        replace(row, reason=f"{row.reason}; {reason}" if row.needed else reason) if row.feature == feature else row
        for row in rows
    ]


def plan_rows(plan: Plan) -> list[PlanRow]:
    """The features of a plan, without counts."""
    return [_row(feature, plan) for feature in FEATURES]


def count(integrator: Reslrb, plan: Plan, scene: mi.Scene, sensor: mi.Sensor, known: bool) -> list[int]:
    """Operations of each large kernel of a step by this plan."""
    with dr.suspend_grad():
        table = None if plan.grid is None else even_table(plan.grid, film_blocks(sensor) if plan.aimed else None)
        emitters = integrator.preparation.emitters(plan, scene) if plan.weighs else None
        [samples] = passes(plan, scene, sensor, 0, 1, None, table, integrator.light_share, emitters)
        camera = samples.camera and replace(samples.camera, width=PATHS)
        samples = replace(samples, width=PATHS, camera=camera)
        channels = samples.film.film.base_channels_count()
        size = samples.film.size
        gradient = dr.full(mi.TensorXf, 1.0, (int(size.y), int(size.x), int(channels)))
        dr.make_opaque(gradient)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.suspend_grad():
        if known:
            lt.fused(integrator.estimator, [samples], gradient)
        else:
            _, state = lt.trace_image(integrator.estimator, [samples])
            lt.replay_all(integrator.estimator, [samples], gradient, state)
        dr.eval()
        dr.sync_thread()
        history = dr.kernel_history((dr.KernelType.JIT,))
    return [kernel["operation_count"] for kernel in history if kernel["operation_count"] >= LARGE]


@contextmanager
def tracking(params: mi.SceneParameters, keys: Iterable[str]) -> Iterator[None]:
    """Parameters `keys` of the scene track derivatives, for as long as the context lasts."""
    values = {key: type(params[key])(dr.detach(params[key])) for key in keys}
    for key, value in values.items():
        leaf = type(value)(value)
        dr.enable_grad(leaf)
        params[key] = leaf
    _update(params, values)
    try:
        yield
    finally:
        for key, value in values.items():
            params[key] = value
        _update(params, values)


def _update(params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """Have textures do now what they do when they are first looked up: it is no part of the step."""
    params.update()
    for key in keys:
        node = params.properties[key][2]
        if isinstance(node, mi.Texture):
            node.eval(dr.zeros(mi.SurfaceInteraction3f))
    dr.eval([params[key] for key in keys])


def _row(feature: Feature, plan: Plan) -> PlanRow:
    needed = feature.needed(plan)
    why = feature.present if needed else feature.absent
    return PlanRow(feature.name, needed, why if isinstance(why, str) else why(plan))


def _toggled(integrator: Reslrb, feature: Feature, plan: Plan, scene: mi.Scene, sensor: mi.Sensor,
             params: mi.SceneParameters, keys: list[str], known: bool) -> list[int] | str:  # fmt: skip
    """Kernels of the step with the feature the other way round, or the reason why there are none."""
    toggled = feature.toggle(plan)
    if isinstance(toggled, str):
        return toggled
    if toggled is None:
        infos = [info for info in list_parameters(params) if info.kind == feature.parameters]
        more = [info.key for info in infos if info.obstacle is None and info.key not in keys]
        if not more:
            return f"no {feature.parameters} has a parameter that can be differentiated"
        keys = [*keys, *more]
    with tracking(params, keys):
        if toggled is None:
            toggled = replace(integrator.plan(scene, sensor, params), track_zeros=plan.track_zeros)
        return count(integrator, toggled, scene, sensor, known)
