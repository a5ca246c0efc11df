"""Features of a step's plan: whether the step has each feature, and why."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from reslrb_cli.guiding.tables import sensor_bytes
from reslrb_cli.transport.plan import Plan

#: Names of features that runs choose and explain themselves (`with_reason`).
PATHS_FROM = "camera paths"
GUIDED = "guided emission"
SEQUENCE = "low-discrepancy numbers"
PIXELS = "camera paths by pixel"
EDGES = "edges of moving shapes"


@dataclass(frozen=True)
class PlanRow:
    """Feature of a plan. `needed` is true if the scene and its parameters need the feature, and `reason`
    explains why.
    """

    feature: str
    needed: bool
    reason: str


def plan_rows(plan: Plan) -> list[PlanRow]:
    """List all features, including those that the plan leaves out. The scene's own needs are not in the list."""
    camera_alone = plan.paths == "camera"
    no_start = "no path starts at a light" if camera_alone else None
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
        ("attached derivatives", plan.attached, "a parameter moves surfaces or emitters",
         "nothing moves: directions and film positions are constants"),
        ("vertices that stay", plan.attached and plan.stays,
         "after diffuse bounces light goes on to the same point, so edges at rest count",
         "all follow: no moving object is seen after a diffuse bounce, or attached_sampling: follow"),
        (EDGES, plan.has_edges, "the light that they cover and uncover has a derivative",
         "nothing moves, edges: off, or edges: auto before a run decides"),
        ("moving emitters", plan.moving_emission, "rays include the derivative of their origins",
         "emitters are at rest"),
        ("moving lamps in view", bool(plan.visible_moving_lamps),
         "their outlines move in the image", "no moving lamp is in view"),
        ("small lamps in view", bool(plan.small_lamps), "found by points on them instead of rays through pixels",
         "no lamp in view is smaller than a pixel"),
        ("placed lamps", bool(plan.placed_lamps) and not camera_alone,
         "spheres, parallel lamps and moving meshes: by the walk", no_start or "Mitsuba samples all emitters"),
        ("black texels of lamps", bool(plan.evened_lamps), "sampled too, since their derivatives count",
         "no texture of a lamp is differentiated: texels are sampled by radiance"),
        (PATHS_FROM, plan.paths != "light", f"paths: {plan.paths}", "paths: light"),
        (PIXELS, plan.shares_out, "most where noise affects the gradient most",
         "no camera paths" if plan.paths == "light" else "pixels: even"),
        (GUIDED, plan.grid is not None, _tables(plan), no_start or "guiding: off"),
        ("aimed scattering", plan.aimed, "a quarter of scattered paths go where the sensor looks",
         "only guided paths do, in scenes with glossy surfaces and without motion"),
        (SEQUENCE, plan.sequence is not None, "origins and first directions of paths are evenly distributed",
         no_start or "sequence: independent"),
        ("derivative of the filter's normalization", plan.attached and plan.attached_normalization,
         "as in finite differences", "nothing moves, or it is detached"),
        ("zero-factor bookkeeping", plan.track_zeros, "a parameter is zero or nearly zero somewhere",
         "no parameter is nearly zero"),
    )  # fmt: skip
    return [PlanRow(name, needed, present if needed else absent) for name, needed, present, absent in rows]


def with_reason(rows: Iterable[PlanRow], feature: str, reason: str) -> list[PlanRow]:
    """Replace the reason of a feature. If the plan has the feature, `reason` is added to the existing reason."""
    return [
        replace(row, reason=f"{row.reason}; {reason}" if row.needed else reason) if row.feature == feature else row
        for row in rows
    ]


def _tables(plan: Plan) -> str:
    if plan.grid is None:
        return ""
    size = f"{plan.grid.cells} cells, {sensor_bytes(plan.grid, plan.aims) / 2**20:.1f} MiB of tables"
    return f"light paths start and continue where earlier ones contributed: {size}"
