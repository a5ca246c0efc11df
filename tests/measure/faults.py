"""Single-line faults that break the code, and the check that must find each fault. The check is gradcheck or a case of
the extreme suite.
"""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from unittest.mock import patch

import pytest

from reslrb_cli.config.loader import loads
from reslrb_cli.config.schema import Config
from reslrb_cli.estimators.stack import Stack
from reslrb_cli.measure.extreme import run_case
from reslrb_cli.measure.gradcheck import Gradcheck
from reslrb_cli.measure.methods import NamedIntegrator, parse_checked
from reslrb_cli.measure.participants import CheckSettings
from reslrb_cli.measure.scenes import small
from reslrb_cli.measure.scenes.catalogue import CASES
from reslrb_cli.records.measurements import GradcheckRecord

Check = Callable[[], Iterable[GradcheckRecord]]
SMALL = ["scene.options.size=32", "scene.options.texture=4", "run.spp=8", "integrator.max_depth=4"]
SMALL += ["integrator.guiding=off", "run.adjoint=correlated"]  # what is kept between image and gradient takes part then


def room(name: str, *keys: str, overrides: Iterable[str] = ()) -> Config:
    """Return the experiment that finds the parameters of a room. The scene file is in this file's folder."""
    parameters = "".join(f"  - {{key: {key}}}\n" for key in keys)
    text = f"""\
scene: {{file: {Path(__file__).with_name(name)}}}
target: {{render: {{}}}}
parameters:
{parameters}integrator: {{max_depth: 4, rr_depth: 1000000, guiding: off}}
run: {{spp: 64}}
"""
    return loads(text, name, [*overrides])


def estimators_of(names: str) -> list[NamedIntegrator]:
    """Return the estimators of a list such as `stack,reservoir(capacity=2)`."""
    return parse_checked(re.sub(r"(^|,)(?![^(]*\))", r"\1reslrb:", names))


def checked(config: Config, estimators: str, seeds: int) -> list[GradcheckRecord]:
    """Return the records of `reslrb gradcheck`."""
    made = Gradcheck(CheckSettings(config, estimators_of(estimators), 0, seeds))
    return list(made.run(lambda: False, lambda line: None))


def cornell(*overrides: str, estimators: str, seeds: int = 8) -> Check:
    """Return `reslrb gradcheck` on the small built-in Cornell box as a check."""
    return lambda: checked(loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, [*SMALL, *overrides]), estimators, seeds)


def stack_of_2() -> list[GradcheckRecord]:
    """Return the records of `cornell` with `stack`, where a stack holds two vertices."""
    with patch.object(Stack.__init__, "__defaults__", (2,)):
        return list(cornell(estimators="stack")())


def moving(name: str, key: str) -> Check:
    """Return `reslrb gradcheck` for a parameter that moves light. The scene file is in this file's folder."""

    def check() -> list[GradcheckRecord]:
        return checked(room(name, key), "stack", 6)

    return check


def extreme(case: str, *estimators: str) -> Check:
    """Return a check with a case of the extreme suite, for these estimators or for all."""
    return lambda: run_case(CASES[case], estimators or None)


CHECKS: dict[str, Check] = {
    "cornell": cornell(estimators="gather,stack"),
    "cornell_reservoir": cornell(estimators="reservoir,stack"),
    "cornell_event": cornell(estimators="event,stack"),
    "cornell_roulette": cornell("integrator.rr_depth=1", estimators="stack"),
    "cornell_capacity_2": cornell(estimators="reservoir(capacity=2),stack", seeds=16),
    "cornell_stack_of_2": stack_of_2,
    "veil": lambda: checked(
        room("veiled_room.xml", "veil.opacity.value", "floor.reflectance.value"), "gather,stack", 8
    ),
    "glow": lambda: checked(
        room("glowing_room.xml", "wall.emitter.radiance.value", "veil.opacity.value"), "event,stack", 16
    ),
    "behind_lens": lambda: checked(room("glowing_room.xml", "veil.opacity.value"), "event", 64),
    "instance": lambda: checked(room("glowing_room.xml", "floor.reflectance.value", "veil.opacity.value"), "stack", 8),
    "black_texels": extreme("albedo_0"),
    "pure_colours": extreme("pure_colours", "gather", "stack"),
    "lamp": extreme("one_texel"),
    "wide_filter": extreme("film_border", "gather", "stack"),
    "crop": extreme("film_crop", "stack"),
    "shading_normals": extreme("shading_normals", "stack"),
    "refraction": extreme("refraction", "stack"),
    "delta_lobes": extreme("nested_dielectrics", "reservoir", "stack"),
    "sky": extreme("sun_1e6", "stack"),
    "black_texels_of_lamp": extreme("black_texels", "stack"),
    "black_lamp": extreme("black_lamp", "stack"),
    "furnace": extreme("furnace", "stack"),
    "black_solid": extreme("shading_normals_albedo_0", "stack"),
    "behind_mask": extreme("albedo_0_behind_mask", "gather", "stack"),
    "opacity": extreme("opacity_0.4", "stack"),
    "deep": extreme("white_box_100", "gather"),
    "wavy_glass": moving("wavy_glass.xml", "top.vertex_positions"),
    "sliding": extreme("sliding_faces", "stack"),
    "moved_lamp": moving("lamp_over_floor.xml", "lamp.position"),
}


