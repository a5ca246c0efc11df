"""Cases of test_attached.py, and faults that break attached derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np
from conformance.moving import (
    GLASS,
    WHITE,
    Moving,
    beam,
    camera,
    enclosed,
    flat,
    rippled,
    sheet,
    textured,
    turned,
    under_glass,
)
from measure.faults import Fault

from reslrb_cli.measure.scenes.moving import Latents, Place
from reslrb_cli.measure.scenes.small import bitmap, diffuse, rgb, transform

# The cases of test_attached.py: the scene, its moving parts, and the reference of the comparison.

#: Relative L2 distance that rounding causes at equal seeds, through smooth glass and mirrors, and through rough
#: surfaces.
SMOOTH, ROUGH = 5e-5, 5e-4


@dataclass(frozen=True)
class AttachedCase:
    """One scene and its differentiated parameters, in the form that `Moving` takes. `scene` is a function because it
    needs Mitsuba.

    If `stock` is true, Mitsuba's own `ptracer` has these derivatives too. `both` holds options of all integrators, and
    `ours` holds options of `reslrb` alone. If `quick` is true, the case is part of the default suite.
    """

    name: str
    scene: Callable[[], dict[str, Any]]
    start: dict[str, Any]
    place: Place | None = None
    depth: int = 5
    stock: bool = True
    limit: float = SMOOTH
    spp: int = 16
    sensor: int = 0
    both: dict[str, Any] = field(default_factory=dict)
    ours: dict[str, Any] = field(default_factory=dict)
    quick: bool = False

    def moving(self) -> Moving:
        """Load the scene and return it as a `Moving`."""
        return Moving(self.scene(), self.start, self.place, self.sensor)


def rough(alpha: float = 0.1) -> dict[str, Any]:
    """Return the BSDF of rough glass."""
    return {"type": "roughdielectric", "distribution": "ggx", "alpha": alpha, "int_ior": 1.5}


def mirrored(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return a scene with slanted parallel light on a rippled mirror, which faces up. The mirror reflects the light to
    a receiver above. The camera is between them.
    """
    down = mi.ScalarTransform4f().look_at([-2, 2, 0], [0, 0, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale(0.5)
    receiver = {"type": "rectangle", "to_world": transform(translate=[2, 2, 0], rotate=([1, 0, 0], 90)), "bsdf": WHITE}
    up = mi.ScalarTransform4f().look_at([2, 1, 0], [2, 2, 0], [0, 0, -1])
    return {"type": "scene", "camera": camera() | {"to_world": up}, "mirror": sheet("mirror", bsdf, 0.0),
            "lamp": beam() | {"to_world": down}, "receiver": receiver}  # fmt: skip


def two_lenses() -> dict[str, Any]:
    """Return the scene with a ball of glass between the slab and the receiver."""
    ball = {"type": "sphere", "center": [0.1, 1.2, 0.05], "radius": 0.3, "bsdf": GLASS}
    return under_glass(ball=ball, camera=camera() | {"to_world": mi.ScalarTransform4f().look_at(
        [0.9, 0.9, 0.9], [0, 0, 0], [0, 1, 0])})  # fmt: skip


def move_ball(params: mi.SceneParameters, latents: Latents) -> None:
    """Shift the ball to the side, and scale the ball."""
    moved = mi.AffineTransform4f().translate(mi.Vector3f(latents["x"], 0, 0))
    ball = mi.AffineTransform4f(transform(translate=[0.1, 1.2, 0.05], scale=0.3).matrix)
    params["ball.to_world"] = moved @ ball @ mi.AffineTransform4f().scale(latents["size"])


def tilt_receiver(params: mi.SceneParameters, latents: Latents) -> None:
    """Turn the receiver about z, and lift it."""
    moved = turned(latents["angle"], [0, 0, 1], [0, latents["y"], 0])
    params["receiver.to_world"] = moved @ mi.AffineTransform4f(transform(rotate=([1, 0, 0], -90)).matrix)


def mapped() -> dict[str, Any]:
    """Return the receiver with a normal map. The BSDF does not sample a part of the light that this receiver
    scatters.
    """
    normals = np.random.default_rng(3).uniform(0.35, 0.65, (4, 4, 3))
    normals[..., 2] = 1
    bsdf = {"type": "normalmap", "normalmap": bitmap(normals, "bilinear"), "bsdf": diffuse(0.7, 0.5, 0.6)}
    return textured() | {"bsdf": bsdf}


def stretch_slab(params: mi.SceneParameters, latents: Latents) -> None:
    """Multiply the slab's ripples by a number, and lift the slab."""
    heights, rest = (mi.Float(rippled(2.0, 12, ripples)[0].astype(np.float32).ravel()) for ripples in (1.0, 0.0))
    up = np.tile(np.array([0, 1, 0], np.float32), 13 * 13)
    params["slab.vertex_positions"] = rest + (heights - rest) * latents["size"] + mi.Float(up) * latents["lift"]


SLAB = {"slab.vertex_positions": None}
CASES = [
    # ---- What a walk may do, through smooth glass ----
    AttachedCase("slab", under_glass, SLAB, quick=True),
    AttachedCase("slab_9", under_glass, SLAB, depth=9),
    AttachedCase("texture_beside", lambda: under_glass(receiver=textured()),
                 SLAB | {"receiver.bsdf.reflectance.data": None}, depth=6),
    AttachedCase("bounces", lambda: enclosed(receiver=textured()),
                 SLAB | {"receiver.bsdf.reflectance.data": None, "lamp.emitter.radiance.value": None,
                         "shell.bsdf.reflectance.value": None}, depth=7),
    AttachedCase("bounces_4", enclosed, SLAB, depth=4),
    AttachedCase("normal_map", lambda: enclosed(receiver=mapped()), SLAB, depth=6, stock=False),
    AttachedCase("two_lenses", two_lenses, SLAB | {"x": 0.0, "size": 1.0}, move_ball, depth=9),
    AttachedCase("roulette", lambda: enclosed(albedo=0.9), SLAB, depth=10, stock=False, both={"rr_depth": 2}),
    AttachedCase("stack_of_2", lambda: enclosed(albedo=0.9), SLAB, depth=6, stock=False, ours={"stack_size": 2},
                 both={"rr_depth": 3}),
    AttachedCase("passes", under_glass, SLAB, stock=False, both={"samples_per_pass": 8}),
    AttachedCase("receiver", enclosed, {"angle": 5.0, "y": 0.1}, tilt_receiver, depth=6),
    AttachedCase("latents", under_glass, {"size": 1.0, "lift": 0.0}, stretch_slab),
    # ---- Sensors and films ----
    AttachedCase("thin_lens", lambda: under_glass(camera=camera(sensor="thinlens")), SLAB),
    AttachedCase("second_sensor", lambda: under_glass(other=camera(size=24) | {
                     "to_world": mi.ScalarTransform4f().look_at([0.3, 1.2, 0.4], [0, 0, 0], [0, 1, 0])}), SLAB,
                 sensor=1),
    AttachedCase("crop", lambda: under_glass(camera=camera("tent", crop_offset_x=5, crop_offset_y=9, crop_width=17,
                                                           crop_height=13)), SLAB),
    AttachedCase("lanczos", lambda: under_glass(camera=camera("lanczos", pixel_format="luminance")), SLAB),
    # ---- Mirrors, rough surfaces, other BSDFs ----
    AttachedCase("mirror", lambda: mirrored({"type": "conductor", "material": "Ag"}),
                 {"mirror.vertex_positions": None}),
    AttachedCase("rough_mirror", lambda: mirrored({"type": "roughconductor", "alpha": 0.15, "material": "Al"}),
                 {"mirror.vertex_positions": None}, limit=ROUGH),
    AttachedCase("rough_slab", lambda: enclosed(rough()), SLAB, depth=5, limit=ROUGH),
    AttachedCase("roughness_and_index", lambda: enclosed(rough(0.2)),
                 SLAB | {"slab.bsdf.alpha.value": None, "slab.bsdf.eta": None}, limit=ROUGH, depth=6),
    AttachedCase("roughness_alone", lambda: under_glass(rough(0.2)),
                 {"slab.bsdf.alpha.value": None, "slab.bsdf.eta": None}, limit=ROUGH, depth=6,
                 ours={"attached": True}),
    AttachedCase("plastic", lambda: enclosed(receiver=flat({"type": "roughplastic", "alpha": 0.3})), SLAB, depth=6,
                 stock=False, limit=ROUGH),
    AttachedCase("principled", lambda: enclosed(receiver=flat({
                     "type": "principled", "base_color": rgb(0.6, 0.5, 0.4), "roughness": 0.4, "metallic": 0.3})),
                 SLAB, depth=6, stock=False, limit=ROUGH),
    AttachedCase("blend", lambda: enclosed(receiver=flat({
                     "type": "blendbsdf", "weight": bitmap([[[0.3], [0.6]], [[0.8], [0.4]]], "bilinear"),
                     "first": diffuse(0.8, 0.3, 0.2), "second": {"type": "roughconductor", "alpha": 0.3}})),
                 SLAB, depth=6, stock=False, limit=ROUGH),
    AttachedCase("two_sided", lambda: enclosed(receiver=flat({"type": "twosided", "bsdf": WHITE})), SLAB, depth=6),
]  # fmt: skip


# Faults that break attached derivatives, and the case of attached_cases.py that must find each fault.


BACK = "estimators.attached:AttachedFrame.differentiate"
FAULTS = [
    # ---- The walk back: naive AD of our walk is right ----
    Fault("sign_of_adjoint_of_origin", "slab", BACK,
                  "(mi.Vector3f(dr.grad(ray.o)),", "(-mi.Vector3f(dr.grad(ray.o)),"),
    Fault("direction_has_no_adjoint", "slab", BACK, " + dr.dot(following.d, adjoint.direction)", ""),
    Fault("prefix_missing", "bounces", BACK, "dr.dot(P, reached * (own + later))",
                  "dr.sum(reached * (own + later))"),
    Fault("own_contribution_not_carried", "bounces", BACK, "dr.detach(own + later)", "dr.detach(later)"),
    Fault("roulette_weight_missing", "stack_of_2", BACK, " * self.roulette", ""),
    Fault("normalization_the_other_way", "slab", BACK,
                  "plan.attached_normalization)", "not plan.attached_normalization)"),
    Fault("film_position_does_not_move", "slab", BACK,
                  "p.adjoint.lookup(there.u,", "p.adjoint.lookup(dr.detach(there.u),"),
    Fault("connection_without_geometry", "slab", BACK,
                  "there.f * there.rest", "there.f * dr.detach(there.rest)"),
    Fault("rows_of_the_filter_detached", "slab", "transport.film:Film.taps",
                  "columns[x] * rows[y]", "columns[x] * dr.detach(rows[y])"),
    Fault("blocks_begin_anew", "stack_of_2", "estimators.stack:walk_back",
                  "retraced, left, bottom, adjoint)", "retraced, left, bottom, adjoint.none())"),
    Fault("blocks_without_their_last_vertex", "stack_of_2", "estimators.stack:walk_back",
                  "retraced, left, bottom", "retraced, left - 1, bottom"),
    Fault("emission_not_differentiated", "bounces", "estimators.attached:differentiate_start",
                  "concerns_emission(plan)", "plan.moving_emission"),
    Fault("pushed_from_the_second_vertex", "mirror", "estimators.attached:begins",
                  "plan.moves(vertex.si.shape) | ", ""),
    Fault("another_point_of_the_lens", "thin_lens", "estimators.attached:AttachedSweep.vertex",
                  "aperture=[connection.sample]", "aperture=[mi.Point2f(0.5)]"),
    # ---- The segment: naive AD shares the fault, `ptracer` does not ----
    Fault("next_ray_detached", "slab", "transport.walk:Segment.next_ray",
                  "return ray if attached else dr.detach(ray)", "return dr.detach(ray)", stock=True),
    Fault("hit_point_detached", "slab", "transport.walk:find_vertex",
                  "pi.compute_surface_interaction(ray,", "pi.compute_surface_interaction(dr.detach(ray, False),",
                  stock=True),
    Fault("shading_normals_detached", "slab", "transport.connection:shading_correction",
                  "dr.abs((cos_i * wo_dot_n) / (cos_o * wi_dot_n))",
                  "dr.detach(dr.abs((cos_i * wo_dot_n) / (cos_o * wi_dot_n)))", stock=True),
    Fault("importance_detached", "slab", "transport.connection:connect",
                  "Connection(importance * correction", "Connection(dr.detach(importance) * correction", stock=True),
    Fault("density_of_rough_glass_detached", "rough_slab", "transport.bsdf:scatter",
                  "sample = (staying if plan.stays else following)(plan, si, bsdf, active, sample)",
                  "sample.weight = dr.detach(sample.weight)", stock=True),
]  # fmt: skip
