"""Light that moves at the film's border, where its derivative is cut off.

A splat that moves across the border leaves the film, or enters it: no sample knows of that, since what lies outside is
not traced. How much of the derivative is missing goes with how much of what moves lands there.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.integrators.interface import Job
from reslrb_cli.integrators.tracer import LightTracer
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.hooks import Hooks, Vertex
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.scattering import Scattering
from reslrb_cli.transport.visible_lamps import moving_splats
from reslrb_cli.transport.walk import walk


def border_share(tracer: LightTracer, job: Job) -> float:
    """Of the light that a job's parameters move, the share that lands at the film's border: 0 to 1.

    At the border is what the reconstruction filter spreads beyond it. 0 where nothing moves.
    """
    with dr.suspend_grad():
        at_border, total = 0.0, 0.0
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
    """Loop state: whether the path has met anything that moves, and what it has added, at the border and in all."""

    moved: mi.Bool
    at_border: mi.Float
    total: mi.Float

    def plus(self, samples: Samples, u: mi.Point2f, C: mi.Spectrum, active: mi.Bool) -> Sums:
        """The sums with one more contribution (C,) at film position `u`."""
        light = dr.select(active, dr.sum(dr.abs(C)), 0)
        return Sums(self.moved, self.at_border + dr.select(is_at_border(samples, u), light, 0), self.total + light)


class BorderLight(Hooks):
    """Sum the contributions behind anything that moves."""

    def __init__(self, samples: Samples) -> None:
        self.samples, self.plan = samples, samples.plan

    def start(self, product: Product) -> Sums:
        moved = mi.Bool(False)
        if self.plan.moving_emitters:
            emitter = sample_emission(self.samples, self.samples.sampler()).emitter
            for moving in self.plan.moving_emitters:
                moved |= emitter == mi.EmitterPtr(moving)
        return Sums(moved, mi.Float(0), mi.Float(0))

    def connection(self, state: Sums, vertex: Vertex, connection: Connection, numbers: list[mi.Float]) -> Sums:
        C = vertex.product.times(connection.c, vertex.depth).scaled(self.samples.scale).value()
        moved = state.moved | self.plan.moves(vertex.si.shape)
        return state.plus(self.samples, connection.u, C, connection.active & moved)

    def scattering(self, state: Sums, vertex: Vertex, connection: Connection, scattering: Scattering) -> Sums:
        turned = self.plan.moves(vertex.si.shape) | self.plan.differentiates(vertex.bsdf)
        return Sums(state.moved | turned, state.at_border, state.total)


def is_at_border(samples: Samples, u: mi.Point2f) -> mi.Bool:
    """Whether film position `u` (pixels, relative to the crop window) is within the filter's radius of the border.

    That is the border of the crop window: sensors see no light beyond it.
    """
    radius, size = samples.film.film.rfilter().radius(), samples.film.size
    inside = dr.minimum(dr.minimum(u.x, int(size.x) - u.x), dr.minimum(u.y, int(size.y) - u.y))
    return inside < radius
