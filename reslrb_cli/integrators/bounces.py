"""Whether light that moves is scattered by a surface that is not specular, and then comes to be seen from another one.

Only there do the two ways of `estimators.staying` differ. In a caustic of few segments light ends where it lands first.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.hooks import Hooks, Vertex
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import passes
from reslrb_cli.transport.scattering import Scattering, stays_behind
from reslrb_cli.transport.walk import walk

#: Light paths that are looked at: of what they do not meet, the part in a derivative is small.
PATHS = 2**16
#: What is found is to be the same for all runs of a scene.
SEED = 0xB0A2CE


def bounces(plan: Plan, scene: mi.Scene, sensor: mi.Sensor) -> bool:
    """Whether any of so many paths is such; `plan` is one with attached derivatives in which vertices stay."""
    width, height = sensor.film().size()
    spp = max(PATHS // int(width * height), 1)
    with dr.suspend_grad():
        [samples, *_] = passes(plan, scene, sensor, dr.opaque(mi.UInt32, SEED), spp, None)
        found: Bounced = walk(samples, BouncedLight(plan, sample_emission(samples, samples.sampler()).emitter))
        return bool(dr.any(found.seen))


@dataclass
class Bounced:
    """Loop state: whether the path has met anything that moves, has then bounced, and has then been seen."""

    moved: mi.Bool
    bounced: mi.Bool
    seen: mi.Bool


class BouncedLight(Hooks):
    """Follow what moves through bounces."""

    def __init__(self, plan: Plan, emitter: mi.EmitterPtr) -> None:
        self.plan, self.emitter = plan, emitter

    def start(self, product: Product) -> Bounced:
        moved = mi.Bool(False)
        for moving in self.plan.moving_emitters:
            moved |= self.emitter == mi.EmitterPtr(moving)
        return Bounced(moved, mi.Bool(False), mi.Bool(False))

    def connection(self, state: Bounced, vertex: Vertex, connection: Connection, numbers: list[mi.Float]) -> Bounced:
        return Bounced(state.moved, state.bounced, state.seen | (connection.active & state.bounced))

    def scattering(self, state: Bounced, vertex: Vertex, connection: Connection, scattering: Scattering) -> Bounced:
        moved = state.moved | self.plan.moves(vertex.si.shape) | self.plan.differentiates(vertex.bsdf)
        staying = scattering.active & stays_behind(self.plan, vertex.bsdf, scattering.is_delta)
        return Bounced(moved, state.bounced | (moved & staying), state.seen)
