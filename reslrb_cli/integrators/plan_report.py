"""Features of a step's plan: whether the step has each feature, and why.

`autotune/sampling.py` has the features that a run decides.
"""

from __future__ import annotations

from dataclasses import dataclass

from reslrb_cli.transport.plan import Plan


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
        ("attached derivatives", plan.attached, "a parameter moves surfaces or emitters",
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
