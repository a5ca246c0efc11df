"""The second step compiles nothing. No seed, parameter value or adjoint image reaches a kernel as a literal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.gradient_cases import CASES
from turns import taking_turns

from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.scene.load import load_scene

pytestmark = pytest.mark.usefixtures("llvm")
ROOT = Path(__file__).resolve().parents[2]

#: The shipped scenes and their optimized parameters.
SHIPPED = {
    "cornell_floor": ("floor.reflectance.data",),
    "grey_room": ("painting.reflectance.data", "sky.data"),
    "caustic_slab": ("receiver.reflectance.data",),
    "furnace": None,
}


class Kernels:
    """Launched kernels, identified by their hash. `cache_hit` cannot identify new kernels, because `cache_hit` is also
    set for kernels found on the disk.
    """

    def __init__(self) -> None:
        self.known: set[str] = set()

    def new(self, step: Callable[[], Any]) -> list[dict]:
        """Return the kernels of `step` that no earlier step launched."""
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            step()
            dr.sync_thread()
            history = dr.kernel_history((dr.KernelType.JIT,))
        assert history, "no kernel was launched"
        found = [kernel for kernel in history if kernel["hash"] not in self.known]
        self.known |= {kernel["hash"] for kernel in found}
        return found


def steps_compile_nothing(scene: Case, step: Callable[[int], Any]) -> None:
    """Assert that steps 2 to 4 compile nothing. Each step has another seed. From step 3 on, parameter values also
    differ.
    """
    kernels = Kernels()
    scene.set(scene.initial)
    kernels.new(lambda: step(1))
    for seed in (2, 3, 4):
        if seed > 2:
            shift = 1 - 0.02 * seed
            scene.set({key: value * shift for key, value in scene.initial.items()})
        found = kernels.new(lambda: step(seed))  # noqa: B023
        assert not found, f"step {seed} compiled kernels of {[k['operation_count'] for k in found]} operations"


#: The cases of the default suite. Each has objects of a kind that the others do not have.
FEW = ("texture", "passes", "glass", "mask", "envmap", "thin_lens", "principled", "two_emitters")


@taking_turns("name", [case.name for case in CASES], "adjoint", ("independent", "correlated"), FEW)
def test_second_step_compiles_nothing(name: str, adjoint: str):
    """The steps' dL/dI changes with the image."""
    case = next(case for case in CASES if case.name == name)
    scene = Case(case.scene(), case.keys)
    ours = integrator("reslrb", **case.own)

    def loss(image: Any) -> Any:
        return dr.sum(dr.square(image[:, :, :3] - scene.weights), axis=None)

    steps_compile_nothing(scene, lambda seed: scene.gradient(ours, seed, 16, loss, adjoint=adjoint))


@taking_turns("name", list(SHIPPED), "adjoint", ("correlated", "independent"), ("caustic_slab", "furnace"))
def test_second_step_compiles_nothing_on_shipped_scenes(name: str, adjoint: str):
    loaded = load_scene(ROOT / "scenes" / name / "scene.xml", {"resx": 16, "resy": 16, "spp": 4})
    found = list(mi.traverse(loaded).keys())
    keys = SHIPPED[name] or [key for key in found if "reflectance" in key or "radiance" in key][:2]
    assert set(keys) <= set(found), found
    scene = Case(loaded, keys)
    ours = integrator("reslrb", 6, 3)

    def step(seed: int) -> None:
        def loss(image: Any) -> Any:
            return dr.mean(dr.square(image - 0.5), axis=None)

        scene.gradient(ours, seed, 4, loss, adjoint=adjoint)

    steps_compile_nothing(scene, step)


def test_zero_texels_come_and_go():
    """A texel that reaches zero requires new kernels once. The texel requires no new kernels when it leaves zero.

    In a spectral variant, no spectrum of a colour is zero.
    """
    case = next(case for case in CASES if case.name == "texture")
    scene = Case(case.scene(), case.keys)
    ours = integrator("reslrb")
    initial = dict(scene.initial)
    zero = {key: np.where(np.arange(value.size) == 0, 0.0, value) for key, value in initial.items()}

    def step(seed: int, values: dict[str, np.ndarray]) -> None:
        scene.set(values)
        scene.gradient(ours, seed, 16)

    kernels = Kernels()
    kernels.new(lambda: step(1, initial))
    assert bool(kernels.new(lambda: step(2, zero))) != mi.is_spectral
    assert not kernels.new(lambda: step(3, zero))
    assert not kernels.new(lambda: step(4, initial))
    assert not kernels.new(lambda: step(5, zero))
