"""Peak memory of a gradient step is flat in depth for the reservoir, and linear for naive AD."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import pytest

from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.scenes.small import diffuse, room, texture

pytestmark = pytest.mark.usefixtures("llvm")
FLOOR = "floor.brdf_0.reflectance.data"
SPP = 256


@pytest.fixture(scope="module")
def case(llvm: str) -> Case:
    """Scene with bright walls all around, so that paths reach the depth limit."""
    bright = {"type": "twosided", "bsdf": diffuse(0.95, 0.95, 0.95)}
    floor = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(8, 8, 0.8, 0.95)}}
    cave = {"type": "sphere", "radius": 8.0, "flip_normals": True, "bsdf": diffuse(0.95, 0.95, 0.95)}
    return Case(room(floor=floor, wall=bright, side=bright, cave=cave), (FLOOR,))


def peak(case: Case, name: str, max_depth: int, estimator: str | None = None, **step: str) -> int:
    """Return the maximum number of bytes that the allocator gave out during a second step, beyond the number before
    this step.
    """
    backend = dr.backend_v(mi.Float)
    # rr_depth exceeds every depth, so that there is no roulette
    tracer = integrator(name, max_depth, 1000, **({"estimator": estimator} if estimator else {}))
    case.gradient(tracer, 1, SPP, **step)
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(backend)
    case.gradient(tracer, 2, SPP, **step)
    dr.sync_thread()
    return dr.detail.malloc_watermark(backend) - before


@pytest.mark.long
def test_reservoir_is_flat(case: Case):
    peaks = {depth: peak(case, "reslrb", depth) for depth in (2, 40)}
    print(peaks)
    assert peaks[2] > 1 << 20, "the watermark sees nothing"
    assert max(peaks.values()) <= 1.02 * min(peaks.values()), peaks


@pytest.mark.parametrize(
    ("estimator", "depths"),
    [
        ("reservoir", (2, 40)),
        *(pytest.param(name, (2, 40, 80, 160), marks=pytest.mark.long)
          for name in ("reservoir", "event", "gather", "stack")),
    ],
)  # fmt: skip
def test_nothing_is_kept_of_paths_with_a_known_adjoint(case: Case, estimator: str, depths: tuple[int, ...]):
    peaks = {depth: peak(case, "reslrb", depth, estimator, adjoint="independent") for depth in depths}
    print(estimator, peaks)
    assert max(peaks.values()) < SPP * case.weights.shape[0] * case.weights.shape[1]  # one byte per path
    # Vertices that do not fit on the stack are traced again, which needs another copy of the texture's gradient.
    for depths in ((2, 40), (80, 160)) if estimator == "stack" else (tuple(peaks),):
        assert max(peaks[depth] for depth in depths) <= 1.02 * min(peaks[depth] for depth in depths), peaks


@pytest.mark.long
def test_naive_ad_grows(case: Case):
    ours = {depth: peak(case, "reslrb", depth) for depth in (4, 16)}
    for name in ("ptracer", "walk_ad"):
        peaks = {depth: peak(case, name, depth) for depth in (4, 16)}
        print(name, peaks, "reslrb", ours)
        assert peaks[16] > 2.5 * peaks[4], name
        assert ours[16] < 0.25 * peaks[16], name
