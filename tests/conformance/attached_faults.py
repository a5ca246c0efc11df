"""Faults to break attached derivatives with, and the case of attached_cases.py that is to find each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AttachedFault:
    """`right`, in the source of the function `where`, becomes `wrong`; `case` then fails.

    `stock`: naive AD of our walk shares it, so that `ptracer` has to find it. `quick`: part of the default suite.
    """

    name: str
    case: str
    where: str
    right: str
    wrong: str
    stock: bool = False
    quick: bool = False


BACK = "estimators.attached:walk_back"
FAULTS = [
    # ---- The walk back: naive AD of our walk is right ----
    AttachedFault("sign_of_adjoint_of_origin", "slab", BACK,
                  "scattered, dr.grad(ray.o),", "scattered, -dr.grad(ray.o),", quick=True),
    AttachedFault("direction_has_no_adjoint", "slab", BACK, " + dr.dot(following.d, adjoint.direction)", ""),
    AttachedFault("prefix_missing", "bounces", BACK, "dr.dot(P, reached * (own + later))",
                  "dr.sum(reached * (own + later))"),
    AttachedFault("own_contribution_not_carried", "bounces", BACK, "dr.detach(own + later))", "dr.detach(later))"),
    AttachedFault("roulette_weight_missing", "stack_of_2", BACK, "(r * B)", "B"),
    AttachedFault("normalization_the_other_way", "slab", BACK,
                  "plan.attached_normalization)", "not plan.attached_normalization)"),
    AttachedFault("film_position_does_not_move", "slab", BACK,
                  "image.lookup(there.u,", "image.lookup(dr.detach(there.u),"),
    AttachedFault("connection_without_geometry", "slab", BACK,
                  "there.f * there.weight", "there.f * dr.detach(there.weight)"),
    AttachedFault("rows_of_the_filter_detached", "slab", "transport.film:AdjointImage._filtered",
                  "weights_x[x] * weights_y[y]", "weights_x[x] * dr.detach(weights_y[y])"),
    AttachedFault("blocks_begin_anew", "stack_of_2", "estimators.attached:sweep",
                  "walk_back(again, size, pushed, left, bottom, adjoint)",
                  "walk_back(again, size, pushed, left, bottom, Adjoint.zero())"),
    AttachedFault("blocks_without_their_last_vertex", "stack_of_2", "estimators.attached:sweep",
                  "walk_back(again, size, pushed, left, bottom, adjoint)",
                  "walk_back(again, size, pushed, left - 1, bottom, adjoint)"),
    AttachedFault("emission_not_differentiated", "bounces", "estimators.attached:differentiate_start",
                  "concerns_emission(plan)", "plan.moving_emission"),
    AttachedFault("pushed_from_the_second_vertex", "mirror", "estimators.attached:begins",
                  "plan.moves(vertex.si.shape) | ", ""),
    AttachedFault("another_point_of_the_lens", "thin_lens", "estimators.attached:Pushing.scattering",
                  "aperture=[connection.sample]", "aperture=[mi.Point2f(0.5)]"),
    # ---- The segment: naive AD shares the fault, `ptracer` does not ----
    AttachedFault("next_ray_detached", "slab", "transport.walk:Segment.next_ray",
                  "return ray if attached else dr.detach(ray)", "return dr.detach(ray)", stock=True),
    AttachedFault("hit_point_detached", "slab", "transport.walk:find_vertex",
                  "pi.compute_surface_interaction(ray,", "pi.compute_surface_interaction(dr.detach(ray, False),",
                  stock=True),
    AttachedFault("shading_normals_detached", "slab", "transport.bsdf:shading_correction",
                  "dr.abs((cos_i * wo_dot_n) / (cos_o * wi_dot_n))",
                  "dr.detach(dr.abs((cos_i * wo_dot_n) / (cos_o * wi_dot_n)))", stock=True, quick=True),
    AttachedFault("importance_detached", "slab", "transport.connection:connect",
                  "Connection(importance * correction", "Connection(dr.detach(importance) * correction", stock=True),
    AttachedFault("density_of_rough_glass_detached", "rough_slab", "transport.bsdf:scatter",
                  "sample = (staying if plan.stays else following)(plan, si, bsdf, active, sample)",
                  "sample.weight = dr.detach(sample.weight)", stock=True),
]  # fmt: skip
