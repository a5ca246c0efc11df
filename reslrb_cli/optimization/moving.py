"""Experiments whose parameters move light: derivatives lost at the film's border, and checks of unsupported parameters.

A splat that moves across the film's border leaves or enters the film. No sample records splats that cross the border,
because nothing outside the film is traced. The missing part of the derivative depends on the share of moving light that
lands at the border (`border_share`). If the border share is large, a warning is printed before the optimisation
(`warn_of_border`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.integrators.baselines import Projective
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.optimization.memory import plans
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.scene.deformation import where_moved
from reslrb_cli.scene.parameters import Selection
from reslrb_cli.seeds import seed
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.visible import moving_splats
from reslrb_cli.transport.walk import Hooks, Vertex, walk


def border_share(tracer: LightTracer, job: Job) -> float:
    """Return the share (0 to 1) of moving light that lands at the film's border.

    Moving light is light that a job's parameters move. The border is as wide as the reconstruction filter. The share is
    0 if nothing moves.
    """
    at_border, total = 0.0, 0.0
    with dr.suspend_grad():
        for samples in tracer.passes(job):
            if not samples.plan.attached:
                return 0.0
            sums: Sums = walk(samples, BorderLight(samples))
            for u, C, active in moving_splats(samples):
                sums = sums.plus(samples, u, C, active)
            at_border += float(dr.sum(sums.at_border)[0])
            total += float(dr.sum(sums.total)[0])
    return at_border / total if total > 0 else 0.0


@dataclass
class Sums:
    """Loop state: whether the path has met anything that moves, and the path's contributions at the border and in
    total.
    """

    moved: mi.Bool
    at_border: mi.Float
    total: mi.Float

    def plus(self, samples: Samples, u: mi.Point2f, C: mi.Spectrum, active: mi.Bool) -> Sums:
        """Return the sums with one more contribution (C,) at film position `u`."""
        light = dr.select(active, dr.sum(dr.abs(C)), 0)
        return Sums(self.moved, self.at_border + dr.select(is_at_border(samples, u), light, 0), self.total + light)


class BorderLight(Hooks):
    """Hooks that sum the contributions of light that has met moving objects."""

    def __init__(self, samples: Samples) -> None:
        self.samples, self.plan = samples, samples.plan

    def start(self, product: Product) -> Sums:
        moved = mi.Bool(False)
        if self.plan.moving_emitters:
            emitter = sample_emission(self.samples, self.samples.sampler()).emitter
            for moving in self.plan.moving_emitters:
                moved |= emitter == mi.EmitterPtr(moving)
        return Sums(moved, mi.Float(0), mi.Float(0))

    def vertex(
        self, state: Sums, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Sums:  # fmt: skip
        C = vertex.product.times(connection.c, vertex.depth).scaled(self.samples.scale).value()
        moved = state.moved | self.plan.moves(vertex.si.shape)
        state = state.plus(self.samples, connection.u, C, connection.active & moved)
        return replace(state, moved=moved | self.plan.differentiates(vertex.bsdf))


def is_at_border(samples: Samples, u: mi.Point2f) -> mi.Bool:
    """Return whether film position `u` (in pixels, relative to the crop window) is within the filter's radius of the
    border.

    The border is the edge of the crop window, because sensors record no light beyond the crop window.
    """
    radius, size = samples.film.film.rfilter().radius(), samples.film.size
    inside = dr.minimum(dr.minimum(u.x, int(size.x) - u.x), dr.minimum(u.y, int(size.y) - u.y))
    return inside < radius


#: Share of moving light at the border above which a warning appears.
NOTICED = 0.01

#: Samples per pixel for measuring it.
SPP = 8


def warn_of_border(problem: Problem, warn: Callable[[str], None]) -> None:
    """Call `warn` with a line for each view in which more than NOTICED of the moving light lands at the border."""
    if not isinstance(problem.integrator, LightTracer):
        return
    tracer = problem.integrator.with_options(samples_per_pass=None, freeze=False)
    for index in problem.sensors:
        sensor = problem.scene.sensors()[index]
        number = dr.opaque(mi.UInt32, seed(problem.config.run.seed, 0, index, "border"))
        share = border_share(tracer, Job(problem.scene, sensor, number, SPP, problem.selection.params))
        if share > NOTICED:
            line = f"view {index}: {share:.0%} of the moving light lands at the film's border, where its derivative "
            warn(f"{line}is cut off; use a view with all of this light inside")


def is_attached(problem: Problem) -> bool:
    """True if the parameters of `problem` move surfaces or lights, or if the integrator option `attached` is true."""
    return moves_anything(problem.config, problem.selection)


def moves_anything(config: Config, selection: Selection) -> bool:
    """True if the selected parameters move surfaces or lights, or if the integrator option `attached` is true."""
    attached = config.integrator.options().get("attached", "auto")
    return attached is True or bool(where_moved(selection.params, selection.scene_keys))


def check_moving(problem: Problem) -> None:
    """Raise ConfigError at the faulty setting if the integrator cannot differentiate a moving parameter."""
    if not is_attached(problem):
        return
    config, moved = problem.config, where_moved(problem.selection.params, problem.selection.scene_keys)
    kind, tracer = config.integrator.type, problem.integrator
    if moved and kind in ("prb", "trajectory"):
        reason = f"{kind} has no derivatives of moving light, which `{moved[0].key}` needs; use reslrb, ptracer or "
        reason += "prb_projective"
        raise ConfigError(config.source, "integrator.type", reason)
    if isinstance(tracer, Projective):
        sensors = [problem.scene.sensors()[index] for index in problem.sensors]
        wrong = tracer.obstacle(problem.scene, sensors, [item.node for item in moved])
        if wrong is not None:
            raise ConfigError(config.source, "integrator.type", wrong)
        return
    if isinstance(tracer, LightTracer):
        try:
            plans(problem, tracer)
        except UnsupportedScene as error:
            key = f"integrator.{error.option}" if error.option else "scene.file"
            raise ConfigError(config.source, key, str(error)) from error
        return
    for index in problem.sensors:  # splats of Mitsuba's own light tracer have no derivative through a box filter
        sensor = problem.scene.sensors()[index]
        if sensor.film().rfilter().is_box_filter():
            reason = f"sensor {sensor.id()} has a box filter, whose splats do not change while they move within a "
            reason += "pixel; use a smooth filter, such as gaussian, for derivatives of moving light"
            raise ConfigError(config.source, "scene.file", reason)