@dataclass(frozen=True)
class Fault:
    """A fault in the source of the function `where` that replaces `right` by `wrong`. Then `check` fails, at least in
    the records in `fails`.

    `fails` are pairs of an estimator and a reference. In an image's record, the estimator is None. Estimators that are
    not in `fails` do not have the fault, and their records hold. With `stock`, naive AD of our walk shares the fault,
    so that only `ptracer` can find it.
    """

    name: str
    check: str
    where: str
    right: str
    wrong: str
    fails: frozenset[tuple[str | None, str]] = frozenset()
    stock: bool = False


def planted(faults: Iterable[Fault]) -> pytest.MarkDecorator:
    """Parametrise a test with faults. It needs `-m long`, because it tests another test."""
    return pytest.mark.parametrize("fault", [pytest.param(one, id=one.name, marks=pytest.mark.long) for one in faults])


def plant(fault: Fault, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plant a fault in a function. The fault takes effect in every module that imports the function.

    The function's source must contain the fault's line exactly once. A fault that no longer fits the code fails the
    test.
    """
    module, _, path = fault.where.partition(":")
    function = attrgetter(path)(importlib.import_module(f"reslrb_cli.{module}"))
    function = getattr(function, "__func__", getattr(function, "fget", function))
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(fault.right) == 1, f"{fault.where} has no such line any more: {fault.right}"
    # Annotations name types that are imported only for type checkers.
    broken_source = "from __future__ import annotations\n" + source.replace(fault.right, fault.wrong)
    scope = dict(function.__globals__)
    exec(compile(broken_source, fault.where, "exec", dont_inherit=True), scope)
    broken = scope[function.__name__]
    broken = getattr(broken, "__func__", getattr(broken, "fget", broken))
    monkeypatch.setattr(function, "__code__", broken.__code__)


def assert_found(fault: Fault, monkeypatch: pytest.MonkeyPatch, holds: Callable[[], object]) -> None:
    """Plant a fault, and assert that the result of `holds` is false."""
    plant(fault, monkeypatch)
    found = holds()
    print(f"{fault.name}: {found}")
    assert not found


def by(estimators: str, *references: str) -> frozenset[tuple[str | None, str]]:
    """Return all pairs of these estimators with these references. The name `image` gives the estimator None."""
    return frozenset((None if e == "image" else e, r) for e in estimators.split() for r in references)


GRADIENT = ("walk_ad", "finite_difference", "forward_mode")  # references of estimators with a correct walk
WALK = "transport.walk:walk"
BACK = "estimators.attached:AttachedFrame.differentiate"
MOVED = ("walk_ad", "ptracer", "finite_difference")  # references of a moving mesh

FAULTS = [
    # ---- Light paths: naive AD and differences share the fault, a stock integrator does not ----
    Fault("cosine_of_connection", "cornell", "transport.bsdf:scatter",
          "return evaluate(plan, si, self, wo, connected), own.wo",
          "return evaluate(plan, si, self, wo, connected) / dr.maximum(mi.Frame3f.cos_theta(wo), 1e-3), own.wo",
          by("gather stack", "walk_ad", "ptracer", "finite_difference") | by("image", "ptracer")),
    Fault("roulette_without_weight", "cornell_roulette", "transport.factors:play",
          "dr.select(playing, dr.rcp(q), 1)", "dr.select(playing, mi.Float(1), 1)",
          by("image stack", "ptracer")),
    Fault("shading_normals_uncorrected", "shading_normals", "transport.connection:shading_correction",
          "dr.abs((cos_i * wo_dot_n) / (cos_o * wi_dot_n))", "mi.Float(1)", by("stack", "prb", "path")),
    Fault("radiance_at_refraction", "refraction", "transport.bsdf:context_of",
          "TransportMode.Importance", "TransportMode.Radiance", by("stack", "analytic", "ptracer")),
    Fault("crop_offset_dropped", "crop", "transport.film:Film.put", "u + mi.Vector2f(self.offset)", "u",
          by("stack", "ptracer")),
    Fault("density_of_sky_without_uniform_part", "sky", "transport.lamps:_any_direction",
          "(1 - DEFENSIVE) * own + DEFENSIVE * dr.inv_four_pi", "own", by("stack", "prb")),
    Fault("density_of_texels_too_high", "black_texels_of_lamp", "transport.lamps:_any_uv",
          "(1 - DEFENSIVE) * own + DEFENSIVE", "own + DEFENSIVE", by("stack", "analytic")),
    Fault("black_texels_not_drawn", "black_texels_of_lamp", "integrators.context:Preparation.plan",
          "lamp.texture in which.emission_nodes", "False", by("stack", "analytic")),
    Fault("black_lamp_drawn_as_others", "black_lamp", "transport.lamps:_any_uv",
          "dr.select(even | black, sample, uv)", "dr.select(even, sample, uv)", by("stack", "analytic")),
    # ---- Adjoints and derivatives: paths are right, and naive AD of them is a reference ----
    Fault("adjoint_without_filter", "wide_filter", "transport.film:AdjointImage.lookup",
          "self.film.film.rfilter().is_box_filter()", "True", by("gather stack", "walk_ad", "ptracer")),
    Fault("channels_of_adjoint_swapped", "cornell", "transport.film:AdjointImage._channels",
          "mi.Spectrum(*color)", "mi.Spectrum(*color[::-1])", by("gather stack", "walk_ad", "ptracer")),
    Fault("emission_not_differentiated", "lamp", "estimators.base:differentiate_emission",
          "p.plan.differentiate_emission", "False", by("reservoir event gather stack", "walk_ad", "ptracer")),
    Fault("zero_factor_dropped", "black_texels", "estimators.base:adjoint_of_factor",
          "at_zero = dr.select(zero == mi.Int32(index), value[c] * rest[c], 0)", "at_zero = mi.Float(0)",
          by("reservoir event gather", "walk_ad", "finite_difference")),
    Fault("zero_factor_of_prefix_dropped", "black_texels", "estimators.gather:AdjointSum.adjoint_of_factor",
          "(f[c] == 0) & (zero == NO_ZERO)", "mi.Bool(False)", by("gather", "walk_ad")),
    Fault("zero_factor_not_pushed", "black_texels", "estimators.stack:pass_vertex",
          "dr.select(on, P *", "dr.select(on & dr.any(scattering.f != 0), P *",
          by("stack", "walk_ad", "finite_difference")),
    Fault("second_zero_factor_forgotten", "pure_colours", "transport.factors:Product.times",
          "dr.select(z == NO_ZERO, mi.Int32(index), MANY_ZEROS)", "mi.Int32(index)",
          by("gather", "walk_ad", "finite_difference")),
    Fault("stand_in_without_cosine", "black_texels", "transport.connection:stand_in",
          "connection.rest * f", "connection.rest * dr.inv_pi",
          by("reservoir event gather", "walk_ad", "finite_difference")),
    Fault("delta_lobe_without_probability", "delta_lobes", "transport.bsdf:_singular_factor",
          "weight * pdf", "weight", by("reservoir stack", "ptracer")),
    Fault("veil_not_differentiated", "veil", "estimators.base:differentiate_passage",
          "differentiate if p.plan.differentiate_null else None", "None",
          by("gather stack", "walk_ad", "forward_mode")),
    Fault("veil_taken_for_clear_in_adjoint", "veil", "estimators.base:differentiate_passage",
          "mi.Int32(NO_ZERO), dr.detach(transmission)", "mi.Int32(NO_ZERO), mi.Spectrum(1)",
          by("gather stack", "walk_ad")),
    Fault("visible_emission_not_differentiated", "furnace",
          "transport.emission:differentiate_visible_emission",
          'plan.visible_emission and plan.paths == "light" and (', "False and (", by("stack", "walk_ad", "analytic")),
    Fault("shading_normals_uncorrected_beside_zero", "black_solid", "estimators.stack:pass_vertex",
          "scattering.correction / scattering.pdf", "1 / scattering.pdf", by("stack", "walk_ad")),
    Fault("mask_forgotten_beside_zero", "behind_mask", "estimators.gather:adjoint_of_connection",
          "rest *= differentiate_passage(", "differentiate_passage(", by("gather", "walk_ad", "finite_difference")),
    Fault("mask_forgotten_by_the_stack", "behind_mask", "estimators.stack:LightSweep.vertex",
          "connection.rest * connection.through", "connection.rest",
          by("stack", "walk_ad", "finite_difference")),
    Fault("opacity_not_differentiated", "opacity", "estimators.base:differentiate_passage",
          "differentiate if p.plan.differentiate_null else None", "None", by("stack", "walk_ad", "finite_difference")),
    Fault("instance_forgotten", "instance", "estimators.base:SurfacePoint.of",
          "_index(pi.instance)", "mi.UInt32(0)", by("stack", "walk_ad")),
    Fault("mask_in_view_not_differentiated", "glow", "transport.emission:differentiate_visible_radiance",
          "adjoint * behind", "mi.Spectrum(0)", by("event stack", "walk_ad", "forward_mode")),
    # ---- Estimators: the others are right ----
    Fault("another_point_of_the_lens", "behind_lens", "estimators.selection:differentiate_event",
          "kept.point.ray(), sample,", "kept.point.ray(), mi.Point2f(0),", by("event", "walk_ad")),
    Fault("w_of_previous_step", "cornell_reservoir", "estimators.reservoir:ReservoirSelection.vertex",
          "chosen_by(numbers, w, W,", "chosen_by(numbers, w, state.W,", by("reservoir", *GRADIENT, "ptracer")),
    Fault("replay_one_number_too_many", "delta_lobes", WALK,
          "sampler.next_1d(active)  # the number of roulette", "sampler.next_1d(active), sampler.next_1d(active)",
          by("reservoir", "walk_ad")),
    Fault("replay_ends_a_vertex_early", "cornell_reservoir", "estimators.selection:SlotReplay.is_followed",
          "vertex.depth < self.last", "vertex.depth + 1 < self.last", by("reservoir", *GRADIENT, "ptracer")),
    Fault("slots_counted_twice", "cornell_capacity_2", "estimators.selection:inverse_probability",
          "W / (capacity * slot.w)", "W / slot.w", by("reservoir(capacity=2)", *GRADIENT, "ptracer")),
    Fault("weight_of_prefix", "cornell_event", "estimators.event:EventSelection.vertex",
          "return EventState([Q], W", "return EventState(state.Q, W", by("event", *GRADIENT, "ptracer")),
    Fault("one_visibility_bit_late", "cornell", "estimators.gather:Visibility.of",
          "index = depth - 1", "index = depth", by("gather stack", *GRADIENT)),
    Fault("beyond_visibility_bits_all_seen", "deep", "transport.connection:passage",
          "traced = unknown & ~is_hidden(scene, si, connection.target, plan.has_edges, unknown)",
          "traced = unknown", by("gather", "walk_ad")),
    Fault("visibility_inverted", "cornell", "estimators.gather:Visibility.of",
          "& 1) != 0", "& 1) == 0", by("gather stack", *GRADIENT)),
    Fault("stack_without_last_vertex", "cornell", "estimators.stack:walk_back",
          "state.useful, bottom", "state.useful - dr.select(state.useful > 0, mi.UInt32(1), 0), bottom",
          by("stack", *GRADIENT)),
    Fault("blocks_begin_anew", "cornell_stack_of_2", "estimators.stack:walk_back",
          "retraced, left, bottom, adjoint)", "retraced, left, bottom, 0 * adjoint)",
          by("stack", *GRADIENT)),
    Fault("stack_forgets_what_it_does_not_push", "cornell", "estimators.stack:pass_vertex",
          "own=state.D_here() + T * own", "own=T * own",
          by("stack", *GRADIENT)),
    Fault("candidates_by_their_own_factor_alone", "cornell_reservoir",
          "estimators.reservoir:ReservoirSelection.vertex",
          "self.concerned(state) | plan.concerns(vertex.bsdf)", "plan.concerns(vertex.bsdf)",
          by("reservoir", *GRADIENT, "ptracer")),
    Fault("sum_ends_a_vertex_early", "cornell", "estimators.gather:needed",
          "dr.minimum(latest + 1, depth)", "latest", by("gather", *GRADIENT)),
    # ---- What moves light: differences share no derivative, and `ptracer` none of ours ----
    Fault("origin_of_ray_backwards", "wavy_glass", BACK,
          "moved = dr.dot(following.o, adjoint.origin)", "moved = -dr.dot(following.o, adjoint.origin)",
          by("stack", *MOVED)),
    Fault("direction_of_ray_forgotten", "wavy_glass", BACK,
          "dr.dot(following.o, adjoint.origin) + dr.dot(following.d, adjoint.direction)",
          "dr.dot(following.o, adjoint.origin)", by("stack", *MOVED)),
    Fault("throughput_forgotten_on_the_way_back", "wavy_glass", BACK,
          "dr.dot(P, reached * (own + later))", "dr.dot(mi.Spectrum(1), reached * (own + later))",
          by("stack", *MOVED)),
    Fault("film_position_detached", "wavy_glass", BACK,
          "p.adjoint.lookup(there.u,", "p.adjoint.lookup(dr.detach(there.u),", by("stack", *MOVED)),
    Fault("factor_detached", "wavy_glass", BACK,
          "this.scattering.s * B", "dr.detach(this.scattering.s) * B", by("stack", "walk_ad")),
    Fault("adjoints_of_origin_and_direction_exchanged", "wavy_glass", BACK,
          "(mi.Vector3f(dr.grad(ray.o)), dr.grad(ray.d), B)", "(dr.grad(ray.d), mi.Vector3f(dr.grad(ray.o)), B)",
          by("stack", *MOVED)),
    Fault("last_vertex_of_the_attached_stack", "wavy_glass", "estimators.stack:StackState.push",
          "dr.select(contributes, count, self.useful)", "dr.select(contributes, self.count, self.useful)",
          by("stack", *MOVED)),
    Fault("next_ray_detached", "wavy_glass", "transport.walk:Segment.next_ray",
          "ray if attached else dr.detach(ray)", "dr.detach(ray)", by("stack", "ptracer", "finite_difference")),
    Fault("shape_detached", "wavy_glass", "transport.walk:find_vertex",
          "mi.RayFlags.All", "mi.RayFlags.All | mi.RayFlags.DetachShape", by("stack", "ptracer", "finite_difference")),
    Fault("connection_detached", "wavy_glass", "transport.connection:connect",
          "dr.suspend_grad(when=not attached)", "dr.suspend_grad()", by("stack", "ptracer", "finite_difference")),
    Fault("shading_correction_without_its_jumps", "sliding", "transport.connection:shading_correction",
          "dr.detach(correction) if plan.attached_normalization else correction", "correction",
          by("stack", "finite_difference")),
    Fault("lamp_left_where_it_is", "moved_lamp", "estimators.attached:differentiate_start",
          "dr.dot(adjoint.origin, emission.ray.o) + ", "", by("stack", "walk_ad", "finite_difference")),
    # ---- Forward mode: all estimators share it ----
    Fault("forward_without_emission", "glow", "integrators.forward:TangentSplat.start",
          "mi.Spectrum(self.dE)", "mi.Spectrum(0)", by("event stack", "forward_mode")),
    Fault("forward_without_prefix", "cornell", "integrators.forward:TangentSplat.vertex",
          "(dP * c + P * dc)", "(P * dc)", by("gather stack", "forward_mode")),
    Fault("forward_without_veil", "veil", "integrators.forward:TangentSplat.vertex",
          "(df_c * through + f_c * d_through)", "df_c * through",
          by("gather stack", "forward_mode")),
]  # fmt: skip
