"""A replay stands where the image pass stood: the same vertices, the same factors, up to the kept connection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest
from conformance.gradient_cases import CASES

from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.reservoir import ReservoirSelection
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.scenes.small import room
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.walk import Hooks

pytestmark = pytest.mark.usefixtures("llvm")
BY_NAME = {case.name: case for case in CASES}
#: Every way in which random numbers are drawn: delta lobes, masks, an aperture, several emitters, roulette.
NAMES = ("texture", "roulette", "thin_lens", "plastic", "blend", "glass", "mirror", "bumpmap", "mask",
         "mask_texture_in_view", "area_texture", "envmap", "two_emitters", "visible_lamp")  # fmt: skip

NONE = 0xFFFFFFFF


@dataclass
class Kept:
    """The reservoir's state, which of the path's vertices it holds (0: none), and where that stands."""

    state: Any
    I: Any  # noqa: E741
    p: Any


class Recording(ReservoirSelection):
    """The reservoir's image pass among all connections, which also keeps index and position of the kept vertex."""

    def start(self, product: Any) -> Kept:
        import mitsuba as mi

        return Kept(super().start(product), mi.UInt32(0), mi.Point3f(0))

    def wants(self, state: Kept, vertex: Any) -> Any:
        import mitsuba as mi

        return mi.Bool(True)

    def connection(self, state: Kept, vertex: Any, connection: Any, numbers: list[Any]) -> Kept:
        import drjit as dr
        import mitsuba as mi

        [slot] = state.state.slots
        before = replace(state.state, slots=[replace(slot, last=mi.UInt32(NONE))])
        after = super().connection(before, vertex, connection, numbers)
        taken = after.slots[0].last != NONE
        return Kept(after, dr.select(taken, vertex.depth, state.I), dr.select(taken, vertex.si.p, state.p))

    def scattering(self, state: Kept, vertex: Any, connection: Any, scattering: Any) -> Kept:
        return replace(state, state=super().scattering(state.state, vertex, connection, scattering))


class Rewalk(Hooks):
    """A replay that differentiates nothing: it multiplies all factors up to the kept connection anew."""

    replaying = True
    connects = True

    def __init__(self, samples: Any, kept: Any, emission: Any) -> None:
        self.samples, self.kept, self.emission = samples, kept, emission

    def start(self, product: Any) -> list[Any]:
        import mitsuba as mi

        return [mi.Spectrum(self.emission), mi.Spectrum(0), mi.Point3f(0), mi.Point2f(0), mi.UInt32(0)]

    def goes_on(self, state: Any, vertex: Any) -> Any:
        return vertex.depth < self.kept.I

    def connection(self, state: Any, vertex: Any, connection: Any, numbers: list[Any]) -> Any:
        import drjit as dr

        here = vertex.active & (vertex.depth == self.kept.I)
        found = [state[0] * connection.c * self.samples.scale, vertex.si.p, connection.u, vertex.depth]
        return [state[0], *(dr.select(here, new, old) for new, old in zip(found, state[1:], strict=True))]

    def scattering(self, state: Any, vertex: Any, connection: Any, scattering: Any) -> Any:
        return [state[0] * scattering.weight, *state[1:]]


@pytest.mark.parametrize("name", NAMES)
def test_replay_meets_the_same_vertices(name: str):
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    case = BY_NAME[name]
    scene = Case(case.scene(), case.keys)
    ours = integrator("reslrb", **case.both | case.options)
    with dr.suspend_grad():
        [samples] = ours.passes(Job(scene.scene, scene.scene.sensors()[0], mi.UInt32(5), 64))
        context = Pass(samples, None, None)
        kept = context.walk(Recording(context, 1, "luminance", False))
        dr.eval(kept)
        slot, active = kept.state.slots[0], kept.state.W > 0
        emission = sample_emission(samples, samples.sampler()).weight
        _, C, p, u, I = context.walk(Rewalk(samples, kept, emission), active)  # noqa: E741
        stored = slot.C.value()
        dr.eval(C, p, u, I, stored)
    where = np.array(active)
    assert where.sum() > 1000
    assert len(np.unique(np.array(I)[where])) > 1, "paths of one length only"
    assert np.array_equal(np.array(I)[where], np.array(kept.I)[where])

    def error(found: Any, expected: Any) -> float:
        found, expected = np.array(found, np.float64).T[where], np.array(expected, np.float64).T[where]
        return (np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)).max()

    assert error(p, kept.p) < 1e-6
    assert error(u, slot.u) < 1e-6
    if not samples.plan.roulette:  # a replay does not know the roulette's weights
        assert error(C, stored) < 1e-6


def test_no_light_no_replay():
    """A scene whose light reaches nothing keeps nothing, and its gradient is zero."""
    from reslrb_cli.measure.scenes.small import rgb, transform

    lamp = room()["lamp"] | {"to_world": transform(translate=[0, 5, 0], rotate=([1, 0, 0], -90))}
    case = Case(room(lamp=lamp | {"emitter": {"type": "area", "radiance": rgb(1, 1, 1)}}),
                ("floor.brdf_0.reflectance.value",))  # fmt: skip
    assert not case.gradient(integrator("reslrb"), 1, 16).any()
